"""What is compiled gives the numbers of plain numpy, and what happens where its machine code cannot be kept."""

from collections.abc import Iterator

import numpy as np
import pytest

from sb3_chac.envs.driving.compiled import compiled
from sb3_chac.envs.driving.corridors import (
    ARC_HALF_WIDTHS,
    CURVATURES,
    FAR,
    LATERALS,
    STRIP_HALF_WIDTHS,
    STRIPS_BEGIN,
    Corridors,
)
from sb3_chac.envs.driving.geometry import wrap_angle
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.envs.safedrive import traffic as t
from sb3_chac.envs.safedrive.driver import ScriptedDriver
from sb3_chac.envs.safedrive.navigation import CHECKPOINTS, N_EGO, N_STATE, route_ahead


@pytest.fixture(scope="module", params=[(0.6, 0.3), (3.0, 1.0)], ids=["usual", "dense"])
def env(request) -> SafeDriveEnv:
    traffic_density, obstacle_density = request.param
    return SafeDriveEnv(traffic_density=traffic_density, obstacle_density=obstacle_density, blocks="RXO")


def situations(env: SafeDriveEnv) -> Iterator[np.ndarray]:
    """Observations of a wild drive through three maps; the environment stands where they were made."""
    driver = ScriptedDriver(env, reaction_delay=0, action_noise=0.3)
    for scenario in range(2000, 2003):
        observation, _ = env.reset(options={"scenario": scenario})
        driver.reset(scenario)
        done = False
        while not done and env.steps < 150:
            observation, _, terminated, truncated, _ = env.step(driver(observation))
            done = terminated or truncated
            if env.steps % 7 == 0:
                yield observation


def plain_scan(env: SafeDriveEnv) -> tuple[np.ndarray, np.ndarray]:
    d = env.ego.position - env.box_positions
    headings, half_length, half_width = env.box_headings, env.box_lengths[:, None] / 2, env.box_widths[:, None] / 2
    cos, sin = np.cos(headings), np.sin(headings)
    x, y = (d[:, 0] * cos + d[:, 1] * sin)[:, None], (d[:, 1] * cos - d[:, 0] * sin)[:, None]
    angles = env.ego.heading - headings[:, None] + np.arange(env.lidar.rays) * 2 * np.pi / env.lidar.rays
    per_x, per_y = 1 / np.cos(angles), 1 / np.sin(angles)
    enters = np.maximum(-x * per_x - half_length * np.abs(per_x), -y * per_y - half_width * np.abs(per_y))
    leaves = np.minimum(-x * per_x + half_length * np.abs(per_x), -y * per_y + half_width * np.abs(per_y))
    distances = np.where((leaves >= enters) & (leaves > 0), np.maximum(enters, 0.0), np.inf)
    nearest = distances.min(axis=0, initial=env.lidar.reach)
    return nearest, np.flatnonzero((distances <= nearest).any(axis=1))


def plain_route(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    tanhs = np.clip(observation[[2, 10, 12, 14, 16, 18]], -0.999999, 0.999999)
    there = np.arctanh(tanhs) * np.array([-0.15, 0.6, 0.6, 0.6, 0.6, 0.6], np.float32)
    headings = np.interp(np.arange(51.0), [0.0, *CHECKPOINTS], there)
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    beside = observation[0] * np.float32(4.0) * np.array([directions[0, 1], -directions[0, 0]])
    return np.concatenate([[beside], beside + np.cumsum((directions[1:] + directions[:-1]) / 2, axis=0)]), headings


def plain_navigation(env: SafeDriveEnv) -> np.ndarray:
    route, ego = env.map.route, env.ego
    points = route[np.minimum(((env.s + CHECKPOINTS) / 0.5).astype(int), len(route) - 1)]
    bearings = np.arctan2(points[:, 1] - ego.position[1], points[:, 0] - ego.position[0]) - ego.heading
    headings = points[:, 2] - ego.heading
    return np.stack([np.tanh(wrap_angle(bearings) / 0.4), np.tanh(wrap_angle(headings) / 0.6)], axis=1).ravel()


def plain_corridors(closeness: np.ndarray, route: np.ndarray, headings: np.ndarray) -> np.ndarray:
    angles = np.arange(len(closeness)) * 2 * np.pi / len(closeness)
    hit = (np.cos(angles) > 1e-9) & (closeness > 1e-4)
    distances = (1.0 - closeness[hit]) * 50.0
    x, y = distances * np.cos(angles[hit]), distances * np.sin(angles[hit])

    bend, inwards = np.abs(CURVATURES)[:, None], np.where(CURVATURES < 0, -1.0, 1.0)[:, None] * y
    offset = bend * (x * x + y * y) / 2 - inwards
    along = np.where(bend > 0, np.arctan2(bend * x, 1 - bend * inwards) / np.maximum(bend, 1e-9), x)
    half_widths = ARC_HALF_WIDTHS[:, None, None]
    inside = np.abs(offset - bend * half_widths**2 / 2) < half_widths
    arcs = np.where(inside, along, FAR).min(axis=2, initial=FAR)

    nearest = np.hypot(x[:, None] - route[:, 0], y[:, None] - route[:, 1]).argmin(axis=1)
    dx, dy = x - route[nearest, 0], y - route[nearest, 1]
    cos, sin = np.cos(headings[nearest]), np.sin(headings[nearest])
    along, across = nearest + dx * cos + dy * sin, dy * cos - dx * sin
    inside = (np.abs(across - LATERALS[:, None]) < STRIP_HALF_WIDTHS[:, None, None]) & (along > STRIPS_BEGIN)
    strips = np.where(inside, along, FAR).min(axis=2, initial=FAR)
    return 1 - np.concatenate([arcs.ravel(), strips.ravel()]) / FAR


def test_lidar(env: SafeDriveEnv) -> None:
    for _ in situations(env):
        (distances, seen), (expected, expected_seen) = env.scan(), plain_scan(env)
        np.testing.assert_allclose(distances, expected, atol=1e-6)
        np.testing.assert_array_equal(seen, expected_seen)


def test_the_way_ahead(env: SafeDriveEnv) -> None:
    corridors = Corridors(env.lidar.rays, env.lidar.reach)
    closed = 0
    for observation in situations(env):
        np.testing.assert_allclose(observation[N_EGO:N_STATE], plain_navigation(env), atol=1e-6)
        lidar = observation[N_STATE : N_STATE + env.lidar.rays]
        route, headings = route_ahead(observation)
        expected_route, expected_headings = plain_route(observation)
        np.testing.assert_allclose(route, expected_route, atol=1e-6)
        np.testing.assert_allclose(headings, expected_headings, atol=1e-6)
        expected = plain_corridors(lidar, expected_route, expected_headings)
        np.testing.assert_allclose(corridors(lidar, route, headings), expected, atol=1e-6)
        closed += np.count_nonzero(expected)
    assert closed > 100


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_corridors_of_nothing_and_of_everything(dtype) -> None:
    corridors = Corridors(240, 50.0)
    for value in (0.0, 0.7, 1.0):
        closeness, (route, headings) = np.full(240, value, dtype), plain_route(np.zeros(N_STATE, np.float32))
        np.testing.assert_allclose(
            corridors(closeness, route, headings), plain_corridors(closeness, route, headings), atol=1e-6
        )


def plain_poses(traffic: t.Traffic, path: np.ndarray, s: np.ndarray, lateral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    index = np.minimum(np.maximum((s / 0.5).astype(int), 0), traffic.last[path])
    x, y, heading, curvature = np.moveaxis(traffic.points[traffic.first[path] + index, :4], -1, 0)
    rest = s - index * 0.5
    x, y = x + rest * np.cos(heading) - lateral * np.sin(heading), y + rest * np.sin(heading) + lateral * np.cos(heading)
    return np.stack([x, y], axis=-1), heading + curvature * np.minimum(rest, 0.5)


def everybody(env: SafeDriveEnv) -> tuple[np.ndarray, ...]:
    """Path, place, lateral, speed, positions and headings of the cars that can be seen, then of the ego."""
    traffic, cars = env.traffic, env.traffic.visible
    columns = (traffic.path, 0), (traffic.s, env.s), (traffic.lateral, env.lateral), (traffic.speed, env.ego.speed)
    positions = np.concatenate([traffic.positions, env.ego.position[None]])
    return (
        *(np.append(values[cars], of_ego) for values, of_ego in columns), positions,
        np.append(traffic.headings, env.ego.heading),
    )  # fmt: skip


def plain_decision(env: SafeDriveEnv, gaps: np.ndarray) -> np.ndarray:
    """Accelerations of the cars, all pairs at once."""
    traffic, cars = env.traffic, env.traffic.visible
    path, s, lateral, speed, positions, headings = everybody(env)
    n, own = len(cars), np.arange(len(cars))
    cos, sin = np.cos(headings), np.sin(headings)
    mine, _ = plain_poses(traffic, path[:n, None], s[:n, None] + t.CAR_LENGTH / 2 + t.AHEAD, lateral[:n, None])
    d = mine[:, :, None] - positions
    covered = np.abs(d[..., 0] * cos + d[..., 1] * sin) < t.CAR_LENGTH / 2 + 0.8
    covered &= np.abs(d[..., 1] * cos - d[..., 0] * sin) < t.CAR_WIDTH / 2 + 1.2
    covered[own, :, own] = False
    to_others = np.where(covered, t.AHEAD[:, None], np.inf).min(axis=1)
    leader = np.argmin(to_others, axis=1)
    gap = to_others[own, leader] - 1.0
    their_speed = np.maximum(speed[leader] * np.cos(headings[leader] - headings[:n]), 0.0)
    their_speed = np.where(gaps < gap, 0.0, their_speed)
    gap, v = np.maximum(np.minimum(gap, gaps), 0.3), speed[:n]
    wanted = 3.0 + v + v * (v - their_speed) / (2 * np.sqrt(3.0 * 4.0))
    acceleration = 3.0 * (1 - (v / traffic.desired_speed[cars]) ** 4 - (np.maximum(wanted, 0.0) / gap) ** 2)
    future, _ = plain_poses(traffic, path[:, None], s[:, None] + speed[:, None] * t.SOON, lateral[:, None])
    near = ((future[:n, None] - future) ** 2).sum(axis=-1).min(axis=-1) < 4.5**2
    crossing = near & (np.abs(wrap_angle(headings[:n, None] - headings)) > 0.25)
    to = positions - positions[:, None]
    in_front = to[..., 0] * cos[:, None] + to[..., 1] * sin[:, None]
    yields = (crossing & (in_front > in_front.T)[:n]).any(axis=1) & (traffic.standing[cars] < t.PATIENCE)
    return np.clip(np.where(yields, np.minimum(acceleration, -4.0), acceleration), -6.0, 3.0)


def plain_gaps(env: SafeDriveEnv) -> np.ndarray:
    """From each car to an obstacle in its way."""
    traffic = env.traffic
    path, s, lateral, *_ = (values[:-1, None] for values in everybody(env))
    on_route = (s >= traffic.shared_from[path] - 12.0) & (s <= traffic.shared_to[path])
    ahead = traffic.obstacle_s - s - traffic.ahead_of_route[path]
    in_way = on_route & traffic.obstacle_there & (ahead > 0) & (ahead < 35.0)
    in_way &= np.abs(traffic.obstacle_lateral - lateral) < 2.3
    return np.where(in_way, ahead - t.CAR_LENGTH / 2 - traffic.obstacle_half, np.inf).min(axis=1, initial=np.inf)


def test_traffic(env: SafeDriveEnv) -> None:
    braked = found_obstacle = 0
    for _ in situations(env):
        traffic, cars = env.traffic, env.traffic.visible
        path, s, lateral, speed, positions, headings = everybody(env)
        places, directions = plain_poses(traffic, traffic.path[cars], traffic.s[cars], traffic.lateral[cars])
        np.testing.assert_allclose(traffic.positions, places, atol=1e-6)
        np.testing.assert_allclose(traffic.headings, directions, atol=1e-6)
        if len(cars) == 0:
            continue
        shared = traffic.shared_from[path] - 12.0, traffic.shared_to[path], traffic.ahead_of_route[path]
        obstacles = traffic.obstacle_s, traffic.obstacle_lateral, traffic.obstacle_half, traffic.obstacle_there
        _, gaps = t._pull_over(traffic.target[cars], s, lateral, speed, shared, obstacles)
        np.testing.assert_allclose(gaps, plain_gaps(env), atol=1e-6)
        waits = traffic.standing[cars] < t.PATIENCE
        acceleration = t._decide(
            traffic._tables, path, s, lateral, speed, positions, headings, traffic.desired_speed[cars], waits, gaps
        )
        np.testing.assert_allclose(acceleration, plain_decision(env, gaps), atol=1e-6)
        braked, found_obstacle = braked + (acceleration < -1).sum(), found_obstacle + np.isfinite(gaps).sum()
    assert braked and found_obstacle


def test_a_function_whose_code_cannot_be_kept_is_compiled_all_the_same() -> None:
    names: dict = {}
    exec("def halve(x):\n    return x / 2", names)  # numba finds no file beside which it could keep the code
    assert compiled(names["halve"])(3.0) == 1.5
