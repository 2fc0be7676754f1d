"""SAC with a Lagrange multiplier on the safety cost (SAC-Lag)."""

import warnings
from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_integer
from sb3_chac.common.lagrange import CostConstrainedAlgorithm, constrained_actor_loss
from sb3_chac.common.off_policy_algorithm import CheckedOffPolicyAlgorithm
from sb3_chac.common.utils import TargetUpdate, detach_distributions, frozen, initial_ent_coef, minimize, target_entropy
from sb3_chac.sac_lag.buffers import CostNStepReplayBuffer, CostReplayBuffer, CostReplayBufferSamples, default_buffer_class
from sb3_chac.sac_lag.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, SACLagPolicy

SelfSACLag = TypeVar("SelfSACLag", bound="SACLag")


class SACLag(CostConstrainedAlgorithm, CheckedOffPolicyAlgorithm, SAC):
    """
    SAC-Lagrangian: SAC that keeps the mean cost of an episode (the sum of ``info["cost"]``) below a limit, with the PID
    multiplier of https://arxiv.org/abs/2007.03964 (Stooke et al. 2020), see ``PIDLagrangian``.

    Beside SAC's critics Q, two more learn the discounted cost Q_c. With a' ~ pi(s') the targets are::

        y   = r + gamma (1 - d) (min Q'(s', a') - alpha log pi(a'|s'))
        y_c = c + cost_gamma (1 - d) max Q_c'(s', a')

    and the actor minimises ``mean[ (alpha log pi - min Q + lambda max Q_c) / (1 + lambda) ]``. The maximum for costs is what
    the minimum is for returns: the actor seeks out where costs are underestimated, so an action is cheap only if both critics
    say so. Costs carry no entropy bonus, as the limit is on the costs alone.

    The multiplier lambda is moved once for each episode that ends, by its cost. ``rollout/ep_cost_mean`` is the mean over the
    last ``stats_window_size`` episodes, ``safety/safety_cost`` the sum since the start of the training.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with a bounded Box action space and
        ``info["cost"]`` at every step
    :param learning_rate: learning rate of all networks and the entropy coefficient,
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
    :param replay_buffer_class: Replay buffer class to use, derived from ``CostReplayBuffer``.
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
    :param n_steps: When n_step > 1, uses n-step returns of rewards and costs. As in SB3, not for Dict observations.
    :param ent_coef: Entropy regularization coefficient alpha. Set it to 'auto' to learn it
        (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target networks every ``target_update_interval`` gradient steps
    :param target_entropy: target entropy when learning ``ent_coef``, "auto" is -1 per action, "auto_8" -8 per action
    :param cost_limit: that the mean cost of an episode is to stay below
    :param cost_gamma: the discount factor of costs; ``gamma`` if None
    :param lagrange_start: how many steps of the model to leave the multiplier as it is for
    :param lagrange_init: the multiplier until then
    :param lagrange_max: upper bound of the multiplier, None for none
    :param pid_kp: gain of the proportional term
    :param pid_ki: gain of the integral term
    :param pid_kd: gain of the derivative term
    :param pid_tau: coefficient of the running mean of costs, for the proportional and the derivative term
    :param pid_delay: number of episodes between the two costs of the derivative term
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling
        during the warm up phase (before learning starts)
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, mean reward, and mean cost over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, those of SB3's ``SACPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or, while learning,
        an observation, reward or cost that is NaN or infinite, or a cost that is missing
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    required_policy = SACLagPolicy
    required_buffer = CostReplayBuffer
    policy: SACLagPolicy
    cost_critic: ContinuousCritic
    cost_critic_target: ContinuousCritic

    @checked
    def __init__(
        self,
        policy: str | type[SACLagPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[CostReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        cost_limit: float = 1.0,
        cost_gamma: float | None = None,
        lagrange_start: int = 1000,
        lagrange_init: float = 0.0,
        lagrange_max: float | None = None,
        pid_kp: float = 0.1,
        pid_ki: float = 0.01,
        pid_kd: float = 0.01,
        pid_tau: float = 0.05,
        pid_delay: int = 10,
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
            policy=policy,
            env=env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self._set_constraint(cost_limit, cost_gamma, lagrange_init, lagrange_max, pid_kp, pid_ki, pid_kd, pid_tau, pid_delay)
        self.lagrange_start = lagrange_start

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()  # before the buffer is chosen by them
        self._setup_constraint()
        self._choose_replay_buffer()
        self.target_entropy = target_entropy(self.target_entropy, get_action_dim(self.action_space))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`n_steps=")  # our buffer has got it
            super()._setup_model()
        self.target_updates = [
            TargetUpdate(self.critic, self.critic_target),
            TargetUpdate(self.cost_critic, self.cost_critic_target),
        ]

    def _choose_replay_buffer(self) -> None:
        if self.replay_buffer_class is None:
            self.replay_buffer_class = default_buffer_class(self.observation_space, self.n_steps)
        if not issubclass(self.replay_buffer_class, CostReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must derive from CostReplayBuffer, got {self.replay_buffer_class.__name__}: "
                f"{type(self).__name__} stores costs. Leave it out to get the default."
            )
        if issubclass(self.replay_buffer_class, CostNStepReplayBuffer) and self.n_steps > 1:
            returns = {"n_steps": self.n_steps, "gamma": self.gamma, "cost_gamma": self.cost_discount}
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, **returns}

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.cost_critic = self.policy.cost_critic
        self.cost_critic_target = self.policy.cost_critic_target

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_integer("target_update_interval", self.target_update_interval, low=1)
        check_integer("lagrange_start", self.lagrange_start, low=0)
        initial_ent_coef(self.ent_coef)
        target_entropy(self.target_entropy, get_action_dim(self.action_space))

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        _, finished = self._count_costs(infos, dones)
        if self.num_timesteps > self.lagrange_start:
            for episode_cost in finished:
                self.multiplier.update(episode_cost)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer, self.cost_critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        # Kept as tensors and read only once, at the end
        stats: defaultdict[str, list[th.Tensor]] = defaultdict(list)

        for _ in range(gradient_steps):
            self._n_updates += 1
            batch: Any = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            # We need to sample because `log_std` may have changed between two gradient steps
            if self.use_sde:
                self.actor.reset_noise()

            # Action by the current actor for the sampled state
            actions, log_prob = self.actor.action_log_prob(batch.observations)
            ent_coef = self._update_ent_coef(log_prob.detach())
            losses = self._update_critics(batch, ent_coef)
            with frozen(self._critic_parameters()):
                q_values = th.cat(self.critic(batch.observations, actions), dim=1)
                cost_q_values = th.cat(self.cost_critic(batch.observations, actions), dim=1)
                actor_loss = constrained_actor_loss(log_prob, q_values, cost_q_values, ent_coef, self.multiplier.value)
                minimize(actor_loss, self.actor.optimizer)
            if self._n_updates % self.target_update_interval == 0:
                for update in self.target_updates:
                    update(self.tau)

            means = {"q_mean": q_values.mean(), "cost_q_mean": cost_q_values.mean(), "ent_coef": ent_coef.squeeze()}
            for name, value in (losses | means | {"actor_loss": actor_loss}).items():
                stats[name].append(value.detach())
        detach_distributions(self.policy)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._record_multiplier()
        for name, values in stats.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())

    def _critic_parameters(self) -> list[th.Tensor]:
        return [p for critic in (self.critic, self.cost_critic) for p in critic.optimizer.param_groups[0]["params"]]

    def _update_ent_coef(self, log_prob: th.Tensor) -> th.Tensor:
        """
        Update the entropy coefficient.

        :param log_prob: log pi of the actor's actions, shape (batch_size,)
        :return: alpha before the update
        """
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return self.ent_coef_tensor
        ent_coef = self.log_ent_coef.detach().exp()
        minimize(-(self.log_ent_coef * (log_prob + float(self.target_entropy))).mean(), self.ent_coef_optimizer)
        return ent_coef

    def _update_critics(self, batch: CostReplayBufferSamples, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        losses = {}
        for name, critic, targets in zip(
            ("critic_loss", "cost_critic_loss"), (self.critic, self.cost_critic), self._targets(batch, ent_coef), strict=True
        ):
            q_values = th.cat(critic(batch.observations, batch.actions), dim=1)
            losses[name] = 0.5 * (q_values - targets).square().mean(dim=0).sum()
            minimize(losses[name], critic.optimizer)
        return losses

    @th.no_grad()
    def _targets(self, batch: CostReplayBufferSamples, ent_coef: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute the targets of return and cost.

        :return: y and y_c, both of shape (batch_size, 1)
        """
        next_actions, next_log_prob = self.actor.action_log_prob(batch.next_observations)
        q_values = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1).min(dim=1, keepdim=True).values
        costs = th.cat(self.cost_critic_target(batch.next_observations, next_actions), dim=1).max(dim=1, keepdim=True).values
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = self.gamma if batch.discounts is None else batch.discounts
        cost_discounts = self.cost_discount if batch.cost_discounts is None else batch.cost_discounts
        q_values = q_values - ent_coef * next_log_prob.reshape(-1, 1)
        goes_on = 1 - batch.dones
        return batch.rewards + goes_on * discounts * q_values, batch.costs + goes_on * cost_discounts * costs

    def dump_logs(self) -> None:
        self._record_costs()
        super().dump_logs()

    def learn(
        self: SelfSACLag,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SACLag",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSACLag:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "cost_critic", "cost_critic_target", "target_updates"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "cost_critic.optimizer"], variables
