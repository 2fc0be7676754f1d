import gc
import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from shell import run
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_chac import DPVP, InterventionWrapper
from sb3_chac.envs.metadrive import PRESETS, MetaDriveSafetyEnv
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.evaluation.evaluation import evaluate

needs_metadrive = pytest.mark.skipif(
    importlib.util.find_spec("metadrive") is None,
    reason="MetaDrive is not installed: pip install metadrive-simulator==0.4.3 (its wheel is for Python up to 3.11)",
)


@pytest.fixture(autouse=True)
def headless(monkeypatch):
    monkeypatch.setenv("SB3_CHAC_METADRIVE_HEADLESS", "1")


@pytest.fixture
def env():
    env = MetaDriveSafetyEnv(render_mode="rgb_array")
    yield env
    env.close()


def place(env, behind, gap, speed=0.0):
    """The ego ``gap`` metres behind a thing, heading for it."""
    ahead = np.array([np.cos(behind.heading_theta), np.sin(behind.heading_theta)])
    env.ego.set_position(np.array(behind.position) - gap * ahead)
    env.ego.set_heading_theta(behind.heading_theta)
    env.ego.set_velocity(ahead, speed)


def parked_vehicle(env):
    """A vehicle of the traffic that waits for the ego to come near, in any of some scenarios."""
    for scenario in range(3000, 3020):
        env.reset(options={"scenario": scenario})
        for thing in env.simulator.engine.get_objects().values():
            if getattr(thing, "break_down", False):
                return thing
    raise AssertionError("no scenario has a broken-down vehicle")


# The environment as gymnasium and SB3 see it


@needs_metadrive
def test_checkers_of_gymnasium_and_sb3():
    env = gym.make("MetaDriveSafety-v0")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sb3_check_env(env)
            check_env(env.unwrapped, skip_render_check=True, skip_close_check=True)  # closing: below
    finally:
        env.close()


@needs_metadrive
def test_observations_are_scaled(env):
    own = []
    observe = env.simulator.reset
    env.simulator.reset = lambda **kwargs: own.append(observe(**kwargs)) or own[-1]
    observation, _ = env.reset(options={"scenario": 100})
    raw = np.clip(own[0][0], 0, 1)
    np.testing.assert_allclose(observation[19:259], 1 - raw[19:], atol=1e-6)  # closeness
    np.testing.assert_allclose(observation[3], (raw[3] - 0.75) / 0.2, rtol=1e-4)  # speed
    assert env.observation_space.contains(observation)
    low, high = env.observation_space.low, env.observation_space.high
    np.testing.assert_allclose(low[3], -0.75 / 0.2)
    np.testing.assert_allclose([low[19], high[19]], [0, 1])
    env.close()
    env = MetaDriveSafetyEnv(raw_observations=True, headless=True)
    assert (env.observation_space.low == 0).all() and (env.observation_space.high == 1).all()
    observation, _ = env.reset(options={"scenario": 100})
    np.testing.assert_allclose(observation, raw, atol=1e-4)
    env.close()


@needs_metadrive
def test_info_is_safedrives_and_metadrives_own_cost(env):
    safedrive = SafeDriveEnv()
    _, expected = safedrive.reset()
    _, info = env.reset()
    assert set(info) == set(expected) | {"contact_cost"}
    assert {key: type(info[key]) for key in expected} == {key: type(value) for key, value in expected.items()}


@needs_metadrive
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_reach_the_simulator(preset):
    env = MetaDriveSafetyEnv(preset, horizon=7)
    try:
        env.reset()
        assert env.ego.max_speed_km_h == PRESETS[preset].max_speed
        assert env.simulator.config["traffic_density"] == PRESETS[preset].traffic_density
        assert env.num_scenarios == PRESETS[preset].num_scenarios
        assert not env.simulator.config["crash_vehicle_done"] and not env.simulator.config["crash_object_done"]
        ends = [env.step(np.zeros(2))[2:4] for _ in range(7)]
        assert ends == [(False, False)] * 6 + [(False, True)]  # an argument overrides the preset
    finally:
        env.close()


@needs_metadrive
def test_scenarios_are_drawn_from_their_range_and_can_be_named(env):
    drawn = {env.reset(seed=seed)[1]["scenario"] for seed in range(10)}
    assert len(drawn) > 3 and drawn <= set(range(100, 120))
    assert env.reset(seed=3)[1]["scenario"] == env.reset(seed=3)[1]["scenario"]
    assert env.reset(options={"scenario": 4321})[1]["scenario"] == 4321
    for wrong in (-1, 1.5, 1_000_000, "a"):
        with pytest.raises(ValueError, match=r"options\['scenario'\]"):
            env.reset(options={"scenario": wrong})


def wild_drive(env, scenario, steps=130):
    """Observations, rewards and ends."""
    observation, _ = env.reset(options={"scenario": scenario})
    rows, rng = [observation], np.random.default_rng(0)
    for action in np.clip(rng.normal((0.0, 0.4), 0.2, (steps, 2)), -1, 1):
        observation, *rest, _ = env.step(action)
        rows.append(np.append(observation, rest))
    return np.concatenate(rows)


def crash(env, scenario):
    """The same, of running into a vehicle that stands, and on."""
    env.reset(options={"scenario": scenario})
    things = env.simulator.engine.get_objects().values()
    place(env, next(thing for thing in things if getattr(thing, "break_down", False)), gap=6.5, speed=5.0)
    rows = []
    for action in [(0.0, 0.5)] * 30 + [(0.5, 1.0)] * 30:
        observation, *rest, info = env.step(np.array(action))
        rows.append(np.append(observation, rest))
    assert info["episode_cost"] > 0
    return np.concatenate(rows)


@needs_metadrive
@pytest.mark.parametrize("drive", [wild_drive, crash])
def test_an_episode_repeats_to_the_digit_whatever_came_before(env, drive):
    scenario = 1006
    if drive is crash:
        parked_vehicle(env)
        scenario = env.scenario
    first = drive(env, scenario)
    for before in (lambda: None, lambda: wild_drive(env, 1003, 300), lambda: crash(env, env.scenario)):
        parked_vehicle(env)
        before()
        np.testing.assert_array_equal(drive(env, scenario), first)


@pytest.mark.parametrize(
    "argument",
    [
        {"preset": "paper"}, {"start_scenario": -1}, {"num_scenarios": 0}, {"traffic_density": 2.0}, {"max_speed": 0.0},
        {"horizon": 0}, {"contact_limit": 0}, {"render_mode": "3d"},
    ],
)  # fmt: skip
def test_arguments_out_of_range(argument):
    (name,) = argument
    with pytest.raises(ValueError, match=name):
        MetaDriveSafetyEnv(**argument)


# Physics


@needs_metadrive
def test_braking_at_a_standstill_does_not_creep(env):
    env.reset(options={"scenario": 3003})
    start = env.position
    for _ in range(50):
        env.step(np.array([0.0, -1.0]))
    assert np.hypot(*(env.position - start)) < 0.02
    for _ in range(50):  # what MetaDrive does by itself: as long as this fails, the remedy is needed
        env.simulator.step([0.0, -1.0])
    assert np.hypot(*(env.position - start)) > 0.2


@needs_metadrive
def test_the_brake_still_stops_the_vehicle(env):
    env.reset(options={"scenario": 3003})
    for _ in range(40):
        env.step(np.array([0.0, 0.6]))
    assert env.forward_speed > 4.0
    for _ in range(10):
        env.step(np.array([0.0, -1.0]))
    assert abs(env.forward_speed) < 0.3


@needs_metadrive
def test_a_collision_costs_once_however_long_the_contact(env):
    place(env, parked_vehicle(env), gap=6.5, speed=5.0)
    infos = [env.step(np.array([0.0, 0.5]))[4] for _ in range(60)]
    assert sum(info["contact"] for info in infos) >= 5
    assert sum(info["cost"] for info in infos) == 1.0 == infos[-1]["episode_cost"]
    assert sum(info["contact_cost"] for info in infos) >= sum(info["contact"] for info in infos)
    first = next(i for i, info in enumerate(infos) if info["contact"])
    assert infos[first]["collision"] and infos[first]["cost"] == 1.0


@needs_metadrive
def test_counts_a_collision_with_a_vehicle_that_is_removed_in_that_step(env):
    """MetaDrive takes away who is off the road, here the only other vehicle."""
    env.reset(options={"scenario": 3000})
    traffic = env.simulator.engine.traffic_manager
    waiting = [name for block in traffic.block_triggered_vehicles for name in block.vehicles]
    traffic.block_triggered_vehicles = []
    other = traffic.spawned_objects[waiting[0]]
    traffic.clear_objects(waiting[1:])
    traffic._traffic_vehicles.append(other)
    right_lane = env.simulator.engine.current_map.road_network.graph[env.ego.lane.index[0]][env.ego.lane.index[1]][-1]
    edge = right_lane.width / 2
    heading = right_lane.heading_theta_at(10.0)
    for vehicle, lateral in ((env.ego, edge - 0.9), (other, edge + 0.7)):
        vehicle.set_position(right_lane.position(10.0, lateral))
        vehicle.set_heading_theta(heading)
    info = env.step(np.zeros(2))[4]
    assert not traffic._traffic_vehicles
    assert info["contact"] and info["cost"] == 1.0


@needs_metadrive
def test_collision_replaces_the_reward(env):
    place(env, parked_vehicle(env), gap=6.5, speed=5.0)
    for _ in range(60):
        _, reward, _, _, info = env.step(np.array([0.0, 0.5]))
        if info["contact"]:
            break
    assert reward == -5.0


@needs_metadrive
@pytest.mark.parametrize(
    ("limit", "every", "end"),  # steps between two touches, step at which the episode is truncated
    [(30, 1, 30), (30, 8, 40), (30, 15, None), (None, 1, None)],
)
def test_a_contact_that_lasts_truncates_the_episode(env, monkeypatch, limit, every, end):
    env.contact_limit = limit
    env.reset(options={"scenario": 3003})
    monkeypatch.setattr(env, "_touching", lambda vehicles, objects: {"somebody"} if env.steps % every == 0 else set())
    ends = [env.step(np.zeros(2))[2:4] for _ in range(end or 60)]
    assert ends[:-1] == [(False, False)] * (len(ends) - 1) and ends[-1] == (False, end is not None)


@needs_metadrive
def test_leaving_the_road_ends_the_episode_without_success(env):
    env.reset(options={"scenario": 3003})
    for _ in range(200):
        _, reward, terminated, _, info = env.step(np.array([-0.5, 0.5]))
        if terminated:
            break
    assert terminated and info["out_of_road"] and not info["is_success"] and reward == -5.0


# Drivers


@needs_metadrive
@pytest.mark.parametrize("name", ["scripted", "scripted-ideal", "idm", "ppo"])
def test_drivers_by_name_get_going(env, name):
    observation, info = env.reset(options={"scenario": 3003})
    driver = env.scripted_driver(name)
    driver.reset(0)
    for _ in range(60):
        action = driver(observation)
        assert env.action_space.contains(action)
        observation, _, terminated, truncated, info = env.step(action)
        assert not (terminated or truncated)
    assert info["route_completion"] > 0.04
    assert driver.time_to_trouble(observation, np.array([1.0, 1.0])) < 2.5


@needs_metadrive
def test_unknown_driver(env):
    with pytest.raises(ValueError, match="idm"):
        env.scripted_driver("somebody")


# Pictures


@needs_metadrive
def test_picture_shows_what_the_wrapper_says(env):
    env.reset(options={"scenario": 3003})
    before = env.render()
    assert before.shape == (600, 800, 3) and before.dtype == np.uint8
    assert (before == env.render()).all()
    env.hud = {"takeover": True, "stage": 1}
    human = env.render()
    here = (slice(420, 445), slice(388, 412))  # the ego, in the human's colour
    assert (before[here] != human[here]).any() and (before[:200, :220] != human[:200, :220]).any()
    for _ in range(30):
        env.step(np.array([0.0, 1.0]))
    assert (env.render() != human).mean() > 0.02


@needs_metadrive
def test_map_as_a_plot(env):
    from matplotlib.figure import Figure

    env.reset(options={"scenario": 3003})
    axes = Figure().subplots()
    env.plot_map(axes)
    (patches,) = axes.collections
    assert len(patches.get_paths()) > 50
    markers = {line.get_marker() for line in axes.lines}
    assert {"o", "*", "^"} <= markers  # start, destination, cones


# One engine per process


@needs_metadrive
def test_second_environment_is_refused_until_the_first_is_closed_or_lost():
    first = MetaDriveSafetyEnv()
    first.reset()
    with pytest.raises(gym.error.Error, match="SubprocVecEnv"):
        MetaDriveSafetyEnv()
    first.step(np.zeros(2))  # the first goes on
    first.close()
    second = MetaDriveSafetyEnv()
    second.reset()
    first.close()  # once more, which leaves the second alone
    second.step(np.zeros(2))
    del second
    gc.collect()
    third = MetaDriveSafetyEnv()
    third.reset()
    third.close()


@needs_metadrive
def test_training_and_evaluation_in_processes_of_their_own():
    training = make_vec_env(
        "MetaDriveSafety-v0",
        n_envs=2,
        seed=0,
        env_kwargs={"headless": True},  # the server that forks them may be older than the environment variable
        wrapper_class=InterventionWrapper,
        vec_env_cls=SubprocVecEnv,
    )
    try:
        model = DPVP("MlpPolicy", training, learning_starts=50, batch_size=16, seed=0)
        model.learn(200)
        assert model.counts["human_steps"] > 0
        evaluation = evaluate(model, "MetaDriveSafety-v0", [2000], env_kwargs={"horizon": 20})
        assert evaluation.records[0]["scenario"] == 2000 and "takeover" not in evaluation.records[0]
    finally:
        training.close()


@needs_metadrive
def test_the_zoo_trains_and_evaluates(tmp_path):
    command = ["train", "--algo", "chac", "--env", "MetaDriveSafety-v0", "-n", "200", "--eval-freq", "100"]
    few = ["--eval-episodes", "1", "-params", "switch_after:100", "prefit_steps:5", "--env-kwargs", "horizon:40"]
    output = run(Path(sys.executable).with_name("rl_zoo3"), *command, *few, "-f", "logs", cwd=tmp_path)
    assert "Saving to" in output
    model = tmp_path / "logs" / "chac" / "MetaDriveSafety-v0_1" / "MetaDriveSafety-v0.zip"
    output = run(sys.executable, "-m", "sb3_chac", "evaluate", model, "--scenarios", "1000", cwd=tmp_path)
    assert "MetaDriveSafety-v0, 1 episode" in output and "safety cost" in output


# What is missing


def test_without_metadrive_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr("sb3_chac.envs.metadrive.simulator.importlib.util.find_spec", lambda name: None)
    with pytest.raises(gym.error.DependencyNotInstalled, match="pip install metadrive-simulator=="):
        gym.make("MetaDriveSafety-v0")


@needs_metadrive
def test_without_assets_nothing_is_downloaded_and_the_remedies_are_named(monkeypatch, tmp_path):
    code = """
import sys, socket
socket.socket.connect = lambda *arguments: sys.exit("connects")
from metadrive.engine.asset_loader import AssetLoader
import pathlib
AssetLoader.asset_path = pathlib.PurePosixPath(sys.argv[1], "assets")
from sb3_chac.envs.metadrive import MetaDriveSafetyEnv
try:
    MetaDriveSafetyEnv(headless=False)
except Exception as error:
    print(type(error).__name__, error)
env = MetaDriveSafetyEnv(headless=True)
env.reset()
print("drives", env.step([0.0, 1.0])[1] > 0)
"""
    output = run(sys.executable, "-c", code, tmp_path, cwd=tmp_path)
    assert "MissingAssets" in output and "metadrive.pull_asset" in output and "SB3_CHAC_METADRIVE_HEADLESS=1" in output
    assert "drives True" in output and not list(tmp_path.iterdir())


@needs_metadrive
def test_the_installation_is_left_as_it_was():
    package = Path(importlib.util.find_spec("metadrive").origin).parent
    before = {path for path in package.rglob("*") if "__pycache__" not in path.parts}
    code = "from sb3_chac.envs.metadrive import MetaDriveSafetyEnv as E; e = E(headless=True); e.reset(); e.close()"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert {path for path in package.rglob("*") if "__pycache__" not in path.parts} == before


@pytest.mark.parametrize("action", [[np.nan, 0], [0, np.inf], [0], "left"])
def test_actions_that_are_none_do_not_move_the_car(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^action must be two finite numbers.*did not make a step"):
        env.step(action)
    assert env.steps == 0
