"""pytest plugin: hands our algorithm to SB3's own tests wherever they import SAC (see test_sb3_suite.py)."""

import stable_baselines3

import sb3_chac


class DSAC(sb3_chac.DSAC):
    """With SAC's pace: those tests train for a few steps and expect the actor to have moved."""

    def __init__(self, *args, learning_rate=3e-4, policy_delay=1, **kwargs):
        super().__init__(*args, learning_rate=learning_rate, ent_coef_lr=learning_rate, policy_delay=policy_delay, **kwargs)


stable_baselines3.SAC = DSAC
