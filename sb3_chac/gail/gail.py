"""Generative adversarial imitation learning (GAIL)."""

from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, obs_as_tensor, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common.arguments import check_policy_kwargs, checked
from sb3_chac.common.checked_rollouts import CheckedRollouts
from sb3_chac.common.checks import check_integer, check_learning_rate, check_policy, check_range
from sb3_chac.common.demonstrations import Dataset, Demonstrations, check_imitable, load_demonstrations, missing_dataset
from sb3_chac.common.utils import minimize
from sb3_chac.gail.discriminator import Discriminator, discriminator_loss, imitation_rewards

SelfGAIL = TypeVar("SelfGAIL", bound="GAIL")


class GAIL(CheckedRollouts, PPO):
    """
    Generative adversarial imitation learning (GAIL): PPO whose reward comes from a discriminator that learns to tell
    demonstrations from what the policy does. Paper: https://arxiv.org/abs/1606.03476 (Ho and Ermon 2016).

    ``D(s, a)`` is the probability that a step is the expert's: 1 for the expert, 0 for the policy (in the paper it is the
    other way round). After each rollout the discriminator makes ``n_disc_updates`` steps on::

        -(mean log D(s_e, a_e) + mean log(1 - D(s, a))) / 2

    with as many demonstrated steps (s_e, a_e) as steps (s, a) of the rollout; then the rewards of the rollout become
    ``-log(1 - D(s, a))`` and PPO goes on with these (bootstrapped through time limits). They are above 0: surviving pays, also
    where the task is to reach an end soon.

    The rewards of the environment are only logged (``rollout/ep_rew_mean``). The dataset is not saved with the model: to
    go on learning, hand it to ``load(..., dataset=...)``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with Box observations and a bounded Box or a
        Discrete action space
    :param dataset: see ``load_demonstrations``: id or folder of a dataset of Minari, a list of them, ...
    :param learning_rate: The learning rate of PPO, it can be a function
        of the current progress remaining (from 1 to 0)
    :param n_steps: The number of steps to run for each environment per update
        (i.e. rollout buffer size is n_steps * n_envs where n_envs is number of environment copies running in parallel)
    :param batch_size: Minibatch size
    :param n_epochs: Number of epoch when optimizing the surrogate loss
    :param gamma: Discount factor
    :param gae_lambda: Factor for trade-off of bias vs variance for Generalized Advantage Estimator
    :param clip_range: Clipping parameter, it can be a function of the current progress
        remaining (from 1 to 0).
    :param clip_range_vf: Clipping parameter for the value function,
        it can be a function of the current progress remaining (from 1 to 0). No clipping if None.
    :param normalize_advantage: Whether to normalize or not the advantage
    :param ent_coef: Entropy coefficient for the loss calculation
    :param vf_coef: Value function coefficient for the loss calculation
    :param max_grad_norm: The maximum value for the gradient clipping
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param rollout_buffer_class: Rollout buffer class to use. If ``None``, it will be automatically selected.
    :param rollout_buffer_kwargs: Keyword arguments to pass to the rollout buffer on creation
    :param target_kl: Limit the KL divergence between updates. By default, there is no limit.
    :param disc_learning_rate: learning rate of the discriminator, it can be a function of the current progress remaining
    :param n_disc_updates: gradient steps of the discriminator per rollout
    :param disc_batch_size: steps of each side in a batch of the discriminator
    :param gradient_penalty: weight of ``(norm of the gradient of the logit - 1)^2`` between demonstrations and rollout
        (https://arxiv.org/abs/1704.00028), against a discriminator that is too sure
    :param disc_kwargs: additional arguments of the ``Discriminator``
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, those of SB3's ``ActorCriticPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument of its own that is out of its range, or a dataset that is missing, damaged or does not
        fit (``DatasetError``)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ActorCriticPolicy, "CnnPolicy": ActorCriticCnnPolicy}

    @checked
    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        disc_learning_rate: float | Schedule = 3e-4,
        n_disc_updates: int = 8,
        disc_batch_size: int = 512,
        gradient_penalty: float = 0.0,
        disc_kwargs: dict[str, Any] | None = None,
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
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.dataset = dataset
        self.disc_learning_rate = disc_learning_rate
        self.n_disc_updates = n_disc_updates
        self.disc_batch_size = disc_batch_size
        self.gradient_penalty = gradient_penalty
        self.disc_kwargs = disc_kwargs or {}
        self._demonstrations: Demonstrations | None = None

        if _init_setup_model:
            self._setup_model()
            self.set_dataset(dataset)

    def _setup_model(self) -> None:
        self._check_arguments()
        super()._setup_model()
        self.disc_lr_schedule = FloatSchedule(self.disc_learning_rate)
        self.discriminator = Discriminator(
            self.observation_space,  # type: ignore[arg-type]
            self.action_space,  # type: ignore[arg-type]
            self.disc_lr_schedule,
            **self.disc_kwargs,
        ).to(self.device)

    def _check_arguments(self) -> None:
        """
        Check the arguments.

        :raises ValueError: names the argument and the remedy
        """
        check_policy(type(self), self.policy_class, ActorCriticPolicy)
        check_policy_kwargs("policy_kwargs", self.policy_class, self.policy_kwargs, ("pi", "vf"))
        check_policy_kwargs("disc_kwargs", Discriminator, self.disc_kwargs)
        check_learning_rate("learning_rate", self.learning_rate)
        check_learning_rate("disc_learning_rate", self.disc_learning_rate)
        check_integer("n_disc_updates", self.n_disc_updates, low=1)
        check_integer("disc_batch_size", self.disc_batch_size, low=1)
        check_range("gradient_penalty", self.gradient_penalty, low=0.0)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_imitable(env)
        return BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def set_dataset(self, dataset: Dataset | None) -> None:
        """
        Set the dataset.

        :param dataset: to imitate from now on
        :raises DatasetError: if there is none, or it does not fit
        """
        if dataset is None:
            raise missing_dataset(type(self).__name__)
        self._demonstrations = load_demonstrations(dataset, self.observation_space, self.action_space)
        self.dataset = dataset
        if self._vec_normalize_env is None and not self.discriminator.is_image:
            self.discriminator.normalize_by(self._demonstrations.observations)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self._demonstrations is None:  # it was loaded
            self.set_dataset(self.dataset)
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        # What PPO adds to the reward of the last step before a time limit
        self._beyond_time_limits = np.zeros((n_rollout_steps, env.num_envs), dtype=np.float32)
        if not super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps):
            return False
        self._train_discriminator()
        with th.no_grad():
            logits = self._logits(*self._rollout_inputs())
            last_values = self.policy.predict_values(obs_as_tensor(self._last_obs, self.device))  # type: ignore[arg-type]
        rewards = imitation_rewards(logits).cpu().numpy().reshape(rollout_buffer.rewards.shape)
        self.logger.record("rollout/imitation_reward_mean", rewards.mean())
        rollout_buffer.rewards[:] = rewards + self._beyond_time_limits
        assert self._last_episode_starts is not None
        rollout_buffer.compute_returns_and_advantage(last_values, dones=self._last_episode_starts)
        return True

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Called once per step, before it is stored."""
        super()._update_info_buffer(infos, dones)
        assert dones is not None
        for idx, info in enumerate(infos):
            if dones[idx] and info.get("terminal_observation") is not None and info.get("TimeLimit.truncated", False):
                terminal_obs = self.policy.obs_to_tensor(info["terminal_observation"])[0]
                with th.no_grad():
                    value = self.policy.predict_values(terminal_obs).item()
                self._beyond_time_limits[self.rollout_buffer.pos, idx] = self.gamma * value

    def _train_discriminator(self) -> None:
        assert self._demonstrations is not None
        update_learning_rate(self.discriminator.optimizer, self.disc_lr_schedule(self._current_progress_remaining))
        observations, actions = self._rollout_inputs()
        stats: defaultdict[str, list[th.Tensor]] = defaultdict(list)
        for _ in range(self.n_disc_updates):
            rows = th.as_tensor(np.random.randint(len(observations), size=self.disc_batch_size), device=self.device)
            policy = self.discriminator.inputs(observations[rows], actions[rows])
            expert = self._expert_inputs(np.random.randint(len(self._demonstrations), size=self.disc_batch_size))
            expert_logits, policy_logits = self.discriminator(*expert), self.discriminator(*policy)
            loss = discriminator_loss(expert_logits, policy_logits)
            stats["disc_loss"].append(loss.detach())
            if self.gradient_penalty > 0:
                loss = loss + self.gradient_penalty * self._penalty(expert, policy)
            minimize(loss, self.discriminator.optimizer)
            stats["disc_accuracy_expert"].append((expert_logits > 0).float().mean())
            stats["disc_accuracy_policy"].append((policy_logits < 0).float().mean())
        for name, values in stats.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())

    def _penalty(self, expert: tuple[th.Tensor, th.Tensor], policy: tuple[th.Tensor, th.Tensor]) -> th.Tensor:
        """
        Compute the gradient penalty.

        :param expert: inputs of the discriminator
        :param policy: likewise, as many
        :return: (norm of the gradient of the logit - 1)^2, its mean over random points between the two
        """
        share = th.rand(len(expert[1]), device=self.device)
        between = []
        for ours, theirs in zip(expert, policy, strict=True):
            weight = share.view(-1, *[1] * (ours.dim() - 1))
            between.append((weight * ours + (1 - weight) * theirs).requires_grad_())
        gradients = th.autograd.grad(self.discriminator(*between).sum(), between, create_graph=True)
        norms = th.cat([gradient.flatten(start_dim=1) for gradient in gradients], dim=1).norm(dim=1)
        return (norms - 1.0).square().mean()

    def _logits(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Evaluate the discriminator.

        :return: of D, in parts of the size that training has, shape (n,)
        """
        parts = zip(observations.split(self.disc_batch_size), actions.split(self.disc_batch_size), strict=True)
        return th.cat([self.discriminator(*self.discriminator.inputs(*part)) for part in parts])

    def _rollout_inputs(self) -> tuple[th.Tensor, th.Tensor]:
        """
        Collect the steps of the rollout.

        :return: observations and actions (as the environment gets them) of the rollout, before it is shuffled, shape
            (n_steps * n_envs, ...)
        """
        buffer = self.rollout_buffer
        actions = buffer.actions
        if isinstance(self.action_space, spaces.Box) and self.policy.squash_output:
            actions = self.policy.unscale_action(actions)
        observations = buffer.observations.reshape(-1, *self.observation_space.shape)  # type: ignore[misc]
        actions = actions.reshape(-1, *(self.action_space.shape or (1,)))
        return th.as_tensor(observations, device=self.device), th.as_tensor(actions, device=self.device)

    def _expert_inputs(self, rows: np.ndarray) -> tuple[th.Tensor, th.Tensor]:
        """
        Collect steps of the demonstrations.

        :param rows: steps of the demonstrations
        :return: inputs of the discriminator
        """
        assert self._demonstrations is not None
        observations, actions = self._demonstrations.observations[rows], self._demonstrations.actions[rows]
        if self._vec_normalize_env is not None:
            observations = self._vec_normalize_env.normalize_obs(observations)
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions - self.action_space.start
        return self.discriminator.inputs(
            th.as_tensor(observations, device=self.device), th.as_tensor(actions, device=self.device)
        )

    def learn(
        self: SelfGAIL,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "GAIL",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfGAIL:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dataset", "_demonstrations", "_beyond_time_limits"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return [*super()._get_torch_save_params()[0], "discriminator", "discriminator.optimizer"], []
