"""Which of SB3's algorithms each of ours stands in for in SB3's own test suite, and what cannot be asked of it there."""

ROLES = {
    "DSAC": "SAC",
    "DPVP": "SAC",
    "CHAC": "SAC",
    "SACLag": "SAC",
    "CQL": "SAC",
    "PVP": "TD3",
    "BC": "TD3",
    "HGDagger": "TD3",
    "IWR": "TD3",
    "PPOLag": "PPO",
    "GAIL": "PPO",
}
GUIDED = ("PVP", "DPVP", "CHAC", "HGDagger", "IWR")
OFFLINE = ("BC", "CQL")
IMITATING = ("BC", "HGDagger", "IWR")
FROM_DATASETS = (*OFFLINE, "GAIL", "HGDagger", "IWR")

# Files that nothing is asked of: they need what is not installed, or concern no algorithm
LEFT_OUT = {
    "tests/test_utils.py": "needs the Atari emulator",
    "tests/test_distributions.py": "concerns distributions alone",
}

OWN_BUFFER = "has a replay buffer of its own: that of SB3 holds no takeovers"
NO_BUFFER = "has no replay buffer"
NO_REWARD = "does not learn from reward"
NO_ACTING = "learns from a dataset, without acting"
NO_DICT = "takes no Dict observations"
NO_CRITIC = "has an actor alone, no critic and no targets"
BOX_ONLY = "takes Box observations only, as datasets of demonstrations have"
NO_SDE = "has no gSDE"
COSTS = "its replay buffer must hold costs"

# Of whom, part of the test's id, why not
NOT_APPLICABLE: list[tuple[tuple[str, ...], str, str]] = [
    (tuple(ROLES), "test_tensorboard.py", "expects that the folder of the logs is named after SB3's algorithm"),
    (GUIDED, "test_her.py", OWN_BUFFER),
    (GUIDED, "test_her_normalization", OWN_BUFFER),
    (GUIDED, "test_n_step_replay.py", OWN_BUFFER),
    (GUIDED, "test_save_load_replay_buffer", OWN_BUFFER),
    (GUIDED, "test_warn_buffer", OWN_BUFFER),
    (GUIDED, "test_identity.py", NO_REWARD),
    (GUIDED, "test_infinite_horizon", NO_REWARD),
    (("DPVP", "CHAC"), "test_save_load_policy", "the average of the actor acts when deterministic, not the actor"),
    (("DPVP", "CHAC"), "test_state_dependent_noise", OWN_BUFFER),
]
