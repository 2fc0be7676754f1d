"""Distributional soft actor-critic (DSAC)."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from stable_baselines3.sac.policies import Actor

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_integer, check_learning_rate, check_range
from sb3_chac.common.critics import DistributionalCritic
from sb3_chac.common.distributional import gaussian_nll, gaussian_surrogate_loss, return_targets
from sb3_chac.common.off_policy_algorithm import CheckedOffPolicyAlgorithm
from sb3_chac.common.utils import (
    TargetUpdate,
    detach_distributions,
    frozen,
    initial_ent_coef,
    minimize,
    safe_log,
    target_entropy,
)
from sb3_chac.dsac.policies import CnnPolicy, DSACPolicy, MlpPolicy, MultiInputPolicy

SelfDSAC = TypeVar("SelfDSAC", bound="DSAC")


class DSAC(CheckedOffPolicyAlgorithm):
    """
    Distributional Soft Actor-Critic with three refinements (DSAC-T)
    Paper: https://arxiv.org/abs/2310.05858 (Duan et al. 2023), after https://arxiv.org/abs/2001.02811 (Duan et al. 2021).
    It is the base of the methods of "Confidence-Guided Human-AI Collaboration" (C-HAC, Li et al. 2025).

    SAC whose critics learn the distribution of the soft return, Z(s, a) ~ N(Q(s, a), sigma(s, a)^2). With a' from the
    target actor and m the critic whose target mean is the smaller one::

        y_q = r + gamma (1 - d) (Q_m(s', a') - alpha log pi(a'|s'))           target of the mean
        y_z = r + gamma (1 - d) (Z_m(s', a') - alpha log pi(a'|s'))           target of the standard deviation

    See ``sb3_chac.common.distributional.gaussian_surrogate_loss`` for the critic's loss.

    Differences from the paper:

    - y_z samples the critic m that y_q uses, so that both targets belong to one distribution.
    - The divisions are stabilised with +0.1 and the sample is clipped to three standard deviations, as in the
      authors' experiments, but rescaled to unit variance: clipping alone leaves sigma 10 % too small at gamma 0.99.
      Their later "Huber" form of the loss is not used: it shrinks sigma about 7 times.
    - The target entropy is counted in actions scaled to [-1, 1], as everywhere in SB3. The authors count it in the
      environment's units; theirs is ours plus ``sum(log((high - low) / 2))``.
    - Time limits do not end the return (SB3 bootstraps through truncations).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with a bounded Box action space
    :param learning_rate: learning rate of the actor and the critics,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient of the target networks (between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default), added to the sampled action
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the critics.
        As in SB3, only with the default replay buffer and not for Dict observations.
    :param ent_coef: Entropy regularization coefficient alpha. Set it to 'auto' to learn it
        (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target networks every ``target_update_interval`` actor updates
    :param target_entropy: target entropy when learning ``ent_coef``: "auto" is -1 per action, "auto_8" -8 per action
    :param ent_coef_lr: learning rate of the entropy coefficient, can be a schedule too
    :param policy_delay: gradient steps of the critics per update of the actor, the entropy coefficient and all targets
    :param eta: weight of sigma^2 in the critic's loss; sigma^2 shrinks as 1 / eta, 1 keeps it calibrated
    :param tau_b: coefficient of the running mean of sigma that scales and clips the critic's loss; ``tau`` if None
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling
        during the warm up phase (before learning starts)
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``DSACPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or, while learning,
        an observation or reward that is NaN or infinite
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    required_policy = DSACPolicy
    policy: DSACPolicy
    actor: Actor
    actor_target: Actor
    critic: DistributionalCritic
    critic_target: DistributionalCritic
    log_ent_coef: th.nn.Parameter | None  # None for a fixed coefficient, as in SB3

    @checked
    def __init__(
        self,
        policy: str | type[DSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        ent_coef_lr: float | Schedule = 3e-4,
        policy_delay: int = 2,
        eta: float = 1.0,
        tau_b: float | None = None,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
            support_multi_env=True,
        )

        self.ent_coef = ent_coef
        self.target_update_interval = target_update_interval
        self.target_entropy = target_entropy
        self.ent_coef_lr = ent_coef_lr
        self.ent_coef_optimizer: th.optim.Adam | None = None
        self.policy_delay = policy_delay
        self.eta = eta
        self.tau_b = tau_b

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self._create_aliases()
        self.target_updates = [
            TargetUpdate(self.critic, self.critic_target),
            TargetUpdate(self.actor, self.actor_target),
        ]
        self.ent_coef_lr_schedule = FloatSchedule(self.ent_coef_lr)

        self.target_entropy = target_entropy(self.target_entropy, get_action_dim(self.action_space))

        initial = initial_ent_coef(self.ent_coef)
        parameter = self.policy.log_ent_coef
        with th.no_grad():
            parameter.fill_(safe_log(initial))
        self.ent_coef_tensor = th.full((1,), initial, device=self.device)  # the fixed one
        self.log_ent_coef = parameter if isinstance(self.ent_coef, str) else None
        parameter.requires_grad_(self.log_ent_coef is not None)
        if self.log_ent_coef is not None:
            self.ent_coef_optimizer = th.optim.Adam([parameter], lr=self.ent_coef_lr_schedule(1.0), fused=True)

    def _current_ent_coef(self) -> th.Tensor:
        """Return the entropy coefficient alpha, shape (1,)."""
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()

    def _optimizers(self) -> list[th.optim.Optimizer]:
        """Return the optimizers that follow ``learning_rate``."""
        return [self.actor.optimizer, self.critic.optimizer]

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_learning_rate("ent_coef_lr", self.ent_coef_lr)
        check_integer("target_update_interval", self.target_update_interval, low=1)
        check_integer("policy_delay", self.policy_delay, low=1)
        check_range("eta", self.eta, low=0.0, exclusive_low=True)
        if self.tau_b is not None:
            check_range("tau_b", self.tau_b, low=0.0, high=1.0)
        target_entropy(self.target_entropy, get_action_dim(self.action_space))
        initial_ent_coef(self.ent_coef)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rates according to their schedules
        self._update_learning_rate(self._optimizers())
        if self.ent_coef_optimizer is not None:
            update_learning_rate(self.ent_coef_optimizer, self.ent_coef_lr_schedule(self._current_progress_remaining))
        # Kept as tensors and read only once, at the end
        stats: defaultdict[str, list[th.Tensor]] = defaultdict(list)

        for _ in range(gradient_steps):
            self._n_updates += 1
            # We need to sample because `log_std` may have changed between two gradient steps
            if self.use_sde:
                self.policy.reset_noise()
            for name, value in self._gradient_step(self._sample_batch(batch_size)).items():
                stats[name].append(value)
        detach_distributions(self.policy)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in stats.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())

    def _sample_batch(self, batch_size: int) -> Any:
        return self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]

    def _gradient_step(self, batch: Any) -> dict[str, th.Tensor]:
        """
        Make one gradient step.

        :param batch: from the replay buffer
        :return: what to log, scalars
        """
        ent_coef = self._current_ent_coef()
        stats = self._update_critic(batch, ent_coef)
        if self._n_updates % self.policy_delay == 0:
            stats |= self._update_policy(batch, ent_coef)
        return stats

    def _update_critic(self, batch: Any, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        targets = self._return_targets(self.actor_target, self.critic_target, batch, batch.rewards.flatten(), ent_coef)
        losses, _, stats = self._critic_losses(self.critic, batch, targets)
        minimize(losses.mean(dim=1).sum(), self.critic.optimizer)
        return stats

    def _update_policy(self, batch: Any, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        stats = self._update_actor(self.actor, self.critic, batch.observations, ent_coef)
        if self._targets_are_due():
            for update in self.target_updates:
                update(self.tau)
        return stats

    def _targets_are_due(self) -> bool:
        return (self._n_updates // self.policy_delay) % self.target_update_interval == 0

    @th.no_grad()
    def _return_targets(
        self, actor_target: Actor, critic_target: DistributionalCritic, batch: Any, rewards: th.Tensor, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute the mean and the sampled target of the return.

        :return: y_q and y_z with a' from ``actor_target``, both of shape (batch_size,)
        """
        next_actions, next_log_prob = actor_target.action_log_prob(batch.next_observations)
        next_q, next_std = critic_target.pessimistic(batch.next_observations, next_actions)
        return return_targets(rewards, self._discounts(batch), next_q, next_std, ent_coef * next_log_prob)

    def _discounts(self, batch: Any) -> th.Tensor:
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        gamma = self.gamma if batch.discounts is None else batch.discounts.flatten()
        return (1 - batch.dones.flatten()) * gamma

    def _critic_losses(
        self, critic: DistributionalCritic, batch: Any, targets: tuple[th.Tensor, th.Tensor], eta: float | None = None
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor], dict[str, th.Tensor]]:
        """
        Compute the losses of the critics.

        :return: losses of shape (n_critics, batch_size), (Q, sigma) of the same shape, and what to log
        """
        q_values, stds = critic(batch.observations, batch.actions)
        mean_std = critic.update_mean_std(stds, self.tau if self.tau_b is None else self.tau_b)
        losses = gaussian_surrogate_loss(q_values, stds, *targets, mean_std, self.eta if eta is None else eta)
        with th.no_grad():
            nll = gaussian_nll(q_values, stds, targets[1]).mean()
            stats = {"critic_nll": nll, "q_mean": q_values.mean(), "sigma_mean": stds.mean()}
        return losses, (q_values, stds), stats

    def _update_actor(
        self,
        actor: Actor,
        critic: DistributionalCritic,
        observations: PyTorchObs,
        ent_coef: th.Tensor,
        penalty: Callable[[th.Tensor], th.Tensor] | None = None,
    ) -> dict[str, th.Tensor]:
        """
        Optimize an actor against the smaller mean of a critic, and the entropy coefficient.

        :param penalty: of the actions, of shape (batch_size, action_dim); subtracted from the mean, shape (batch_size,)
        :return: what to log
        """
        actions, log_prob = actor.action_log_prob(observations)
        with frozen(critic.optimizer.param_groups[0]["params"]):
            q_values, _ = critic(observations, actions)
            actor_loss = (ent_coef * log_prob - q_values.min(dim=0).values).mean()
            if penalty is not None:
                actor_loss = actor_loss + penalty(actions).mean()
            minimize(actor_loss, actor.optimizer)
        entropy = -log_prob.detach().mean()
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            minimize((self.log_ent_coef * (entropy - float(self.target_entropy))).mean(), self.ent_coef_optimizer)
        return {"actor_loss": actor_loss.detach(), "entropy": entropy, "ent_coef": ent_coef.squeeze()}

    def learn(
        self: SelfDSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "DSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDSAC:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        # Aliases of what the policy holds
        aliases = ["actor", "actor_target", "critic", "critic_target", "log_ent_coef", "ent_coef_tensor"]
        return [*super()._excluded_save_params(), *aliases, "target_updates"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer"]
        if self.ent_coef_optimizer is not None:
            state_dicts.append("ent_coef_optimizer")
        return state_dicts, []
