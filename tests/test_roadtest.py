"""RoadTest-v0: two fixed routes, the paper's observation, people and bicycles that cross."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sb3_chac.envs  # noqa: F401
from sb3_chac.envs.driving.geometry import SPACING
from sb3_chac.envs.roadtest.env import CHECKPOINTS, KERB, KINDS, ROUTES


def make(**kwargs):
    return gym.make("RoadTest-v0", **kwargs).unwrapped


def test_it_keeps_gymnasium_s_contract():
    check_env(make(), skip_render_check=True)


def test_the_routes_are_fixed_and_differ():
    env, maps = make(traffic_density=0.0), []
    for route in (1, 2, 1):
        env.reset(options={"scenario": route}, seed=len(maps))
        maps.append(env.map.route.copy())
        assert "".join(block.kind for block in env.map.blocks).replace("-", "") == ROUTES[route]
    assert np.array_equal(maps[0], maps[2]) and not np.array_equal(maps[0][:100], maps[1][:100])
    with pytest.raises(ValueError, match="routes 1, 2"):
        make(route=3)
    with pytest.raises(ValueError, match="scenario"):
        env.reset(options={"scenario": 1000})


def test_people_depend_on_the_seed_alone():
    env, places = make(), []
    for seed in (0, 0, 1):
        env.reset(seed=seed)
        places.append([*env._people.s, *env._people.trigger])
    assert places[0] == places[1] != places[2]


def test_the_observation_is_the_paper_s():
    env = make(traffic_density=0.0, obstacle_density=0.0, crossing_density=0.0)
    assert env.observation_layout[-1]["stop"] == env.observation_space.shape[0] == 306
    observation, _ = env.reset(seed=0)
    driver, commands = env.scripted_driver("scripted-ideal"), []
    driver.reset(0)
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(driver(observation))
        done = terminated or truncated
        assert observation[0] == pytest.approx(2 * env.ego.speed / 15 - 1, abs=1e-6)
        assert observation[1] == pytest.approx(env.lateral / 4, abs=1e-6) or abs(env.lateral) > 4
        point = env.map.route[min(int((env.s + CHECKPOINTS[4]) / SPACING), len(env.map.route) - 1)]
        ahead = observation[14] * 60 * env.ego.direction
        right = observation[15] * 60 * np.array([-env.ego.direction[1], env.ego.direction[0]])
        assert np.allclose(env.ego.position + ahead + right, point[:2], atol=1e-3)
        assert observation[3:6].sum() == 1 and env.command == info["command"]
        if not commands or commands[-1] != info["command"]:
            commands.append(info["command"])
    assert info["is_success"] and len(commands) > 1
    assert not observation[66:].any()  # nobody to be seen


def test_who_crosses_is_seen_and_can_be_hit():
    env = make(traffic_density=0.0, obstacle_density=0.0, crossing_density=1.0)
    env.reset(seed=3)
    people = env._people
    people.s[0], people.trigger[0], people.walked[0], people.walks[0], people.kind[0] = 18.0, 50.0, KERB, False, 0
    people.walks[1:] = False
    assert KINDS[0].name == "pedestrian"
    cost, nearest = 0.0, []
    for _ in range(40):
        people.walked[0] = KERB - env.lateral * people.side[0] if people.there[0] else 99.0  # in the way, whatever it does
        observation, _, _, _, info = env.step([0.0, 0.6])
        nearest.append(observation[66])
        cost += info["cost"]
        if cost:
            break
    assert cost == 1 and env.ego.speed == 0 and not people.there[0]
    assert max(nearest) > 0.8 and nearest[5] < nearest[15]


@pytest.mark.slow
@pytest.mark.parametrize("route", [1, 2])
def test_the_scripted_driver_stops_for_people(route):
    """Compared with the one who does not see them."""
    costs = {}
    for name in ("sees", "blind"):
        env = make(route=route, traffic_density=0.0, obstacle_density=0.0, crossing_density=0.6)
        driver = env.scripted_driver("scripted-ideal")
        if name == "blind":
            driver = super(type(env), env).scripted_driver("scripted-ideal")
        costs[name] = 0.0
        for seed in range(2):
            observation, _ = env.reset(seed=seed)
            driver.reset(seed)
            done = False
            while not done:
                observation, _, terminated, truncated, info = env.step(driver(observation))
                done = terminated or truncated
                costs[name] += info["cost"]
            assert info["is_success"] or name == "blind"
    assert costs["sees"] < costs["blind"] / 2
