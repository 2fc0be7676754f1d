"""Human-gated DAgger (HG-DAgger)."""

import math
import warnings
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule, TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.bc.policies import BCPolicy, CnnPolicy, MlpPolicy, check_loss, imitating_policy
from sb3_chac.common.arguments import checked
from sb3_chac.common.buffers import DualReplayBuffer, TransitionStore
from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.common.demonstrations import Dataset, check_spaces
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.common.utils import fix_statistics, minimize

SelfHGDagger = TypeVar("SelfHGDagger", bound="HGDagger")

WARM_UP_STEPS = 30_000  # of the paper


class HGDagger(GuidedOffPolicyAlgorithm):
    """
    Human-gated DAgger (HG-DAgger): behaviour cloning of what the human drives, gathered in rounds.
    Paper: "HG-DAgger: Interactive Imitation Learning with Human Experts" (Kelly et al. 2019, https://arxiv.org/abs/1810.02890).

    First the human drives alone for ``warm_up_steps`` steps, or a dataset is read in their place. Then, round by round, the
    novice drives and the human takes over; after ``round_human_steps`` steps of the human the novice is fitted to all
    that the human ever drove, for ``n_epochs`` epochs from where it was (``BC`` has the two losses). ``learn`` returns
    after ``n_rounds`` rounds, but at ``total_timesteps`` steps of the environment (the warm-up included) at the latest; then
    an unfinished round is learned from, too. To have more rounds later, set ``model.n_rounds``. Rewards are not used.

    Under ``VecNormalize`` (in training) observations are normalized by the statistics of what is fitted, which stand still
    from one fit to the next.

    What was driven is kept in the replay buffer: to go on learning with a loaded model, load that as well.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with a bounded Box action space and in an
        ``InterventionWrapper``
    :param dataset: what the human did before: id or folder of a dataset of Minari, a list of them, ... (see
        ``load_demonstrations``); may be None
    :param learning_rate: learning rate, it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: capacity of each of the two stores (human and novice), in transitions; the oldest are overwritten
    :param batch_size: Minibatch size for each gradient update
    :param warm_up_steps: steps that the human drives alone at first; if None, 30,000 without ``dataset`` and 0 with one
    :param round_human_steps: steps of the human after which a round ends
    :param n_rounds: number of rounds after the warm-up, None for as many as fit into ``total_timesteps``
    :param n_epochs: epochs after the warm-up and after each round
    :param loss: "mse", which acts deterministically, or "nll", which also learns how much the actions vary
    :param weight_decay: of AdamW
    :param replay_buffer_class: ``DualReplayBuffer``, or a class derived from it
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, mean reward, and mean cost over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``BCPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, a dataset that is missing, damaged or does not fit
        (``DatasetError``), or, while learning, an observation or reward that is NaN or infinite
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy}
    required_policy = BCPolicy
    networks: ClassVar[tuple[str, ...]] = ("pi",)
    policy: BCPolicy

    @checked
    def __init__(
        self,
        policy: str | type[BCPolicy],
        env: GymEnv | str,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 300_000,
        batch_size: int = 256,
        warm_up_steps: int | None = None,
        round_human_steps: int = 5000,
        n_rounds: int | None = 4,
        n_epochs: int = 20,
        loss: str = "mse",
        weight_decay: float = 1e-4,
        replay_buffer_class: type[DualReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy=policy,
            env=env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=0,
            batch_size=batch_size,
            train_freq=1,
            gradient_steps=1,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
        )
        self.dataset = dataset
        self.warm_up_steps = warm_up_steps if warm_up_steps is not None else WARM_UP_STEPS if dataset is None else 0
        self.round_human_steps = round_human_steps
        self.n_rounds = n_rounds
        self.n_epochs = n_epochs
        self.loss = loss
        self.weight_decay = weight_decay
        self.round = 0  # the warm-up
        self.round_started_at = 0  # steps of the human
        self.demonstrated_rows = 0  # rows that the human's store got until the end of the warm-up

        if _init_setup_model:
            self._setup_model()
            if dataset is not None:
                self.store_demonstrations(dataset)

    def _setup_model(self) -> None:
        with imitating_policy(self, self.loss, self.weight_decay):
            super()._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_integer("warm_up_steps", self.warm_up_steps, low=0)
        check_integer("round_human_steps", self.round_human_steps, low=1)
        check_integer("n_epochs", self.n_epochs, low=1)
        if self.n_rounds is not None:
            check_integer("n_rounds", self.n_rounds, low=0)
        check_loss(self.loss)
        check_range("weight_decay", self.weight_decay, low=0.0)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_spaces(env.observation_space, env.action_space)
        return GuidedOffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def store_demonstrations(self, dataset: Dataset) -> None:
        super().store_demonstrations(dataset)
        self.demonstrated_rows = self.replay_buffer.human.added

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.replay_buffer.human.added < self.demonstrated_rows:
            warnings.warn(
                f"{type(self).__name__}: the demonstrations that it learned from are not in the replay buffer: they will be "
                "forgotten. Load the buffer that belongs to the model with load_replay_buffer() before learning."
            )
            self.demonstrated_rows = 0
        if self.is_finished:
            warnings.warn(
                f"{type(self).__name__}: all its {self.n_rounds} rounds are done, there is nothing to learn. To have more, "
                "set model.n_rounds."
            )
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._set_rule()
        if self._is_round_over():
            self._end_round()  # nothing to warm up: the demonstrations are there
        return prepared

    def _set_rule(self) -> None:
        """The human drives throughout the warm-up."""
        self._ask_wrappers(self._wrapped, "set_rule", "always" if self.round == 0 else None)
        self._ask_wrappers(self._wrapped, "set_stage", f"round {self.round}" if self.round else "warm-up")

    @property
    def is_finished(self) -> bool:
        """Tell whether all rounds were made."""
        return self.n_rounds is not None and self.round > self.n_rounds

    def _is_round_over(self) -> bool:
        wanted = self.warm_up_steps if self.round == 0 else self.round_human_steps
        return not self.is_finished and self.counts["human_steps"] - self.round_started_at >= wanted

    def _end_round(self) -> None:
        if self.round == 0:
            self.demonstrated_rows = self.replay_buffer.human.added
        self._fit()
        self.round += 1
        self.round_started_at = int(self.counts["human_steps"])
        self._set_rule()

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        if self.is_finished:
            evaluate_now(callback)  # the last fit
            return RolloutReturn(0, 0, continue_training=False)
        self._callback = callback
        return super().collect_rollouts(env, callback, train_freq, replay_buffer, action_noise, learning_starts, log_interval)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Called after each step of the environments. Learns if a round, or the training, ends there."""
        if self._is_round_over():
            self._end_round()
        elif self.num_timesteps >= self._total_timesteps:
            self._fit()
        if self.num_timesteps >= self._total_timesteps:
            evaluate_now(self._callback)

    def _fit(self) -> None:
        """Some epochs on what was collected so far."""
        observations, actions, weights = self._training_set()
        n = len(actions)
        if n == 0:
            return
        fix_statistics(self._vec_normalize_env, observations)
        if self._vec_normalize_env is not None and self._last_original_obs is not None:
            self._last_obs = self._vec_normalize_env.normalize_obs(self._last_original_obs)
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        for _ in range(self.n_epochs):
            order = np.random.permutation(n) if weights is None else np.random.choice(n, n, p=weights)
            losses = []
            for rows in np.array_split(order, math.ceil(n / self.batch_size)):
                batch = observations[rows]
                if self._vec_normalize_env is not None:
                    batch = self._vec_normalize_env.normalize_obs(batch)  # type: ignore[assignment]
                tensors = (th.as_tensor(values, device=self.device) for values in (batch, actions[rows]))
                loss = self.policy.losses(*tensors).mean()
                minimize(loss, self.policy.optimizer)
                losses.append(loss.detach())
                self._n_updates += 1
        self.policy.set_training_mode(False)
        self.logger.record("train/loss", th.stack(losses).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/round", self.round)
        self.logger.record("train/samples", n)
        self.dump_logs()

    def _training_set(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """
        Collect the data to learn from.

        :return: observations, shape (n, *observation_shape); executed actions scaled to [-1, 1], shape (n, action_dim); and
            the probability with which each is drawn, shape (n,), None for shuffled passes
        """
        return *filled(self.replay_buffer.human), None

    def learn(
        self: SelfHGDagger,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "HGDagger",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfHGDagger:
        """
        Learn from takeovers, round after round.

        :param total_timesteps: number of steps of the environments at most, see above
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dataset", "_callback"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


def filled(store: TransitionStore) -> tuple[np.ndarray, np.ndarray]:
    """
    Collect the rows of a store.

    :return: observations and executed actions of all rows
    """
    return store.arrays["observation/"][: len(store)], store.arrays["action"][: len(store)]


def evaluate_now(callback: BaseCallback) -> None:
    """
    Trigger the evaluations among callbacks.

    :param callback: those that evaluate, also inside others, do so now, whatever their frequency
    """
    if isinstance(callback, EvalCallback) and callback.eval_freq > 0:
        callback.n_calls += callback.eval_freq - 1 - callback.n_calls % callback.eval_freq
        callback.on_step()
    elif isinstance(callback, CallbackList):
        for one in callback.callbacks:
            evaluate_now(one)
    elif isinstance(callback, EventCallback) and callback.callback is not None:
        evaluate_now(callback.callback)
