"""Confidence-guided human-AI collaboration (C-HAC)."""

import warnings
from collections import deque
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.sac.policies import Actor

from sb3_chac.chac.policies import CONTROLS, CHACPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_chac.chac.relapse import RelapseWatch
from sb3_chac.common.arguments import checked
from sb3_chac.common.buffers import DualReplayBuffer, DualReplayBufferSamples
from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.common.critics import DistributionalCritic
from sb3_chac.common.distributional import return_targets
from sb3_chac.common.utils import TargetUpdate, minimize
from sb3_chac.dpvp.dpvp import DPVP

SelfCHAC = TypeVar("SelfCHAC", bound="CHAC")

QUIET_STEPS = 5000  # of stage 2 without pi_r, after which a warning says so
MOST_CHOICES = 1000  # steps of which the logger is told who drove, at most


class CHAC(DPVP):
    """
    Confidence-Guided Human-AI Collaboration (C-HAC).
    Paper: "Confidence-Guided Human-AI Collaboration" (Li et al. 2025).

    **Stage 1** is D-PVP (see ``DPVP``): the human-guided policy pi_g learns from takeovers. Beside it the confidence return
    distribution Z_c learns the reward's return of pi_g, as in DSAC.

    **Stage 2** begins after ``switch_after`` steps. The human is no longer asked, pi_g and Z_g stay as they are. The
    self-learning policy pi_r goes on from pi_g and maximises Q_c - alpha log pi_r on what is now collected. It acts only where
    the return distribution says, with enough confidence, that it does better::

        P(Q_r > Q_g) = Phi( (Q_c(s, a_r) - Q_c(s, a_g)) / sqrt(sigma_c(s, a_r)^2 + sigma_c(s, a_g)^2) ) > 1 - delta

    with a_r a sample of pi_r (its mode if ``deterministic``) and a_g the mode of pi_g; Q and sigma are those of the critic
    with the smaller mean. ``predict`` runs the same shared control.

    Differences from the paper, besides those of ``DPVP``:

    - The paper's second condition, a mean log pi_g below a threshold, is off by default: log pi rises as a policy sharpens.
    - sigma_c is the spread of the RETURN, which hardly any gain of pi_r exceeds: with a calibrated sigma_c pi_r never drives,
      and nothing corrects what Z_c believes of it. ``sigma_scale`` says by how much it is scaled in the confidence.
    - Z_c is far from converged at the switch: it follows its target faster (``tau_c``) and is fitted to both stores first
      (``prefit_steps``).
    - In stage 2, Z_c bootstraps on what is executed, not on pi_r alone (``bootstrap``).
    - pi_r exploits what Z_c believes of actions that nobody has tried, and leaves the road in most episodes after the switch.
      It is tied to pi_g: it maximises Q_c - alpha log pi_r - anchor_coef ||a_r - a_g||^2 (``anchor_coef``).
    - Where no training map is like what is seen, both critics believe in the same wrong slopes, and neither anchor nor
      confidence holds pi_r: what it executes can be limited to a neighbourhood of a_g (``max_deviation``).
    - Z_c learns rewards in units of their root mean square (``normalize_rewards``), so that stage 2 does the same whatever the
      scale of a task's reward.
    - The return hardly shows a collision (5 of 370 on SafeDrive): the safety cost is subtracted from the reward that Z_c
      learns (``cost_coef``).
    - In stage 1 nothing bad happens, as the human takes over before. So the step of the novice after which the human took
      over counts as a share of an accident (``takeover_cost``; as in RLIF, Luo et al. 2023). Without it Z_c knows the gain of
      driving faster but not the risk, and pi_r alone collides five times as often as pi_g.
    - Forgetting is noticed: the scores of ``relapse_window`` episodes (the sum of what Z_c learns) are compared with the best
      before, stage 1 included. If they are worse by more than their noise, a warning says so, ``chac/relapse`` is 1, and
      unless it is over when ``learn`` ends, the policy is the best one again then (at once with ``return_to_best``).

    ``PAPER`` are the arguments that read the paper literally, see ``DPVP``.

    The parameters are those of ``DPVP``, and:

    :param delta: pi_r acts where P(Q_r > Q_g) is above 1 - delta. 0 leaves pi_g alone, 0.5 compares the means (the ablation
        "No Confidence")
    :param shared_control: if False, pi_r always acts in stage 2 (the ablation "No Share")
    :param switch_after: N_g, stage 2 begins after more than this many steps of stage 1 (in all environments)
    :param sigma_threshold: and when the running mean of sigma_c is below it; not asked if None
    :param log_prob_threshold: kappa, and when the mean log pi_g of a batch is below it (log pi rises as a policy sharpens);
        not asked if None
    :param eta_c: weight of sigma^2 in the loss of Z_c, ``eta`` if None; above 1 it shrinks sigma_c
    :param sigma_scale: factor of sigma_c in the confidence
    :param tau_c: the soft update coefficient of the target of Z_c, ``tau`` if None
    :param prefit_steps: gradient steps of Z_c, on both stores, at the switch
    :param bootstrap: "executed": Z_c evaluates what is executed in stage 2 (shared control); "self": pi_r
    :param stage2_human_share: share of the human's transitions in the batches of stage 2
    :param stage2_guided_share: least share of the novice's transitions of stage 1. Those before a takeover are what Z_c knows
        danger from, and are the rarer the longer stage 2 goes on
    :param anchor_coef: weight of the squared distance between the actions of pi_r and pi_g, both in [-1, 1], in pi_r's loss;
        in units of what Z_c learns
    :param max_deviation: of pi_r's action from pi_g's in each dimension, both in [-1, 1], when it acts; 2: no limit
    :param normalize_rewards: whether Z_c learns rewards in units of their running root mean square
    :param cost_coef: what ``info["cost"]`` counts against (normalised) rewards in Z_c
    :param takeover_cost: safety cost, in Z_c, of a step of the novice after which the human took over
    :param relapse_window: episodes whose scores are judged together to notice that stage 2 forgets, 0 to judge nothing
    :param return_to_best: whether the policy is the best one again as soon as stage 2 forgets, not only at the end
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or, while learning,
        an observation or reward that is NaN or infinite
    """

    PAPER: ClassVar[dict[str, Any]] = DPVP.PAPER | {
        "sigma_scale": 1.0,
        "tau_c": None,
        "prefit_steps": 0,
        "bootstrap": "self",
        "stage2_human_share": 0.0,
        "anchor_coef": 0.0,
        "normalize_rewards": False,
        "cost_coef": 0.0,
        "takeover_cost": 0.0,
        "relapse_window": 0,
    }
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    required_policy = CHACPolicy
    policy: CHACPolicy
    confidence_critic: DistributionalCritic
    confidence_critic_target: DistributionalCritic
    self_actor: Actor
    self_actor_target: Actor

    @checked
    def __init__(
        self,
        policy: str | type[CHACPolicy],
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
        delta: float = 0.15,
        shared_control: bool = True,
        switch_after: int = 50_000,
        sigma_threshold: float | None = None,
        log_prob_threshold: float | None = None,
        eta_c: float | None = None,
        sigma_scale: float = 0.02,
        tau_c: float | None = 0.02,
        prefit_steps: int = 8000,
        bootstrap: str = "executed",
        stage2_human_share: float = 0.25,
        stage2_guided_share: float = 0.0,
        anchor_coef: float = 15.0,
        max_deviation: float = 2.0,
        normalize_rewards: bool = True,
        cost_coef: float = 100.0,
        takeover_cost: float = 0.3,
        relapse_window: int = 20,
        return_to_best: bool = False,
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
            proxy_value=proxy_value,
            pv_coef=pv_coef,
            pv_min_diff=pv_min_diff,
            bounded_targets=bounded_targets,
            weight_decay=weight_decay,
            average_tau=average_tau,
            eta_pv=eta_pv,
            takeover_stop_td=takeover_stop_td,
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
        self.delta = delta
        self.shared_control = shared_control
        self.switch_after = switch_after
        self.sigma_threshold = sigma_threshold
        self.log_prob_threshold = log_prob_threshold
        self.eta_c = eta_c
        self.sigma_scale = sigma_scale
        self.tau_c = tau_c
        self.prefit_steps = prefit_steps
        self.bootstrap = bootstrap
        self.stage2_human_share = stage2_human_share
        self.stage2_guided_share = stage2_guided_share
        self.anchor_coef = anchor_coef
        self.max_deviation = max_deviation
        self.normalize_rewards = normalize_rewards
        self.cost_coef = cost_coef
        self.takeover_cost = takeover_cost
        self.relapse_window = relapse_window
        self.return_to_best = return_to_best

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        if not hasattr(self, "reward_square"):  # else it was loaded
            self.reward_square, self.n_reward_updates = 1.0, 0
        for name in ("delta", "sigma_scale", "max_deviation"):
            setattr(self.policy, name, getattr(self, name))
        self.policy.control = "shared" if self.shared_control else "self"
        self.confidence_update = TargetUpdate(self.confidence_critic, self.confidence_critic_target)
        self.self_update = TargetUpdate(self.self_actor, self.self_actor_target)
        self.self_average_update = TargetUpdate(self.self_actor, self.policy.averaged_self_actor)
        # Steps of stage 2 and the highest confidence in them, until pi_r acts or a warning was given
        self.waiting: tuple[int, float] | None = (0, 0.0)
        # Since the logger took them, or the latest: nobody may ever take them
        self.choices: deque[dict[str, np.ndarray]] = deque(maxlen=MOST_CHOICES)
        self.watch = RelapseWatch(self.relapse_window) if self.relapse_window else None

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.confidence_critic = self.policy.confidence_critic
        self.confidence_critic_target = self.policy.confidence_critic_target
        self.self_actor = self.policy.self_actor
        self.self_actor_target = self.policy.self_actor_target

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_range("delta", self.delta, low=0.0, high=1.0)
        check_integer("switch_after", self.switch_after, low=0)
        for name in ("sigma_threshold", "log_prob_threshold"):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name))
        if self.eta_c is not None:
            check_range("eta_c", self.eta_c, low=0.0, exclusive_low=True)
        check_range("sigma_scale", self.sigma_scale, low=0.0, exclusive_low=True)
        if self.tau_c is not None:
            check_range("tau_c", self.tau_c, low=0.0, high=1.0)
        check_integer("prefit_steps", self.prefit_steps, low=0)
        check_range("stage2_human_share", self.stage2_human_share, low=0.0, high=1.0)
        check_range("stage2_guided_share", self.stage2_guided_share, low=0.0, high=1.0)
        check_range("anchor_coef", self.anchor_coef, low=0.0)
        check_range("max_deviation", self.max_deviation, low=0.0, high=2.0)
        check_range("cost_coef", self.cost_coef, low=0.0)
        check_range("takeover_cost", self.takeover_cost, low=0.0)
        check_integer("relapse_window", self.relapse_window, low=0)
        if self.relapse_window == 1:
            raise ValueError("relapse_window must be 0 or at least 2: one episode does not tell its noise.")
        if self.bootstrap not in ("executed", "self"):
            raise ValueError(f"bootstrap must be 'executed' or 'self', got {self.bootstrap!r}.")

    @property
    def stage(self) -> int:
        """1: the human guides; 2: self-learning under shared control."""
        return int(self.policy.stage)

    def _needs_human(self) -> bool:
        return self.stage == 1

    def _prepare_wrappers(self) -> None:
        super()._prepare_wrappers()
        self._show_stage()

    def _show_stage(self) -> None:
        self._ask_wrappers(self._wrapped, "set_stage", self.stage)

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [*super()._optimizers(), self.confidence_critic.optimizer, self.self_actor.optimizer]

    def _sample_batch(self, batch_size: int) -> DualReplayBufferSamples:
        shares = (0.5, 0.0) if self.stage == 1 else (self.stage2_human_share, self.stage2_guided_share)
        return self.replay_buffer.sample(batch_size, self._vec_normalize_env, *shares)

    def _gradient_step(self, batch: DualReplayBufferSamples) -> dict[str, th.Tensor]:
        return self._stage_1_step(batch) if self.stage == 1 else self._stage_2_step(batch)

    def _stage_1_step(self, batch: DualReplayBufferSamples) -> dict[str, th.Tensor]:
        """Make a gradient step of stage 1 of the paper's Algorithm 1: a human guides."""
        # Z_g by proxy values and rewardless temporal differences; every policy_delay steps pi_g, alpha and all targets
        stats = super()._gradient_step(batch)
        # Z_c by temporal differences with reward: the return of pi_g
        return stats | self._update_confidence_critic(batch)

    def _stage_2_step(self, batch: DualReplayBufferSamples) -> dict[str, th.Tensor]:
        """Make a gradient step of stage 2 of the paper's Algorithm 1: shared control. pi_g and Z_g stay as they are."""
        # Z_c by temporal differences with reward: the return of what is executed
        stats = self._update_confidence_critic(batch)
        # Every policy_delay steps pi_r, alpha and the targets
        if self._n_updates % self.policy_delay == 0:
            stats |= self._update_self_actor(batch)
            if self._targets_are_due():
                self.self_update(self.tau)
            self.self_average_update(self.average_tau)
        return stats

    def _update_self_actor(self, batch: DualReplayBufferSamples) -> dict[str, th.Tensor]:
        """pi_r maximises Q_c - alpha log pi_r - anchor_coef ||a_r - a_g||^2."""
        with th.no_grad():
            guided_actions = self.actor(batch.observations, deterministic=True)
        return self._update_actor(
            self.self_actor,
            self.confidence_critic,
            batch.observations,
            self._current_ent_coef(),
            lambda actions: self.anchor_coef * (actions - guided_actions).square().sum(dim=1),
        )

    def _update_confidence_critic(self, batch: DualReplayBufferSamples) -> dict[str, th.Tensor]:
        losses, _, stats = self._critic_losses(self.confidence_critic, batch, self._confidence_targets(batch), self.eta_c)
        minimize(losses.mean(dim=1).sum(), self.confidence_critic.optimizer)
        self.confidence_update(self.tau if self.tau_c is None else self.tau_c)
        return {f"confidence_{name}": value for name, value in stats.items()}

    def _confidence_targets(self, batch: DualReplayBufferSamples) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute the return targets of Z_c, with a' from who acts: pi_g in stage 1, shared control or pi_r in stage 2.

        :return: y_q and y_z, both of shape (batch_size,)
        """
        ent_coef = self._current_ent_coef()
        rewards = self._confidence_rewards(batch)
        if self.stage == 1:
            return self._return_targets(self.actor_target, self.confidence_critic_target, batch, rewards, ent_coef)
        return self._stage_2_return_targets(batch, rewards, ent_coef)

    def _confidence_rewards(self, batch: DualReplayBufferSamples) -> th.Tensor:
        """
        Rewards in units of their root mean square, less what safety costs.

        :return: shape (batch_size,)
        """
        rewards = batch.rewards.flatten()
        if self.normalize_rewards:
            self.n_reward_updates += 1
            step = max(1e-3, 1 / self.n_reward_updates)
            self.reward_square += step * (rewards.square().mean().item() - self.reward_square)
        rewards = rewards / self._reward_scale()
        costs = batch.costs + self.takeover_cost * batch.takeovers_follow
        return rewards - self.cost_coef * costs.flatten()

    def _reward_scale(self) -> float:
        """Return the unit of the rewards that Z_c learns."""
        return max(self.reward_square**0.5, 1e-8) if self.normalize_rewards else 1.0

    @th.no_grad()
    def _stage_2_return_targets(
        self, batch: DualReplayBufferSamples, rewards: th.Tensor, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute the return targets of stage 2.

        :return: y_q and y_z with a' from shared control or from pi_r, both of shape (batch_size,)
        """
        self_actions, log_prob = self.self_actor_target.action_log_prob(batch.next_observations)
        choice = self.policy.choose(batch.next_observations, self_actions, self.confidence_critic_target)
        is_shared = self.shared_control and self.bootstrap == "executed"
        self_drives = choice.self_drives if is_shared else th.ones_like(choice.self_drives)
        next_q = th.where(self_drives, choice.q_self, choice.q_guided)
        next_std = th.where(self_drives, choice.std_self, choice.std_guided)
        # The mode of pi_g has no entropy
        return return_targets(rewards, self._discounts(batch), next_q, next_std, ent_coef * log_prob * self_drives)

    def _forget_episodes(self) -> None:
        super()._forget_episodes()
        self._episode_scores = np.zeros(self.n_envs)

    def _count(self, infos: list[dict[str, Any]], rewards: np.ndarray, dones: np.ndarray) -> None:
        super()._count(infos, rewards, dones)
        if self.watch is None:
            return
        costs = [(info["cost"] or 0.0) + self.takeover_cost * info["takeover_start"] for info in infos]
        self._episode_scores += rewards / self._reward_scale() - self.cost_coef * np.array(costs)
        for idx in np.flatnonzero(dones):
            self.watch.add(self._episode_scores[idx])
            self._episode_scores[idx] = 0.0
            if self.stage == 2 and self.watch.judge(self.policy):
                self._on_relapse()

    def _on_relapse(self) -> None:
        warnings.warn(
            f"C-HAC: stage 2 has become worse than the best so far (step {self.num_timesteps}). "
            + ("It goes back to that." if self.return_to_best else "Unless it recovers, that will act when learn() is over.")
        )
        if self.return_to_best:
            self.watch.restore(self.policy)  # type: ignore[union-attr]

    def _on_step(self) -> None:
        super()._on_step()
        if self.stage == 1 and self._guidance_is_over():
            self._start_stage_2()

    def _guidance_is_over(self) -> bool:
        return (
            self.counts["total_steps"] > self.switch_after
            and self._n_updates > 0
            and (self.sigma_threshold is None or self.confidence_critic.mean_std.mean().item() < self.sigma_threshold)
            and (self.log_prob_threshold is None or self._mean_log_prob() < self.log_prob_threshold)
        )

    def _mean_log_prob(self) -> float:
        """Estimate the mean of log pi_g of its own actions, over a batch."""
        with th.no_grad():
            batch = self._sample_batch(self.batch_size)
            return self.actor.action_log_prob(batch.observations)[1].mean().item()

    def _start_stage_2(self) -> None:
        for _ in range(self.prefit_steps):
            self._prefit_step()
        self._switch_to_stage_2()

    def _prefit_step(self) -> None:
        self.policy.set_training_mode(True)
        self._update_confidence_critic(self._sample_batch(self.batch_size))
        self.policy.set_training_mode(False)

    def _switch_to_stage_2(self) -> None:
        self._disarm()
        self.replay_buffer.end_guidance()
        self.policy.start_stage_2()
        if self.watch is not None:
            self.watch.begin(self.policy)
        self._show_stage()
        if self.verbose > 0:
            human_steps = int(self.counts["human_steps"])
            print(f"C-HAC: stage 2 begins at step {self.num_timesteps}, after {human_steps} steps of the human")

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        self.policy.last_choice = None
        sampled = super()._sample_action(learning_starts, action_noise, n_envs)
        if self.policy.last_choice is not None:
            choice = self.policy.last_choice._asdict()
            self.choices.append({name: values.cpu().numpy() for name, values in choice.items() if name != "actions"})
            self._wait_for_self_policy(self.choices[-1])
        return sampled

    def _wait_for_self_policy(self, choice: dict[str, np.ndarray]) -> None:
        """
        Warn, once, if pi_r does not act in the first ``QUIET_STEPS`` steps of stage 2, which then is no more than stage 1.

        :param choice: of a step, as in ``choices``
        """
        if self.waiting is None or self.delta == 0:
            return
        steps, highest = self.waiting
        steps, highest = steps + len(choice["confidence"]), max(highest, float(choice["confidence"].max()))
        self.waiting = None if choice["self_drives"].any() else (steps, highest)
        if self.waiting is not None and steps >= QUIET_STEPS:
            self.waiting = None
            warnings.warn(
                f"C-HAC: the self-learning policy has not acted in the first {steps} steps of stage 2. Its confidence reached "
                f"{highest:.2f} and must exceed 1 - delta = {1 - self.delta:.2f}: lower sigma_scale ({self.sigma_scale:g}), "
                f"or anchor_coef ({self.anchor_coef:g}) if it does what the guided one does, or raise delta ({self.delta:g})."
            )

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        control: str | None = None,
        policy: str | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Predict actions, as in SB3, under shared control.

        :param control: who acts in stage 2: "guided" (pi_g), "self" (pi_r) or "shared"; by default as in training
        :param policy: old name of ``control``
        :raises ValueError: for another ``control``
        """
        control = control if policy is None else policy
        if control not in (None, *CONTROLS):
            raise ValueError(f"control must be one of {', '.join(map(repr, CONTROLS))}, got {control!r}.")
        usual = self.policy.control
        self.policy.control = control or usual
        try:
            return super().predict(observation, state, episode_start, deterministic)
        finally:
            self.policy.control = usual

    def dump_logs(self) -> None:
        self.logger.record("chac/stage", self.stage)
        if self.stage == 2 and self.watch is not None:
            self.logger.record("chac/relapse", int(self.watch.relapsed))
        if self.choices:
            means = {name: np.concatenate([choice[name] for choice in self.choices]) for name in self.choices[0]}
            self.choices.clear()
            confidence = means.pop("confidence")
            self.logger.record("chac/self_share", means.pop("self_drives").mean())
            self.logger.record("chac/confidence_mean", confidence.mean())
            for quantile in (0.1, 0.5, 0.9):
                self.logger.record(f"chac/confidence_q{100 * quantile:.0f}", np.quantile(confidence, quantile))
            for name, values in means.items():
                self.logger.record(f"chac/{name}", values.mean())
        super().dump_logs()

    def learn(
        self: SelfCHAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "CHAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCHAC:
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        if self.watch is not None and self.watch.relapsed:
            self.watch.restore(self.policy)
        return self

    def _excluded_save_params(self) -> list[str]:
        networks = ["confidence_critic", "confidence_critic_target", "self_actor", "self_actor_target"]
        return [
            *super()._excluded_save_params(),
            *networks,
            "confidence_update",
            "self_update",
            "self_average_update",
            "choices",
            "watch",
            "_episode_scores",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "confidence_critic.optimizer", "self_actor.optimizer"], tensors
