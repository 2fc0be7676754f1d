"""A vehicle in a process of its own, or on another machine, that a learner trains over UDP: its two ends."""

import json
import select
import socket
import struct
import time
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.common import contract
from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import number_or_nan
from sb3_chac.deploy.address import parse_address, resolve
from sb3_chac.deploy.link import Channel
from sb3_chac.deploy.metadata import NotDeployable

MAGIC = b"SB3R"
HEADER = struct.Struct("!4s16sQBI")  # magic, session of the learner, number of the request, kind, length of the JSON text
SPACES, RESET, STEP = range(3)
LARGEST = 65_000  # [bytes] of a packet
ROUNDING = 1e-4  # that an action may be out of its bounds
RESEND = 0.05  # [s] without an answer after which a request is sent again
MOST_LEARNERS = 8  # whose last answers are kept
PATIENCE = 10.0  # [s] without an answer after which the vehicle is given up


class LateLink(gym.Wrapper):
    """
    The vehicle's end of a bad link, on the environment's own clock: actions come late or never, and sensors are noisy.

    An action that arrives within the first half of a step is executed in it, later ones in the step after. Where none has come
    in time, the last one goes on. It belongs outside of the takeover: a person in the vehicle acts at once.

    :param env: with bounded actions and observations in a Box
    :param latency: [s] least delay of an action
    :param jitter: [s] that the greatest delay is longer
    :param loss: share of the actions that are lost
    :param noise: standard deviation of what is added to observations, in their units; they stay in their space
    :param seed: of the link
    :raises ValueError: for values that are none, or out of their range
    """

    @checked
    def __init__(
        self, env: gym.Env, latency: float = 0.0, jitter: float = 0.0, loss: float = 0.0, noise: float = 0.0, seed: int = 0
    ) -> None:
        super().__init__(env)
        if noise < 0:
            raise NotDeployable(f"noise must be a finite number of at least 0, got {noise!r}.")
        self.rng = np.random.default_rng(seed)
        self.period = 1 / float(env.metadata.get("render_fps") or 10)
        self.settings = latency, jitter, loss
        self.noise = noise
        Channel(self.rng, *self.settings)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.channel, self.steps, self.newest = Channel(self.rng, *self.settings), 0, -1
        space = self.action_space
        assert isinstance(space, spaces.Box)
        self.action = np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        observation, info = self.env.reset(**kwargs)
        return self._sensed(observation), info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        now = self.steps * self.period
        self.channel.put((self.steps, np.array(action)), now)
        for number, arrived in self.channel.ready(now + self.period / 2):
            if number > self.newest:
                self.newest, self.action = number, arrived
        self.steps += 1
        observation, *rest = self.env.step(self.action)
        return self._sensed(observation), *rest  # type: ignore[return-value]

    def _sensed(self, observation: np.ndarray) -> np.ndarray:
        if self.noise == 0:
            return observation
        space = self.observation_space
        assert isinstance(space, spaces.Box)
        noisy = observation + self.rng.normal(0, self.noise, observation.shape)
        return np.clip(noisy, space.low, space.high).astype(space.dtype)


class VehicleServer:
    """
    The vehicle's end: resets and steps an environment as a learner asks. A request that comes twice is answered twice and done
    once.

    :param env: observations and actions are Boxes; takeovers happen in it
    :param sock: bound UDP socket
    :raises NotDeployable: for other spaces
    """

    def __init__(self, env: gym.Env, sock: socket.socket) -> None:
        found = []
        for name in ("observation_space", "action_space"):
            space = getattr(env, name)
            if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
                raise NotDeployable(f"{name} must be a Box of floating point numbers, got {space}.")
            found.append(space)
        if len(json.dumps([*map(space_of, found)])) + 4 * int(np.prod(found[0].shape)) > LARGEST // 2:
            raise NotDeployable(f"observation_space: {env.observation_space} is too large for one packet of {LARGEST} bytes.")
        self.env, self.sock = env, sock
        self.steps = self.episodes = 0
        self._last: dict[bytes, tuple[int, bytes]] = {}  # session -> number and answer of its last request
        self._drives = b""  # session that has reset the vehicle last

    def serve(self, steps: int | None = None) -> None:
        """
        Answer until ``steps`` were made.

        :param steps: of the environment, None to go on for ever
        """
        while steps is None or self.steps < steps:
            self.answer(*self.sock.recvfrom(LARGEST))

    def answer(self, data: bytes, sender: Any) -> None:
        """
        Answer one packet; what is no request is left alone.

        :param data: that came
        :param sender: its address
        """
        try:
            session, number, kind, meta, body = unpack(data)
        except ValueError:
            return
        last_number, last_answer = self._last.get(session, (-1, b""))
        if number <= last_number:
            if number == last_number:
                self.sock.sendto(last_answer, sender)
            return
        try:
            answer = pack(session, number, kind, *self._do(session, kind, meta, body))
            if len(answer) > LARGEST:
                raise ValueError(f"the answer has {len(answer)} bytes, more than {LARGEST} in a packet: info is too long")
        except Exception as error:  # of the environment, the person or the request: the vehicle goes on for the next one
            answer = pack(session, number, kind, {"error": f"{type(error).__name__}: {error}"[:1000]})
        self._last = {**dict(list(self._last.items())[-MOST_LEARNERS:]), session: (number, answer)}
        self.sock.sendto(answer, sender)

    def _do(self, session: bytes, kind: int, meta: dict[str, Any], body: bytes) -> tuple[dict[str, Any], bytes]:
        env = self.env
        if kind == SPACES:
            found = {name: space_of(getattr(env, name)) for name in ("observation_space", "action_space")}
            return {**found, "render_fps": env.metadata.get("render_fps"), "env": env.spec.id if env.spec else str(env)}, b""
        if kind == RESET:
            self._drives = session
            self.episodes += 1
            observation, info = env.reset(seed=meta["seed"], options=meta["options"])
            return {"info": reported(info)}, observation.astype(np.float32).tobytes()
        if session != self._drives:
            raise ValueError(
                "it was started anew, or another learner has reset the vehicle since (it has one at a time: leave out what "
                "evaluates beside the training, rl_zoo3 train: --eval-freq -1); reset() goes on"
            )
        assert isinstance(env.action_space, spaces.Box)
        action = np.frombuffer(body, np.float32).reshape(env.action_space.shape)
        low, high = env.action_space.low, env.action_space.high
        if not np.isfinite(action).all() or np.any((action < low - ROUNDING) | (action > high + ROUNDING)):
            raise ValueError(f"the action is {action}, out of {env.action_space}")
        action = np.clip(action, low, high)
        observation, reward, terminated, truncated, info = env.step(action.astype(env.action_space.dtype))
        self.steps += 1
        ends = {"reward": float(reward), "terminated": bool(terminated), "truncated": bool(truncated)}
        return {**ends, "info": reported(info)}, observation.astype(np.float32).tobytes()


class RemoteVehicle(gym.Env):
    """
    The learner's end: an environment whose steps a vehicle makes ('sb3-chac vehicle'), as ``RemoteVehicle-v0``.

    Takeovers happen in the vehicle, and come in ``info`` as HIL-SERL's do: ``intervene_action`` is what the person did, None
    else, and ``is_intervention`` tells. Lost packets are sent again, so that no step is made twice or lost; how late and noisy
    the vehicle's own link is, it says itself (``LateLink``).

    :param address: HOST:PORT of the vehicle
    :param patience: [s] without an answer after which the vehicle is given up
    :raises ValueError: for arguments that are none
    :raises NotDeployable: for an address that cannot be used, or if no vehicle answers
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    @checked
    def __init__(self, address: str = "127.0.0.1:5700", patience: float = PATIENCE) -> None:
        host, port = parse_address("address", address, low=1)
        if patience <= 0:
            raise NotDeployable(f"patience must be a finite number of seconds above 0, got {patience!r}.")
        self.address, self.patience = (host, port), patience
        place = resolve("address", host), port
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.sock.connect(place)
        except OSError as error:
            self.sock.close()
            raise NotDeployable(f"address: {address} cannot be reached ({error.strerror}): give another.") from error
        self.sock.setblocking(False)
        self.session, self.number = np.random.default_rng().bytes(16), 0
        try:
            meta, _ = self._ask(SPACES, {})
        except NotDeployable:
            self.sock.close()
            raise
        self.observation_space, self.action_space = (
            spaces.Box(np.float32(low), np.float32(high), tuple(shape), np.float32)
            for low, high, shape in (meta["observation_space"], meta["action_space"])
        )
        self.metadata = {**self.metadata, "render_fps": meta["render_fps"], "vehicle": meta["env"]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        meta, body = self._ask(RESET, {"seed": seed, "options": options})
        return self._observation(body), meta["info"]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        meta, body = self._ask(STEP, {}, np.asarray(action, np.float32).tobytes())
        return self._observation(body), meta["reward"], meta["terminated"], meta["truncated"], meta["info"]

    def _observation(self, body: bytes) -> np.ndarray:
        return np.frombuffer(body, np.float32).reshape(self.observation_space.shape or ()).copy()

    def _ask(self, kind: int, meta: dict[str, Any], body: bytes = b"") -> tuple[dict[str, Any], bytes]:
        """
        Send a request until it is answered.

        :raises NotDeployable: if nobody answers, the vehicle says that it cannot, or the request is too long for a packet
        """
        self.number += 1
        request = pack(self.session, self.number, kind, meta, body)
        if len(request) > LARGEST:
            raise NotDeployable(
                f"options: the request has {len(request)} bytes, more than {LARGEST} in a packet: shorten them."
            )
        end = time.monotonic() + self.patience
        while time.monotonic() < end:
            try:
                self.sock.send(request)
                while select.select([self.sock], [], [], RESEND)[0]:
                    session, number, _, answer, rest = unpack(self.sock.recv(LARGEST))
                    if (session, number) != (self.session, self.number):
                        continue
                    if "error" in answer:
                        raise NotDeployable(f"the vehicle at {self.address[0]}:{self.address[1]} refuses: {answer['error']}")
                    return answer, rest
            except OSError:  # nobody listens there yet, or there is no way there at the moment
                time.sleep(RESEND)
            except ValueError as error:
                if isinstance(error, NotDeployable):
                    raise
        host, port = self.address
        raise NotDeployable(
            f"no vehicle answers at {host}:{port} for {self.patience:g} s: start one, 'sb3-chac vehicle --listen HOST:PORT'."
        )

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()


def pack(session: bytes, number: int, kind: int, meta: dict[str, Any], body: bytes = b"") -> bytes:
    """
    Make a packet.

    :param session: 16 bytes, of the learner
    :param number: of the request
    :param kind: SPACES, RESET or STEP
    :param meta: what JSON can hold
    :param body: numbers, float32
    """
    text = json.dumps(meta).encode()  # NaN and infinite included: the learner judges them
    return HEADER.pack(MAGIC, session, number, kind, len(text)) + text + body


def unpack(data: bytes) -> tuple[bytes, int, int, dict[str, Any], bytes]:
    """
    Read a packet.

    :return: session, number, kind, meta and body, see ``pack``
    :raises ValueError: if it is none
    """
    if len(data) < HEADER.size:
        raise ValueError("too short")
    magic, session, number, kind, length = HEADER.unpack_from(data)
    if magic != MAGIC or kind not in (SPACES, RESET, STEP):
        raise ValueError("not a packet of ours")
    try:
        meta = json.loads(data[HEADER.size : HEADER.size + length])
    except RecursionError as error:
        raise ValueError("not a packet of ours") from error
    if not isinstance(meta, dict):
        raise ValueError("not a packet of ours")
    return session, number, kind, meta, data[HEADER.size + length :]


def space_of(space: spaces.Box) -> tuple[float | list[Any], float | list[Any], list[int]]:
    """
    Describe a space for the link.

    :return: low and high, each a number if all are equal, and the shape
    """
    bounds = [b.flat[0].item() if np.all(b == b.flat[0]) else b.tolist() for b in (space.low, space.high)]
    return *bounds, list(space.shape)  # type: ignore[return-value]


def reported(info: dict[str, Any]) -> dict[str, Any]:
    """
    Choose what a vehicle reports of ``info``.

    :param info: of an environment in an ``InterventionWrapper``, or without one
    :return: its numbers and texts, and the takeover as other projects report theirs
    """
    found: dict[str, Any] = {}
    for key, value in info.items():
        if key in ("cost", "takeover_cost") and value is not None:
            value = number_or_nan(value)  # what is none is told, too: the learner refuses it
        elif isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.size == 1):
            value = value.item()
        elif isinstance(value, np.ndarray) and key in (*contract.REPORTED_ACTIONS, *contract.FLAGS):
            value = value.tolist()
        if isinstance(value, bool | int | float | str) or key in (*contract.REPORTED_ACTIONS, *contract.FLAGS):
            found[key] = value
    if contract.TAKEOVER in info:
        takeover = bool(found.pop(contract.TAKEOVER))
        found.pop(contract.TAKEOVER_START, None)
        action = np.asarray(info[contract.APPLIED_ACTION], float).tolist() if takeover else None
        found |= {"is_intervention": takeover, "intervene_action": action}
    return found
