"""The wrapper in which an expert takes over from the novice."""

import copy
from enum import StrEnum
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs

from sb3_chac.common import contract
from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_action_space, check_integer, check_range, real_numbers
from sb3_chac.human.experts import check_expert
from sb3_chac.human.rules import check_rule
from sb3_chac.human.supervisor import Supervisor


class ControlState(StrEnum):
    """States of control. An environment that is not armed stays AUTONOMOUS."""

    AUTONOMOUS = "autonomous"  # the novice drives and the human watches
    TAKEOVER = "takeover"  # the human drives
    PAUSED = "paused"  # the novice drives and the human is not asked


# (state, event) -> next state. Events that are not listed for a state leave it as it is.
TRANSITIONS = {
    (ControlState.AUTONOMOUS, "take over"): ControlState.TAKEOVER,  # by the rule
    (ControlState.TAKEOVER, "hand back"): ControlState.AUTONOMOUS,  # by the rule, the end of the episode, an error, disarm()
    (ControlState.AUTONOMOUS, "pause"): ControlState.PAUSED,  # by pause() or when the budget is spent
    (ControlState.TAKEOVER, "pause"): ControlState.PAUSED,  # likewise, it ends the takeover
    (ControlState.PAUSED, "resume"): ControlState.AUTONOMOUS,  # by resume() or disarm()
}


class InterventionWrapper(contract.TakeoverWrapper, RecordConstructorArgs):
    """
    A stand-in for the human who watches the novice (the agent), takes over and hands back.

    It is inert until armed: actions pass through, the expert is neither built nor called, so that evaluation and loaded models
    are never driven by it. Algorithms arm their training environments step by step, see ``begin_step``, and disarm them.
    When armed, the expert acts on the observation before each step, the rule decides, and either action is executed. The
    ``info`` of each step, armed or not, says what happened (the keys are those of ``sb3_chac.common.contract``):

    ==================  ==========  ==============================================================================
    takeover            bool        the human drove this step
    takeover_start      bool        it is the first step of a takeover
    applied_action      np.ndarray  what was executed, a copy, in the units and dtype of the action space
    received_action     np.ndarray  what the novice proposed, as it arrived here; None while nobody watches
    takeover_cost       float       on the first step of a takeover 1 - cos(novice action, human's action), both
                                    scaled to [-1, 1]: 0 (same direction) to 2 (opposite); 0 if either is zero
    intervene_action    np.ndarray  the human's action, on takeover steps (HIL-SERL's key)
    is_intervention     bool        as ``takeover`` (the key of gym-hil and LeRobot)
    human_steps         int         steps that the human drove so far
    total_steps         int         steps made while armed so far
    takeover_rate       float       human_steps / total_steps
    ==================  ==========  ==============================================================================

    A takeover that the environment itself reports (see ``contract.read_report``) is one, whatever the rule says.

    An error of the expert, the rule or the environment ends the episode: the next ``step`` needs a ``reset``. The expert is
    seeded by ``reset(seed=...)``, also when it is armed later. An expert or rule object that remembers must not be shared by
    several environments (a ``RiskRule`` may).

    :param env: an environment with a bounded Box action space
    :param expert: who drives during a takeover: the name of a scripted driver of ``env``, a model, an ``Expert`` or a function
        observation -> action, see ``make_expert``
    :param rule: when: "risk", "disagreement", "always", "never", a ``TakeoverRule`` or a function, see ``make_rule``
    :param budget: how many steps the human drives at most, over all episodes, None for no limit. Among the copies of an
        environment that an algorithm trains in, it is shared
    :param armed: whether to arm it at once
    :param deadline: seconds that the expert and the rule have for each answer, None for as long as they need. With one, they
        are asked in a thread of their own, which is left to itself if it is late
    :param rule_kwargs: of the rule if it is "risk" (e.g. ``{"take_over_below": 1.8}``, see ``RiskRule``) or "disagreement"
    :raises ValueError: for an argument that does not fit; while armed, for an action that is not finite or of another shape
    :raises ExpertError: from ``reset``, ``step`` and ``arm`` when the expert fails or is late
    :raises RuleError: likewise, of the rule
    """

    @checked
    def __init__(
        self,
        env: gym.Env,
        expert: Any = "scripted",
        rule: Any = "risk",
        budget: int | None = None,
        armed: bool = False,
        rule_kwargs: dict[str, Any] | None = None,
        deadline: float | None = None,
    ):
        # Not copied: a model may hold a replay buffer or subprocesses
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            expert=expert,
            rule=rule,
            budget=budget,
            armed=armed,
            rule_kwargs=rule_kwargs,
            deadline=deadline,
        )
        gym.Wrapper.__init__(self, env)
        check_action_space(env.action_space)
        self._box: spaces.Box = env.action_space  # type: ignore[assignment]
        check_expert(expert, env)
        check_rule(rule, expert, rule_kwargs)
        if budget is not None:
            check_integer("budget", budget, low=0)
        if deadline is not None:
            check_range("deadline", deadline, low=0.0, exclusive_low=True)
        self.budget = budget
        self._supervisor = Supervisor(expert, rule, rule_kwargs, deadline, self._box)  # builds them when first armed
        self._armed = False
        self._step_by_step = False
        self._is_granted = self._may_drive = False  # of the next step, see ``begin_step``
        self._has_to_start = False
        self._was_reported = False  # a takeover, by the environment, in the step before
        self._state = ControlState.AUTONOMOUS
        self._human_steps = 0
        self._total_steps = 0
        self._stage: str | int = ""
        self._observation: Any = None  # None unless an episode is under way
        self._seed: int | None = None  # the last one that the expert has not had yet
        if armed:
            self.arm()

    @property
    def deadline(self) -> float | None:
        """Seconds that expert and rule have for each answer, None for as long as they need."""
        return self._supervisor.deadline

    @property
    def armed(self) -> bool:
        """Tell whether the human watches."""
        return self._armed

    @property
    def state(self) -> ControlState:
        """State of control."""
        return self._state

    @property
    def human_steps(self) -> int:
        """Number of steps that the human drove so far."""
        return self._human_steps

    @property
    def total_steps(self) -> int:
        """Number of steps made while armed so far."""
        return self._total_steps

    @property
    def takeover_rate(self) -> float:
        """Share of the steps made while armed that the human drove."""
        return self._human_steps / self._total_steps if self._total_steps else 0.0

    def arm(self, step_by_step: bool = False) -> None:
        """
        Let the human watch from the next step on, also in the middle of an episode. If armed already, it goes on as it is.

        :param step_by_step: only in the steps that ``begin_step`` announces; in all others the wrapper is inert. That also
            holds for a wrapper that is armed already
        :raises ValueError: if the environment does not know the expert, or "risk" is the rule and the expert predicts nothing
        """
        if self._armed:
            self._step_by_step |= step_by_step
            return
        self._supervisor.build(self.env)
        self._step_by_step = step_by_step
        if self._budget_is_spent():
            self._on("pause")
        else:
            self._start_now_or_when_granted()
        self._armed = True

    def begin_step(self, may_drive: bool) -> None:
        """
        Announce that the next step is one of the training: nobody else's (an evaluation in the same environment) is watched,
        driven or counted by the human.

        :param may_drive: whether the human may drive it
        """
        self._is_granted, self._may_drive = True, may_drive

    def disarm(self) -> None:
        """End a takeover and a pause; from the next step on the wrapper is inert. The counts are kept."""
        self._on("hand back")
        self._on("resume")
        self._armed = self._has_to_start = self._is_granted = False

    def set_rule(self, rule: Any = None) -> None:
        """
        Change the rule from the next step on, e.g. to "always" while the human demonstrates.

        :param rule: see ``make_rule``; None for the rule that the wrapper was made with
        :raises ValueError: for a rule that does not fit; nothing is changed then
        """
        self._supervisor.set_rule(rule, self.env)

    def pause(self) -> None:
        """
        Stop asking the human, which ends a takeover; steps go on counting.

        :raises RuntimeError: if the wrapper is not armed
        """
        self._check_armed("pause")
        self._on("pause")

    def resume(self) -> None:
        """
        Ask the human again, unless the budget is spent.

        :raises RuntimeError: if the wrapper is not armed
        """
        self._check_armed("resume")
        if self._state is ControlState.PAUSED and not self._budget_is_spent():
            self._on("resume")
            self._start_now_or_when_granted()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._observation = None
        self._on("hand back")
        self._was_reported = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = copy.deepcopy(observation)
        if seed is not None:
            self._seed = seed
        if self._armed and self._state is not ControlState.PAUSED:
            self._start_now_or_when_granted()
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        is_granted, self._is_granted = self._is_granted, False
        watches = self._armed and (is_granted or not self._step_by_step)
        if watches and self._has_to_start:
            self._has_to_start = False
            self._start()
        novice_action = self._checked_novice_action(action) if watches else np.array(action, self._box.dtype)
        received_action = np.array(action, np.float64) if watches else None
        # If anything below fails it stays so: the human does not drive, and only reset() goes on
        observation, self._observation = self._observation, None
        was_driving = self._state is ControlState.TAKEOVER
        self._on("hand back")

        drives, executed, applied_action = False, action, novice_action
        if watches and self._state is not ControlState.PAUSED and (self._may_drive or not self._step_by_step):
            expert_action = self._supervisor.act(observation)
            drives = self._supervisor.drives(observation, novice_action, expert_action, was_driving)
            if drives:
                executed, applied_action = expert_action.copy(), expert_action
        observation, reward, terminated, truncated, info = self.env.step(executed)
        report = self._read_report(info)
        takeover = drives or report.takeover
        starts = takeover and not (was_driving or self._was_reported)
        if report.action is not None:
            applied_action = report.action.astype(self._box.dtype)

        is_over = terminated or truncated
        self._was_reported = report.takeover and not is_over
        self._total_steps += watches
        self._human_steps += watches and takeover
        if not is_over:
            self._observation = copy.deepcopy(observation)
            self._on("take over" if drives else "hand back")
        if self._armed and not watches:
            self._has_to_start = True
        if self._armed and self._budget_is_spent():
            self._on("pause")
        info = {
            **info,
            contract.RECEIVED_ACTION: received_action,
            contract.TAKEOVER: takeover,
            contract.TAKEOVER_START: starts,
            contract.APPLIED_ACTION: applied_action,
            "takeover_cost": self._cosine_distance(novice_action, applied_action) if starts else 0.0,
            "is_intervention": takeover,
            "human_steps": self._human_steps,
            "total_steps": self._total_steps,
            "takeover_rate": self.takeover_rate,
        }
        if takeover:
            info["intervene_action"] = applied_action.copy()
        # A copy: environments that reuse the array would overwrite what VecEnvs keep of the end of an episode
        return copy.deepcopy(observation), reward, terminated, truncated, info

    def _read_report(self, info: dict[str, Any]) -> contract.Report:
        report = contract.read_report(info, self._box)
        if report.takeover:
            contract.check_report_order(self.env)
        return report

    def set_stage(self, stage: str | int) -> None:
        """
        Set the stage that is displayed.

        :param stage: stage of the training, for the display
        """
        self._stage = stage

    @property
    def hud(self) -> dict[str, Any]:
        """Values for a ``TakeoverDisplay``."""
        return {
            "takeover": self._state is ControlState.TAKEOVER,
            "steps": self._total_steps,
            "takeover rate": self.takeover_rate,
            "stage": self._stage,
        }

    def render(self) -> Any:
        if isinstance(self.unwrapped, contract.TakeoverDisplay):
            self.unwrapped.hud = self.hud
        return self.env.render()

    def state_dict(self) -> dict[str, int]:
        """Return the counts, to go on with the same budget after a restart."""
        return {"human_steps": self._human_steps, "total_steps": self._total_steps}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """
        Restore the counts.

        :param state_dict: from ``state_dict``
        :raises ValueError: unless it holds the two counts
        """
        human_steps, total_steps = state_dict.get("human_steps"), state_dict.get("total_steps")
        check_integer("human_steps in state_dict", human_steps, low=0)
        check_integer("total_steps in state_dict", total_steps, low=int(human_steps))  # type: ignore[arg-type]
        self._human_steps, self._total_steps = int(human_steps), int(total_steps)  # type: ignore[arg-type]
        if self._armed and self._budget_is_spent():
            self._on("pause")

    def _on(self, event: str) -> None:
        self._state = TRANSITIONS.get((self._state, event), self._state)

    def _budget_is_spent(self) -> bool:
        return self.budget is not None and self._human_steps >= self.budget

    def _check_armed(self, name: str) -> None:
        if not self._armed:
            raise RuntimeError(f"{name}() needs an armed InterventionWrapper: call arm() first.")

    def _start_now_or_when_granted(self) -> None:
        if self._step_by_step:
            self._has_to_start = True
        else:
            self._start()

    def _start(self) -> None:
        """Tell expert and rule that they are asked from now on; before the first reset() there is nothing to look at yet."""
        if self._observation is None:
            return
        observation, self._observation = self._observation, None  # stays None if anything fails
        self._supervisor.reset(self._seed)
        self._observation, self._seed = observation, None

    def _checked_novice_action(self, action: Any) -> np.ndarray:
        if self._observation is None:
            raise ResetNeeded("Call reset() before step(): no episode is under way (none started, it ended, or it failed).")
        array = real_numbers(action)
        if array is None or not np.isfinite(array).all() or array.shape != self._box.shape:
            raise ValueError(
                f"action must be finite numbers of shape {self._box.shape}, got {action!r}. The environment did not "
                "make a step: look for the NaN or the shape where the action comes from."
            )
        return array.astype(self._box.dtype)

    def _cosine_distance(self, novice_action: np.ndarray, expert_action: np.ndarray) -> float:
        novice, expert = (contract.scale_action(action, self._box).ravel() for action in (novice_action, expert_action))
        norms = np.linalg.norm(novice) * np.linalg.norm(expert)
        return float(np.clip(1 - novice @ expert / norms, 0, 2)) if norms > 0 else 0.0
