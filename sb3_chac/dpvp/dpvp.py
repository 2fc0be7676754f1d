"""Distributional proxy value propagation (D-PVP)."""

import io
import pathlib
import warnings
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TensorDict

from sb3_chac.common.arguments import checked
from sb3_chac.common.buffers import DualReplayBuffer, DualReplayBufferSamples, taken_over
from sb3_chac.common.checks import check_range
from sb3_chac.common.distributional import gaussian_surrogate_loss
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.common.utils import TargetUpdate, initial_ent_coef, minimize
from sb3_chac.dpvp.policies import CnnPolicy, DPVPPolicy, MlpPolicy, MultiInputPolicy
from sb3_chac.dsac.dsac import DSAC

SelfDPVP = TypeVar("SelfDPVP", bound="DPVP")


class DPVP(GuidedOffPolicyAlgorithm, DSAC):
    """
    Distributional Proxy Value Propagation (D-PVP): a human takes over, and the takeovers shape the return distribution.
    Paper: "Confidence-Guided Human-AI Collaboration" (C-HAC, Li et al. 2025), after PVP (Peng et al., NeurIPS 2023).

    DSAC without reward. The proxy return distribution Z_g(s, a) ~ N(Q, sigma^2) learns from temporal differences with r = 0 on
    the executed action a_b, and from two labels where the human drove (I = 1): +B for the human's action a_h, -B for the
    action a_n that the novice had proposed. With L(y; s, a) the surrogate of -log N(y; Q(s, a), sigma(s, a)^2)
    (``sb3_chac.common.distributional.gaussian_surrogate_loss``), averaged over the whole batch::

        mean[ L(y; s, a_b) + pv_coef I (L(+B; s, a_h) + L(-B; s, a_n)) ],     y = gamma (1 - d) (Z_g(s', a') - alpha log pi_g)

    The human-guided policy pi_g is DSAC's actor and maximises Q - alpha log pi_g. Half of a batch comes from each store.

    Differences from the paper:

    - D_KL(Dirac, Gaussian) is infinite: the cross-entropy -log N(B; Q, sigma^2) is minimised, in DSAC-T's stabilised form.
    - The confidence distribution Z_c, which D-PVP itself has no use for, belongs to ``CHAC``.
    - A transition is stored once: in the human's store if the human drove, in the novice's otherwise.
    - The entropy bonus, which the novice can collect for ever by standing still, must not swamp labels of +-1 (it sums up to
      gamma alpha H / (1 - gamma)): alpha is fixed at 0.01. The paper learns it from 1, towards -8 per action.
    - No -B where the novice proposed nearly what the human did (``pv_min_diff``): else both labels fall on one action.
    - Without reward no return lies outside of [-B, B], but what Q believes of unseen actions does, and grows by bootstrapping:
      targets are clipped (``bounded_targets``).
    - A few thousand labels are drawn many hundred times each. A strong decay of the weights (``weight_decay``) keeps Z_g and
      pi_g from learning them by heart.
    - The policy differs from one thousand steps to the next. What acts when ``deterministic`` (and, in C-HAC, in stage 2) is
      an average of its parameters over time (``average_tau``).

    ``PAPER`` are the arguments that read the paper literally: ``DPVP("MlpPolicy", env, **DPVP.PAPER)``, or RL-Zoo3's
    ``--conf-file`` with hyperparams/paper/dpvp.yml.

    The parameters are those of ``DSAC``, and:

    :param buffer_size: capacity of each of the two stores, in transitions
    :param replay_buffer_class: ``DualReplayBuffer``, or a class derived from it
    :param optimize_memory_usage: not supported, must be False
    :param n_steps: number of rewards in a return; it ends early where the driver changes
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``DPVPPolicy``
    :param proxy_value: B, the label of the human's actions; minus B is the label of the novice's
    :param pv_coef: weight of the labels
    :param pv_min_diff: no label -B where the root mean square of a_h - a_n, both in [-1, 1], is smaller
    :param bounded_targets: whether the targets of Z_g are clipped to [-B, B]
    :param weight_decay: of pi_g and Z_g, relative to the learning rate (decoupled, as in AdamW)
    :param average_tau: coefficient of the running mean of pi_g's parameters; 1 is pi_g itself
    :param eta_pv: weight of sigma^2 in the loss of the labels, ``eta`` if None
    :param takeover_stop_td: leave temporal differences out on the first step of a takeover
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or, while learning,
        an observation or reward that is NaN or infinite
    """

    PAPER: ClassVar[dict[str, Any]] = {
        "ent_coef": "auto",
        "target_entropy": "auto_8",
        "pv_min_diff": 0.0,
        "bounded_targets": False,
        "weight_decay": 0.0,
        "average_tau": 1.0,
    }
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    required_policy = DPVPPolicy
    policy: DPVPPolicy

    @checked
    def __init__(
        self,
        policy: str | type[DPVPPolicy],
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
        replay_buffer_class: type[DualReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = 0.01,
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        ent_coef_lr: float | Schedule = 3e-4,
        policy_delay: int = 2,
        eta: float = 1.0,
        tau_b: float | None = None,
        proxy_value: float = 1.0,
        pv_coef: float = 1.0,
        pv_min_diff: float = 0.15,
        bounded_targets: bool = True,
        weight_decay: float = 3.0,
        average_tau: float = 5e-4,
        eta_pv: float | None = None,
        takeover_stop_td: bool = False,
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
            ent_coef_lr=ent_coef_lr,
            policy_delay=policy_delay,
            eta=eta,
            tau_b=tau_b,
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
        self.proxy_value = proxy_value
        self.pv_coef = pv_coef
        self.pv_min_diff = pv_min_diff
        self.bounded_targets = bounded_targets
        self.weight_decay = weight_decay
        self.average_tau = average_tau
        self.eta_pv = eta_pv
        self.takeover_stop_td = takeover_stop_td

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self.average_update = TargetUpdate(self.actor, self.policy.averaged_actor)
        self._set_weight_decay()

    def _set_weight_decay(self) -> None:
        for optimizer in (self.actor.optimizer, self.critic.optimizer):
            for group in optimizer.param_groups:
                group["weight_decay"] = self.weight_decay

    def set_parameters(
        self,
        load_path_or_dict: str | pathlib.Path | io.BufferedIOBase | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        super().set_parameters(load_path_or_dict, exact_match, device)
        self._set_weight_decay()  # an argument: the optimizers' state holds the one that they were saved with

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_range("proxy_value", self.proxy_value, low=0.0, exclusive_low=True)
        check_range("pv_coef", self.pv_coef, low=0.0)
        check_range("pv_min_diff", self.pv_min_diff, low=0.0)
        check_range("weight_decay", self.weight_decay, low=0.0)
        if self.weight_decay > 0 and self.policy_kwargs.get("optimizer_class", th.optim.AdamW) is not th.optim.AdamW:
            raise ValueError("weight_decay needs the optimizer AdamW, the default: pass weight_decay=0 for another one.")
        check_range("average_tau", self.average_tau, low=0.0, high=1.0)
        if self.eta_pv is not None:
            check_range("eta_pv", self.eta_pv, low=0.0, exclusive_low=True)
        if initial_ent_coef(self.ent_coef) > 0.1 * self.proxy_value:
            warnings.warn(
                f"ent_coef={self.ent_coef!r}: the entropy bonus will swamp the takeovers' labels of +-{self.proxy_value:g}. "
                "Use a fixed coefficient of about 0.01 times proxy_value."
            )

    def _update_policy(self, batch: DualReplayBufferSamples, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        stats = super()._update_policy(batch, ent_coef)
        n_actor_updates = self._n_updates // self.policy_delay
        self.average_update(max(self.average_tau, 1 / n_actor_updates))
        return stats

    def _update_critic(self, batch: DualReplayBufferSamples, ent_coef: th.Tensor) -> dict[str, th.Tensor]:
        # Temporal differences without reward
        no_rewards = th.zeros_like(batch.rewards.flatten())
        targets = self._return_targets(self.actor_target, self.critic_target, batch, no_rewards, ent_coef)
        if self.bounded_targets:
            mean_targets, sampled_targets = (target.clamp(-self.proxy_value, self.proxy_value) for target in targets)
            targets = mean_targets, sampled_targets
        losses, (q_values, stds), stats = self._critic_losses(self.critic, batch, targets)
        if self.takeover_stop_td:
            losses = losses * (1 - batch.takeover_starts.flatten())
        loss = losses.mean(dim=1).sum()

        # Labels, on the human's rows only
        human = taken_over(batch, self.pv_min_diff)
        if len(human.rows) > 0:
            q_human, std_human = q_values[:, human.rows], stds[:, human.rows]
            q_novice, std_novice = self.critic(human.observations, human.novice_actions)
            human_losses = self._label_losses(q_human, std_human, self.proxy_value)
            novice_losses = self._label_losses(q_novice, std_novice, -self.proxy_value) * human.differ
            loss = loss + self.pv_coef * (human_losses + novice_losses).sum() / len(batch.takeovers)
            stats |= {"q_human": q_human.detach().mean(), "q_novice": q_novice.detach().mean()}
        minimize(loss, self.critic.optimizer)
        return stats

    def _label_losses(self, q_values: th.Tensor, stds: th.Tensor, label: float) -> th.Tensor:
        """
        Compute the loss of the proxy values.

        :return: loss of each critic and sample against a fixed target, shape of ``q_values``
        """
        target = th.full_like(q_values, label)
        eta = self.eta if self.eta_pv is None else self.eta_pv
        return gaussian_surrogate_loss(q_values, stds, target, target, self.critic.mean_std, eta)

    def learn(
        self: SelfDPVP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "DPVP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDPVP:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "average_update"]
