"""What the environments tell of the way ahead: the next junction, the way through it, how far it is."""

import numpy as np
import pytest

from sb3_chac.common.contract import Guidance, TakeoverDisplay
from sb3_chac.envs.driving.guidance import Junction, guide, way_through
from sb3_chac.envs.metadrive.route import Route
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.envs.safedrive.vehicle import MAX_SPEED


@pytest.mark.parametrize(
    "angle, way", [(0.0, "straight"), (np.pi / 2, "right"), (-np.pi / 2, "left"), (1.5 * np.pi, "left"), (-0.3, "straight")]
)
def test_ways_through_a_junction(angle, way):
    assert way_through(angle) == way


def test_the_next_junction_is_told_until_it_is_left_and_then_the_goal():
    junctions = [Junction(30.0, 50.0, "left", False), Junction(70.0, 120.0, "right", True)]
    told = [guide(junctions, s, 200.0, 15.0) for s in (0.0, 40.0, 50.0, 119.0, 120.0, 201.0)]
    assert [(guidance.turn, guidance.distance) for guidance in told] == [
        ("left", 30.0), ("left", 0.0), ("1st exit", 20.0), ("1st exit", 0.0), ("goal", 80.0), ("goal", 0.0),
    ]  # fmt: skip
    assert {guidance.speed_limit for guidance in told} == {15.0}


@pytest.mark.parametrize("scenario", range(8))
def test_safedrive_tells_the_way_that_its_route_takes(scenario):
    env = SafeDriveEnv(blocks="XOT")
    env.reset(options={"scenario": scenario})
    assert [junction.is_roundabout for junction in env.map.junctions] == [False, True, False]
    route = env.map.route
    for junction in env.map.junctions:
        before, after = (route[int(s / 0.5), 2] for s in (junction.start - 1.0, junction.end + 1.0))
        assert way_through(after - before) == junction.way
        env.s = junction.start - 12.0
        assert env.guidance.distance == pytest.approx(12.0) and env.guidance.speed_limit == MAX_SPEED
    env.s = env.map.finish - 3.0
    assert str(env.guidance) == "goal 3 m"


def test_an_environment_that_tells_nothing():
    assert TakeoverDisplay().guidance == Guidance() and str(Guidance()) == "-" and TakeoverDisplay().show_corridors is None


class Lane:
    """Of MetaDrive: straight on, then a turn to the left on a circle of 10 m, straight on again."""

    width = 3.5

    def __init__(self, x, y, heading, length, turns=False):
        self.x, self.y, self.heading, self.length, self.turns = x, y, heading, length, turns

    def heading_theta_at(self, s):
        return self.heading + (s / 10.0 if self.turns else 0.0)

    def position(self, s, lateral):
        if self.turns:
            return np.array([self.x + 10 * np.sin(s / 10), self.y + 10 * (1 - np.cos(s / 10))])
        return np.array([self.x + s * np.cos(self.heading), self.y + s * np.sin(self.heading)])


class Navigation:
    def __init__(self, **values):
        vars(self).update(values)


@pytest.mark.parametrize("block, is_roundabout", [("1X0_0_", False), ("2O1_0_", True), ("-1T0_0_", False), ("1C0_0_", None)])
def test_metadrive_tells_the_junctions_of_its_route(block, is_roundabout):
    lanes = [Lane(0, 0, 0.0, 40.0), Lane(40, 0, 0.0, 5 * np.pi, True), Lane(50, 10, np.pi / 2, 40.0)]
    names = [">", ">>", block, "3S0_0_"]
    graph = {start: {end: [lane]} for start, end, lane in zip(names[:-1], names[1:], lanes, strict=True)}
    network = Navigation(road_network=Navigation(graph=graph))
    route = Route(Navigation(map=network, checkpoints=names))
    wanted = [] if is_roundabout is None else [Junction(40.0, pytest.approx(40 + 5 * np.pi), "left", is_roundabout)]
    assert route.junctions == wanted
