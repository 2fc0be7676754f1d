"""A drive from its beginning to its end: what runs in the driving thread."""

import argparse
import asyncio
import contextlib
import io
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chac.cockpit.devices import Device
from sb3_chac.cockpit.driven import DrivenTraining, driven
from sb3_chac.cockpit.person import NotDrivable, Person, check_drivable
from sb3_chac.cockpit.recording import CrashSafeRecorder, EpisodeRecord, Summary
from sb3_chac.cockpit.session import Session
from sb3_chac.cockpit.wrapper import Cockpit
from sb3_chac.common.checkpoints import ResumableCheckpoint
from sb3_chac.human.intervention import InterventionWrapper
from sb3_chac.zoo import register
from sb3_chac.zoo.algorithms import drivable_algorithms

DEFAULT_RATE = 10.0  # [1/s]


class EpisodeCheckpoint(ResumableCheckpoint):
    """
    Checkpoints at the beginnings of episodes, when nobody is driving at speed.

    :param cockpit: tells when that is
    """

    def __init__(self, cockpit: Cockpit, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.cockpit = cockpit

    def _on_rollout_start(self) -> None:
        if self.cockpit.steps <= 1:  # a rollout may be of two steps
            super()._on_rollout_start()


class CockpitExperiment(ExperimentManager):
    """
    RL-Zoo3's experiment in which a person drives: hyperparameters, folders and files are those of ``rl_zoo3 train``. There is
    one environment; in the place of the yaml's ``InterventionWrapper`` stands the person's.

    :param wrap: puts the person and the cockpit around the environment
    """

    tells_errors = True

    def __init__(self, wrap: Callable[[gym.Env], gym.Env], args: argparse.Namespace) -> None:
        super().__init__(
            args,
            args.algo,
            args.env,
            args.log_folder,
            n_timesteps=args.n_timesteps,
            eval_freq=-1,
            save_freq=0,
            hyperparams={**args.hyperparams, "n_envs": 1},
            env_kwargs={**args.env_kwargs, "render_mode": "rgb_array"},
            trained_agent=args.trained_agent,
            seed=args.seed,
            log_interval=1,
            verbose=args.verbose,
            config=args.conf_file,
        )
        self.wrap = wrap
        self.vec_env_class = DummyVecEnv

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if hyperparams.get("normalize"):
            raise NotDrivable("normalize: the cockpit knows no VecNormalize, choose hyperparameters without it (-params).")
        others = hyperparams.pop("env_wrapper", None) or []
        others = [others] if isinstance(others, str | dict) else list(others)
        others = [entry for entry in others if InterventionWrapper.__name__ not in str(entry)]
        if others:
            hyperparams["env_wrapper"] = others
        found, wrapper, callbacks, vec_env_wrapper = super()._preprocess_hyperparams(hyperparams)
        wrap = self.wrap if wrapper is None else lambda env: self.wrap(wrapper(env))
        return found, wrap, callbacks, vec_env_wrapper


class CockpitRun:
    """
    One drive, in a thread of its own: environment, model and all that is written belong to it.

    :param args: of the command line, see ``sb3_chac.cli.drive``
    :param device: that the person holds
    :param on_episode: called with each episode that has ended
    """

    def __init__(
        self, args: argparse.Namespace, device: Device, on_episode: Callable[[EpisodeRecord], None] | None = None
    ) -> None:
        register()
        self.args = args
        self.on_episode = on_episode
        person = Person(device, not args.no_takeover)
        self.drive = Session(person, args.rate or DEFAULT_RATE, args.query, not args.no_meter, not args.no_learning)
        self.summary: Summary | None = None
        self.run_folder: Path | None = None
        self.error: BaseException | None = None
        self.cockpit: Cockpit | None = None
        self.thread = threading.Thread(target=self._run, name="driving", daemon=True)

    @property
    def is_over(self) -> bool:
        """Tell whether the driving thread has ended."""
        return not self.thread.is_alive()

    async def wait(self) -> None:
        """Wait for the end of the driving thread, in an event loop."""
        while not self.is_over:
            await asyncio.sleep(0.1)

    def _run(self) -> None:
        try:
            self._drive()
        except BaseException as error:  # for the main thread to tell
            self.error = error
        finally:
            self.drive.quit()

    def _drive(self) -> None:
        args = self.args
        algorithm = drivable_algorithms()[args.algo]
        ALGOS[args.algo] = driven(algorithm)
        try:
            self.manager = CockpitExperiment(self._wrap, args)
            self.run_folder = Path(self.manager.save_path)
            with contextlib.redirect_stdout(io.StringIO()) if args.verbose == 0 else contextlib.nullcontext():
                model, _ = self.manager.setup_experiment()  # type: ignore[misc]
        except (TypeError, AttributeError, KeyError) as error:  # of hyperparameters and environments that do not fit
            raise NotDrivable(f"{args.algo} on {args.env} cannot be set up: {type(error).__name__}: {error}") from error
        finally:
            ALGOS[args.algo] = algorithm
        self._learn(model)  # type: ignore[arg-type]

    def _learn(self, model: DrivenTraining) -> None:
        args, manager = self.args, self.manager
        assert self.cockpit is not None
        model.attach(self.drive)
        if args.demos:
            model.store_demonstrations(args.demos)
        save_freq = args.save_freq
        checkpoint = EpisodeCheckpoint(self.cockpit, save_freq, manager.save_path, manager.env_name)
        checkpoint.init_callback(model)
        if save_freq > 0:
            manager.callbacks.append(checkpoint)
        try:
            if args.pretrain:
                self.drive.busy = f"The car waits: {args.pretrain} gradient steps on {args.demos}"
                model.pretrain(args.pretrain)
                self.drive.busy = ""
            with contextlib.redirect_stdout(io.StringIO()) if args.verbose == 0 else contextlib.nullcontext():
                manager.learn(model)
                self.drive.ended = True
                checkpoint.save()
                manager.save_trained_model(model)
        finally:
            self.drive.ended = True
            self.summary = self.cockpit.recorder.finish()

    def _wrap(self, env: gym.Env) -> gym.Env:
        check_drivable(env)
        args, person = self.args, self.drive.person
        steers_left = bool(env.metadata.get("steers_left")) if args.steering == "auto" else args.steering == "left"
        person.sit_in(env.action_space, steers_left)  # type: ignore[arg-type]
        if args.rate is None:
            self.drive.period = 1 / float(env.metadata.get("render_fps") or DEFAULT_RATE)
        assert self.run_folder is not None
        watched = InterventionWrapper(env, expert=person, rule=person.drives)
        recorder = CrashSafeRecorder(self.run_folder, env, args.dataset, f"{args.algo} and a person", self.drive.period)
        recorder.on_episode = self.on_episode
        self.cockpit = Cockpit(watched, self.drive, recorder)
        return self.cockpit
