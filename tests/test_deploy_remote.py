"""A learner and a vehicle in two processes: nothing is lost or done twice, whatever the link does."""

import socket
import subprocess
import sys
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from shell import FOREVER, wait_until
from stable_baselines3.common.env_checker import check_env

from sb3_chac import DPVP, InterventionWrapper
from sb3_chac.deploy.metadata import NotDeployable
from sb3_chac.deploy.remote import HEADER, LateLink, RemoteVehicle, VehicleServer, pack, unpack


class Cart(gym.Env):
    """The position is the sum of the actions; an episode has 20 steps. It notes every action."""

    observation_space = spaces.Box(-100.0, 100.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    metadata = {"render_fps": 10}  # noqa: RUF012

    def __init__(self):
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and "place" not in options:
            raise ValueError("options: only place is known")
        self.position, self.steps = np.zeros(2, np.float32), 0
        return self.look(), {"scenario": np.int64(3), "array": np.zeros(2)}

    def look(self):
        return np.append(self.position, self.steps).astype(np.float32)

    def step(self, action):
        self.actions.append(np.array(action))
        self.position = self.position + action
        self.steps += 1
        return self.look(), float(action[0]), False, self.steps == 20, {"cost": np.float64(0.5), "nan": np.nan}


class Lossy:
    """A socket that loses packets, sends them twice, and now and then sends what is no packet."""

    def __init__(self, sock, seed):
        self.sock, self.rng = sock, np.random.default_rng(seed)

    def sendto(self, data, address):
        luck = self.rng.random()
        for _ in range(0 if luck < 0.2 else 2 if luck < 0.4 else 1):
            self.sock.sendto(data, address)
        if luck > 0.8:
            self.sock.sendto(self.rng.bytes(int(luck * 60)), address)

    def recvfrom(self, size):
        while True:
            data, sender = self.sock.recvfrom(size)
            if self.rng.random() > 0.2:
                return data, sender


@pytest.fixture(autouse=True)
def no_haste(monkeypatch):
    """No vehicle is given up because the machine is slow, unless a test says after how many seconds."""
    constructor = RemoteVehicle.__init__.__wrapped__
    monkeypatch.setattr(constructor, "__defaults__", (*constructor.__defaults__[:-1], FOREVER))


@pytest.fixture
def vehicle(request):
    """Makes a vehicle of an environment that drives in a thread; returns its server and address."""
    threads = []

    def make(env, lossy=False):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind(("127.0.0.1", 0))
        server = VehicleServer(env, Lossy(sock, 0) if lossy else sock)
        ended = threading.Event()

        def serve():
            while not ended.is_set():
                server.answer(*server.sock.recvfrom(65_000))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        threads.append(ended)
        return server, ":".join(map(str, sock.getsockname()))

    yield make
    for ended in threads:
        ended.set()


def test_it_is_an_environment_like_that_of_the_vehicle(vehicle):
    _, address = vehicle(Cart())
    env = gym.make("RemoteVehicle-v0", address=address)
    check_env(env.unwrapped)
    assert env.observation_space == Cart.observation_space and env.action_space == Cart.action_space
    observation, info = env.reset(seed=1)
    assert info == {"scenario": 3} and observation.tolist() == [0, 0, 0]
    observation, reward, terminated, truncated, info = env.step(np.array([0.5, -0.25], np.float32))
    assert observation.tolist() == [0.5, -0.25, 1] and reward == 0.5 and not terminated and not truncated
    assert info["cost"] == 0.5 and np.isnan(info["nan"])
    env.close()


def test_lost_and_doubled_packets_lose_and_double_no_step(vehicle):
    cart = Cart()
    server, address = vehicle(cart, lossy=True)
    env = RemoteVehicle(address)
    sent = []
    for _ in range(3):
        env.reset()
        for _ in range(20):
            sent.append(np.random.default_rng(len(sent)).uniform(-1, 1, 2).astype(np.float32))
            observation, *_ = env.step(sent[-1])
    np.testing.assert_array_equal(cart.actions, sent)
    np.testing.assert_allclose(observation[:2], np.sum(sent[-20:], axis=0), rtol=1e-5)
    assert server.steps == 60 and server.episodes == 3
    env.close()


def test_who_takes_over_in_the_vehicle_is_counted_by_the_learner(vehicle):
    human = np.array([-0.5, 0.5], np.float32)
    watched = InterventionWrapper(Cart(), lambda _: human, lambda observation, *_: observation[2] % 4 == 1, armed=True)
    _, address = vehicle(LateLink(watched))
    model = DPVP("MlpPolicy", RemoteVehicle(address), learning_starts=30, policy_kwargs=dict(net_arch=[8]), seed=0)
    model.learn(40)
    assert model.counts["human_steps"] == 10 and model.counts["total_steps"] == 40
    stored = model.replay_buffer.human.arrays["action"][:10].reshape(10, 2)
    np.testing.assert_allclose(stored, np.tile(human, (10, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "executed"),
    [
        ({}, [1, 2, 3, 4]),
        ({"latency": 0.04}, [1, 2, 3, 4]),
        ({"latency": 0.1}, [0, 1, 2, 3]),
        ({"latency": 0.24}, [0, 0, 1, 2]),
        ({"loss": 1.0}, [0, 0, 0, 0]),
    ],
)
def test_late_actions(settings, executed):
    cart = Cart()
    env = LateLink(cart, **settings)
    env.reset()
    for number in (1, 2, 3, 4):
        env.step(np.full(2, number / 10, np.float32))
    np.testing.assert_allclose(np.array(cart.actions)[:, 0], np.array(executed) / 10, atol=1e-6)


def test_an_action_that_was_overtaken_is_not_executed():
    cart = Cart()
    env = LateLink(cart, latency=0.0, jitter=0.5, seed=3)
    env.reset()
    for number in range(1, 19):
        env.step(np.full(2, number / 20, np.float32))
    executed = np.array(cart.actions)[:, 0]
    assert (np.diff(executed) >= 0).all() and len(set(executed.tolist())) < 18


def test_noise_stays_in_the_space():
    env = LateLink(Cart(), noise=60.0, seed=0)
    seen = np.array([env.reset()[0] for _ in range(200)])
    assert seen.std() > 30 and all(env.observation_space.contains(row) for row in seen)
    for noise in (float("nan"), "loud", 1j):
        with pytest.raises(ValueError, match=r"^noise must be a finite number"):
            LateLink(Cart(), noise=noise)
    with pytest.raises(NotDeployable, match=r"^noise must be a finite number of at least 0"):
        LateLink(Cart(), noise=-1.0)
    with pytest.raises(NotDeployable, match="loss"):
        LateLink(Cart(), loss=1.5)


def test_nobody_answers():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(NotDeployable, match=rf"no vehicle answers at {address}.*sb3-chac vehicle"):
            RemoteVehicle(address, patience=0.2)


@pytest.mark.parametrize(
    "wrong", ["nowhere", "127.0.0.1:0", "127.0.0.1:port", "127.0.0.1:65536", ":5700", "127.0.0.1:²", "a:" + "9" * 5000]
)
def test_an_address_that_is_none(wrong):
    with pytest.raises(
        NotDeployable, match=r"^address must be HOST:PORT with a port from 1 to 65535, such as 127.0.0.1:5600, got"
    ):
        RemoteVehicle(wrong)


@pytest.mark.parametrize("host", ["nohost.invalid", "a..b", "x" * 300, "256.0.0.1", "no\0host", "::1"])
def test_a_host_that_is_not_known(host):
    with pytest.raises(NotDeployable, match=r"^address: no host .*: mend the name, or give its IPv4 address"):
        RemoteVehicle(f"{host}:5700")


@pytest.mark.parametrize("patience", [0, -1.0, float("nan"), "long", None, 1j])
def test_patience_is_a_time(patience):
    with pytest.raises(ValueError, match=r"^patience must be a finite number"):
        RemoteVehicle("127.0.0.1:5700", patience)


def test_a_request_that_fits_no_packet_names_the_options(vehicle):
    env = RemoteVehicle(vehicle(Cart())[1])
    with pytest.raises(NotDeployable, match=r"^options: the request has .* bytes, more than 65000"):
        env.reset(options={"text": "x" * 70_000})
    env.reset()


def test_what_the_vehicle_refuses_is_said_and_changes_nothing(vehicle):
    cart = Cart()
    _, address = vehicle(cart)
    env = RemoteVehicle(address)
    env.reset()
    with pytest.raises(NotDeployable, match="refuses: ValueError: options: only place is known"):
        env.reset(options={"nonsense": 1})
    with pytest.raises(NotDeployable, match="refuses: ValueError: the action is"):
        env.step(np.array([np.nan, 0.0], np.float32))
    with pytest.raises(NotDeployable, match="refuses"):
        env.step(np.zeros(5, np.float32))
    assert not cart.actions
    env.step(np.zeros(2, np.float32))
    env.close()


def test_a_vehicle_has_one_learner_at_a_time(vehicle):
    cart = Cart()
    _, address = vehicle(cart)
    first, second = RemoteVehicle(address), RemoteVehicle(address)
    with pytest.raises(NotDeployable, match="another learner"):
        first.step(np.zeros(2, np.float32))
    first.reset()
    first.step(np.zeros(2, np.float32))
    second.reset()
    with pytest.raises(NotDeployable, match=r"another learner has reset the vehicle.*--eval-freq -1"):
        first.step(np.zeros(2, np.float32))
    assert len(cart.actions) == 1
    second.step(np.zeros(2, np.float32))
    first.close()
    second.close()


def test_packets_of_others_are_left_alone():
    answers = []

    class Silent:
        def sendto(self, data, address):
            answers.append(data)

    server = VehicleServer(Cart(), Silent())
    whole = pack(bytes(16), 1, 0, {})
    rng = np.random.default_rng(0)
    deep = b"[" * 60_000
    deep = HEADER.pack(b"SB3R", bytes(16), 1, 0, len(deep)) + deep
    for data in [b"", b"x", deep, whole[:30], whole[:-1], b"SB3X" + whole[4:], *(rng.bytes(n) for n in range(1, 90))]:
        server.answer(data, ("x", 1))
    assert not answers
    server.answer(whole, ("x", 1))
    assert unpack(answers[0])[3]["env"]


def test_the_command_is_a_vehicle(tmp_path):
    ready = tmp_path / "address"
    command = [sys.executable, "-m", "sb3_chac", "vehicle", "--listen", "127.0.0.1:0", "--steps", "30", "--ready", str(ready)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    # It is there as a whole or not at all
    wait_until(lambda: ready.is_file() or process.poll() is not None, pause=0.05)
    assert process.poll() is None
    env = gym.make("RemoteVehicle-v0", address=ready.read_text())
    assert env.observation_space.shape == (306,)
    env.reset(seed=0, options={"scenario": 2})
    infos = [env.step(np.array([0.0, 1.0], np.float32))[4] for _ in range(30)]
    assert {info["is_intervention"] for info in infos} <= {True, False} and infos[-1]["scenario"] == 2
    assert "30 steps in 1 episodes" in process.communicate(timeout=FOREVER)[0]
    assert process.returncode == 0
    env.close()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--listen", "here"], "--listen"),
        (["--listen", "127.0.0.1:65536"], "--listen must be HOST:PORT"),
        (["--listen", "nohost.invalid:1"], "--listen: no host 'nohost.invalid'"),
        (["--listen", "203.0.113.1:5700"], "--listen: cannot listen at 203.0.113.1:5700"),
        (["--ready", "nowhere/address"], "--ready nowhere/address"),
        (["--loss", "2"], "loss"),
        (["--noise", "-1"], "noise"),
        (["--env", "Nowhere-v0"], "Nowhere-v0"),
        (["--steps", "0"], "--steps"),
        (["--expert", "nobody"], "nobody"),
        (["--env", "CartPole-v1", "--expert", "scripted"], "CartPole|Discrete|scripted"),
    ],
)
def test_bad_command_lines(arguments, named, capsys):
    from sb3_chac.cli.vehicle import main

    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err.strip()
    assert ended.value.code == 2 and "\n" not in error
    assert any(name in error for name in named.split("|")), error


class Odd(Cart):
    """Fails in the third step, or reports what is odd."""

    def __init__(self, info=None, error=None):
        super().__init__()
        self.info, self.error = info or {}, error

    def step(self, action):
        if self.error is not None and self.steps == 2:
            raise self.error
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, dict(self.info)


@pytest.mark.parametrize("error", [RuntimeError("broken"), IndexError("broken"), OSError("broken"), AssertionError("broken")])
def test_a_vehicle_that_fails_says_so_and_goes_on(vehicle, error):
    _, address = vehicle(Odd(error=error))
    env = RemoteVehicle(address)
    for _ in range(2):
        env.reset()
        env.step(np.zeros(2, np.float32))
        env.step(np.zeros(2, np.float32))
        with pytest.raises(NotDeployable, match=f"refuses: {type(error).__name__}: broken"):
            env.step(np.zeros(2, np.float32))
    env.close()


@pytest.mark.parametrize(
    ("info", "learner"),
    [
        ({"cost": np.array([0.5])}, {"cost": 0.5}),
        ({"cost": np.float32(2)}, {"cost": 2.0}),
        ({"intervene_action": np.array([0.5, 0.0])}, {"intervene_action": [0.5, 0.0]}),
        (
            {"intervene_action": None, "is_intervention": np.array([False])},
            {"intervene_action": None, "is_intervention": False},
        ),
    ],
)
def test_what_a_vehicle_reports_arrives(vehicle, info, learner):
    _, address = vehicle(Odd(info))
    env = RemoteVehicle(address)
    env.reset()
    assert env.step(np.zeros(2, np.float32))[4] == learner
    env.close()


@pytest.mark.parametrize("cost", [float("nan"), 1j, np.array([1j]), "0.5", [0.1, 0.2]], ids=repr)
def test_a_cost_that_is_no_number_is_not_dropped(vehicle, cost):
    _, address = vehicle(Odd({"cost": cost}))
    model = DPVP("MlpPolicy", RemoteVehicle(address), learning_starts=5, policy_kwargs=dict(net_arch=[8]), seed=0)
    with pytest.raises(ValueError, match=r"info\['cost'\]"):
        model.learn(10)


def test_spaces_of_a_vehicle(vehicle):
    class Wide(Cart):
        observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)

    _, address = vehicle(Wide())
    assert RemoteVehicle(address).observation_space == Wide.observation_space
    for name, space in [
        ("observation_space", spaces.Box(0, 255, (84, 84, 3), np.uint8)),
        ("observation_space", spaces.Box(-1.0, 1.0, (20_000,), np.float32)),
        ("action_space", spaces.Box(0, 10, (2,), np.int64)),
        ("action_space", spaces.Discrete(2)),
    ]:
        cart = Cart()
        setattr(cart, name, space)
        with pytest.raises(NotDeployable, match=name):
            VehicleServer(cart, None)


def test_actions_stay_in_their_bounds(vehicle):
    cart = Cart()
    cart.action_space = spaces.Box(0.5, 1.0, (2,), np.float32)
    late = LateLink(cart, latency=0.3)
    late.reset()
    late.step(np.full(2, 0.75, np.float32))
    np.testing.assert_allclose(cart.actions, [[0.5, 0.5]])
    _, address = vehicle(cart)
    env = RemoteVehicle(address)
    env.reset()
    with pytest.raises(NotDeployable, match="out of Box"):
        env.step(np.array([1e9, 0.75], np.float32))
    env.close()
