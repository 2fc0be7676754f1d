"""PPO with a Lagrange multiplier on the safety cost (PPO-Lag)."""

from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional as F

from sb3_chac.common.arguments import check_policy_kwargs, checked
from sb3_chac.common.checked_rollouts import CheckedRollouts
from sb3_chac.common.checks import check_learning_rate, check_policy, check_range
from sb3_chac.common.lagrange import CostConstrainedAlgorithm, constrained_advantages
from sb3_chac.common.utils import detach_distributions
from sb3_chac.ppo_lag.buffers import CostDictRolloutBuffer, CostRolloutBuffer, CostRolloutBufferSamples
from sb3_chac.ppo_lag.policies import CnnPolicy, CostActorCriticPolicy, MlpPolicy, MultiInputPolicy

SelfPPOLag = TypeVar("SelfPPOLag", bound="PPOLag")


class PPOLag(CostConstrainedAlgorithm, CheckedRollouts, PPO):
    """
    PPO-Lagrangian: PPO that keeps the mean cost of an episode (the sum of ``info["cost"]``) below a limit, with the PID
    multiplier of https://arxiv.org/abs/2007.03964 (Stooke et al. 2020), see ``PIDLagrangian``.

    A second value network learns the discounted cost, from which the advantage of the cost A_c is estimated as that of the
    reward A_r is (GAE, bootstrapped through time limits). After each rollout the multiplier lambda is moved by the mean cost
    of the episodes that ended in it; then PPO goes on with ``(A_r - lambda A_c) / (1 + lambda)``, in which A_r is normalised
    as in PPO and A_c centred, see ``constrained_advantages``.

    ``rollout/ep_cost_mean`` is the mean over the last ``stats_window_size`` episodes, ``safety/safety_cost`` the sum since the
    start of the training.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with ``info["cost"]`` at every step
    :param learning_rate: The learning rate, it can be a function
        of the current progress remaining (from 1 to 0)
    :param n_steps: The number of steps to run for each environment per update
        (i.e. rollout buffer size is n_steps * n_envs where n_envs is number of environment copies running in parallel)
    :param batch_size: Minibatch size
    :param n_epochs: Number of epoch when optimizing the surrogate loss
    :param gamma: Discount factor
    :param gae_lambda: Factor for trade-off of bias vs variance for Generalized Advantage Estimator
    :param clip_range: Clipping parameter, it can be a function of the current progress
        remaining (from 1 to 0).
    :param clip_range_vf: Clipping parameter for the value function of the reward,
        it can be a function of the current progress remaining (from 1 to 0). No clipping if None.
        IMPORTANT: this clipping depends on the reward scaling; the value function of the cost is never clipped.
    :param normalize_advantage: Whether to normalize the advantage of the reward and centre that of the cost
    :param ent_coef: Entropy coefficient for the loss calculation
    :param vf_coef: Value function coefficient for the loss calculation
    :param max_grad_norm: The maximum value for the gradient clipping
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param rollout_buffer_class: Rollout buffer class to use, derived from ``CostRolloutBuffer``.
        If ``None``, it will be automatically selected.
    :param rollout_buffer_kwargs: Keyword arguments to pass to the rollout buffer on creation
    :param target_kl: Limit the KL divergence between updates. By default, there is no limit.
    :param cost_limit: that the mean cost of an episode is to stay below
    :param cost_gamma: discount factor of costs; ``gamma`` if None
    :param cost_gae_lambda: ``gae_lambda`` of costs
    :param cost_vf_coef: coefficient of the loss of the cost's value function
    :param lagrange_init: the multiplier before the first rollout
    :param lagrange_max: upper bound of the multiplier, None for none
    :param pid_kp: gain of the proportional term
    :param pid_ki: gain of the integral term
    :param pid_kd: gain of the derivative term
    :param pid_tau: coefficient of the running mean of costs, for the proportional and the derivative term
    :param pid_delay: number of rollouts between the two costs of the derivative term
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, mean reward, and mean cost over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, those of SB3's ``ActorCriticPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument of its own that is out of its range, or, while learning, a cost that is missing, NaN or
        infinite
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: CostActorCriticPolicy
    rollout_buffer: CostRolloutBuffer

    @checked
    def __init__(
        self,
        policy: str | type[CostActorCriticPolicy],
        env: GymEnv | str,
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
        rollout_buffer_class: type[CostRolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        cost_limit: float = 1.0,
        cost_gamma: float | None = None,
        cost_gae_lambda: float = 0.95,
        cost_vf_coef: float = 0.5,
        lagrange_init: float = 0.0,
        lagrange_max: float | None = None,
        pid_kp: float = 0.1,
        pid_ki: float = 0.01,
        pid_kd: float = 0.01,
        pid_tau: float = 0.05,
        pid_delay: int = 10,
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
        self._set_constraint(cost_limit, cost_gamma, lagrange_init, lagrange_max, pid_kp, pid_ki, pid_kd, pid_tau, pid_delay)
        self.cost_gae_lambda = cost_gae_lambda
        self.cost_vf_coef = cost_vf_coef

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        self._setup_constraint()
        # Costs of the episodes that ended in this rollout
        self.finished_costs: list[float] = []
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = CostDictRolloutBuffer if is_dict else CostRolloutBuffer
        super()._setup_model()

    def _check_arguments(self) -> None:
        """
        Check the arguments.

        :raises ValueError: names the argument and the remedy
        """
        check_policy(type(self), self.policy_class, CostActorCriticPolicy)
        if self.rollout_buffer_class is not None and not issubclass(self.rollout_buffer_class, CostRolloutBuffer):
            raise ValueError(
                f"rollout_buffer_class must derive from CostRolloutBuffer, got {self.rollout_buffer_class.__name__}: "
                "PPOLag stores costs. Leave it out to get the default."
            )
        check_policy_kwargs("policy_kwargs", self.policy_class, self.policy_kwargs, ("pi", "vf"))
        check_learning_rate("learning_rate", self.learning_rate)
        check_range("cost_gae_lambda", self.cost_gae_lambda, low=0.0, high=1.0)
        check_range("cost_vf_coef", self.cost_vf_coef, low=0.0)

    def _maybe_recommend_cpu(self, mlp_class_name: str = CostActorCriticPolicy.__name__) -> None:
        super()._maybe_recommend_cpu(mlp_class_name)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Called once per step, before the rest of it is stored: stores the costs, beyond time limits those to come too."""
        assert dones is not None
        costs, finished = self._count_costs(infos, dones)
        super()._update_info_buffer(infos, dones)
        self.finished_costs += finished
        for idx, info in enumerate(infos):
            if dones[idx] and info.get("terminal_observation") is not None and info.get("TimeLimit.truncated", False):
                terminal_obs = self.policy.obs_to_tensor(info["terminal_observation"])[0]
                with th.no_grad():
                    costs[idx] += self.cost_discount * self.policy.predict_cost_values(terminal_obs).item()
        self.rollout_buffer.add_costs(costs, self._cost_values())

    @th.no_grad()
    def _cost_values(self) -> th.Tensor:
        """
        Predict the costs to come in the current states.

        :return: cost values of where the environments are, shape (n_envs, 1)
        """
        return self.policy.predict_cost_values(obs_as_tensor(self._last_obs, self.device))  # type: ignore[arg-type]

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        self.finished_costs = []
        is_complete = super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        if is_complete:
            assert self._last_episode_starts is not None
            self.rollout_buffer.compute_cost_returns_and_advantage(
                self._cost_values(), self._last_episode_starts, self.cost_discount, self.cost_gae_lambda
            )
        return is_complete

    def train(self) -> None:
        """
        Update the multiplier and, with it, the policy, using the currently gathered rollout buffer.
        """
        if self.finished_costs:
            self.multiplier.update(float(np.mean(self.finished_costs)))
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizer learning rate
        self._update_learning_rate(self.policy.optimizer)
        stats: defaultdict[str, list[float]] = defaultdict(list)

        continue_training = True
        for epoch in range(self.n_epochs):
            stats["approx_kl"].clear()
            for batch in self.rollout_buffer.get(self.batch_size):
                loss, values = self._loss(batch)
                for name, value in values.items():
                    stats[name].append(value.item())
                if self.target_kl is not None and stats["approx_kl"][-1] > 1.5 * self.target_kl:
                    continue_training = False
                    if self.verbose >= 1:
                        print(f"Early stopping at step {epoch} due to reaching max kl: {stats['approx_kl'][-1]:.2f}")
                    break
                self.policy.optimizer.zero_grad()
                loss.backward()
                # Clip grad norm
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1
            if not continue_training:
                break
        detach_distributions(self.policy)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._record_multiplier()
        for name, numbers in stats.items():
            self.logger.record(f"train/{name}", np.mean(numbers))
        buffer = self.rollout_buffer
        for name, predicted, returns in (
            ("explained_variance", buffer.values, buffer.returns),
            ("cost_explained_variance", buffer.cost_values, buffer.cost_returns),
        ):
            self.logger.record(f"train/{name}", explained_variance(predicted.flatten(), returns.flatten()))
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/clip_range", self._now(self.clip_range))
        if self.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", self._now(self.clip_range_vf))

    def _now(self, schedule: Any) -> float:
        return schedule(self._current_progress_remaining)

    def _loss(self, batch: CostRolloutBufferSamples) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        Compute the loss of a minibatch.

        :return: PPO's loss, with that of the cost's value function, and what to log, scalars
        """
        # Convert discrete action from float to long
        is_discrete = isinstance(self.action_space, spaces.Discrete)
        actions = batch.actions.long().flatten() if is_discrete else batch.actions
        values, cost_values, log_prob, entropy = self.policy.evaluate_actions_and_costs(batch.observations, actions)
        values = values.flatten()
        advantages = constrained_advantages(
            batch.advantages, batch.cost_advantages, self.multiplier.value, self.normalize_advantage
        )

        # Clipped surrogate loss; the ratio between old and new policy is one at the first iteration
        log_ratio = log_prob - batch.old_log_prob
        ratio = log_ratio.exp()
        clip_range = self._now(self.clip_range)
        policy_loss = -th.min(advantages * ratio, advantages * ratio.clamp(1 - clip_range, 1 + clip_range)).mean()

        if self.clip_range_vf is not None:
            # Clip the difference between old and new value
            clip_range_vf = self._now(self.clip_range_vf)
            values = batch.old_values + (values - batch.old_values).clamp(-clip_range_vf, clip_range_vf)
        value_loss = F.mse_loss(batch.returns, values)
        cost_value_loss = F.mse_loss(batch.cost_returns, cost_values.flatten())
        # Approximate entropy when no analytical form
        entropy_loss = log_prob.mean() if entropy is None else -entropy.mean()

        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss + self.cost_vf_coef * cost_value_loss
        with th.no_grad():
            return loss, {
                "loss": loss,
                "policy_gradient_loss": policy_loss,
                "value_loss": value_loss,
                "cost_value_loss": cost_value_loss,
                "entropy_loss": entropy_loss,
                # Of the reverse KL divergence, http://joschu.net/blog/kl-approx.html
                "approx_kl": ((ratio - 1) - log_ratio).mean(),
                "clip_fraction": ((ratio - 1).abs() > clip_range).float().mean(),
            }

    def dump_logs(self, iteration: int = 0) -> None:
        self._record_costs()
        super().dump_logs(iteration)

    def learn(
        self: SelfPPOLag,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "PPOLag",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPPOLag:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "finished_costs"]
