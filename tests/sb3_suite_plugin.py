"""
pytest plugin: hands our algorithms to SB3's own tests wherever they import their nearest relatives (see test_sb3_suite.py).

``SB3_SUITE`` names one algorithm for each role, such as ``DSAC,PVP,GAIL``. What concerns no role is deselected, what cannot be
asked (``sb3_suite_roles``) is skipped with the reason. ``SB3_SUITE_REPORT`` is a file that gets one row a test.
"""

import csv
import inspect
import os
import re
from typing import Any

import numpy as np
import pytest
import sb3_suite_roles as roles
import stable_baselines3
from gymnasium import spaces

import sb3_chac
from sb3_chac.common.demonstrations import Demonstrations

NAMES = os.environ["SB3_SUITE"].split(",")
N_ROWS = 60


def random_demonstrations(observation_space: spaces.Space, action_space: spaces.Space) -> Demonstrations:
    """Six episodes of what is drawn from the spaces."""
    for space in (observation_space, action_space):
        space.seed(0)
    rows = np.stack([observation_space.sample() for _ in range(N_ROWS)])
    return Demonstrations(
        observation_space=observation_space,
        action_space=action_space,
        observations=rows,
        actions=np.stack([action_space.sample() for _ in range(N_ROWS)]),
        next_observations=rows[::-1].copy(),
        rewards=np.zeros(N_ROWS),
        terminations=np.zeros(N_ROWS, bool),
        truncations=np.arange(N_ROWS) % 10 == 9,
        episodes=np.arange(N_ROWS) // 10,
    )


def in_role(name: str) -> type:
    """
    :param name: of one of our algorithms
    :return: it, with the pace that those tests expect (the actor has moved after a few steps), without the arguments that it
        does not have, and with the costs and demonstrations that those tests do not know of
    """
    base: Any = getattr(sb3_chac, name)
    known = inspect.signature(base).parameters

    class Quick(base):
        def __init__(self, *args: Any, **kwargs: Any):
            pace: dict[str, Any] = {
                "learning_rate": 3e-4,
                "policy_delay": 1,
                "warm_up_steps": 0,
                "n_epochs": 2,
                "actor_lr": 3e-4,
            }
            if "learning_rate" in kwargs:
                pace |= dict.fromkeys(("ent_coef_lr", "actor_lr"), kwargs["learning_rate"])
            else:
                pace["ent_coef_lr"] = 3e-4
            if roles.ROLES[name] == "PPO":
                pace = {}
            elif roles.ROLES[name] == "SAC":
                pace["ent_coef"] = "auto"  # as SAC's, but not D-PVP's
            super().__init__(*args, **{key: value for key, value in (pace | kwargs).items() if key in known})
            if name in ("HGDagger", "IWR") and kwargs.get("_init_setup_model", True):
                self.store_demonstrations(random_demonstrations(self.observation_space, self.action_space))

        def set_dataset(self, dataset: Any) -> None:
            super().set_dataset(dataset or random_demonstrations(self.observation_space, self.action_space))

        def _store_transition(self, *args: Any) -> None:
            add_costs(args[-1])
            super()._store_transition(*args)

        def _update_info_buffer(self, infos: Any, dones: Any = None) -> None:
            add_costs(infos)
            super()._update_info_buffer(infos, dones)

    Quick.__name__ = name  # the tests' ids
    return Quick


def add_costs(infos: list[dict[str, Any]]) -> None:
    """SB3's environments know of none, SAC-Lag and PPO-Lag insist on them."""
    for info in infos:
        info.setdefault("cost", 0.1)


OURS = {name: in_role(name) for name in NAMES}
for _name, _ours in OURS.items():
    setattr(stable_baselines3, roles.ROLES[_name], _ours)


def algorithm_of(item: pytest.Item) -> str | None:
    """
    :return: name of the algorithm of ours that a test is about, None if there is none
    """
    values = item.callspec.params.values() if hasattr(item, "callspec") else []
    classes = [value for value in values if inspect.isclass(value) and hasattr(value, "learn")]
    if classes:
        return next((name for name, ours in OURS.items() if ours in classes), None)
    source = inspect.getsource(item.function)  # type: ignore[attr-defined]
    called = [name for name in NAMES if re.search(rf"\b{roles.ROLES[name]}[(.]", source)]
    return called[0] if called else None


def reason_against(name: str, item: pytest.Item) -> str | None:
    """
    :return: why a test cannot be asked of an algorithm, None if it can
    """
    return next((why for names, part, why in roles.NOT_APPLICABLE if name in names and part in item.nodeid), None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept = [item for item in items if algorithm_of(item) is not None]
    config.hook.pytest_deselected(items=[item for item in items if algorithm_of(item) is None])
    for item in kept:
        name = algorithm_of(item)
        assert name is not None
        item.user_properties.append(("algorithm", name))
        why = reason_against(name, item)
        if why is not None:
            item.user_properties.append(("reason", why))
            item.add_marker(pytest.mark.skip(reason=why))
    items[:] = kept


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if "SB3_SUITE_REPORT" not in os.environ or not (report.when == "call" or (report.when == "setup" and not report.passed)):
        return
    properties = dict(report.user_properties)
    why = properties.get("reason", "")
    if report.skipped and not why:
        return  # SB3's own test says that it does not apply to the relative either
    outcome = "not applicable" if why else report.outcome
    with open(os.environ["SB3_SUITE_REPORT"], "a", newline="") as file:
        csv.writer(file).writerow([properties["algorithm"], report.nodeid, outcome, why])
