"""Corridors: what they measure, and that they depend on the observation alone."""

import gymnasium as gym
import numpy as np
import pytest

import sb3_chac.envs  # noqa: F401
from sb3_chac.envs.driving.corridors import (
    ARC_HALF_WIDTHS,
    CURVATURES,
    FAR,
    FASTEST,
    LATERALS,
    N_ARCS,
    N_CORRIDORS,
    N_VIEW,
    STRIP_HALF_WIDTHS,
    Corridors,
    CorridorView,
)
from sb3_chac.envs.safedrive.navigation import route_ahead

RAYS, REACH = 240, 50.0
STRAIGHT = np.stack([np.arange(51.0), np.zeros(51)], axis=1), np.zeros(51)
ANGLES = np.arange(RAYS) * 2 * np.pi / RAYS


def scan(*points: tuple[float, float]) -> np.ndarray:
    """Closeness along the rays when each of the points [m] (ahead, to the side) is hit by the ray next to it."""
    closeness = np.zeros(RAYS)
    for x, y in points:
        ray = round(np.arctan2(y, x) / (2 * np.pi / RAYS)) % RAYS
        closeness[ray] = max(closeness[ray], 1 - np.hypot(x, y) / REACH)
    return closeness


def arcs_and_strips(closeness: np.ndarray, route=STRAIGHT) -> tuple[np.ndarray, np.ndarray]:
    """Free distances [m], shapes (widths, curvatures) and (widths, laterals)."""
    free = FAR * (1 - Corridors(RAYS, REACH)(closeness, *route))
    return free[:N_ARCS].reshape(len(ARC_HALF_WIDTHS), -1), free[N_ARCS:].reshape(len(STRIP_HALF_WIDTHS), -1)


def reference(closeness: np.ndarray, route: np.ndarray, headings: np.ndarray) -> np.ndarray:
    """The same by the definition: hit by hit, and corridor by corridor."""
    free = np.full(N_CORRIDORS, FAR)
    for ray in range(RAYS):
        distance = (1 - closeness[ray]) * REACH
        x, y = distance * np.cos(ANGLES[ray]), distance * np.sin(ANGLES[ray])
        if closeness[ray] <= 1e-4 or x <= 1e-9:
            continue
        for i, half_width in enumerate(ARC_HALF_WIDTHS):
            for j, curvature in enumerate(CURVATURES):
                if curvature == 0:
                    away, along = abs(y), x
                else:
                    radius, side = 1 / abs(curvature), np.sign(curvature)
                    away = abs(np.hypot(x, radius - side * y) - radius)
                    along = radius * np.arctan2(x, radius - side * y)
                if away < half_width:
                    free[i * len(CURVATURES) + j] = min(free[i * len(CURVATURES) + j], along)
        nearest = int(np.argmin(np.hypot(*(route - [x, y]).T)))
        dx, dy, heading = x - route[nearest, 0], y - route[nearest, 1], headings[nearest]
        along = nearest + dx * np.cos(heading) + dy * np.sin(heading)
        lateral = dy * np.cos(heading) - dx * np.sin(heading)
        for i, half_width in enumerate(STRIP_HALF_WIDTHS):
            for j, middle in enumerate(LATERALS):
                if abs(lateral - middle) < half_width and along > 0.5:
                    k = N_ARCS + i * len(LATERALS) + j
                    free[k] = min(free[k], along)
    return 1 - free / FAR


def observations_of(scenario: int, steps: int) -> list[np.ndarray]:
    env = gym.make("SafeDrive-v0").unwrapped
    driver = env.scripted_driver("scripted")
    observation, _ = env.reset(options={"scenario": scenario})
    driver.reset(0)
    observations = [observation]
    while len(observations) < steps:
        observation, _, terminated, truncated, _ = env.step(driver(observation))
        observations.append(observation)
        if terminated or truncated:
            break
    return observations


def test_nothing_near_is_zero_everywhere() -> None:
    assert not Corridors(RAYS, REACH)(np.zeros(RAYS), *STRAIGHT).any()


def test_a_hit_straight_ahead_closes_the_straight_arc_and_the_middle_strips() -> None:
    arcs, strips = arcs_and_strips(scan((20.0, 0.0)))
    assert arcs[:, CURVATURES == 0] == pytest.approx(20.0)
    assert strips[:, LATERALS == 0] == pytest.approx(20.0)
    assert (arcs[:, np.abs(CURVATURES) > 0.02] == FAR).all()  # they lead past it
    assert (strips[:, np.abs(LATERALS) > 1.3] == FAR).all()


def test_a_hit_beside_the_ego_closes_only_what_leads_there() -> None:
    radius = 1 / 0.06
    arcs, strips = arcs_and_strips(scan((radius * np.sin(0.8), radius * (1 - np.cos(0.8)))))  # on the arc, after 0.8 rad
    assert arcs[0, CURVATURES == 0.06] == pytest.approx(0.8 * radius, abs=0.3)
    assert (arcs[:, CURVATURES <= 0] == FAR).all()
    assert (strips == FAR).all()  # 5 m beside the route


def test_strips_follow_the_route() -> None:
    radius, s = 30.0, np.arange(51.0)
    route = np.stack([radius * np.sin(s / radius), radius * (1 - np.cos(s / radius))], axis=1)
    _, strips = arcs_and_strips(scan(tuple(route[25])), (route, s / radius))
    assert strips[0, LATERALS == 0] == pytest.approx(25.0, abs=0.5)
    assert (strips[0, np.abs(LATERALS) > 1.5] == FAR).all()


@pytest.mark.parametrize("scenario", [2000, 2001])
def test_they_are_what_their_definition_says(scenario: int) -> None:
    for observation in observations_of(scenario, 60)[::10]:
        expected = reference(observation[19:259], *route_ahead(observation))
        np.testing.assert_allclose(observation[259 : 259 + N_CORRIDORS], expected, atol=2e-5)


def test_a_mirrored_world_gives_mirrored_corridors() -> None:
    rng = np.random.default_rng(0)
    corridors = Corridors(RAYS, REACH)
    closeness = np.where(rng.random(RAYS) < 0.3, rng.random(RAYS), 0.0)
    route, headings = STRAIGHT[0] + [0.0, 0.7], STRAIGHT[1] + 0.05
    here = corridors(closeness, route, headings)
    there = corridors(np.roll(closeness[::-1], 1), route * [1, -1], -headings)
    for part, n in ((slice(None, N_ARCS), len(CURVATURES)), (slice(N_ARCS, None), len(LATERALS))):
        np.testing.assert_allclose(there[part].reshape(2, n)[:, ::-1], here[part].reshape(2, n), atol=1e-9)


def test_they_are_bounded_and_finite_whatever_is_observed() -> None:
    rng = np.random.default_rng(1)
    corridors = Corridors(RAYS, REACH)
    for _ in range(200):
        observation = rng.uniform(-1, 1, 259).astype(np.float32)
        observation[19:] = np.where(rng.random(240) < rng.random(), np.abs(observation[19:]), 0.0)
        values = corridors(observation[19:], *route_ahead(observation))
        assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1
    everything = corridors(np.ones(RAYS, np.float32), *route_ahead(np.ones(259, np.float32)))
    assert np.isfinite(everything).all() and everything.min() >= 0 and everything.max() <= 1


def test_the_same_observations_in_another_world_give_the_same_corridors() -> None:
    seen, elsewhere = observations_of(2000, 40), gym.make("SafeDrive-v0", blocks="OX", traffic_density=3.0).unwrapped
    elsewhere.reset(options={"scenario": 7})
    elsewhere._corridors.reset()
    for observation in seen:
        again = elsewhere._corridors(observation[19:259], *route_ahead(observation))
        np.testing.assert_array_equal(again.astype(np.float32), observation[259:])


def test_what_stands_comes_nearer_and_what_drives_along_does_not() -> None:
    view, step = CorridorView(RAYS, REACH), 0.9
    first = view(scan((20.0, 0.0), (10.0, 3.0)), *STRAIGHT)
    assert not first[N_CORRIDORS:].any()  # nothing is known yet
    change = view(scan((20.0 - step, 0.0), (10.0, 3.0)), *STRAIGHT)[N_CORRIDORS:]
    strips = change[N_ARCS:].reshape(len(STRIP_HALF_WIDTHS), -1)
    assert strips[:, LATERALS == 0] == pytest.approx(-step / FASTEST)
    assert not strips[:, LATERALS > 2.0].any()
    view.reset()
    assert not view(scan((5.0, 0.0)), *STRAIGHT)[N_CORRIDORS:].any()


def test_changes_are_bounded() -> None:
    view = CorridorView(RAYS, REACH)
    view(scan((30.0, 0.0)), *STRAIGHT)
    appears = view(scan((5.0, 0.0)), *STRAIGHT)[N_CORRIDORS:]
    gone = view(np.zeros(RAYS), *STRAIGHT)[N_CORRIDORS:]
    assert appears.min() == -1 and gone.max() == 1 and np.abs(np.concatenate([appears, gone])).max() == 1


def test_an_episode_begins_without_changes() -> None:
    env = gym.make("SafeDrive-v0").unwrapped
    for scenario in (2000, 2001):
        observation, _ = env.reset(options={"scenario": scenario})
        assert not observation[259 + N_CORRIDORS :].any()
        changed = False
        for _ in range(60):
            observation, *_ = env.step(np.array([0.0, 0.5]))
            changed |= bool(observation[259 + N_CORRIDORS :].any())
        assert changed


def test_without_them_the_observation_is_the_plain_one() -> None:
    with_them, plain = (gym.make("SafeDrive-v0", corridors=flag) for flag in (True, False))
    assert with_them.observation_space.shape == (259 + N_VIEW,) and plain.observation_space.shape == (259,)
    full, _ = with_them.reset(options={"scenario": 2000})
    short, _ = plain.reset(options={"scenario": 2000})
    np.testing.assert_array_equal(full[:259], short)
