"""Training that goes on beside the driving: gradient steps in a thread of their own."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sb3_chac.cockpit.session import Session

if TYPE_CHECKING:
    from sb3_chac.cockpit.driven import DrivenTraining


class Learner(threading.Thread):
    """
    Thread that makes the gradient steps that a model owes, in their order and number, one at a time. It leaves the moment of
    the next step of the environment to the driver.

    :param model: that learns
    :param drive: beside which it learns
    """

    def __init__(self, model: "DrivenTraining", drive: Session) -> None:
        super().__init__(name="learner", daemon=True)
        self.model, self.drive = model, drive
        self.error: BaseException | None = None
        self.seconds_per_step = 0.0  # running mean
        self._stopped = False
        self._changed = threading.Condition()
        self._working = threading.Lock()  # held while the networks change

    def owe(self, gradient_steps: int) -> None:
        """
        Add gradient steps to those that are still to be made.

        :param gradient_steps: to be made
        :raises BaseException: what a gradient step has raised
        """
        self._raise_error()
        with self._changed:
            self.model.owed_steps += gradient_steps
            self._changed.notify_all()

    def drain(self) -> None:
        """
        Wait until nothing is owed.

        :raises BaseException: what a gradient step has raised
        """
        with self._changed:
            while self.model.owed_steps and self.error is None and not self._stopped:
                self._changed.wait()
        self._raise_error()

    @contextmanager
    def resting(self) -> Iterator[None]:
        """Keep the networks as they are inside the block."""
        with self._working:
            yield

    def stop(self) -> None:
        """Stop once the gradient step that is under way is made. What is owed stays so."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        while True:
            with self._changed:
                while not self._stopped and not self.model.owed_steps:
                    self._changed.wait()
                if self._stopped:
                    return
            self.drive.wait_for_room(self.seconds_per_step)
            begun = time.monotonic()
            try:
                with self._working:
                    self.model.train_now(1, self.model.batch_size)
                    self.model.refresh_driver()
            except BaseException as error:
                self.error = error
            seconds = time.monotonic() - begun
            self.seconds_per_step += (0.2 if self.seconds_per_step else 1.0) * (seconds - self.seconds_per_step)
            with self._changed:
                self._changed.notify_all()
                if self.error is not None:
                    return
                self.model.owed_steps -= 1
                self.drive.lag = self.model.owed_steps

    def _raise_error(self) -> None:
        if self.error is not None:
            raise self.error
