"""One replay buffer with two stores: what the novice drove, and what the human drove."""

from collections import defaultdict, deque
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_integer, check_range, number_in
from sb3_chac.common.contract import NOVICE_ACTION, TAKEOVER, TAKEOVER_START

Observation = np.ndarray | dict[str, np.ndarray]
# Columns of a store with one number a row
SCALARS = ("reward", "discount", "done", "takeover", "takeover_start", "cost", "takeover_follows")


class DualReplayBufferSamples(NamedTuple):
    """A batch; novice rows come first. All but the observations have the shape (batch_size, 1) or (batch_size, action_dim)."""

    observations: th.Tensor | TensorDict
    actions: th.Tensor  # a_b, executed
    next_observations: th.Tensor | TensorDict
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None  # None if they are gamma for all
    novice_actions: th.Tensor  # a_n, what the novice would have done
    takeovers: th.Tensor  # I, 1 where the human drove
    takeover_starts: th.Tensor  # 1 on the first step of a takeover
    costs: th.Tensor  # safety costs, summed up as the rewards are
    takeovers_follow: th.Tensor  # 1 where the human took over in the next step; returns that were complete by then have 0


def take_rows(observations: th.Tensor | TensorDict, rows: th.Tensor) -> Any:
    """
    Select rows of a batch of observations.

    :param observations: batch of observations, possibly a dictionary
    :param rows: indices
    """
    if isinstance(observations, dict):
        return {key: value[rows] for key, value in observations.items()}
    return observations[rows]


class TakenOver(NamedTuple):
    """Rows of a batch that the human drove, n of them."""

    rows: th.Tensor  # (n,)
    observations: th.Tensor | TensorDict
    novice_actions: th.Tensor  # (n, action_dim)
    differ: th.Tensor  # (n,) whether the human's action is far enough from the novice's to be told from it


def taken_over(batch: DualReplayBufferSamples, min_diff: float) -> TakenOver:
    """
    Find what the human drove in a batch.

    :param batch: of transitions
    :param min_diff: least root mean square of the difference between two actions that are told apart
    """
    rows = batch.takeovers.flatten().nonzero().flatten()
    novice_actions = batch.novice_actions[rows]
    differ = (batch.actions[rows] - novice_actions).square().mean(dim=1).sqrt() >= min_diff
    return TakenOver(rows, take_rows(batch.observations, rows), novice_actions, differ)


class TransitionStore:
    """
    A ring of transitions, one row per step and environment. Memory is taken as it fills, pickles hold the filled rows only.

    :param capacity: greatest number of rows; then the oldest is overwritten
    :param columns: shape and dtype of one entry, by name
    """

    def __init__(self, capacity: int, columns: dict[str, tuple[tuple[int, ...], Any]]):
        self.capacity, self.columns = capacity, columns
        self.added = 0
        self.arrays = self._allocate()

    def _allocate(self) -> dict[str, np.ndarray]:
        # The operating system hands out pages of zeros when they are first written to
        return {name: np.zeros((self.capacity, *shape), dtype) for name, (shape, dtype) in self.columns.items()}

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def append(self, row: dict[str, Any]) -> None:
        """
        Store one transition.

        :param row: an entry for each column
        """
        for name, array in self.arrays.items():
            array[self.added % self.capacity] = row[name]
        self.added += 1

    def replace(self, number: int, name: str, value: float) -> None:
        """
        Change an entry of a row that was appended as the ``number``-th, unless it has been overwritten since.

        :param number: from 0
        :param name: of the column
        """
        if number >= self.added - self.capacity:
            self.arrays[name][number % self.capacity] = value

    def sample(self, n_rows: int, n_early: int = 0, before: int = 0) -> dict[str, np.ndarray]:
        """
        Sample transitions.

        :param n_early: rows that are drawn from those that were appended before the ``before``-th, as long as there are any
        :return: rows drawn with replacement, an array of shape (n_rows, ...) per column
        """
        first = max(0, self.added - self.capacity)  # number of the oldest row
        early = range(first, before if n_early else first)
        n_early = n_early if early else 0
        rows = np.random.randint(0, len(self), size=n_rows - n_early)
        if early:
            rows = np.concatenate([np.random.randint(early.start, early.stop, size=n_early) % self.capacity, rows])
        return {name: array[rows] for name, array in self.arrays.items()}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "arrays": {name: array[: len(self)] for name, array in self.arrays.items()}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        filled, self.arrays = self.arrays, self._allocate()
        for name, array in filled.items():
            self.arrays[name][: len(array)] = array

    def complete(self, columns: dict[str, tuple[tuple[int, ...], Any]]) -> None:
        """
        Add the columns that are missing in a store of an older version, with zeros.

        :param columns: see the constructor
        """
        for name, (shape, dtype) in columns.items():
            if name not in self.columns:
                self.columns = {**self.columns, name: (shape, dtype)}
                self.arrays[name] = np.zeros((self.capacity, *shape), dtype)


class DualReplayBuffer(ReplayBuffer):
    """
    Buffer with two stores: ``human`` (B_h) for what the human drove, ``novice`` (B_g) for the rest. Batches take from both.

    Each row holds its next observation, as the following row belongs to another time when two stores are fed in turns. Rows of
    several environments stand in one ring. With ``n_steps`` above 1 the return of a row ends early where the human takes over
    or hands back, so that it belongs to one driver.

    :param buffer_size: capacity of each store, in transitions (of all environments)
    :param observation_space: Observation space, Dict included
    :param action_space: Action space
    :param device: PyTorch device
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: not supported, must be False
    :param handle_timeout_termination: whether returns go on beyond time limits
    :param n_steps: number of rewards in a return
    :param gamma: the discount factor
    :raises ValueError: for an argument that does not fit
    """

    @checked
    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
    ):
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        if optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage must be False: the dual replay buffer stores next observations explicitly."
            )
        check_integer("buffer_size", buffer_size, low=1)
        check_integer("n_steps", n_steps, low=1)
        check_range("gamma", gamma, low=0.0, high=1.0)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps, self.gamma = n_steps, gamma
        spaces_by_key = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        shapes = self.obs_shape if isinstance(self.obs_shape, dict) else {"": self.obs_shape}
        columns: dict[str, tuple[tuple[int, ...], Any]] = {
            f"{kind}/{key}": (shapes[key], space.dtype)
            for kind in ("observation", "next_observation")
            for key, space in spaces_by_key.items()
        }
        columns |= {name: ((self.action_dim,), np.float32) for name in ("action", "novice_action")}
        columns |= {name: ((1,), np.float32) for name in SCALARS}
        self.novice = TransitionStore(buffer_size, columns)
        self.human = TransitionStore(buffer_size, columns)
        # Transitions of each environment whose return is not complete yet
        self.pending: defaultdict[int, deque[dict[str, Any]]] = defaultdict(deque)
        # Number of the novice's row that each environment stored last, in this episode
        self.last_novice_row: dict[int, int] = {}
        self.n_guided = 0  # rows of the novice that were appended while the human was there

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for store in (self.novice, self.human):
            store.complete(dict.fromkeys(SCALARS, ((1,), np.float32)))
        self.last_novice_row = state.get("last_novice_row", {})
        self.n_guided = state.get("n_guided", 0)
        for row in chain.from_iterable(self.pending.values()):
            row |= {name: np.zeros(1, np.float32) for name in SCALARS if name not in row}

    def size(self) -> int:
        """Count the transitions of both stores."""
        return len(self.novice) + len(self.human)

    def reset(self) -> None:
        self.novice.added = self.human.added = 0
        self.pending.clear()
        self.last_novice_row.clear()
        self.n_guided = 0

    def end_guidance(self) -> None:
        """Note that the human is not there any more, see ``guided_share`` of ``sample``."""
        self.n_guided = self.novice.added

    def add(
        self,
        obs: Observation,
        next_obs: Observation,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one step of all environments.

        :param obs: shape (n_envs, ...), or a dictionary of such arrays, as ``next_obs``
        :param action: a_b, executed, scaled to [-1, 1], shape (n_envs, action_dim)
        :param reward: shape (n_envs,), as ``done``
        :param infos: "takeover", "takeover_start", "cost" and "novice_action" (a_n, scaled; ``action`` if it is not there)
            are used
        """
        for idx, info in enumerate(infos):
            is_timeout = self.handle_timeout_termination and info.get("TimeLimit.truncated", False)
            row: dict[str, Any] = {
                **self._entries("observation", obs, idx),
                **self._entries("next_observation", next_obs, idx),
                "action": np.ravel(action[idx]),
                "novice_action": np.ravel(info.get(NOVICE_ACTION, action[idx])),
                "reward": reward[idx],
                "discount": self.gamma,
                "done": done[idx] and not is_timeout,
                "takeover": bool(info.get(TAKEOVER, False)),
                "takeover_start": bool(info.get(TAKEOVER_START, False)),
                "cost": number_in(info, "cost", idx) or 0.0,  # None: not measured
                "takeover_follows": 0.0,
            }
            if row["takeover_start"]:
                self._mark_step_before(idx)
            if self.n_steps == 1:
                self._append(row)
                self.last_novice_row.pop(idx, None)
                if not (row["takeover"] or done[idx]):
                    self.last_novice_row[idx] = self.novice.added - 1
                continue
            pending = self.pending[idx]
            if pending and pending[-1]["takeover"] != row["takeover"]:
                self._flush(pending)
            pending.append({name: np.array(value) for name, value in row.items()})
            if done[idx]:
                self._flush(pending)
            elif len(pending) == self.n_steps:
                self._append_return(pending)

    def _mark_step_before(self, idx: int) -> None:
        """Note that the human took over after the novice's last step in an environment."""
        if self.pending[idx]:
            self.pending[idx][-1]["takeover_follows"] = np.array(1.0)
        elif idx in self.last_novice_row:
            self.novice.replace(self.last_novice_row[idx], "takeover_follows", 1.0)

    @staticmethod
    def _entries(kind: str, obs: Observation, idx: int) -> dict[str, np.ndarray]:
        return {f"{kind}/{key}": value[idx] for key, value in (obs if isinstance(obs, dict) else {"": obs}).items()}

    def _append(self, row: dict[str, Any]) -> None:
        (self.human if row["takeover"] else self.novice).append(row)

    def _append_return(self, pending: deque[dict[str, Any]]) -> None:
        """Complete the oldest transition: rewards up to the last one, then its next observation."""
        ends = {name: value for name, value in pending[-1].items() if name == "done" or name.startswith("next_observation/")}
        sums = {
            name: sum(self.gamma**k * row[name] for k, row in enumerate(pending))
            for name in ("reward", "cost", "takeover_follows")
        }
        self._append(pending.popleft() | ends | sums | {"discount": self.gamma ** (len(pending) + 1)})

    def _flush(self, pending: deque[dict[str, Any]]) -> None:
        while pending:
            self._append_return(pending)

    def end_trajectories(self) -> None:
        """Complete all returns with what is there, for when the environments are about to be reset."""
        for pending in self.pending.values():
            self._flush(pending)

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None, human_share: float = 0.5, guided_share: float = 0.0
    ) -> DualReplayBufferSamples:
        """
        Sample a batch from both stores.

        :param batch_size: number of transitions, novice rows first
        :param env: to normalize observations and rewards with
        :param human_share: share of the human's rows. As long as a store holds fewer rows than its part of the batch, all are
            taken from the other one
        :param guided_share: share of those rows of the novice that were stored before ``end_guidance``
        :raises ValueError: if the buffer is empty
        """
        if self.size() == 0:  # better short returns than none
            self.end_trajectories()
        n_human = round(human_share * batch_size)
        if len(self.human) < n_human:
            n_human = 0
        elif len(self.novice) < batch_size - n_human:
            n_human = batch_size
        n_novice = batch_size - n_human
        parts = []
        if n_novice and len(self.novice):
            parts.append(self.novice.sample(n_novice, min(n_novice, round(guided_share * batch_size)), self.n_guided))
        if n_human and len(self.human):
            parts.append(self.human.sample(n_human))
        if not parts:  # one store was short, the other is empty
            parts = [store.sample(batch_size) for store in (self.novice, self.human) if len(store)]
        if not parts:
            raise ValueError("The replay buffer is empty: collect transitions before sampling.")
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if len(parts) > 1 else parts[0]
        to_torch = {name: self.to_torch(columns[name], copy=False) for name in columns if "observation" not in name}
        return DualReplayBufferSamples(
            self._observations("observation", columns, env),
            to_torch["action"],
            self._observations("next_observation", columns, env),
            to_torch["done"],
            self.to_torch(self._normalize_reward(columns["reward"], env), copy=False),
            to_torch["discount"] if self.n_steps > 1 else None,
            to_torch["novice_action"],
            to_torch["takeover"],
            to_torch["takeover_start"],
            to_torch["cost"],
            to_torch["takeover_follows"],
        )

    def _observations(self, kind: str, columns: dict[str, np.ndarray], env: VecNormalize | None) -> Any:
        entries = {name.partition("/")[2]: array for name, array in columns.items() if name.startswith(f"{kind}/")}
        if not isinstance(self.observation_space, spaces.Dict):
            return self.to_torch(self._normalize_obs(entries[""], env), copy=False)  # type: ignore[arg-type]
        normalized: Any = self._normalize_obs(entries, env)
        return {key: self.to_torch(array, copy=False) for key, array in normalized.items()}
