"""Pictures of SafeDrive-v0, and its roads as highway-env's network."""

import os
import subprocess
import sys
import textwrap

import gymnasium as gym
import numpy as np
import pytest
from shell import FOREVER

from sb3_chac.envs.driving import display
from sb3_chac.envs.driving.geometry import wrap_angle
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.envs.safedrive import render as rendering
from sb3_chac.envs.safedrive.map import HALF_WIDTH, RING, Map
from sb3_chac.envs.safedrive.roads import KERB, road_network

EVERY_KIND = ["S", "C", "R", "O", "T", "X", "OX", 4]


def make(scenario=1, until=0.0, **options):
    """An environment in which the scripted driver has driven that share of the route."""
    env = SafeDriveEnv(**{"render_mode": "rgb_array", **options})
    env.reset(seed=0, options={"scenario": scenario})
    driver = env.scripted_driver("scripted-ideal")
    while env._info()["route_completion"] < until:
        env.step(driver())
    return env


def closest(frame, place, colour, within=3):
    """The largest difference of a channel from that colour, at the most similar pixel around that place [px]."""
    x, y = np.asarray(place).round().astype(int)
    around = frame[y - within : y + within + 1, x - within : x + within + 1].reshape(-1, 3).astype(int)
    return np.abs(around - colour).max(axis=1).min()


@pytest.mark.parametrize("blocks", EVERY_KIND)
def test_frame_shows_ego_on_its_route(blocks):
    env = make(blocks=blocks, until=0.3, traffic_density=0, obstacle_density=0)
    frame = env.render()
    assert frame.shape == (600, 800, 3) and frame.dtype == np.uint8
    assert closest(frame, env._viewer.to_picture(env.ego.position), display.EGO, within=8) < 20
    beside = env.map.route[int((env.s + 12) / 0.5)]
    right = beside[:2] + 1.5 * np.array([-np.sin(beside[2]), np.cos(beside[2])])
    assert closest(frame, env._viewer.to_picture(right), rendering.COLOURS["route"]) < 8
    grass = (np.abs(frame.astype(int) - rendering.COLOURS["grass"]).max(axis=2) < 4).mean()
    assert 0.2 < grass < 0.95


def test_route_ahead_is_up():
    env = make(blocks="OXC", until=0.5)
    env.render()
    here, ahead = env._viewer.to_picture(np.array([env._viewer._on_route(env.s + d) for d in rendering.UP]))
    assert abs(ahead[0] - here[0]) < 1 and ahead[1] < here[1] - 10


def test_the_faster_the_farther_it_looks_ahead():
    env = make(blocks="SS", until=0.3)
    reach = []
    for speed in (0.0, 5.0, 10.0, 15.0):
        env.ego.speed = speed
        env.render()
        here, ahead = env._viewer.to_picture(np.array([env._viewer._on_route(env.s + d) for d in (0.0, 10.0)]))
        reach.append(10 * here[1] / (here[1] - ahead[1]))  # [m] to the upper edge of the picture
    assert reach == sorted(reach) and reach[0] > 40 and reach[-1] > 80


@pytest.mark.parametrize("scenario", range(6))
def test_the_way_ahead_stays_in_the_picture(scenario):
    """Through curves and junctions, and the view moves steadily."""
    env = make(scenario, traffic_density=0, obstacle_density=0)  # a collision stops the ego at once
    driver = env.scripted_driver("scripted-ideal")
    shifts, done = [], False
    while not done:
        done = any(env.step(driver())[2:4])
        env._viewer._look_along_route() if env._viewer else env.render()
        ahead = env._viewer.to_picture(np.array([env._viewer._on_route(env.s + d) for d in (0.0, 10.0, 20.0, 30.0)]))
        assert (ahead > 0).all() and (ahead[:, 0] < 800).all() and (ahead[:, 1] < 600).all()
        shifts.append(env._viewer.shift / rendering.FINE)
    assert np.abs(np.diff(shifts, axis=0)).max() < 30  # [px] from one step to the next


def test_kerb_around_roundabout():
    env = make(blocks="O", until=0.35, traffic_density=0)
    frame = env.render()
    centre = next(block for block in env.map.blocks if block.kind == "O").centre
    radius = RING + HALF_WIDTH + KERB / 2
    seen = 0
    for arm in np.arange(4) * np.pi / 2:
        for angle in arm + np.linspace(0.65, 0.9, 4):
            rim = centre.shifted(radius * np.cos(angle), radius * np.sin(angle))
            x, y = env._viewer.to_picture(np.array(rim[:2]))
            if 220 < x < 780 and 20 < y < 580:
                assert closest(frame, (x, y), rendering.COLOURS["kerb"], within=1) < 40
                seen += 1
    assert seen >= 4


def test_no_kerb_across_junction():
    """Between the middle of an intersection and any of its arms."""
    env = make(blocks="X", until=0.2, traffic_density=0)
    frame = env.render()
    block = next(block for block in env.map.blocks if block.kind == "X")
    for angle in np.arange(4) * np.pi / 2:
        for distance in np.arange(0.0, block.half_size - 1.5, 0.25):
            x, y = env._viewer.to_picture(np.array(block.centre.shifted(0, 0, angle).shifted(distance)[:2])).astype(int)
            if 220 < x < 800 and 0 <= y < 600:
                assert np.abs(frame[y, x].astype(int) - rendering.COLOURS["kerb"]).max() > 40


OBSTACLES = {"cone": display.ORANGE, "triangle": display.RED, "parked": display.PARKED}


@pytest.mark.parametrize("kind", OBSTACLES)
def test_obstacles_are_painted_where_they_are(kind):
    for scenario in range(20):
        env = make(scenario, until=0.2, blocks="SS", obstacle_density=1, traffic_density=0)
        frame = env.render()
        places = env._viewer.to_picture(env.scene.obstacle_positions)
        seen = ((places > 20) & (places < np.array([780, 580]))).all(axis=1)
        places = [place for o, place, s in zip(env.map.obstacles, places, seen, strict=True) if o.kind == kind and s]
        if places:
            break
    assert places
    for place in places:
        assert closest(frame, place, OBSTACLES[kind], within=8) < 30


def test_traffic_and_wrecks_have_their_colours():
    env = make(blocks="SS", until=0.3, traffic_density=3, obstacle_density=0)
    driver = env.scripted_driver("scripted-ideal")
    while not (near := np.linalg.norm(env.traffic.positions - env.ego.position, axis=1) < 15).any():
        assert not any(env.step(driver())[2:4])
    car = int(env.traffic.visible[near][0])
    for colour in (display.TRAFFIC, rendering.WRECK):
        frame = env.render()
        place = env._viewer.to_picture(env.box_positions[env.box_ids.index(("car", car))])
        assert closest(frame, place, colour, within=8) < 20
        env.traffic.crash(car)


def test_destination_is_chequered():
    env = make(blocks="S", until=0.8, traffic_density=0)
    frame = env.render()
    x, y = env._viewer.to_picture(env._viewer._on_route(env.map.length - 5)).round().astype(int)
    strip = frame[y - 6 : y + 6, x - 18 : x + 18].reshape(-1, 3)
    assert (strip.max(axis=1) < 50).mean() > 0.2 and (strip.min(axis=1) > 200).mean() > 0.2


def test_same_state_gives_same_picture():
    env = make(until=0.4)
    frame = env.render()
    assert np.array_equal(frame, env.render())
    env.close()
    assert np.array_equal(frame, env.render())


def test_hud_shows_what_wrappers_tell():
    env = make()
    plain = env.render()
    env.hud = {"takeover": False, "steps": 12, "takeover rate": 0.25, "stage": "chac"}
    told = env.render()
    env.hud = {**env.hud, "takeover": True}
    human = env.render()
    assert np.array_equal(plain[300:], told[300:]) and not np.array_equal(plain[:200, :300], told[:200, :300])
    assert closest(human, env._viewer.to_picture(env.ego.position), display.HUMAN, within=8) < 20


def test_collision_flashes():
    env = make()
    before = env.render()
    env._touched[("car", 0)] = env.steps
    assert (env.render()[-3, 400] == display.RED).all() and not (before[-3, 400] == display.RED).all()


def test_lidar_on_request():
    env = make(show_lidar=True, blocks="SS", until=0.3)
    rays = env.render()
    env.show_lidar = False
    assert (rays != env.render()).any(axis=2).mean() > 0.02


def test_new_map_is_painted_after_reset():
    env = make(1, blocks="C")
    first = env.render()
    env.reset(options={"scenario": 2})
    env.render()
    env.reset(options={"scenario": 1})
    assert np.array_equal(first, env.render())


def test_rendering_changes_nothing():
    def rollout(render):
        env = make(3, render_mode="rgb_array", traffic_density=2, show_lidar=True)
        results = []
        for i in range(60):
            observation, reward, *_ = env.step(np.array([0.1 * np.sin(i), 0.6]))
            results.append(np.append(observation, reward))
            if render:
                env.render()
        return np.array(results)

    assert np.array_equal(rollout(True), rollout(False))


def test_without_mode_and_before_reset(recwarn):
    env = SafeDriveEnv()
    env.reset(seed=0)
    assert env.render() is None
    assert any("render_mode" in str(warning.message) for warning in recwarn)
    env.close()
    with pytest.raises(gym.error.ResetNeeded):
        SafeDriveEnv(render_mode="rgb_array").render()


def test_close_twice():
    env = make()
    env.render()
    env.close()
    env.close()
    SafeDriveEnv().close()


def run(code, driver):
    """A new Python, with SDL_VIDEODRIVER as given (None: not set)."""
    variables = {
        name: value for name, value in os.environ.items() if name not in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    }
    if driver:
        variables["SDL_VIDEODRIVER"] = driver
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], env=variables, capture_output=True, text=True, timeout=FOREVER
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_images_need_no_display():
    code = """
        import hashlib
        import gymnasium, sb3_chac.envs
        env = gymnasium.make("SafeDrive-v0", render_mode="rgb_array")
        env.reset(seed=0, options={"scenario": 100})
        frame = env.render()
        assert len(set(frame[300:].reshape(-1, 3).max(axis=1).tolist())) > 20
        print(hashlib.sha256(frame.tobytes()).hexdigest())
    """
    assert run(code, None) == run(code, "dummy")


def test_closing_the_window_ends_the_display():
    code = """
        import pygame
        from sb3_chac.envs.safedrive import SafeDriveEnv
        env = SafeDriveEnv(render_mode="human")
        env.reset(seed=0)
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
        assert env.render() is None and not env._viewer.closed
        assert pygame.event.get(pygame.KEYDOWN), "a device could not see the key"
        assert pygame.display.get_surface().get_size() == (800, 600)
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        env.step([0, 1])
        assert env._viewer.closed and not pygame.display.get_init()
        for _ in range(3):
            env.step([0, 1])
        env.reset()
        env.close()
        print("fine")
    """
    assert run(code, "dummy") == "fine"


def test_no_display_names_the_remedy():
    code = """
        from sb3_chac.envs.safedrive import SafeDriveEnv
        try:
            SafeDriveEnv(render_mode="human").reset(seed=0)
        except RuntimeError as error:
            print(error)
    """
    assert "render_mode='rgb_array'" in run(code, "no-such-driver")


def test_plot_map():
    from matplotlib.figure import Figure

    env = make(blocks="OSX", obstacle_density=1)
    axes = Figure().add_subplot()
    env.plot_map(axes)
    env.plot_map(axes)
    bottom, top = axes.get_ylim()
    left, right = sorted(axes.get_xlim())
    assert bottom > top, "y does not point downwards"
    x, y = env.map.route[:, 0], env.map.route[:, 1]
    assert left < x.min() and right > x.max() and top < y.min() and bottom > y.max()
    assert len(axes.lines) >= 2 and axes.get_aspect() == 1
    axes.figure.canvas.draw()


@pytest.mark.parametrize("blocks", EVERY_KIND)
@pytest.mark.parametrize("scenario", [0, 1, 2, 3, -5])
def test_end_points_of_lanes_meet(blocks, scenario):
    network = road_network(Map(scenario, blocks, 0.5))
    followed = 0
    for middle, after in network.graph.items():
        for before in (origin for origin in network.graph if middle in network.graph[origin]):
            lanes = network.graph[before][middle]
            for following in after.values():
                # From the right: a ramp's only lane meets the right one
                for lane, follower in zip(lanes[::-1], following[::-1], strict=False):
                    assert np.allclose(lane.position(lane.length, 0), follower.position(0, 0), rtol=0, atol=1e-6)
                    assert abs(wrap_angle(lane.heading_at(lane.length) - follower.heading_at(0))) < 1e-6
                    followed += 1
    assert followed >= len(network.graph)
    lanes = network.lanes_list()
    courses = [np.concatenate([lane.position(lane.length * part, 0) for part in (0, 0.5, 1)]) for lane in lanes]
    assert len(np.unique(np.round(courses, 3), axis=0)) == len(lanes), "a lane is there twice"


@pytest.mark.parametrize("blocks", EVERY_KIND)
def test_network_has_the_route(blocks):
    """Both lanes of the ego's carriageway, all along, in its direction."""
    env = make(blocks=blocks, render_mode=None)
    network = env.road.network
    assert env.road is env.road
    for x, y, heading, _ in env.map.route[4::40]:
        for offset in (-2.0, 2.0):
            place = np.array([x - offset * np.sin(heading), y + offset * np.cos(heading)])
            lane = network.get_lane(network.get_closest_lane_index(place, heading))
            s, lateral = lane.local_coordinates(place)
            assert abs(lateral) < 1e-6 and abs(wrap_angle(lane.heading_at(s) - heading)) < 1e-6
    env.reset(options={"scenario": 7})
    assert env.road.network is not network


def test_corridors_are_painted_as_far_as_they_are_free():
    env = make(show_corridors=True, blocks="SS", until=0.3, traffic_density=0, obstacle_density=0)
    shown = env.render()
    env.show_corridors = False
    plain = env.render()
    rows, columns = np.nonzero((shown != plain).any(axis=2))
    assert 1000 < len(rows) < 60_000
    blue = (np.abs(shown[rows, columns].astype(int) - rendering.FREE) < 60).all(axis=1).mean()
    assert blue > 0.5  # nothing is there but the road
    assert env.corridors.shape == (48,)
    with pytest.raises(ValueError, match="show_corridors"):
        make(show_corridors=True, corridors=False)
    assert make(corridors=False).corridors is None
