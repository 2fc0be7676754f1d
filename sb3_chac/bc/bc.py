"""Behaviour cloning (BC)."""

from collections import defaultdict
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_chac.bc.policies import BCPolicy, CnnPolicy, MlpPolicy, check_loss, imitating_policy
from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_range
from sb3_chac.common.demonstrations import Dataset
from sb3_chac.common.offline import Batch, OfflineAlgorithm
from sb3_chac.common.utils import minimize

SelfBC = TypeVar("SelfBC", bound="BC")

VALIDATION_BATCH = 4096  # steps whose loss is computed at once


class BC(OfflineAlgorithm):
    """
    Behaviour cloning: supervised learning of the actions in demonstrations (Pomerleau 1991; the baseline "BC" of C-HAC).

    With the actions a scaled to [-1, 1], over a batch of demonstrated steps (s, a)::

        mse    mean over batch and action dimensions of (mu(s) - a)^2
        nll    mean over the batch of -log N(a; mu(s), sigma(s)^2), summed over the action dimensions;
               of discrete actions -log pi(a | s)

    ``learn(total_timesteps)`` counts gradient steps. See ``OfflineAlgorithm`` for what the environment is for.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy)
    :param env: The environment that the dataset was recorded in (if registered in Gym, can be str), with a bounded Box or a
        Discrete action space
    :param dataset: see ``load_demonstrations``: id or folder of a dataset of Minari, a list of them, ...
    :param learning_rate: learning rate, it can be a function of the current progress remaining (from 1 to 0)
    :param batch_size: Minibatch size for each gradient update
    :param loss: "mse", which acts deterministically, or "nll", which also learns how much the actions vary;
        Discrete actions need "nll"
    :param weight_decay: of AdamW
    :param validation_share: share of the steps (whole episodes) that are not learned from, for
        train/validation_loss; at most 0.9
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``BCPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: for an argument out of its range, or a dataset that is missing, damaged or does not
        fit (``DatasetError``)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy}
    required_policy = BCPolicy
    policy: BCPolicy

    @checked
    def __init__(
        self,
        policy: str | type[BCPolicy],
        env: GymEnv | str,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        loss: str = "mse",
        weight_decay: float = 0.0,
        validation_share: float = 0.1,
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
            validation_share,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.loss = loss
        self.weight_decay = weight_decay

        if _init_setup_model:
            self._setup_model()
            self.set_dataset(dataset)

    def _setup_model(self) -> None:
        with imitating_policy(self, self.loss, self.weight_decay):
            super()._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_loss(self.loss)
        if isinstance(self.action_space, spaces.Discrete) and self.loss != "nll":
            raise ValueError(f"loss must be 'nll' for {self.action_space}, got {self.loss!r}.")
        check_range("weight_decay", self.weight_decay, low=0.0)

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [self.policy.optimizer]

    def _gradient_step(self, batch: Batch) -> dict[str, th.Tensor]:
        loss = self.policy.losses(batch.observations, batch.actions).mean()
        minimize(loss, self.policy.optimizer)
        return {"loss": loss.detach()}

    @th.no_grad()
    def validation_loss(self) -> float | None:
        """
        Measure the loss on the steps that are held out.

        :return: mean loss of the steps that are not learned from, None if there are none
        """
        assert self._sampler is not None, "There is no dataset yet: call set_dataset() first."
        steps = self._sampler.validation
        if len(steps) == 0:
            return None
        self.policy.set_training_mode(False)
        parts = [self._batch(steps[start : start + VALIDATION_BATCH]) for start in range(0, len(steps), VALIDATION_BATCH)]
        return float(th.cat([self.policy.losses(part.observations, part.actions) for part in parts]).mean())

    def _dump_logs(self, stats: defaultdict[str, list[th.Tensor]]) -> None:
        validation_loss = self.validation_loss()
        if validation_loss is not None:
            self.logger.record("train/validation_loss", validation_loss)
        super()._dump_logs(stats)

    def learn(
        self: SelfBC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1000,
        tb_log_name: str = "BC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfBC:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
