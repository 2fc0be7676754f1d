"""Base class for algorithms that learn from demonstrations alone (BC, CQL)."""

import sys
import time
from collections import defaultdict
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common.arguments import check_policy_kwargs, checked
from sb3_chac.common.checked_env import check_env_is_there
from sb3_chac.common.checks import check_integer, check_learning_rate, check_policy, check_range
from sb3_chac.common.demonstrations import Dataset, Demonstrations, check_imitable, load_demonstrations, missing_dataset
from sb3_chac.common.saved_by import NamedAlgorithm
from sb3_chac.common.utils import fix_statistics

SelfOffline = TypeVar("SelfOffline", bound="OfflineAlgorithm")


class Batch(NamedTuple):
    """
    Steps of the dataset: observations of shape (batch_size, *observation_shape), likewise next_observations; actions scaled to
    [-1, 1], shape (batch_size, action_dim), or numbers from 0 on if they are discrete; rewards and dones (1 where the
    episode ended for good, not at a time limit), shape (batch_size,).
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor


class DatasetSampler:
    """
    Sampler of transitions in shuffled epochs. Whole episodes are kept apart for validation (neighbouring steps are
    much alike); which, depends on the dataset only, so that a training that goes on does not learn from them. Of a single
    episode it is the end.

    :param episodes: index of the episode of each step, shape (n,)
    :param batch_size: that of the training steps, if there are so many
    :param validation_share: of the steps, about
    :param seed: of the shuffling
    """

    def __init__(self, episodes: np.ndarray, batch_size: int, validation_share: float, seed: int | None):
        steps = np.arange(len(episodes))
        wanted = validation_share * len(steps)
        names, lengths = np.unique(episodes, return_counts=True)
        if len(names) == 1:
            validates = steps >= len(steps) - round(wanted)
        else:
            order = np.random.default_rng(0).permutation(len(names))
            fits = np.cumsum(lengths[order]) <= wanted
            fits[0] |= validation_share > 0
            validates = np.isin(episodes, names[order[fits]])
        self.training, self.validation = steps[~validates], steps[validates]
        self.batch_size = min(batch_size, len(self.training))
        self.rng = np.random.default_rng(seed)
        self.order = self.training[:0]
        self.position = 0
        self.drawn = 0

    @property
    def epochs(self) -> float:
        """Number of epochs completed, with the fraction of the present one."""
        return self.drawn / len(self.training)

    def draw(self) -> np.ndarray:
        """
        Draw a batch of steps.

        :return: their indices, shape (batch_size,); a pass ends where the next batch would not be full
        """
        if self.position + self.batch_size > len(self.order):
            self.order, self.position = self.rng.permutation(self.training), 0
        self.position += self.batch_size
        self.drawn += self.batch_size
        return self.order[self.position - self.batch_size : self.position]


class OfflineAlgorithm(NamedAlgorithm):
    """
    Base of the algorithms that learn from a dataset, without acting. Their timesteps are gradient steps: ``learn(n)`` makes n
    of them and calls the callbacks after each, so that evaluation, checkpoints, pruning and the progress bar work as usual.

    The environment is for evaluation only, and says which spaces the dataset must have. If it is a VecNormalize in training,
    its statistics of the observations are made those of the dataset, and the policy sees normalized ones; rewards stay as
    they were recorded. The dataset is not saved with the model: to go on learning, hand it to ``load(..., dataset=...)``.

    :param policy: The policy model to use
    :param env: The environment that the dataset was recorded in (if registered in Gym, can be str)
    :param dataset: see ``load_demonstrations``: id or folder of a dataset of Minari, a list of them, ...
    :param learning_rate: learning rate, it can be a function of the current progress remaining (from 1 to 0)
    :param batch_size: Minibatch size for each gradient update
    :param validation_share: share of the steps that are kept apart for validation, below 1
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    """

    # What ``policy`` must derive from
    required_policy: type[BasePolicy]
    # That it has, see ``check_policy_kwargs``
    networks: ClassVar[tuple[str, ...]] = ("pi",)

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        dataset: Dataset | None,
        learning_rate: float | Schedule,
        batch_size: int,
        validation_share: float = 0.0,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.dataset = dataset
        self.batch_size = batch_size
        self.validation_share = validation_share
        self._demonstrations: Demonstrations | None = None  # of ``_loaded_from``
        self._loaded_from: Any = None
        self._sampler: DatasetSampler | None = None

    def _setup_model(self) -> None:
        self._check_arguments()
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            **self.policy_kwargs,
        ).to(self.device)

    def _check_arguments(self) -> None:
        """
        Called on creation and on loading, before anything is built.

        :raises ValueError: names the argument and the remedy
        """
        check_policy(type(self), self.policy_class, self.required_policy)
        check_policy_kwargs("policy_kwargs", self.policy_class, self.policy_kwargs, self.networks)
        check_learning_rate("learning_rate", self.learning_rate)
        check_integer("batch_size", self.batch_size, low=1)
        check_range("validation_share", self.validation_share, low=0.0, high=0.9)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_imitable(env)
        return BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def set_dataset(self, dataset: Dataset | None) -> None:
        """
        Set the dataset.

        :param dataset: to learn from, from now on
        :raises DatasetError: if there is none, or it does not fit
        """
        self.dataset = dataset
        if dataset is None:
            raise missing_dataset(type(self).__name__)
        self._demonstrations = load_demonstrations(dataset, self.observation_space, self.action_space)
        self._loaded_from = dataset
        self._sampler = DatasetSampler(self._demonstrations.episodes, self.batch_size, self.validation_share, self.seed)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.dataset is None or self._loaded_from is not self.dataset:
            self.set_dataset(self.dataset)
        check_env_is_there(self)
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        assert self._demonstrations is not None
        fix_statistics(self._vec_normalize_env, self._demonstrations.observations)
        return prepared

    @checked
    def learn(
        self: SelfOffline,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1000,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOffline:
        """
        Learn from the dataset.

        :param total_timesteps: number of gradient steps
        :param callback: called after each gradient step, each of which counts as a rollout
        :param log_interval: number of gradient steps between two logs
        :param tb_log_name: the name of the run for TensorBoard logging
        :param reset_num_timesteps: whether to count from 0
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: itself
        :raises DatasetError: if there is no dataset, or it does not fit
        """
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        assert self._sampler is not None
        callback.on_training_start(locals(), globals())

        # Kept as tensors and read only when they are logged
        stats: defaultdict[str, list[th.Tensor]] = defaultdict(list)
        while self.num_timesteps < total_timesteps:
            callback.on_rollout_start()
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._update_learning_rates()
            # Switch to train mode (this affects batch norm / dropout), an evaluation may have switched back
            self.policy.set_training_mode(True)
            for name, value in self._gradient_step(self._batch(self._sampler.draw())).items():
                stats[name].append(value)
            self._n_updates += 1
            self.num_timesteps += 1
            callback.update_locals(locals())
            if not callback.on_step():
                break
            callback.on_rollout_end()
            if self.num_timesteps % log_interval == 0:
                self._dump_logs(stats)
        if stats:
            self._dump_logs(stats)
        callback.on_training_end()
        return self

    def _update_learning_rates(self) -> None:
        self._update_learning_rate(self._optimizers())

    def _optimizers(self) -> list[th.optim.Optimizer]:
        """Return the optimizers that follow ``learning_rate``."""
        raise NotImplementedError

    def _gradient_step(self, batch: Batch) -> dict[str, th.Tensor]:
        """
        Make one gradient step.

        :return: what to log, scalars
        """
        raise NotImplementedError

    def _batch(self, indices: np.ndarray) -> Batch:
        """
        Gather a batch from the dataset.

        :param indices: of steps of the dataset, shape (batch_size,)
        """
        data = self._demonstrations
        assert data is not None
        actions = data.actions[indices]
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions - self.action_space.start
        else:
            actions = self.policy.scale_action(actions).reshape(len(indices), -1)
        return Batch(
            self._observations(data.observations[indices]),
            th.as_tensor(actions, device=self.device, dtype=None if actions.dtype.kind == "i" else th.float32),
            self._observations(data.next_observations[indices]),
            th.as_tensor(data.rewards[indices], device=self.device, dtype=th.float32),
            th.as_tensor(data.terminations[indices], device=self.device, dtype=th.float32),
        )

    def _observations(self, observations: np.ndarray) -> th.Tensor:
        if self._vec_normalize_env is not None:
            observations = self._vec_normalize_env.normalize_obs(observations)  # type: ignore[assignment]
        return th.as_tensor(observations, device=self.device)

    def _dump_logs(self, stats: defaultdict[str, list[th.Tensor]]) -> None:
        """
        Log the means since the last time.

        :param stats: since the last time, is emptied
        """
        assert self._sampler is not None
        elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/epochs", self._sampler.epochs)
        for name, values in stats.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        stats.clear()
        self.logger.dump(step=self.num_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dataset", "_demonstrations", "_loaded_from", "_sampler"]
