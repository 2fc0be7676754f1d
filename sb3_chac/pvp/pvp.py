"""Proxy value propagation (PVP)."""

from typing import Any, TypeVar

import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy

from sb3_chac.common.arguments import checked
from sb3_chac.common.buffers import DualReplayBuffer, DualReplayBufferSamples, taken_over
from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.common.utils import frozen, minimize, policy_arguments

SelfPVP = TypeVar("SelfPVP", bound="PVP")


class PVP(GuidedOffPolicyAlgorithm, TD3):
    """
    Proxy Value Propagation (PVP): TD3 that learns from takeovers, without reward.
    Paper: "Learning from Active Human Involvement through Proxy Value Propagation" (Peng et al., NeurIPS 2023).

    Where the human drives (I = 1), Q is drawn to +B for the human's action and to -B for the one that the novice had proposed;
    temporal differences without reward carry these values to all other states. With a_b the executed and a_n the novice's
    action, for each critic::

        mean[ (Q(s, a_b) - gamma (1 - d) min Q(s', a'))^2 ] + mean[ I (Q(s, a_b) - B)^2 ] + mean[ I (Q(s, a_n) + B)^2 ]

    All means are over the whole batch, half of which comes from each store. The masks are applied sample by sample; the
    authors' public code multiplies them with a loss that is averaged already, which draws Q of every novice sample to zero.
    The actor is TD3's and maximises the first critic.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str), with a bounded Box action space
    :param learning_rate: learning rate of the actor and the critics,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: capacity of each of the two stores, in transitions
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient of the target networks (between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default), added to the actor's action
    :param replay_buffer_class: ``DualReplayBuffer``, or a class derived from it
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: not supported, must be False
    :param n_steps: number of rewards in a return; it ends early where the driver changes
    :param policy_delay: gradient steps of the critics per update of the actor and all targets
    :param target_policy_noise: Standard deviation of Gaussian noise added to target policy (smoothing noise)
    :param target_noise_clip: Limit for absolute value of target policy smoothing noise.
    :param proxy_value: B, the label of the human's actions; minus B is the label of the novice's
    :param pv_coef: weight of the labels
    :param pv_min_diff: no label -B where the root mean square of a_h - a_n, both in [-1, 1], is smaller; 0 in the paper
    :param takeover_stop_td: leave temporal differences out on the first step of a takeover
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation; ``net_arch`` is [256, 256] by default
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, an action space that is not a bounded Box, or, while learning,
        an observation or reward that is NaN or infinite
    """

    required_policy = TD3Policy

    @checked
    def __init__(
        self,
        policy: str | type[TD3Policy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 100,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[DualReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        proxy_value: float = 1.0,
        pv_coef: float = 1.0,
        pv_min_diff: float = 0.0,
        takeover_stop_td: bool = False,
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
            policy_delay=policy_delay,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
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
        self.takeover_stop_td = takeover_stop_td

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        with policy_arguments(self, net_arch=[256, 256]):
            super()._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_integer("policy_delay", self.policy_delay, low=1)
        check_range("target_policy_noise", self.target_policy_noise, low=0.0)
        check_range("target_noise_clip", self.target_noise_clip, low=0.0)
        check_range("proxy_value", self.proxy_value, low=0.0, exclusive_low=True)
        check_range("pv_coef", self.pv_coef, low=0.0)
        check_range("pv_min_diff", self.pv_min_diff, low=0.0)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        stats: dict[str, float] = {}

        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self._sample_batch(batch_size)
            stats |= self._update_critic(batch)

            # Delayed policy updates
            if self._n_updates % self.policy_delay == 0:
                actors = {id(parameter) for parameter in self.actor.parameters()}  # a shared features extractor is its own
                with frozen(parameter for parameter in self.critic.parameters() if id(parameter) not in actors):
                    actions = self.actor(batch.observations)
                    actor_loss = -self.critic.q1_forward(batch.observations, actions).mean()  # type: ignore[arg-type]
                    minimize(actor_loss, self.actor.optimizer)
                stats["actor_loss"] = actor_loss.item()
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
                # Copy running stats, see GH issue #996
                polyak_update(self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0)
                polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, value in stats.items():
            self.logger.record(f"train/{name}", value)

    def _sample_batch(self, batch_size: int) -> DualReplayBufferSamples:
        return self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

    def _update_critic(self, batch: DualReplayBufferSamples) -> dict[str, float]:
        discounts = self.gamma if batch.discounts is None else batch.discounts
        with th.no_grad():
            # Select action according to policy and add clipped noise
            noise = th.randn_like(batch.actions).mul_(self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (self.actor_target(batch.next_observations) + noise).clamp(-1, 1)
            next_q_values = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1)
            # No reward; shape (batch_size, 1)
            targets = (1 - batch.dones) * discounts * next_q_values.min(dim=1, keepdim=True).values

        # All of shape (batch_size, n_critics), no reduction before the masks
        q_values = th.cat(self.critic(batch.observations, batch.actions), dim=1)
        td_errors = (q_values - targets).square()
        if self.takeover_stop_td:
            td_errors = td_errors * (1 - batch.takeover_starts)
        loss = td_errors.mean(dim=0).sum()
        stats = {"q_mean": q_values.mean()}

        human = taken_over(batch, self.pv_min_diff)
        if len(human.rows) > 0:
            q_human = q_values[human.rows]
            q_novice = th.cat(self.critic(human.observations, human.novice_actions), dim=1)
            labels = (q_human - self.proxy_value).square()
            labels = labels + (q_novice + self.proxy_value).square() * human.differ.unsqueeze(1)
            loss = loss + self.pv_coef * labels.sum() / len(q_values)
            stats |= {"q_human": q_human.mean(), "q_novice": q_novice.mean()}
        minimize(loss, self.critic.optimizer)
        return {name: value.item() for name, value in (stats | {"critic_loss": loss}).items()}

    def learn(
        self: SelfPVP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "PVP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPVP:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
