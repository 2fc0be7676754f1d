"""Base class for algorithms that learn from takeovers: asking the human, storing who drove, counting."""

import warnings
from collections import deque
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common import contract
from sb3_chac.common.buffers import DualReplayBuffer
from sb3_chac.common.checks import check_action_space, check_policy, happened_in, number_in
from sb3_chac.common.costs import EpisodeCosts, record_costs
from sb3_chac.common.demonstrations import Dataset, load_demonstrations
from sb3_chac.common.off_policy_algorithm import CheckedOffPolicyAlgorithm

SelfGuided = TypeVar("SelfGuided", bound="GuidedOffPolicyAlgorithm")

# Counted from the start of the training, saved with the model and shown in the logger
COUNTS = (
    "total_steps",
    "human_steps",
    "takeovers",
    "takeover_cost",
    "safety_cost",
    "safety_cost_human",
    "collisions",
    "departures",
)
# Count -> keys of ``info`` that measure it, the first that is there counts. highway-env's ``crashed`` stays until the end
EVENTS = {"collisions": ("collision", "crashed"), "departures": ("out_of_road",)}
LASTING = ("crashed",)
WRAPPER_COUNTS = ("human_steps", "total_steps")  # of the InterventionWrapper, in ``info``
STATE_OF_ENVS = ("_wrapped", "_budget", "_events_last", "_human_was_seen")


class GuidedOffPolicyAlgorithm(CheckedOffPolicyAlgorithm):
    """
    Base of the algorithms in whose training environments a human takes over.

    While it learns, the ``InterventionWrapper`` of each training environment is armed, for the steps that are stored and for
    no others: the human never drives an evaluation, also in the training environment; after one, new episodes are begun. What
    the human drove is stored apart (``DualReplayBuffer``), with the action that was executed and the one that the novice
    proposed. Environments that do the takeovers themselves may report them in ``info``, see ``contract.read_report``.
    """

    required_buffer = DualReplayBuffer
    replay_buffer: DualReplayBuffer

    def _setup_model(self) -> None:
        check_policy(type(self), self.policy_class, self.required_policy)
        if self.replay_buffer_class is None:
            self.replay_buffer_class = DualReplayBuffer
        if not issubclass(self.replay_buffer_class, DualReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must derive from DualReplayBuffer, got {self.replay_buffer_class.__name__}: "
                f"{type(self).__name__} keeps what the human drove apart. Leave it out to get the default."
            )
        if self.n_steps > 1:
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_steps": self.n_steps, "gamma": self.gamma}
        if not hasattr(self, "counts"):  # else it was loaded
            self.counts = dict.fromkeys(COUNTS, 0.0)
            self.wrapper_states: list[dict[str, int]] = []
        if not hasattr(self, "measured"):
            self.measured: set[str] = set()  # what is logged of ``counts`` besides the takeovers
        self._wrapped: list[int] = []  # indices of the environments in which the human is asked
        self._budget: int | None = None
        self._forget_episodes()
        self.ep_cost_buffer: deque[float] = deque(maxlen=self._stats_window_size)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`n_steps=")  # the dual buffer gets it, just above
            super()._setup_model()

    def store_demonstrations(self, dataset: Dataset) -> None:
        """
        Put a dataset into the replay buffer, as if it had been driven: what the human drove (all of it, if the dataset does
        not say who drove) beside what the novice proposed, and the rest. It is not counted as steps of this training.

        :param dataset: see ``load_demonstrations``
        :raises DatasetError: if it is missing, damaged or does not fit
        """
        data = load_demonstrations(dataset, self.observation_space, self.action_space)

        def scaled(actions: np.ndarray) -> np.ndarray:
            return self.policy.scale_action(actions).reshape(len(data), -1)

        actions = scaled(data.actions)
        novice_actions = actions if data.novice_actions is None else scaled(data.novice_actions)
        takeovers = np.ones(len(data), dtype=bool) if data.takeovers is None else data.takeovers
        dones = data.ends
        starts = takeovers & (np.roll(dones, 1) | ~np.roll(takeovers, 1))
        columns = (data.observations, data.next_observations, actions, data.rewards, dones)
        for i in range(len(data)):
            info = {
                contract.TAKEOVER: bool(takeovers[i]),
                contract.TAKEOVER_START: bool(starts[i]),
                contract.NOVICE_ACTION: novice_actions[i],
                "TimeLimit.truncated": bool(dones[i] and not data.terminations[i]),
            }
            obs, next_obs, action, reward, done = (column[i : i + 1] for column in columns)
            self.replay_buffer.add(obs, next_obs, action, reward, done, [info])
        self.replay_buffer.end_trajectories()
        normalize = self._vec_normalize_env
        if normalize is not None and normalize.training and normalize.norm_obs:
            normalize.obs_rms.update(data.observations)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        contract.check_order(wrapped)
        check_action_space(wrapped.action_space)
        return wrapped

    def _end_trajectories(self) -> None:
        if self.replay_buffer is not None:
            self.replay_buffer.end_trajectories()

    def _forget_episodes(self) -> None:
        super()._forget_episodes()
        self.episode_costs = EpisodeCosts(self.n_envs)
        self.human_driving = np.zeros(self.n_envs, dtype=bool)
        self._events_last = np.zeros((self.n_envs, len(LASTING)), dtype=bool)

    @property
    def safety_cost(self) -> float | None:
        """Sum of ``info["cost"]`` since the start of the training, None as long as no environment has reported any."""
        return self.counts["safety_cost"] if "safety_cost" in self.measured else None

    def _needs_human(self) -> bool:
        """Tell whether the human is asked in this stage of the training."""
        return True

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self.replay_buffer.end_trajectories()
        assert self.env is not None
        self._wrapped = contract.wrapped_indices(self.env)
        self._human_was_seen = bool(self._wrapped)
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._prepare_wrappers()
        if self._needs_human():
            self._arm()
        return prepared

    def learn(
        self: SelfGuided,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfGuided:
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except BaseException:
            try:
                self._disarm()
            except Exception:  # the environments may be what failed: that error is the one to be seen
                warnings.warn("The human could not be taken out of the training environments: do not evaluate in them.")
            raise
        self._disarm()
        if self._needs_human() and not self._human_was_seen:
            warnings.warn(
                f"{type(self).__name__}: no human is in the loop. Wrap the training environments in "
                "sb3_chac.InterventionWrapper (RL-Zoo3: env_wrapper), or report takeovers in info['intervene_action']."
            )
        return self

    def _prepare_wrappers(self) -> None:
        """Let wrappers that are new go on with the counts of those before them."""
        if not self._wrapped:
            return
        if self.wrapper_states and len(self.wrapper_states) != self.n_envs:  # deal out the sums
            sums = {name: sum(state[name] for state in self.wrapper_states) for name in self.wrapper_states[0]}
            self.wrapper_states = [
                {name: (total + idx) // self.n_envs for name, total in sums.items()} for idx in range(self.n_envs)
            ]
        for idx in self._wrapped:
            if self.wrapper_states:
                self._ask_wrappers([idx], "load_state_dict", self.wrapper_states[idx])
        self._note_wrapper_states(dict(zip(self._wrapped, self._ask_wrappers(self._wrapped, "state_dict"), strict=True)))
        budgets = set(self._ask_wrappers(self._wrapped, "takeover_budget"))
        if len(budgets) > 1:
            raise ValueError(
                f"budget: it is the human's for the whole training, but the environments name {budgets}: pass one to all."
            )
        (self._budget,) = budgets

    def _ask_wrappers(self, indices: list[int], method: str, *args: Any) -> list[Any]:
        assert self.env is not None
        return contract.ask_wrappers(self.env, indices, method, *args)

    def _note_wrapper_states(self, states: dict[int, dict[str, int]]) -> None:
        nothing = dict.fromkeys(WRAPPER_COUNTS, 0)
        self.wrapper_states = [states.get(idx, nothing) for idx in range(self.n_envs)]

    def _arm(self) -> None:
        """Ask the human from now on."""
        self._ask_wrappers(self._wrapped, "arm", True)

    def _disarm(self) -> None:
        if self.env is not None:
            self._ask_wrappers(self._wrapped, "disarm")

    def _begin_step(self) -> None:
        super()._begin_step()
        may_drive = self._may_drive()
        if len(may_drive) == len(self._wrapped):
            self._ask_wrappers(self._wrapped, "begin_step", True)
        else:
            for idx in self._wrapped:
                self._ask_wrappers([idx], "begin_step", idx in may_drive)

    def _may_drive(self) -> list[int]:
        """
        Share the rest of the budget.

        :return: indices of the environments whose human may drive the next step without exceeding the budget
        """
        if self._budget is None:
            return self._wrapped
        left = max(0, self._budget - sum(state["human_steps"] for state in self.wrapper_states))
        return sorted(self._wrapped, key=lambda idx: not self.human_driving[idx])[:left]

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # A model that has learned before does not start with random actions again
        return super()._sample_action(0 if self._n_updates else learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        reports = [contract.read_report(info, self.action_space, idx) for idx, info in enumerate(infos)]
        executed = np.array(buffer_action, dtype=np.float32)
        marked = []
        assert self.env is not None
        for idx, (info, report) in enumerate(zip(infos, reports, strict=True)):
            self._check_received(idx, info, buffer_action[idx])
            if report.action is not None:
                if idx not in self._wrapped and not self.human_driving[idx]:
                    contract.check_reports(self.env, idx)
                executed[idx] = contract.scaled(report.action, self.action_space, idx)
            start = info.get(contract.TAKEOVER_START)
            starts = contract.truth(contract.TAKEOVER_START, start, idx) if start is not None else not self.human_driving[idx]
            own = {
                "takeover": report.takeover,
                "takeover_start": report.takeover and starts,
                "novice_action": buffer_action[idx],
                **{name: number_in(info, name, idx) for name in ("cost", "takeover_cost")},
                **{key: happened_in(info, key, idx) for keys in EVENTS.values() for key in keys},
            }
            marked.append({**info, **own})
        super()._store_transition(replay_buffer, executed, new_obs, reward, dones, marked)
        self.human_driving = np.array([report.takeover for report in reports]) & ~dones.astype(bool)
        self._human_was_seen |= any(report.says_so for report in reports)
        self._count(marked, reward, dones)

    def _check_received(self, idx: int, info: dict[str, Any], sent: np.ndarray) -> None:
        """
        Check that an action arrived as it was sent.

        :param sent: scaled to [-1, 1]
        :raises ValueError: if another action arrived where the human takes over than the one that was sent, or if one cannot
            know as nothing is told of the takeover
        """
        if idx not in self._wrapped:
            return  # the key is the environment's own
        if not {contract.TAKEOVER, contract.RECEIVED_ACTION, *WRAPPER_COUNTS} <= info.keys():
            raise ValueError(
                f"info of environment {idx} lacks what the InterventionWrapper told of the takeover: a wrapper above it "
                "hands out an info of its own. Let it add to the info that it gets. Nothing of this step was stored."
            )
        received = info[contract.RECEIVED_ACTION]
        if received is None:
            return
        sent = np.asarray(self.policy.unscale_action(sent), np.float64)
        box: Any = self.action_space
        if not np.allclose(received, sent, rtol=0, atol=contract.TOLERANCE * (box.high.astype(float) - box.low).max()):
            raise contract.changed_action(idx, sent, received)

    def _count(self, infos: list[dict[str, Any]], rewards: np.ndarray, dones: np.ndarray) -> None:
        counts = self.counts
        for idx, (info, done) in enumerate(zip(infos, dones, strict=True)):
            takeover = info["takeover"]
            counts["total_steps"] += 1
            counts["human_steps"] += takeover
            counts["takeovers"] += info["takeover_start"]
            counts["takeover_cost"] += info["takeover_cost"] or 0.0
            if info["cost"] is not None:
                self.measured |= {"safety_cost", "safety_cost_human"}
                counts["safety_cost"] += info["cost"]
                counts["safety_cost_human"] += info["cost"] * takeover
            for name, keys in EVENTS.items():
                begins = {key: self._happens(idx, key, bool(info[key]), bool(done)) for key in keys}
                key = next((key for key in keys if info[key] is not None), None)
                if key is not None:
                    self.measured.add(name)
                    counts[name] += begins[key]
        finished = self.episode_costs.add([info["cost"] for info in infos], dones)
        if self.safety_cost is not None:
            self.ep_cost_buffer.extend(finished)
        if self._wrapped:
            self._note_wrapper_states({idx: {name: infos[idx][name] for name in WRAPPER_COUNTS} for idx in self._wrapped})

    def _happens(self, idx: int, key: str, value: bool, done: bool) -> bool:
        """Tell whether an event begins that ``info[key]`` tells of."""
        if key not in LASTING:
            return value
        before = self._events_last[idx, LASTING.index(key)]
        self._events_last[idx, LASTING.index(key)] = value and not done
        return value and not before

    def dump_logs(self) -> None:
        counts = self.counts
        for name in ("human_steps", "total_steps", "takeovers", "takeover_cost"):
            self.logger.record(f"takeover/{name}", counts[name])
        self.logger.record("takeover/rate", counts["human_steps"] / max(counts["total_steps"], 1))
        for name in ("safety_cost_human", "collisions", "departures"):
            if name in self.measured:  # else it would look like a zero
                self.logger.record(f"safety/{name}", counts[name])
        record_costs(self.logger, self.safety_cost, self.ep_cost_buffer)
        super().dump_logs()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "episode_costs", "human_driving", "ep_cost_buffer", *STATE_OF_ENVS]
