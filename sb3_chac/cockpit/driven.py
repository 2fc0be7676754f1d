"""Algorithms made fit for a drive: a copy of the policy drives while a ``Learner`` makes the gradient steps."""

import copy
import functools
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy

from sb3_chac.chac import CHAC
from sb3_chac.cockpit.learner import Learner
from sb3_chac.cockpit.meter import GuidanceMeter, Lesson, LessonMeter
from sb3_chac.cockpit.session import Novice, Session, SessionEnded
from sb3_chac.common.contract import scale_action
from sb3_chac.common.critics import DistributionalCritic
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.hg_dagger import HGDagger

if TYPE_CHECKING:
    Base = GuidedOffPolicyAlgorithm
else:
    Base = object

LOW = -1.2816  # the 10 % quantile of the normal distribution


class DrivenTraining(Base):
    """
    Base of the algorithms of a drive, see ``driven``.

    ``train`` only says how many gradient steps are due; a ``Learner`` makes them. Who drives is a copy of the policy, brought
    up to date after each gradient step, so that no step of the environment waits for one. What takes long and is to
    happen between two steps (C-HAC's fit at the beginning of stage 2, the rounds of HG-DAgger and IWR) is done where the
    algorithm does it: the car waits, and the display says so.
    """

    drive: Session
    owed_steps = 0  # gradient steps; saved, so that they are made after a restart
    driven_seconds = 0.0

    def attach(self, drive: Session) -> None:
        """
        Prepare for a drive; to be called before ``learn``.

        :param drive: in whose environment it learns
        :raises ValueError: for what cannot be done in a drive
        """
        if self.use_sde:
            raise ValueError("use_sde: a drive needs use_sde=False, generalised exploration is not supported in the cockpit.")
        self.drive = drive
        self.learner = Learner(self, drive)
        self._this_thread = threading.local()
        self._buffer_lock = threading.Lock()
        self._driving_lock = threading.Lock()  # held while the driving policy acts or is refreshed
        self._learner_logger = Logger(None, [])
        self._meter = GuidanceMeter(drive.query)
        self._lesson: LessonMeter | None = None
        self._lesson_of: tuple[Any, np.ndarray, np.ndarray] | None = None  # observation, the person's and the novice's action
        self._is_taken_over = False
        self._driving_policy = copy.deepcopy(self._learning_policy)
        self._pairs = tuple(
            [*policy.parameters(), *policy.buffers()] for policy in (self._driving_policy, self._learning_policy)
        )
        self._show_counts()
        self._tell()

    # Two policies and two loggers: each thread has its own

    @property
    def policy(self) -> Any:
        acts = "_this_thread" in self.__dict__ and getattr(self._this_thread, "acts", False)
        return self._driving_policy if acts else self._learning_policy

    @policy.setter
    def policy(self, policy: BasePolicy) -> None:
        self._learning_policy = policy

    @property
    def logger(self) -> Logger:
        if "learner" in self.__dict__ and threading.current_thread() is self.learner:
            return self._learner_logger
        return self._logger

    def dump_logs(self) -> None:
        if "learner" in self.__dict__:
            for name, value in dict(self._learner_logger.name_to_value).items():
                self._logger.record(name, value)
            self._logger.record("time/owed_gradient_steps", self.owed_steps)
        super().dump_logs()

    @th.no_grad()
    def refresh_driver(self) -> None:
        """Make the driving policy what was learned."""
        with self._driving_lock:
            th._foreach_copy_(self._pairs[0], self._pairs[1])

    # Learning

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self.drive.learns:
            self.learner.owe(gradient_steps)
        self.drive.lag = self.owed_steps

    def train_now(self, gradient_steps: int, batch_size: int) -> None:
        """Call the algorithm's own ``train``."""
        super().train(gradient_steps, batch_size)

    def pretrain(self, gradient_steps: int) -> None:
        """
        Make gradient steps on what the replay buffer holds, before the drive begins.

        :param gradient_steps: number
        """
        self._setup_learn(0)  # makes the logger, the learner begins
        self._update_current_progress_remaining(0, 1)
        self.learner.owe(gradient_steps)
        self.learner.drain()

    def _sample_batch(self, batch_size: int) -> Any:
        with self._buffer_lock:
            return super()._sample_batch(batch_size)  # type: ignore[misc]

    # Driving

    @property
    def stage_name(self) -> str:
        """Stage of the training, for the display."""
        return "guided"

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        with self._driving_lock:
            self._this_thread.acts = True
            try:
                starts = learning_starts if self.drive.learns else 0
                sampled = super()._sample_action(starts, action_noise, n_envs)
                self._tell(sampled[1])
            finally:
                self._this_thread.acts = False
        return sampled

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        """Predict as the algorithm does, but without exploration where nothing is learned."""
        if not self.drive.learns:
            kwargs["deterministic"] = True
        return super().predict(*args, **kwargs)

    def _tell(self, actions: np.ndarray | None = None) -> None:
        """
        Tell the display about the novice.

        :param actions: that it is about to do, scaled to [-1, 1], shape (1, 2)
        """
        choice = getattr(self.policy, "last_choice", None)
        risk = self._meter.tell(None if actions is None or not self.drive.meter else self._foreseen(actions))
        novice = Novice(
            self.stage_name,
            None if choice is None else bool(choice.self_drives[0]),
            None if choice is None else float(choice.confidence[0]),
            risk,
            self._meter.asks,
            self._tell_lesson(actions),
        )
        self.drive.show(novice=novice)

    def _tell_lesson(self, actions: np.ndarray | None) -> Lesson | None:
        """
        Tell what the last takeover has taught by now.

        :param actions: that the novice is about to do, scaled to [-1, 1], shape (1, 2)
        """
        if self._lesson is None or self._lesson_of is None:
            return None
        observation, person, novice = self._lesson_of
        now = self._guided_value(observation, person), self._guided_value(observation, novice)
        proposed = None
        if actions is not None and not self._is_taken_over:
            proposed = self._guided_value(self._last_obs, actions)
        return self._lesson.tell(now, proposed)

    def _begin_lesson(self, novice: np.ndarray, info: dict[str, Any]) -> None:
        """
        Note the state in which a takeover begins.

        :param novice: action that it proposed, scaled to [-1, 1], shape (1, 2)
        :param info: of the step
        """
        critic = getattr(self._driving_policy, "critic", None)
        if critic is None or not self.drive.meter or not self._n_updates:
            return
        person = scale_action(info["applied_action"], self.action_space)[None].astype(np.float32)  # type: ignore[arg-type]
        self._lesson_of = copy.deepcopy(self._last_obs), person, novice
        with self._driving_lock:
            self._this_thread.acts = True
            values = self._guided_value(self._last_obs, person), self._guided_value(self._last_obs, novice)
            self._this_thread.acts = False
        self._lesson = LessonMeter(values)

    @th.no_grad()
    def _guided_value(self, observation: Any, actions: np.ndarray) -> float:
        """
        Value of the human-guided policy.

        :param observation: as the environment gives it
        :param actions: scaled to [-1, 1], shape (1, 2)
        :return: Q_g, of two critics the smaller one
        """
        obs, _ = self.policy.obs_to_tensor(observation)
        action = th.as_tensor(actions, dtype=th.float32, device=self.device)
        critic = self.policy.critic
        if isinstance(critic, DistributionalCritic):
            return float(critic.pessimistic(obs, action)[0][0])
        return min(float(q_value[0]) for q_value in critic(obs, action))

    def _show_counts(self) -> None:
        steps = {name: int(self.counts[name]) for name in ("total_steps", "human_steps")}
        self.drive.count(seconds=self.driven_seconds, **steps)

    @th.no_grad()
    def _foreseen(self, actions: np.ndarray) -> float | None:
        """
        The value that the guidance meter ranks.

        Z_c's, which knows of the takeovers to come, where there is one: on maps not seen before, its low values foresee a
        takeover within three steps with an area under the ROC curve of about .77, those of Z_g hardly
        (``benchmarks/foresight.py``).

        :param actions: scaled to [-1, 1], shape (1, 2)
        :return: Q_c, else the 10 % quantile of Z_g (PVP: the smaller Q_g), of the action in the present state; None before the
            first gradient step, and for algorithms without any of them
        """
        critic = getattr(self.policy, "critic", None)
        if critic is None or not self._n_updates:
            return None
        assert self._last_obs is not None
        obs, _ = self.policy.obs_to_tensor(self._last_obs)
        action = th.as_tensor(actions, dtype=th.float32, device=self.device)
        if isinstance(self, CHAC):
            return float(self.policy.confidence_critic.pessimistic(obs, action)[0])
        if isinstance(critic, DistributionalCritic):
            mean, std = critic.pessimistic(obs, action)
            return float(mean[0] + LOW * std[0])
        return min(float(q_value[0]) for q_value in critic(obs, action))

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        if infos[0].get("unattended"):  # nobody's decision: nothing is to be learned from it
            self._forget_episodes()
            self._last_obs, self._is_taken_over = new_obs, False
            return
        begins = infos[0]["takeover"] and not self._is_taken_over
        self._is_taken_over = infos[0]["takeover"]
        if begins:
            self._begin_lesson(buffer_action, infos[0])
        with self._buffer_lock:
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.driven_seconds += self.drive.period
        self._show_counts()

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(*args, **kwargs)
        self._callback = prepared[1]
        self.refresh_driver()
        if not self.learner.is_alive():
            self.learner.start()
        return prepared

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """
        Learn as the algorithm does, but return early when the person quits. Everything driven is stored then.
        """
        try:
            super().learn(*args, **kwargs)
            self.drive.busy = "The last gradient steps are made" if self.owed_steps else ""
            self.learner.drain()
        except SessionEnded:
            self._callback.on_training_end()
        finally:
            self.drive.busy = ""
            self.learner.stop()
        return self

    def _excluded_save_params(self) -> list[str]:
        own = ["drive", "learner", "_this_thread", "_buffer_lock", "_driving_lock", "_learner_logger", "_driving_policy"]
        own += ["_meter", "_lesson", "_lesson_of", "_is_taken_over"]
        return [*super()._excluded_save_params(), *own, "_pairs", "_learning_policy", "_callback"]

    def save(self, *args: Any, **kwargs: Any) -> None:
        """Save as SB3 does, between two gradient steps."""
        with self.learner.resting():
            super().save(*args, **kwargs)


class DrivenStages(DrivenTraining):
    """
    ``DrivenTraining`` of C-HAC: the fit of Z_c at the end of stage 1 is made beside the driving, too. Stage 1 goes on until it
    is done. Who sits at the wheel may take over in stage 2 as well.
    """

    steps_before_prefit = 0  # gradient steps that were owed when it was due
    prefit_left: int | None = None  # None: it is not due

    def train_now(self, gradient_steps: int, batch_size: int) -> None:
        if not self.prefit_left:
            super().train_now(gradient_steps, batch_size)
        elif self.steps_before_prefit:
            super().train_now(gradient_steps, batch_size)
            self.steps_before_prefit -= 1
        else:
            self._prefit_step()  # type: ignore[attr-defined]
            self.prefit_left -= 1

    def _start_stage_2(self) -> None:
        """Prepare stage 2; called after each step of the environment as long as it is due."""
        if not self.drive.learns:
            return
        if self.prefit_left is None:
            self.steps_before_prefit, self.prefit_left = self.owed_steps, self.prefit_steps  # type: ignore[attr-defined]
            self.learner.owe(self.prefit_steps)  # type: ignore[attr-defined]
        if self.prefit_left == 0:
            with self.learner.resting():
                self._switch_to_stage_2()  # type: ignore[attr-defined]
            self.refresh_driver()
            self._arm()

    def _needs_human(self) -> bool:
        return True

    @property
    def stage_name(self) -> str:
        if self.stage == 2:  # type: ignore[attr-defined]
            watch = self.watch  # type: ignore[attr-defined]
            return "2: RELAPSE" if watch is not None and watch.relapsed else "2: self-learning"
        return "1: guided" if self.prefit_left is None else "1: prepares 2"


class DrivenRounds(DrivenTraining):
    """
    ``DrivenTraining`` of HG-DAgger and IWR: the novice is fitted between the rounds, where the algorithm does it. The car
    waits meanwhile, and the display says so.
    """

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        assert isinstance(self, HGDagger)
        if not self.drive.learns:
            return
        if self._is_round_over() or self.num_timesteps >= self._total_timesteps:
            self.drive.busy = "The car waits: the novice is fitted to what you drove"
            try:
                with self.learner.resting():
                    self.train_now(gradient_steps, batch_size)
                self.refresh_driver()
            finally:
                self.drive.busy = ""

    @property
    def stage_name(self) -> str:
        assert isinstance(self, HGDagger)
        return f"round {self.round}" if self.round else "warm-up"


@functools.cache
def driven(algorithm: type[GuidedOffPolicyAlgorithm]) -> type[Any]:
    """
    Derive the class of an algorithm that learns while a person drives.

    :param algorithm: that learns from takeovers
    :return: the same algorithm for a drive, see ``DrivenTraining``; what it saves is the algorithm's
    """
    base = DrivenTraining
    for special, general in ((DrivenStages, CHAC), (DrivenRounds, HGDagger)):
        if issubclass(algorithm, general):
            base = special
    return type(f"Driven{algorithm.__name__}", (base, algorithm), {})
