"""Conservative Q-learning (CQL)."""

import math
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import Actor

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_action_space, check_integer, check_learning_rate, check_range
from sb3_chac.common.demonstrations import Dataset
from sb3_chac.common.offline import Batch, OfflineAlgorithm
from sb3_chac.common.utils import (
    TargetUpdate,
    detach_distributions,
    frozen,
    initial_ent_coef,
    minimize,
    safe_log,
    target_entropy,
)
from sb3_chac.cql.policies import CnnPolicy, CQLPolicy, MlpPolicy

SelfCQL = TypeVar("SelfCQL", bound="CQL")

MAX_LOG_WEIGHT = math.log(1e6)  # of the conservative term in the Lagrange form, as in the authors' code


class CQL(OfflineAlgorithm):
    """
    Conservative Q-Learning, the variant CQL(H) on top of SAC, from demonstrations alone
    Paper: https://arxiv.org/abs/2006.04779 (Kumar et al. 2020).

    With a' from the actor in s', Q- the smaller one of the target critics and D the dataset, each critic minimizes::

        1/2 E_D[(Q(s, a) - r - gamma (1 - d) Q-(s', a'))^2] + weight E_D[gap(s, a)]
        gap(s, a) = T log integral of exp(Q(s, b) / T) db - Q(s, a)

    so that Q is small except where the dataset has actions. The integral is estimated from N actions each that are drawn
    uniformly, from the actor in s and from the actor in s' (see ``conservative_gap``). In the Lagrange form, the weight is
    learned: it grows where the gap is above the threshold tau, minimizing ``-weight (E_D[gap] - tau)``. The actor is SAC's: it
    minimizes ``E_D[alpha log pi(b|s) - min Q(s, b)]``.

    Differences from the authors' code:

    - The log integral is an estimate of just that (as in the paper's appendix): theirs lacks the ``- log(3 N)``, and with a
      temperature also divides the log densities by it. This shifts the gap, and so matters for tau only.
    - The actions of the demonstrations are scaled to [-1, 1], as everywhere in SB3; so the uniform density is 2^-dim.
    - The actor does not start with behaviour cloning.

    ``learn(total_timesteps)`` counts gradient steps. See ``OfflineAlgorithm`` for what the environment is for.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy)
    :param env: The environment that the dataset was recorded in (if registered in Gym, can be str), with a bounded Box action
        space
    :param dataset: see ``load_demonstrations``: id or folder of a dataset of Minari, a list of them, ...
    :param learning_rate: learning rate of the critics, it can be a function of the current progress remaining (from 1 to 0)
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient of the target critics (between 0 and 1)
    :param gamma: the discount factor
    :param ent_coef: Entropy regularization coefficient alpha. Set it to 'auto' to learn it
        (and 'auto_0.1' for using 0.1 as initial value)
    :param target_entropy: target entropy when learning ``ent_coef``, "auto" is -1 per action, "auto_8" -8 per action
    :param actor_lr: learning rate of the actor and the entropy coefficient, can be a schedule too
    :param entropy_backup: whether the target of Q holds ``-alpha log pi(a'|s')``, as in SAC
    :param conservative_weight: weight of the gap; where it starts in the Lagrange form
    :param n_action_samples: N
    :param temperature: T, > 0
    :param lagrange_threshold: tau, > 0, for the Lagrange form; None keeps ``conservative_weight``
    :param lagrange_lr: learning rate of the weight in the Lagrange form
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see SB3's ``SACPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or a dataset that is
        missing, damaged or does not fit (``DatasetError``)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy}
    required_policy = CQLPolicy
    networks: ClassVar[tuple[str, ...]] = ("pi", "qf")
    policy: CQLPolicy
    actor: Actor
    critic: ContinuousCritic
    critic_target: ContinuousCritic

    @checked
    def __init__(
        self,
        policy: str | type[CQLPolicy],
        env: GymEnv | str,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        actor_lr: float | Schedule = 1e-4,
        entropy_backup: bool = False,
        conservative_weight: float = 5.0,
        n_action_samples: int = 10,
        temperature: float = 1.0,
        lagrange_threshold: float | None = None,
        lagrange_lr: float = 3e-4,
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
            dataset,
            learning_rate,
            batch_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.tau = tau
        self.gamma = gamma
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.actor_lr = actor_lr
        self.entropy_backup = entropy_backup
        self.conservative_weight = conservative_weight
        self.n_action_samples = n_action_samples
        self.temperature = temperature
        self.lagrange_threshold = lagrange_threshold
        self.lagrange_lr = lagrange_lr
        self.ent_coef_optimizer: th.optim.Adam | None = None
        self.lagrange_optimizer: th.optim.Adam | None = None

        if _init_setup_model:
            self._setup_model()
            self.set_dataset(dataset)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_action_space(env.action_space)
        return OfflineAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor, self.critic, self.critic_target = self.policy.actor, self.policy.critic, self.policy.critic_target
        self.target_update = TargetUpdate(self.critic, self.critic_target)
        self.actor_lr_schedule = FloatSchedule(self.actor_lr)
        self.target_entropy = target_entropy(self.target_entropy, get_action_dim(self.action_space))

        learn_ent_coef, learn_weight = isinstance(self.ent_coef, str), self.lagrange_threshold is not None
        initial = initial_ent_coef(self.ent_coef)
        with th.no_grad():
            self.policy.log_ent_coef.fill_(safe_log(initial))
            self.policy.log_conservative_weight.fill_(safe_log(self.conservative_weight))
        self.ent_coef_tensor = th.full((1,), initial, device=self.device)  # the fixed one
        self.log_ent_coef = self.policy.log_ent_coef if learn_ent_coef else None  # as in SB3
        self.policy.log_ent_coef.requires_grad_(learn_ent_coef)
        self.policy.log_conservative_weight.requires_grad_(learn_weight)
        if learn_ent_coef:
            self.ent_coef_optimizer = th.optim.Adam([self.policy.log_ent_coef], lr=self.actor_lr_schedule(1.0))
        if learn_weight:
            self.lagrange_optimizer = th.optim.Adam([self.policy.log_conservative_weight], lr=self.lagrange_lr)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_range("tau", self.tau, low=0.0, high=1.0)
        check_range("gamma", self.gamma, low=0.0, high=1.0)
        check_learning_rate("actor_lr", self.actor_lr)
        check_range("lagrange_lr", self.lagrange_lr, low=0.0)
        check_range(
            "conservative_weight", self.conservative_weight, low=0.0, exclusive_low=self.lagrange_threshold is not None
        )
        check_integer("n_action_samples", self.n_action_samples, low=1)
        check_range("temperature", self.temperature, low=0.0, exclusive_low=True)
        if self.lagrange_threshold is not None:
            check_range("lagrange_threshold", self.lagrange_threshold, low=0.0, exclusive_low=True)
        target_entropy(self.target_entropy, get_action_dim(self.action_space))
        initial_ent_coef(self.ent_coef)

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [self.critic.optimizer]

    def _update_learning_rates(self) -> None:
        super()._update_learning_rates()
        for optimizer in filter(None, (self.actor.optimizer, self.ent_coef_optimizer)):
            update_learning_rate(optimizer, self.actor_lr_schedule(self._current_progress_remaining))

    def _gradient_step(self, batch: Batch) -> dict[str, th.Tensor]:
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()
        stats = self._update_critic(batch, ent_coef) | self._update_actor(batch, ent_coef)
        self.target_update(self.tau)
        detach_distributions(self.policy)
        return stats

    def _update_critic(self, batch: Batch, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        targets = self._q_targets(batch, ent_coef)
        q_values = th.cat(self.critic(batch.observations, batch.actions), dim=1)
        bellman_loss = 0.5 * (q_values - targets.unsqueeze(1)).square().mean(dim=0).sum()
        sampled_q_values, log_densities = self._sampled_q_values(batch)
        gaps = conservative_gap(sampled_q_values, log_densities, q_values.t(), self.temperature).mean(dim=1)
        if self.lagrange_optimizer is None:
            weight = th.full((1,), self.conservative_weight, device=self.device)
        else:
            weight = self.policy.log_conservative_weight.detach().exp()
        minimize(bellman_loss + (weight * gaps).sum(), self.critic.optimizer)
        if self.lagrange_optimizer is not None:
            assert self.lagrange_threshold is not None
            excess = gaps.detach().mean() - self.lagrange_threshold
            minimize(-(self.policy.log_conservative_weight.exp() * excess).sum(), self.lagrange_optimizer)
            with th.no_grad():
                self.policy.log_conservative_weight.clamp_(max=MAX_LOG_WEIGHT)
        return {
            "bellman_loss": bellman_loss.detach(),
            "conservative_gap": gaps.detach().mean(),
            "conservative_weight": weight.squeeze(),
            "q_data": q_values.detach().mean(),
            # The first N samples are the uniform ones
            "q_random": sampled_q_values[..., : self.n_action_samples].detach().mean(),
        }

    @th.no_grad()
    def _q_targets(self, batch: Batch, ent_coef: th.Tensor) -> th.Tensor:
        """
        Compute the targets of the critics.

        :return: shape (batch_size,)
        """
        next_actions, next_log_prob = self.actor.action_log_prob(batch.next_observations)
        next_q = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1).min(dim=1).values
        if self.entropy_backup:
            next_q = next_q - ent_coef * next_log_prob
        return batch.rewards + self.gamma * (1 - batch.dones) * next_q

    def _sampled_q_values(self, batch: Batch) -> tuple[th.Tensor, th.Tensor]:
        """
        Evaluate the critics at sampled actions.

        :return: Q(s, b) for N actions each drawn uniformly, from the actor in s and from the actor in s', shape
            (n_critics, batch_size, 3 N), and the log densities that they were drawn with, shape (batch_size, 3 N)
        """
        size, n, dim = len(batch.actions), self.n_action_samples, batch.actions.shape[1]
        with th.no_grad():
            uniform = th.empty(size, n, dim, device=self.device).uniform_(-1, 1)
            uniform_log_density = th.full((size, n), -dim * math.log(2), device=self.device)
            current, current_log_prob = self._draw_actions(batch.observations)
            following, following_log_prob = self._draw_actions(batch.next_observations)
            actions = th.cat([uniform, current, following], dim=1)
            log_densities = th.cat([uniform_log_density, current_log_prob, following_log_prob], dim=1)
        # Features once for all actions (a shared extractor is learned by the actor's loss alone, as in SB3's SAC)
        with th.set_grad_enabled(not self.critic.share_features_extractor):
            features = self.critic.extract_features(batch.observations, self.critic.features_extractor)
        inputs = th.cat([features.repeat_interleave(3 * n, dim=0), actions.flatten(end_dim=1)], dim=1)
        return th.stack([q_net(inputs).view(size, 3 * n) for q_net in self.critic.q_networks]), log_densities

    def _draw_actions(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Draw actions of the actor.

        :return: actions of shape (batch_size, N, action_dim) and their log densities, shape (batch_size, N)
        """
        parameters = self.actor.get_action_dist_params(observations)[:2]
        repeated = (parameter.repeat_interleave(self.n_action_samples, dim=0) for parameter in parameters)
        actions, log_prob = self.actor.action_dist.log_prob_from_params(*repeated)
        return actions.view(len(observations), self.n_action_samples, -1), log_prob.view(len(observations), -1)

    def _update_actor(self, batch: Batch, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        actions, log_prob = self.actor.action_log_prob(batch.observations)
        with frozen(self.critic.optimizer.param_groups[0]["params"]):
            q_values = th.cat(self.critic(batch.observations, actions), dim=1).min(dim=1).values
            actor_loss = (ent_coef * log_prob - q_values).mean()
            minimize(actor_loss, self.actor.optimizer)
        entropy = -log_prob.detach().mean()
        if self.ent_coef_optimizer is not None:
            loss = (self.policy.log_ent_coef * (entropy - float(self.target_entropy))).mean()
            minimize(loss, self.ent_coef_optimizer)
        return {"actor_loss": actor_loss.detach(), "entropy": entropy, "ent_coef": ent_coef.squeeze()}

    def learn(
        self: SelfCQL,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1000,
        tb_log_name: str = "CQL",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCQL:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        # Aliases of what the policy holds
        aliases = ["actor", "critic", "critic_target", "log_ent_coef"]
        return [*super()._excluded_save_params(), *aliases, "ent_coef_tensor", "target_update"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        optimizers = [name for name in ("ent_coef_optimizer", "lagrange_optimizer") if getattr(self, name) is not None]
        return ["policy", "actor.optimizer", "critic.optimizer", *optimizers], []


def conservative_gap(
    sampled_q_values: th.Tensor, log_densities: th.Tensor, data_q_values: th.Tensor, temperature: float = 1.0
) -> th.Tensor:
    """
    Estimate how much larger Q is elsewhere than on the dataset, ``T log integral of exp(Q(s, b) / T) db - Q(s, a)``, with the
    integral estimated by importance sampling, ``1/M sum over i of exp(Q(s, b_i) / T) / mu_i(b_i)`` (Kumar et al. 2020,
    appendix F).

    :param sampled_q_values: Q(s, b_i), shape (..., batch_size, M)
    :param log_densities: log mu_i(b_i) of the distributions that the actions were drawn from, shape (batch_size, M)
    :param data_q_values: Q(s, a), shape (..., batch_size)
    :param temperature: T, > 0
    :return: shape (..., batch_size)
    """
    log_mean = th.logsumexp(sampled_q_values / temperature - log_densities, dim=-1) - math.log(sampled_q_values.shape[-1])
    return temperature * log_mean - data_q_values
