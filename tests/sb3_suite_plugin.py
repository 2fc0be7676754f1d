"""pytest plugin: hands one of our algorithms to SB3's own tests wherever they import SAC (see test_sb3_suite.py)."""

import os

import stable_baselines3

import sb3_chac

ALGORITHM = os.environ["SB3_SUITE_ALGORITHM"]
Base = getattr(sb3_chac, ALGORITHM)


class Quick(Base):
    """With SAC's pace: those tests train for a few steps and expect the actor to have moved."""

    def __init__(self, *args, learning_rate=3e-4, policy_delay=1, **kwargs):
        super().__init__(*args, learning_rate=learning_rate, ent_coef_lr=learning_rate, policy_delay=policy_delay, **kwargs)


Quick.__name__ = ALGORITHM  # the tests' ids
stable_baselines3.SAC = Quick
