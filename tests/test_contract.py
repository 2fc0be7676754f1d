"""Takeovers from anywhere: environments that report them, action wrappers around them, evaluations in between, one budget."""

import enum
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from guided_toys import ALGORITHMS, Limited, column, make_guided, scripted
from gymnasium import spaces
from gymnasium.wrappers import ClipAction, RescaleAction, TransformAction
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from takeover_toys import EXPERT, Integrator, NoisyDriver, constant

from sb3_chac import IWR, HGDagger
from sb3_chac.common.contract import read_report
from sb3_chac.human import InterventionWrapper

GUIDED = [*ALGORITHMS, HGDagger, IWR]
each_algorithm = pytest.mark.parametrize("algorithm", GUIDED)


def make(algorithm, env, **kwargs):
    if algorithm in ALGORITHMS:
        return make_guided(algorithm, env, **kwargs)
    sizes = {"warm_up_steps": 500, "n_epochs": 1, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    return algorithm("MlpPolicy", env, buffer_size=500, seed=0, **(sizes | kwargs))


# --- Units


class Halving(gym.ActionWrapper):
    """Halves the actions on their way; the action space stays."""

    def action(self, action):
        return action / 2


class Stepping(gym.Wrapper):
    """Likewise, but no ``ActionWrapper``."""

    def step(self, action):
        return self.env.step(action / 2)


def rescaled(env):
    return RescaleAction(env, np.float32(0), np.float32(1))


def takeover(env):
    return InterventionWrapper(env, constant, "always")


def discretized(env):
    return gym.wrappers.DiscretizeAction(env, 3)


def negated(env):
    return TransformAction(env, np.negative, env.action_space)


@pytest.mark.parametrize(
    "change, vec_env",
    [(rescaled, DummyVecEnv), (Halving, DummyVecEnv), (negated, DummyVecEnv), (Halving, SubprocVecEnv)],
    ids=["rescale", "scale", "negate", "subprocess"],
)
def test_actions_that_are_changed_above_the_takeover_are_refused_at_setup(change, vec_env):
    env = vec_env([lambda: change(takeover(Limited()))])
    try:
        with pytest.raises(ValueError, match=r"takes over in Box\(-1.*acts in Box.*InterventionWrapper\(RescaleAction"):
            make(ALGORITHMS[0], env)
    finally:
        env.close()


@each_algorithm
def test_each_algorithm_refuses_them(algorithm):
    for change in (rescaled, ClipAction, discretized):
        with pytest.raises(ValueError, match=r"takes over in Box\(-1.*acts in .*InterventionWrapper\(RescaleAction"):
            make(algorithm, change(takeover(Limited())))
    model = make(algorithm, Stepping(takeover(Limited())))
    with pytest.raises(ValueError, match=r"changes actions between the algorithm.*Put the InterventionWrapper outside"):
        model.learn(3)
    assert model.replay_buffer.size() == 0


@each_algorithm
def test_below_the_takeover_actions_may_be_changed(algorithm):
    human_action = np.array([0.75, 0.25])  # in [0, 1]
    env = InterventionWrapper(Stepping(Halving(rescaled(Limited()))), lambda observation: human_action, "always")
    model = make(algorithm, env).learn(5)
    assert np.allclose(column(model.replay_buffer.human, "action"), [0.5, -0.5])


# --- Takeovers that environments report


class Hil(gym.Wrapper):
    """A person drives every second pair of steps."""

    def __init__(self, env, report, human_action=EXPERT):
        super().__init__(env)
        self.report, self.human_action, self.steps = report, np.asarray(human_action), 0

    def step(self, action):
        human = self.steps // 2 % 2 == 1
        self.steps += 1
        action = self.human_action if human else action
        *step, info = self.env.step(action)
        return *step, info | self.report(human, action)


class TeleopEvents(enum.Enum):
    IS_INTERVENTION = "is_intervention"


REPORTS = {
    "HIL-SERL": lambda human, a: {"intervene_action": a} if human else {},
    "HIL-SERL, None": lambda human, a: {"intervene_action": a if human else None},
    "HIL-SERL, flag": lambda human, a: {"intervene_action": a, "is_intervention": human},
    "gym-hil": lambda human, a: {"action_intervention": a, "is_intervention": np.bool_(human)},
    "gym-hil, no flag": lambda human, a: {"action_intervention": a} if human else {"action_intervention": None},
    "LeRobot": lambda human, a: {"teleop_action": th.as_tensor(a), "is_intervention": th.tensor(human)},
    "LeRobot, Enum": lambda human, a: {"teleop_action": a[None], TeleopEvents.IS_INTERVENTION: human},
    "LeRobot, no flag": lambda human, a: {"teleop_action": a if human else None, "is_intervention": None},
}


@pytest.mark.parametrize("report", REPORTS.values(), ids=REPORTS)
@pytest.mark.parametrize("wrap", ["alone", "wrapped", "wrapped and driving"])
def test_reported_takeovers_count_exactly(report, wrap):
    env = Hil(Limited(), report)
    if wrap == "wrapped and driving":  # in the steps that the person drives, and in one more
        env = InterventionWrapper(env, lambda obs: -EXPERT, lambda *_: len(env.unwrapped.executed) in (2, 3, 6, 7, 8))
    elif wrap == "wrapped":
        env = InterventionWrapper(env, constant, "never")
    model = make_guided(ALGORITHMS[0], env)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*no human is in the loop")
        model.learn(10)
    human = model.replay_buffer.human
    extra = wrap == "wrapped and driving"
    assert len(human) == model.counts["human_steps"] == 4 + extra
    assert column(human, "takeover_start").tolist() == [1, 0, 1, 0] + [0] * extra
    executed = np.array(env.unwrapped.executed)[[2, 3, 6, 7, 8][: 4 + extra]]
    assert np.allclose(column(human, "action"), executed) and np.allclose(executed[:4], EXPERT)
    if wrap != "alone":
        assert env.human_steps == 4 + extra


@each_algorithm
def test_each_algorithm_counts_reported_takeovers(algorithm):
    model = make(algorithm, Hil(Limited(), REPORTS["gym-hil"])).learn(10)
    assert len(model.replay_buffer.human) == model.counts["human_steps"] == 4


def test_where_nobody_reports_it_is_said():
    with pytest.warns(UserWarning, match="no human is in the loop"):
        make_guided(ALGORITHMS[0], Limited()).learn(3)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*no human is in the loop")  # somebody might have, but did not
        make_guided(ALGORITHMS[0], Hil(Limited(), REPORTS["LeRobot"])).learn(2)


@each_algorithm
@pytest.mark.parametrize(
    "change, action, message",
    [
        (rescaled, EXPERT, r"RescaleAction"),
        (lambda env: env, [2.0, 0.0], "out of bounds"),
        (lambda env: env, [0.0], r"info\['intervene_action'\] of environment 0.*shape"),
        (lambda env: env, [0.0, "left"], r"info\['intervene_action'\] of environment 0"),
    ],
    ids=["rescaled", "outside", "shape", "text"],
)
def test_reports_in_wrong_units_are_refused(algorithm, change, action, message):
    model = make(algorithm, change(Hil(Anywhere(), REPORTS["HIL-SERL"], action)))
    with pytest.raises(ValueError, match=message):
        model.learn(10)
    assert model.replay_buffer.size() == 2


class Anywhere(Limited):
    """Does not look at actions."""

    def step(self, action):
        return super().step(np.zeros(2))


def test_a_flag_needs_an_action():
    with pytest.raises(ValueError, match=r"info\['is_intervention'\] of environment 3 .*missing.*intervene_action"):
        read_report({"is_intervention": True, "teleop_action": None}, spaces.Box(-1, 1, (2,)), 3)


# --- Names


class Robot(Limited):
    """Has methods of our names, none of which is ours to call."""

    hud = "its own"

    def __getattribute__(self, name):
        if name in ("arm", "disarm", "set_rule", "set_stage", "load_state_dict", "state_dict", "begin_step"):
            raise AssertionError(f"{name} was touched")
        return super().__getattribute__(name)


class RobotWrapper(gym.Wrapper):
    def arm(self, *args):
        raise AssertionError("moves things")

    disarm = set_rule = set_stage = load_state_dict = state_dict = begin_step = arm


@each_algorithm
def test_methods_of_ones_own_are_left_alone(algorithm):
    for env in (Robot(), RobotWrapper(Robot()), RobotWrapper(takeover(Robot()))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = make(algorithm, env, learning_starts=3) if algorithm in ALGORITHMS else make(algorithm, env)
            model.learn(4)
            model.learn(4, reset_num_timesteps=False)
    assert model.counts["human_steps"] == 8
    assert env.unwrapped.hud == "its own"


# --- Evaluation in the training environment


class Evaluate(BaseCallback):
    def __init__(self, evaluate):
        super().__init__()
        self.evaluate = evaluate

    def _on_step(self):
        if self.n_calls in (6, 12):
            self.evaluate(self.model)
        return True


@each_algorithm
@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_human_does_not_drive_an_evaluation_in_the_training_environment(algorithm, n_envs):
    drivers = [NoisyDriver() for _ in range(n_envs)]
    env = DummyVecEnv([lambda d=d: InterventionWrapper(Limited(limit=5), d, "always", budget=100) for d in drivers])
    seen = []

    def evaluate(model):
        evaluate_policy(model, env, 3, callback=lambda local, _: seen.append(local["info"]["takeover"]), warn=False)

    model = make(algorithm, env).learn(20 * n_envs, callback=Evaluate(evaluate))
    assert len(seen) >= 30 and not any(seen)
    assert model.counts["human_steps"] == len(model.replay_buffer.human) == 20 * n_envs
    assert sum(len(driver.observations) for driver in drivers) == sum(env.get_attr("human_steps")) == 20 * n_envs
    # No row leads from one episode into another
    human = model.replay_buffer.human
    moved = column(human, "next_observation/") - column(human, "observation/")
    assert np.allclose(moved, column(human, "action"), atol=1e-5)
    # Between two calls of learn(), too
    evaluate(model)
    model.learn(5 * n_envs, reset_num_timesteps=False)
    moved = column(human, "next_observation/") - column(human, "observation/")
    assert len(human) == 25 * n_envs and np.allclose(moved, column(human, "action"), atol=1e-5)


def test_an_eval_callback_on_the_training_environment():
    env = takeover(Limited(limit=5))
    model = make_guided(ALGORITHMS[0], env)
    callback = EvalCallback(model.get_env(), eval_freq=7, n_eval_episodes=2, warn=False, verbose=0)
    model.learn(20, callback=callback)
    assert env.human_steps == model.counts["human_steps"] == 20


def test_training_goes_on_where_it_was_if_nobody_else_was_there():
    """No episode is cut short: neither by limits above the takeover nor between two calls of learn()."""
    env = gym.wrappers.TimeLimit(takeover(Integrator()), 7)
    model = make_guided(ALGORITHMS[0], env, learning_starts=99).learn(10)
    model.learn(10, reset_num_timesteps=False)
    assert model._episode_num == 2 and env.get_wrapper_attr("human_steps") == 20


# --- Budget


@pytest.mark.parametrize("n_envs, budget", [(2, 31), (3, 10), (1, 5), (2, 0)])
@each_algorithm
def test_the_budget_is_shared(algorithm, n_envs, budget):
    model = make(algorithm, scripted(*["1" * 999] * n_envs, budget=budget)).learn(60)
    assert model.counts["human_steps"] == len(model.replay_buffer.human) == budget
    model.learn(12, reset_num_timesteps=False)
    assert model.counts["human_steps"] == budget


def test_budgets_that_differ_are_refused():
    env = DummyVecEnv([lambda n=n: InterventionWrapper(Limited(), constant, "always", budget=n) for n in (3, 5)])
    with pytest.raises(ValueError, match=r"^budget: "):
        make_guided(ALGORITHMS[0], env).learn(4)


# --- Aliasing


class Reusing(Limited):
    """Hands out one array of observations for ever, keeps the actions and changes all that it got."""

    buffer = None

    def obs(self):
        self.buffer = np.zeros(2, np.float32) if self.buffer is None else self.buffer
        self.buffer[:] = self.position
        return self.buffer

    def step(self, action):
        step = super().step(np.array(action))
        np.asarray(action)[...] = 0.777
        return step


class Meddling:
    """As expert and rule, changes what it is given, and later what it returned."""

    def __init__(self):
        self.returned = np.zeros(2)

    def reset(self, seed=None):
        pass

    def __call__(self, observation, novice_action=None, expert_action=None, human_driving=False):
        observation[...] = 9
        if novice_action is None:
            self.returned[...] = 99
            self.returned = EXPERT.copy()
            return self.returned
        novice_action[...] = expert_action[...] = 0.9
        return self.returned[0] != 99 and observation.sum() == 18


@each_algorithm
def test_nothing_stored_depends_on_arrays_of_others(algorithm):
    env = InterventionWrapper(Reusing(limit=3), Meddling(), Meddling())
    model = make(algorithm, env).learn(9)
    human = model.replay_buffer.human
    assert len(human) == 9 and np.allclose(column(human, "action"), EXPERT)
    moved = column(human, "next_observation/") - column(human, "observation/")
    assert np.allclose(moved, EXPERT, atol=1e-5)


# --- What is not measured


@pytest.mark.parametrize(
    "infos, logged",
    [
        ({}, set()),
        ({"cost": 1.0}, {"safety_cost", "safety_cost_human"}),
        ({"crashed": True}, {"collisions"}),
        ({"collision": False, "crashed": True, "out_of_road": True}, {"collisions", "departures"}),
    ],
    ids=["nothing", "cost", "crashed", "ours"],
)
@each_algorithm
def test_what_is_not_measured_is_not_logged(algorithm, infos, logged):
    model = make(algorithm, scripted("01" * 99, infos=infos, limit=5)).learn(10)
    records = {}
    model.logger.record = lambda name, value, exclude=None: records.update({name: value})
    model.dump_logs()
    assert {name.removeprefix("safety/") for name in records if name.startswith("safety/")} == logged
    assert ("rollout/ep_cost_mean" in records) == ("cost" in infos)
    if infos == {"crashed": True}:
        assert records["safety/collisions"] == 2  # it stays set until the episode is over
    if "collision" in infos:
        assert records["safety/collisions"] == 0 and records["safety/departures"] == 10


# --- Normalization


@pytest.mark.parametrize("algorithm", [HGDagger, IWR])
def test_statistics_are_those_of_what_is_fitted_and_stand_still(algorithm):
    env = VecNormalize(scripted("1" * 8 + "01" * 99, limit=6), norm_reward=False)
    model = make(algorithm, env, warm_up_steps=8, round_human_steps=4, n_rounds=1)
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append((self.model.round, env.obs_rms.mean.copy()))
            return True

    model.learn(40, callback=Watch())
    between = np.array([mean for round_, mean in seen if round_ == 1])
    human = model.replay_buffer.human
    assert len(between) and np.ptp(between[1:], axis=0).max() == 0
    assert np.allclose(between[1], column(human, "observation/")[:8].mean(axis=0), atol=1e-4)
    stores = [human, model.replay_buffer.novice][: 1 + (algorithm is IWR)]
    fitted = np.concatenate([column(store, "observation/") for store in stores])
    assert np.allclose(env.obs_rms.mean, fitted.mean(axis=0), atol=1e-4)
    assert np.allclose(env.obs_rms.var, fitted.var(axis=0), rtol=1e-3)
    before = env.obs_rms.mean.copy()
    evaluate_policy(model, env, 2, warn=False)
    assert (env.obs_rms.mean == before).all()


# --- The end of the rounds


@pytest.mark.parametrize("algorithm", [HGDagger, IWR])
@pytest.mark.parametrize("total", [40, 6], ids=["rounds are done", "steps are over"])
def test_the_last_fit_is_evaluated(algorithm, total):
    model = make(algorithm, scripted("1" * 99), warm_up_steps=8, round_human_steps=4, n_rounds=1)
    updates = []
    callback = EvalCallback(scripted("1" * 9, limit=3), eval_freq=1000, n_eval_episodes=1, warn=False, verbose=0)
    evaluate = callback._on_step
    callback._on_step = lambda: updates.append(model._n_updates) or evaluate()
    model.learn(total, callback=[callback])
    assert np.isfinite(callback.last_mean_reward)
    assert updates[-1] == model._n_updates > 0
    if total == 40:
        with pytest.warns(UserWarning, match="rounds are done.*n_rounds"):
            model.learn(5, reset_num_timesteps=False)
