import importlib.util

import numpy as np
import pytest

from sb3_chac.envs.driving.corridors import N_CORRIDORS, N_VIEW, Corridors
from sb3_chac.envs.metadrive import MetaDriveSafetyEnv
from sb3_chac.envs.metadrive.observation import LIDAR_REACH, N_LIDAR, OFFSET, ROUTE, SCALE, STRIPS, route_ahead

needs_metadrive = pytest.mark.skipif(
    importlib.util.find_spec("metadrive") is None,
    reason="MetaDrive is not installed: pip install metadrive-simulator==0.4.3 (its wheel is for Python up to 3.11)",
)
WIDTH, LANE = 10.5, 3.5  # [m] of the road and of its three lanes


@pytest.fixture(scope="module")
def env():
    env = MetaDriveSafetyEnv(headless=True)
    yield env
    env.close()


def checkpoint(ahead, left, curvature=0.0, angle=0.0):
    """Five of MetaDrive's numbers; the curvature is that of the road's middle, positive to the left."""
    far = max(np.hypot(ahead, left) / 50.0, 1.0)
    radius = 1 / abs(curvature) - np.sign(curvature) * (WIDTH - LANE) / 2 if curvature else 0.0
    return [
        (ahead / far / 50 + 1) / 2,
        (left / far / 50 + 1) / 2,
        radius / (60 + WIDTH),
        (1 - np.sign(curvature)) / 2,
        (np.degrees(angle) / 135 + 1) / 2,
    ]


def observed(lateral, heading, first, second, lidar=None):
    """What is seen ``lateral`` [m] to the right of the road's middle with the road's ``heading`` [rad] to the left."""
    edges = [(WIDTH / 2 + lateral) / 18, (WIDTH / 2 - lateral) / 18]
    rest = [0.5, 0.5, 0.5, 0.5, 0.0, 0.5]
    raw = [*edges, (1 + np.sin(heading)) / 2, *rest, *first, *second, *(np.ones(N_LIDAR) if lidar is None else lidar)]
    return (np.array(raw, np.float32) - OFFSET) * SCALE


def bend(start, heading, curvature, angle):
    """End of an arc and the heading there."""
    turned = heading + np.sign(curvature) * angle
    x = start[0] + (np.sin(turned) - np.sin(heading)) / curvature
    y = start[1] - (np.cos(turned) - np.cos(heading)) / curvature
    return (x, y), turned


def axes(driver):
    """The ego's, ahead and to the left, in the world."""
    cos, sin = np.cos(driver.heading), np.sin(driver.heading)
    return np.array([[cos, sin], [-sin, cos]])


@pytest.mark.parametrize("curvature", [1 / 15, 1 / 40, -1 / 15, -1 / 40])
@pytest.mark.parametrize(("lateral", "heading"), [(0.0, 0.0), (2.5, 0.2), (-3.0, -0.3)])
def test_route_follows_straights_and_bends(curvature, lateral, heading):
    """12 m straight on and into a bend; then within the bend and out of it."""
    start = np.array([-np.sin(heading) * lateral, np.cos(heading) * lateral])
    along = np.array([np.cos(heading), np.sin(heading)])
    corner, angle = start + 12 * along, 0.5
    end, _ = bend(corner, heading, curvature, angle)
    points, headings = route_ahead(observed(lateral, heading, checkpoint(*corner), checkpoint(*end, curvature, angle)))
    np.testing.assert_allclose(points[0], start, atol=1e-3)
    np.testing.assert_allclose(points[12], corner, atol=1e-3)
    np.testing.assert_allclose(headings[:13], heading, atol=1e-5)
    middle, there = bend(corner, heading, curvature, 6 * abs(curvature))
    np.testing.assert_allclose(points[18], middle, atol=0.05)
    np.testing.assert_allclose(headings[18], there, atol=1e-4)

    end, out = bend(start, heading, curvature, angle)
    beyond = end + 90 * np.array([np.cos(out), np.sin(out)])  # farther than checkpoints are seen
    points, headings = route_ahead(observed(lateral, heading, checkpoint(*end, curvature, angle), checkpoint(*beyond)))
    bent = angle / abs(curvature)
    straight = ROUTE > bent
    np.testing.assert_allclose(headings[straight], out, atol=1e-4)
    expected = np.array(end) + (ROUTE[straight, None] - bent) * [np.cos(out), np.sin(out)]
    np.testing.assert_allclose(points[straight], expected, atol=0.1)


def test_mirrored_world_gives_mirrored_numbers():
    corridors, rng = Corridors(N_LIDAR, LIDAR_REACH, STRIPS), np.random.default_rng(0)
    for _ in range(20):
        lateral, heading, curvature = rng.uniform(-4, 4), rng.uniform(-0.5, 0.5), rng.uniform(0.02, 0.06)
        end, _ = bend((12.0, 2.0), heading, curvature, 0.6)
        lidar = np.where(rng.random(N_LIDAR) < 0.3, rng.random(N_LIDAR), 1.0)
        numbers = []
        for side in (1, -1):
            first = checkpoint(12.0, side * 2.0)
            second = checkpoint(end[0], side * end[1], side * curvature, 0.6)
            turned = np.roll(lidar[::-1], 1) if side < 0 else lidar  # ray 0 stays straight ahead
            observation = observed(side * lateral, side * heading, first, second, turned)
            numbers.append(corridors(observation[-N_LIDAR:], *route_ahead(observation)))
        mirrored = np.concatenate([group[::-1] for group in np.split(numbers[1], [15, 30, 39])])
        np.testing.assert_allclose(numbers[0], mirrored, atol=1e-3)
        assert (numbers[0] > 0).any()


@needs_metadrive
def test_corridors_are_a_bounded_function_of_the_observation_alone(env):
    rng = np.random.default_rng(0)
    raw = [rng.random(259), rng.integers(0, 2, 259).astype(float), np.zeros(259), np.ones(259), *rng.random((20, 259)) ** 3]
    env.reset(options={"scenario": 2000})
    env._corridors.reset()
    before = [env._observed(values) for values in raw]
    env.reset(options={"scenario": 2003})
    for _ in range(5):
        env.step(np.array([0.3, 1.0]))
    env._corridors.reset()
    for values, expected in zip(raw, before, strict=True):
        np.testing.assert_array_equal(env._observed(values), expected)
        assert env.observation_space.contains(expected) and np.abs(expected[259:]).max() <= 1.0
    low, high = env.observation_space.low[259:], env.observation_space.high[259:]
    assert (low[:N_CORRIDORS] == 0).all() and (low[N_CORRIDORS:] == -1).all() and (high == 1).all()


@needs_metadrive
@pytest.mark.parametrize("scenario", [2000, 2004, 2018])  # junctions, roundabouts, a ramp
def test_route_is_the_navigations(env, scenario):
    observation, _ = env.reset(options={"scenario": scenario})
    driver = env.scripted_driver("scripted-ideal")
    errors, done = [], False
    while not done and len(errors) < 60:
        action = driver(observation)
        if env.steps % 5 == 0:
            world = route_ahead(observation)[0] @ axes(driver) + driver.position
            middle = (env.ego.navigation.get_current_lane_num() - 1) * LANE / 2
            true, _ = driver.route.poses(driver.s + np.arange(0.0, 45.0, 0.25), middle)
            errors.append(np.hypot(*(world[20] - true).T).min())
        observation, _, done, *_ = env.step(action)
    assert np.median(errors) < 0.1 and np.quantile(errors, 0.9) < 1.0


@needs_metadrive
def test_rays_point_where_things_are(env):
    observation, _ = env.reset(options={"scenario": 2000})
    driver = env.scripted_driver("scripted-ideal")
    angles, hits = np.arange(N_LIDAR) * 2 * np.pi / N_LIDAR, 0
    for _ in range(100):
        action = driver(observation)
        seen = np.flatnonzero(observation[19:259] > 0.2)
        distances = (1 - observation[19 + seen, None]) * LIDAR_REACH
        points = distances * np.stack([np.cos(angles), np.sin(angles)], axis=1)[seen] @ axes(driver) + driver.position
        things = np.array([np.array(thing.position)[:2] for thing in env.simulator.engine.get_objects().values()])
        assert all(np.hypot(*(things - point).T).min() < 4.0 for point in points)
        hits += len(points)
        observation, *_ = env.step(action)
    assert hits > 100


@needs_metadrive
def test_without_corridors_the_observation_is_the_same_but_shorter(env):
    observation, _ = env.reset(options={"scenario": 2000})
    assert observation.shape == env.observation_space.shape == (259 + N_VIEW,)
    env.close()
    for arguments, shape in (({"corridors": False}, (259,)), ({"raw_observations": True}, (259,))):
        other = MetaDriveSafetyEnv(headless=True, **arguments)
        shorter, _ = other.reset(options={"scenario": 2000})
        assert shorter.shape == other.observation_space.shape == shape
        if "corridors" in arguments:
            np.testing.assert_allclose(shorter, observation[:259], atol=1e-5)
        other.close()
