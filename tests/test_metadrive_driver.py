import numpy as np
import pytest

pytest.importorskip("metadrive")

from metadrive.component.static_object.traffic_object import TrafficObject

from sb3_chac.envs.metadrive import MetaDriveSafetyEnv
from sb3_chac.envs.metadrive.driver import ScriptedDriver


@pytest.fixture(scope="module", params=["chac", pytest.param("pvp", marks=pytest.mark.slow)])
def env(request):
    env = MetaDriveSafetyEnv(preset=request.param, headless=True)
    yield env
    env.close()


def drive(env, driver, scenario, steps=10_000):
    """:return: actions of the driver and the last info, of an episode or of the first ``steps`` of it"""
    _, info = env.reset(options={"scenario": scenario})
    driver.reset(scenario)
    actions, done = [], False
    while not done and len(actions) < steps:
        actions.append(driver())
        _, _, terminated, truncated, info = env.step(actions[-1])
        done = terminated or truncated
    return np.array(actions), info


def test_arrives_without_collision(env):
    driver = env.scripted_driver("scripted-ideal")
    for scenario in (3000, 3001):
        actions, info = drive(env, driver, scenario)
        assert info["is_success"] and info["episode_cost"] == 0
        assert actions.dtype == np.float32 and actions.shape[1:] == (2,) and np.abs(actions).max() <= 1


def test_same_seed_same_actions(env):
    driver = env.scripted_driver("scripted")
    first, _ = drive(env, driver, 3002, steps=60)
    drive(env, driver, 3001, steps=5)
    again, _ = drive(env, driver, 3002, steps=60)
    np.testing.assert_allclose(again, first, atol=1e-4)  # the simulator repeats itself to about 1e-6
    driver.reset(1)
    one = driver()
    driver.reset(2)
    assert not np.allclose(one, driver())


def test_delay_and_noise_are_what_makes_it_imperfect(env):
    env.reset(options={"scenario": 3000})
    ideal, noisy = ScriptedDriver(env, 0, 0.0), ScriptedDriver(env, 0, 0.1)
    noisy.reset(0)
    wanted = ideal()
    errors = np.array([noisy() - wanted for _ in range(2000)])
    np.testing.assert_allclose(errors.std(axis=0), 0.1, rtol=0.2)
    delayed = ScriptedDriver(env, 3, 0.0)
    for _ in range(8):
        delayed()
    assert len(delayed.seen) == 4


def test_no_trouble_on_a_free_road(env):
    driver = env.scripted_driver("scripted-ideal")
    drive(env, driver, 3000, steps=30)
    assert driver.time_to_trouble(None, driver()) == np.inf


def test_steering_off_the_road_is_trouble(env):
    driver = env.scripted_driver("scripted-ideal")
    drive(env, driver, 3000, steps=30)
    for steering in (-1.0, 1.0):
        assert driver.time_to_trouble(None, np.array([steering, 0.0])) < 1.2


def test_driving_into_something_is_trouble(env):
    driver = env.scripted_driver("scripted-ideal")
    drive(env, driver, 3002, steps=30)
    straight = np.array([driver._steering(driver.lateral, 0.0), 0.5])
    assert driver.time_to_trouble(None, straight) == np.inf
    things = env.simulator.engine.get_objects(lambda thing: isinstance(thing, TrafficObject))
    thing = next(iter(things.values()))
    times = []
    for distance in (14.0, 10.0, 6.0):
        thing.set_position(env.position + distance * env.ego.heading)
        times.append(driver.time_to_trouble(None, straight))
    assert 2.0 > times[0] > times[1] > times[2]
    assert driver()[1] < 0  # it would brake itself


def test_standing_although_the_road_is_free_is_trouble(env):
    driver = env.scripted_driver("scripted-ideal")
    env.reset(options={"scenario": 3000})
    driver.reset(0)
    for _ in range(35):
        driver()
        env.step(np.zeros(2))
    assert driver.time_to_trouble(None, np.array([0.0, 1.0])) == 0.0


def test_goes_on_beside_something_that_it_touches(env):
    """It used to wait there for eight seconds."""
    driver = env.scripted_driver("scripted-ideal")
    drive(env, driver, 3002, steps=2)  # it has hardly begun to move
    things = env.simulator.engine.get_objects(lambda thing: isinstance(thing, TrafficObject))
    thing = next(iter(things.values()))
    ahead = np.asarray(env.ego.heading)
    left = np.array([-ahead[1], ahead[0]])
    for distance, beside, expected in [(0.0, 1.5, True), (-1.0, -1.5, True), (0.0, 4.0, False), (3.0, 0.0, False)]:
        thing.set_position(env.position + distance * ahead + beside * left)
        driver._locate()
        others = driver._look(np.array([0.1, 0.2]))
        nearest = np.argmin(np.linalg.norm(others.positions[:, 0] - np.asarray(thing.position), axis=1))
        assert driver._beside(others)[nearest] == expected
    thing.set_position(env.position + 1.3 * left)
    for _ in range(20):
        env.step(driver())
    assert env.forward_speed > 2.0


def test_drives_from_wherever_it_is(env):
    driver = env.scripted_driver("scripted")
    rng = np.random.default_rng(0)
    for scenario in range(3000, 3006):
        env.reset(options={"scenario": scenario})
        driver.reset(scenario)
        env.ego.set_position(env.position + rng.normal(0.0, 20.0, 2))
        env.ego.set_heading_theta(rng.uniform(-np.pi, np.pi))
        done = False
        while not done and env.steps < 40:
            action, time = driver(), driver.time_to_trouble(None, rng.uniform(-1, 1, 2))
            assert np.isfinite(action).all() and time >= 0
            _, _, terminated, truncated, _ = env.step(np.clip(action + rng.normal(0.0, 0.7, 2), -1, 1))
            done = terminated or truncated


@pytest.mark.parametrize("name", ["idm", "ppo"])
def test_metadrives_own_drivers(env, name):
    driver = env.scripted_driver(name)
    actions, info = drive(env, driver, 3000, steps=150)
    assert np.isfinite(actions).all() and actions.shape == (150, 2) and info["route_completion"] > 0.15
    assert driver.time_to_trouble(None, np.array([1.0, 0.0])) >= 0


@pytest.mark.parametrize("argument", [{"reaction_delay": -1}, {"action_noise": 2.0}, {"desired_speed": 0.0}])
def test_arguments_out_of_range(env, argument):
    with pytest.raises(ValueError, match=next(iter(argument))):
        ScriptedDriver(env, **argument)
