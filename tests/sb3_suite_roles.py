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
NO_REWARD = "does not learn from the environment's reward"
NO_ACTING = "learns from a dataset: its steps are gradient steps, without acting"
NO_DICT = "takes no Dict observations"
NO_CRITIC = "has an actor alone: no critic, no targets, and nothing beside the policy"
BOX_ONLY = "takes Box observations only, as datasets of demonstrations have"
NO_SDE = "has no gSDE"
ROUNDS = "is fitted in rounds, not after each rollout"
COSTS = "stores costs, and says so in its own words"

# Of whom, part of the test's id, why not
NOT_APPLICABLE: list[tuple[tuple[str, ...], str, str]] = [
    (tuple(ROLES), "test_tensorboard.py", "expects that the folder of the logs is named after SB3's algorithm"),
    (GUIDED, "test_her", OWN_BUFFER),
    (OFFLINE, "test_her", NO_BUFFER),
    (GUIDED, "test_n_step_replay.py", OWN_BUFFER),
    (OFFLINE, "test_n_step_replay.py", NO_BUFFER),
    (GUIDED, "test_save_load_replay_buffer", OWN_BUFFER),
    (OFFLINE, "test_save_load_replay_buffer", NO_BUFFER),
    (GUIDED, "test_warn_buffer", OWN_BUFFER),
    (OFFLINE, "test_warn_buffer", NO_BUFFER),
    ((*GUIDED, *OFFLINE, "GAIL"), "test_identity.py", NO_REWARD),
    ((*GUIDED, *OFFLINE), "test_infinite_horizon", NO_REWARD),
    (("DSAC",), "test_infinite_horizon", "its sigma settles first: it has after 1000 steps what is expected after 500"),
    (OFFLINE, "test_callbacks[", NO_ACTING),
    (OFFLINE, "test_offpolicy_multi_env", NO_ACTING),
    (OFFLINE, "test_train_freq", NO_ACTING),
    (OFFLINE, "test_offpolicy_collect_rollout_batch_norm", NO_ACTING),
    (("HGDagger", "IWR"), "test_offpolicy_multi_env", ROUNDS),
    ((*FROM_DATASETS,), "test_dict_env.py", NO_DICT),
    ((*FROM_DATASETS,), "obs_space2", NO_DICT),
    ((*FROM_DATASETS,), "obs_space3", NO_DICT),
    ((*FROM_DATASETS,), "test_identity_spaces", BOX_ONLY),
    ((*FROM_DATASETS,), "test_discrete_obs_space", BOX_ONLY),
    (("BC",), "test_action_spaces[CartPole", "takes Discrete actions, too, with another loss"),
    (IMITATING, "test_features_extractor_target_net", NO_CRITIC),
    (IMITATING, "test_train_eval_mode.py", NO_CRITIC),
    (IMITATING, "test_save_load_policy", NO_CRITIC),
    (("DPVP", "CHAC"), "test_save_load_policy", "the average of the actor acts when deterministic, not the actor"),
    (("DPVP", "CHAC"), "test_state_dependent_noise", OWN_BUFFER),
    (("CQL",), "test_state_dependent_noise", NO_SDE),
    (("SACLag",), "test_her", COSTS),
    (("SACLag",), "test_n_steps_", COSTS),
    (("SACLag",), "test_save_load_replay_buffer", COSTS),
    (("SACLag",), "test_run[", COSTS),
    (("PPOLag",), "test_vec_with_ppo", "its environment gives empty infos, which tell no costs"),
    (OFFLINE, "test_no_resource_warning", NO_BUFFER),
    (("CQL",), "test_features_extractor_target_net", "has no train(): learn(n) makes n gradient steps"),
    (("GAIL",), "test_rollout_success_rate_onpolicy_algo", BOX_ONLY),
    (GUIDED, "test_no_resource_warning", "warns of ent_coef='auto', and warnings are errors there"),
    (("PPOLag", "GAIL"), "test_ppo[-0.2", "refuses a negative clip_range_vf in the constructor, SB3 while learning"),
    (("PPOLag", "GAIL"), "test_ppo_warnings", "says its own name in the warning"),
    (("PPOLag",), "test_gae_computation", "needs a policy with a value of the costs"),
    (("GAIL",), "test_gae_computation", "puts rewards of its own in place of the environment's"),
]
