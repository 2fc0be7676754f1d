import hashlib
import itertools
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from highway_env.envs.common.observation import LidarObservation
from highway_env.utils import are_polygons_intersecting, rect_corners
from hypothesis import given, settings
from hypothesis import strategies as st
from shell import run
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_chac.envs.driving.geometry import boxes_overlap
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.envs.safedrive.geometry import Pose, Segment, chain, sample, turn
from sb3_chac.envs.safedrive.lidar import Lidar
from sb3_chac.envs.safedrive.map import BLOCKS, Map
from sb3_chac.envs.safedrive.traffic import CAR_LENGTH, CAR_WIDTH
from sb3_chac.human import InterventionWrapper

INFO_KEYS = {
    "cost", "collision", "contact", "out_of_road", "arrive_dest", "is_success", "route_completion", "speed", "episode_cost",
    "scenario",
}  # fmt: skip


@pytest.fixture(scope="module")
def env():
    return SafeDriveEnv()


def drive(env, scenario, name="scripted-ideal"):
    """One episode of the scripted driver: observations, rewards, last info."""
    observation, info = env.reset(options={"scenario": scenario})
    driver = env.scripted_driver(name)
    driver.reset(scenario)
    observations, rewards, done = [observation], [], False
    while not done:
        observation, reward, terminated, truncated, info = env.step(driver(observation))
        observations.append(observation)
        rewards.append(reward)
        done = terminated or truncated
    return np.array(observations), np.array(rewards), info


# The environment as gymnasium and SB3 see it


def test_checkers_of_gymnasium_and_sb3():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(gym.make("SafeDrive-v0").unwrapped, skip_render_check=True)
        sb3_check_env(gym.make("SafeDrive-v0"))


def test_known_without_import_and_by_import_alone(tmp_path):
    make = "import gymnasium; print(gymnasium.make('SafeDrive-v0').observation_space.shape)"
    assert "(355,)" in run(sys.executable, "-c", make, cwd=tmp_path)
    off = {"SB3_CHAC_NO_AUTOLOAD": "1"}
    assert "(355,)" in run(sys.executable, "-c", f"import sb3_chac.envs; {make}", cwd=tmp_path, env=off)
    assert "NameNotFound" in run(sys.executable, "-c", make, cwd=tmp_path, env=off, fails=True)


ROLLOUT = """
import hashlib, gymnasium, numpy as np
env = gymnasium.make("SafeDrive-v0")
digest = hashlib.sha256()
rng = np.random.default_rng(0)
for episode in range(3):
    observation, info = env.reset(seed=7 if episode == 0 else None)
    for _ in range(150):
        digest.update(observation.tobytes() + repr(sorted(info.items())).encode())
        observation, reward, terminated, truncated, info = env.step(np.clip(rng.normal([0, 0.4], 0.3), -1, 1))
        digest.update(repr(reward).encode())
        if terminated or truncated:
            break
print(digest.hexdigest())
"""


def test_two_processes_with_one_seed_agree(tmp_path):
    first, second = (run(sys.executable, "-c", ROLLOUT, cwd=tmp_path).strip() for _ in range(2))
    assert len(first) == 64 and first == second


def test_an_episode_does_not_depend_on_earlier_ones():
    fresh, used = SafeDriveEnv(), SafeDriveEnv()
    drive(used, 103, "scripted")
    drive(used, 104)
    for expected, actual in zip(drive(fresh, 103), drive(used, 103), strict=True):
        np.testing.assert_equal(actual, expected)


def test_info_and_scenarios(env):
    scenarios = {env.reset(seed=seed)[1]["scenario"] for seed in range(200)}
    assert scenarios == set(range(100, 120))
    for scenario in (-5, 0, 10**12):
        _, info = env.reset(options={"scenario": scenario})
        assert info["scenario"] == scenario and set(info) == INFO_KEYS
    other = SafeDriveEnv(start_scenario=-3, num_scenarios=2)
    assert {other.reset(seed=seed)[1]["scenario"] for seed in range(20)} == {-3, -2}
    assert env.reset(options={"scenario": 5})[0].tobytes() != env.reset(options={"scenario": -5})[0].tobytes()


@pytest.mark.parametrize(
    ("name", "value", "limits"),
    [
        ("start_scenario", 1.5, "integer"),
        ("num_scenarios", 0, "at least 1"),
        ("traffic_density", -0.1, "at least 0 and at most 3"),
        ("traffic_density", float("nan"), "finite number"),
        ("obstacle_density", 1.1, "at least 0 and at most 1"),
        ("blocks", 0, "at least 1"),
        ("blocks", 13, "at most 12"),
        ("blocks", "SQ", "SCROTX"),
        ("blocks", "", "SCROTX"),
        ("horizon", 0, "at least 1"),
        ("collision_penalty", -1.0, "at least 0"),
        ("arrival_reward", float("inf"), "finite number"),
        ("render_mode", "ansi", "rgb_array"),
    ],
)
def test_bad_keyword(name, value, limits):
    with pytest.raises(ValueError, match=limits) as error:
        SafeDriveEnv(**{name: value})
    assert name in str(error.value)


def test_bad_scenario_and_driver(env):
    with pytest.raises(ValueError, match="scenario"):
        env.reset(options={"scenario": "first"})
    with pytest.raises(ValueError, match="scripted-ideal"):
        env.scripted_driver("human")
    for arguments in ({"reaction_delay": -1}, {"action_noise": 2.0}, {"desired_speed": 0.0}):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            type(env.scripted_driver())(env, **arguments)


# Reward, cost and endings


def test_reward_adds_up(env):
    _, rewards, info = drive(env, 2000)
    assert info["is_success"] and info["arrive_dest"] and info["route_completion"] == 1.0 and info["cost"] == 0
    env.reset(options={"scenario": 2000})
    start = env.s
    driver = env.scripted_driver("scripted-ideal")
    speeds, done = 0.0, False
    while not done:
        _, _, terminated, truncated, info = env.step(driver())
        speeds, done = speeds + info["speed"], terminated or truncated
    expected = env.s - start + 0.1 * speeds / 15.0 + 10.0 - 5.0 * info["episode_cost"]
    assert rewards.sum() == pytest.approx(expected, abs=1e-6)


def test_coefficients_weigh_the_reward():
    plain = SafeDriveEnv(displacement_reward=0, speed_reward=0, arrival_reward=0, out_of_road_penalty=0, collision_penalty=0)
    assert drive(plain, 2000)[1].sum() == 0
    assert drive(SafeDriveEnv(displacement_reward=0, speed_reward=0, collision_penalty=0), 2000)[1].sum() == 10


def test_leaving_the_road_ends_the_episode():
    env = SafeDriveEnv(traffic_density=0, obstacle_density=0)
    env.reset(options={"scenario": 100})
    for _ in range(200):
        _, reward, terminated, _, info = env.step(np.array([0.15, 0.3]))
        if terminated:
            break
    assert info["out_of_road"] and not info["is_success"] and abs(env.lateral) > 4 and reward < -3


def test_horizon_truncates_and_standing_still_earns_nothing():
    env = SafeDriveEnv(horizon=50)
    env.reset(options={"scenario": 100})
    results = [env.step(np.array([0.3, -1.0])) for _ in range(50)]
    assert [r[3] for r in results] == [False] * 49 + [True] and not any(r[2] for r in results)
    assert sum(r[1] for r in results) == pytest.approx(0.0, abs=1e-9) and results[-1][4]["speed"] == 0


@pytest.mark.parametrize("kind", ["cone", "triangle", "parked"])
def test_hitting_an_obstacle_costs_once(kind):
    env = SafeDriveEnv(traffic_density=0, obstacle_density=1, blocks="SS")
    scenario = next(k for k in range(100) if any(o.kind == kind for o in Map(k, "SS", 1.0).obstacles))
    env.reset(options={"scenario": scenario})
    index, obstacle = next((i, o) for i, o in enumerate(env.map.obstacles) if o.kind == kind)
    env.traffic.obstacle_there[:] = False
    env.traffic.obstacle_there[index] = True
    positions, headings = env.traffic.poses(np.array([0]), np.array([obstacle.s - 12.0]), np.array([obstacle.lateral]))
    env.ego.position, env.ego.heading, env.ego.speed = positions[0], float(headings[0]), 8.0
    env.s, env.lateral = obstacle.s - 12.0, obstacle.lateral
    infos, rewards = [], []
    for _ in range(80):
        _, reward, _, _, info = env.step(np.array([0.0, 0.3]))
        infos.append(info)
        rewards.append(reward)
    assert [info["cost"] for info in infos].count(1.0) == 1 and infos[-1]["episode_cost"] == 1
    assert min(rewards) == pytest.approx(-5, abs=1.5)
    assert not env.traffic.obstacle_there[index]  # fallen over, or towed away after five seconds
    if kind == "parked":
        assert infos[30]["speed"] == 0 and infos[30]["contact"] and infos[-1]["speed"] > 0
    else:
        assert min(info["speed"] for info in infos) > 5


def test_hitting_a_car_stops_both(env):
    env.reset(options={"scenario": 100})
    for _ in range(400):
        if len(env.traffic.visible):
            break
        env.step(np.array([0.0, 0.2]))
    car = int(env.traffic.visible[0])
    ahead = np.array([np.cos(env.traffic.headings[0]), np.sin(env.traffic.headings[0])])
    env.ego.position = env.traffic.positions[0] - 6.0 * ahead
    env.ego.heading, env.ego.speed = float(env.traffic.headings[0]), 15.0
    env.ego.steering = 0.0
    env._collide(Pose(*env.ego.position, env.ego.heading))
    assert env.collisions == 0
    env.ego.position = env.traffic.positions[0] - 4.0 * ahead
    env._collide(Pose(*(env.ego.position - ahead), env.ego.heading))
    assert env.collisions == 1 and env.ego.speed == 0 and env.traffic.speed[car] == 0
    env._collide(Pose(*env.ego.position, env.ego.heading))
    assert env.collisions == 0  # the same contact


# Geometry


def test_segments_and_samples_agree():
    segments = [Segment(13.3), turn(20.0, 1.1), turn(15.0, -2.0), Segment(4.0)]
    start = Pose(3.0, -2.0, 0.7)
    table = sample(start, segments)
    end = chain(start, segments)[-1]
    assert np.abs(np.linalg.norm(np.diff(table[:, :2], axis=0), axis=1) - 0.5).max() < 1e-3
    assert np.hypot(table[-1, 0] - end.x, table[-1, 1] - end.y) < 0.5
    assert end.heading == pytest.approx(0.7 + 1.1 - 2.0)
    back = chain(Pose(end.x, end.y, end.heading + np.pi), [segment.reverse() for segment in reversed(segments)])[-1]
    assert back[:2] == pytest.approx(start[:2])
    parallel = chain(start.shifted(0, 2.0), [segment.offset(2.0) for segment in segments])[-1]
    assert parallel[:2] == pytest.approx(end.shifted(0, 2.0)[:2])


def box(rng, reach):
    return rng.uniform(-reach, reach, 2), rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 6), rng.uniform(0.5, 3)


def test_boxes_overlap_as_highway_env_says():
    rng = np.random.default_rng(0)
    outcomes = []
    for _ in range(400):
        (p, h, length, width), (q, g, other_length, other_width) = box(rng, 4), box(rng, 4)
        ours = bool(boxes_overlap(p, h, length, width, q, g, other_length, other_width))
        polygons = [
            rect_corners(*b[:1], *b[2:], b[1], include_midpoints=False)
            for b in ((p, h, length, width), (q, g, other_length, other_width))
        ]
        polygons = [np.array([*polygon, polygon[0]]) for polygon in polygons]
        theirs = are_polygons_intersecting(*polygons, np.zeros(2), np.zeros(2))[0]
        assert ours == theirs
        outcomes.append(ours)
    assert 0.1 < np.mean(outcomes) < 0.9


class Thing:
    solid = True
    velocity = np.zeros(2)

    def __init__(self, position, heading, length, width):
        self.position, self.heading, self.LENGTH, self.WIDTH = position, heading, length, width


def test_lidar_sees_what_highway_envs_lidar_sees():
    rng = np.random.default_rng(1)
    lidar = Lidar(240, 50.0)
    theirs = LidarObservation.__new__(LidarObservation)
    theirs.cells, theirs.maximum_range, theirs.angle = 240, 50.0, 2 * np.pi / 240
    differences = []
    for _ in range(40):
        things = [Thing(*box(rng, 45)) for _ in range(8)]
        things = [t for t in things if np.hypot(*t.position) > 8]
        road = type("Road", (), {"vehicles": things, "objects": []})
        theirs.env = type("Env", (), {"road": road, "vehicle": None})
        theirs._ObservationType__observer_vehicle = None
        expected = theirs.trace(np.zeros(2), np.zeros(2))[:, 0]
        boxes = (np.array([getattr(t, key) for t in things]) for key in ("position", "heading", "LENGTH", "WIDTH"))
        distances, seen = lidar.scan(np.zeros(2), 0.0, *boxes)
        differences.append(np.abs(distances - expected))
        assert len(seen) == len({int(i) for i in seen}) <= len(things)
    differences = np.concatenate(differences)
    assert (differences < 0.02).mean() > 0.99 and np.median(differences) < 1e-3


def test_lidar_turns_with_the_vehicle_and_hides_what_is_behind():
    lidar = Lidar(240, 50.0)
    boxes = np.array([[10.0, 0.0], [20.0, 0.0], [0.0, 10.0]]), np.zeros(3), np.full(3, 2.0), np.full(3, 2.0)
    distances, seen = lidar.scan(np.zeros(2), 0.0, *boxes)
    assert distances[0] == pytest.approx(9.0) and distances[60] == pytest.approx(9.0) and distances[120] == 50.0
    assert sorted(seen) == [0, 2]
    turned, _ = lidar.scan(np.zeros(2), np.pi / 2, *boxes)
    np.testing.assert_allclose(turned, np.roll(distances, -60), atol=1e-9)
    empty = np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0)
    assert (lidar.scan(np.zeros(2), 0.0, *empty)[0] == 50.0).all()


# Maps and traffic


@pytest.mark.parametrize("blocks", [*BLOCKS, *("".join(pair) for pair in itertools.product(BLOCKS, BLOCKS))])
def test_every_block_and_every_pair_of_blocks(blocks):
    env = SafeDriveEnv(blocks=blocks, traffic_density=0, obstacle_density=0)
    for scenario in (0, 1):
        _, _, info = drive(env, scenario)
        assert info["is_success"] and info["episode_cost"] == 0
        for path in env.map.paths:
            table = sample(path.start, path.segments)
            assert np.abs(np.linalg.norm(np.diff(table[:, :2], axis=0), axis=1) - 0.5).max() < 0.01
            turns = (np.diff(table[:, 2]) + np.pi) % (2 * np.pi) - np.pi
            assert np.abs(turns).max() < 0.07  # no kinks


def test_too_crowded_a_layout_is_refused(monkeypatch):
    monkeypatch.setattr(Map, "_is_clear", lambda self, points, joint: False)
    with pytest.raises(ValueError, match=r"blocks='CC': found no layout for scenario 3 .* Use fewer"):
        SafeDriveEnv(blocks="CC").reset(options={"scenario": 3})


def test_paths_share_the_route_where_they_say():
    shared = set()
    for scenario in range(20):
        road_map = Map(scenario, 4, 1.0)
        for path in road_map.paths:
            table = sample(path.start, path.segments)
            s = np.arange(len(table)) * 0.5
            on_route = (s >= path.shared[0]) & (s <= path.shared[1])
            shared |= {path.kind} if on_route.any() else set()
            if on_route.any():
                index = np.round((s[on_route] + path.ahead_of_route) / 0.5).astype(int).clip(0, len(road_map.route) - 1)
                distance = np.linalg.norm(table[on_route, :2] - road_map.route[index, :2], axis=1)
                assert distance.max() < 0.51  # the spacing of the samples
        opposing = chain(road_map.paths[1].start, road_map.paths[1].segments)[-1]
        assert np.hypot(*opposing.shifted(0, -10.0)[:2]) == pytest.approx(0.0, abs=1e-6)
    assert shared == {"route", "side", "leaves", "merges"}


def test_traffic_does_not_drive_through_obstacles():
    env = SafeDriveEnv(traffic_density=1.5, obstacle_density=0.6)
    touched = steps = 0
    for scenario in range(3000, 3008):
        env.reset(options={"scenario": scenario})
        driver = env.scripted_driver("scripted-ideal")
        for _ in range(300):
            _, _, terminated, _, _ = env.step(driver())
            n = len(env.traffic.visible)
            boxes = (values[n:] for values in (env.box_positions, env.box_headings, env.box_lengths, env.box_widths))
            boxes = list(boxes)
            for position, heading in zip(env.traffic.positions, env.traffic.headings, strict=True):
                touched += boxes_overlap(position, heading, CAR_LENGTH, CAR_WIDTH, *boxes).any()
                steps += 1
            if terminated:
                break
    assert steps > 1000 and touched < 0.005 * steps


def test_obstacles_leave_a_lane_free():
    for scenario in range(100):
        obstacles = Map(scenario, 4, 1.0).obstacles
        for a, b in itertools.combinations(obstacles, 2):
            if abs(a.s - b.s) < 20:
                assert (a.lateral > 0) == (b.lateral > 0)


@pytest.mark.parametrize("density", [0.6, 2.0])
def test_traffic_does_not_overlap_and_keeps_moving(density):
    env = SafeDriveEnv(traffic_density=density)
    seen = set()
    for scenario in range(3000, 3010):
        env.reset(options={"scenario": scenario})
        driver = env.scripted_driver("scripted-ideal")
        for _ in range(300):
            _, _, terminated, _, _ = env.step(driver())
            t = env.traffic
            seen |= {(scenario, int(car)) for car in t.visible}
            for i in range(len(t.visible) - 1):
                later = slice(i + 1, None)
                size = CAR_LENGTH, CAR_WIDTH
                assert not boxes_overlap(
                    t.positions[i], t.headings[i], *size, t.positions[later], t.headings[later], *size
                ).any()
            if terminated:
                break
    assert len(seen) > 20 * density


# What the agent sees, over many seeds and actions


@settings(max_examples=25)
@given(
    scenario=st.integers(-(10**9), 10**9),
    blocks=st.one_of(st.integers(1, 5), st.text(BLOCKS, min_size=1, max_size=4)),
    density=st.floats(0, 2),
    seed=st.integers(0, 2**31),
)
def test_any_scenario_any_actions(scenario, blocks, density, seed):
    env = SafeDriveEnv(blocks=blocks, traffic_density=density, obstacle_density=min(density, 1.0), horizon=150)
    observation, info = env.reset(options={"scenario": scenario})
    rng = np.random.default_rng(seed)
    bias, done, total_cost = rng.uniform(-0.2, 0.2), False, 0.0
    while not done:
        assert env.observation_space.contains(observation) and np.isfinite(observation).all()
        observation, reward, terminated, truncated, info = env.step(
            np.clip(rng.normal([bias, 0.5], 0.4), -1, 1).astype(np.float32)
        )
        total_cost += info["cost"]
        assert np.isfinite(reward) and info["episode_cost"] == total_cost
        assert (info["cost"] > 0) == info["collision"] and (not info["collision"] or info["contact"])
        assert 0 <= info["route_completion"] <= 1 and 0 <= info["speed"] <= 15
        done = terminated or truncated
    assert terminated == (info["out_of_road"] or info["arrive_dest"]) and info["arrive_dest"] == info["is_success"]


def test_observations_are_scaled_for_learning(env):
    observations = np.concatenate([drive(env, scenario, "scripted")[0] for scenario in range(2000, 2008)])
    spread = observations[:, :19].std(axis=0)
    assert spread.max() < 5 * spread.min()
    lidar = observations[:, 19:]
    assert np.median(lidar) == 0 and lidar.max() > 0.8 and 0.05 < lidar.std() < 1


def test_observation_layout():
    env = SafeDriveEnv(traffic_density=0, obstacle_density=0, blocks="S")
    observation, _ = env.reset(options={"scenario": 1})
    assert observation[0] == -observation[1] == env.lateral / 4
    assert observation[2] == 0 and observation[3] == -1 and (observation[19:] == 0).all()
    for _ in range(5):
        observation, *_ = env.step(np.array([0.5, 1.0]))
    assert observation[2] > 0 and observation[3] > -1 and observation[4] > 0 and observation[7] > 0
    assert (observation[5:7] == [0.5, 1.0]).all()
    assert observation[0] > env.scene.lane / 4 and (observation[10:19:2] < 0).all()  # to the right, the route turns left of it


# The scripted driver


def test_driver_is_good_and_imperfections_show(env):
    results = {name: [drive(env, scenario, name) for scenario in range(2010, 2020)] for name in ("scripted-ideal", "scripted")}
    for episodes in results.values():
        assert np.mean([info["is_success"] for *_, info in episodes]) >= 0.9
        assert np.mean([info["episode_cost"] for *_, info in episodes]) <= 0.5
        assert 300 < np.mean([rewards.sum() for _, rewards, _ in episodes]) < 450
    digests = {hashlib.sha256(episodes[0][0].tobytes()).hexdigest() for episodes in results.values()}
    assert len(digests) == 2


def test_driver_noise_is_seeded(env):
    def actions(seed):
        env.reset(options={"scenario": 2000})
        driver = env.scripted_driver("scripted")
        driver.reset(seed)
        return np.array([driver() for _ in range(5)])

    np.testing.assert_equal(actions(3), actions(3))
    assert (actions(3) != actions(4)).any()


def test_time_to_trouble():
    env = SafeDriveEnv(traffic_density=0, obstacle_density=0, blocks="S")
    env.reset(options={"scenario": 0})
    driver = env.scripted_driver("scripted-ideal")
    for _ in range(30):
        env.step(driver())
    straight, hard_right = np.array([0.0, 0.0]), np.array([1.0, 0.0])
    assert driver.time_to_trouble(None, straight) == np.inf
    assert driver.time_to_trouble(None, hard_right) < 1.2
    car = SafeDriveEnv(traffic_density=0, obstacle_density=1, blocks="SS")
    parked = {k: o for k in range(100) for o in Map(k, "SS", 1.0).obstacles if o.kind == "parked" and o.s > 62}
    scenario, obstacle = next(iter(parked.items()))
    car.reset(options={"scenario": scenario})
    driver = car.scripted_driver("scripted-ideal")
    times = []
    for distance in (60.0, 22.0, 16.0):
        positions, headings = car.traffic.poses(np.array([0]), np.array([obstacle.s - distance]), np.array([obstacle.lateral]))
        car.ego.position, car.ego.heading, car.ego.speed = positions[0], float(headings[0]), 10.0
        car.s, car.lateral = obstacle.s - distance, obstacle.lateral
        car.traffic.obstacle_there[:] = [o == obstacle for o in car.map.obstacles]
        car._find_boxes()
        car._observe()
        times.append(driver.time_to_trouble(None, straight))
    assert times[0] == np.inf and 1.2 > times[1] > times[2] >= 0
    for _ in range(32):
        env.ego.speed = 0.0
        driver = driver if driver.env is env else env.scripted_driver("scripted-ideal")
        driver()
    assert driver.time_to_trouble(None, straight) == 0  # it stands although it could go


# The driver as the human's stand-in


def test_default_human_keeps_a_random_novice_on_the_road():
    env = InterventionWrapper(gym.make("SafeDrive-v0"))
    rng = np.random.default_rng(0)

    def departures(scenarios):
        total = 0
        for scenario in scenarios:
            env.reset(seed=scenario, options={"scenario": scenario})
            done = False
            while not done:
                *_, terminated, truncated, info = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
                done = terminated or truncated
            total += info["out_of_road"]
        return total

    assert departures(range(2000, 2006)) == 6 and env.human_steps == 0
    env.arm()
    assert departures(range(2000, 2006)) <= 1 and 0.2 < env.takeover_rate < 0.8


def test_default_human_leaves_a_good_driver_alone():
    env = InterventionWrapper(gym.make("SafeDrive-v0"), armed=True)
    for scenario in range(2000, 2006):
        observation, info = env.reset(seed=scenario, options={"scenario": scenario})
        novice = env.unwrapped.scripted_driver("scripted-ideal")
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(novice(observation))
            done = terminated or truncated
        assert info["is_success"]
    assert env.takeover_rate < 0.1


def test_display_of_the_takeover():
    env = InterventionWrapper(gym.make("SafeDrive-v0", render_mode="rgb_array"), rule="always", armed=True)
    env.set_stage(1)
    env.reset(seed=0, options={"scenario": 100})
    before = env.render()
    env.step(np.zeros(2, np.float32))
    after = env.render()
    assert env.unwrapped.hud == {"takeover": True, "steps": 1, "takeover rate": 1.0, "stage": 1}
    assert (before[:60, 300:500] != after[:60, 300:500]).any()  # the banner
