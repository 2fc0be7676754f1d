"""The roads of a map as highway-env's network of lanes, and as areas to paint."""

from typing import NamedTuple

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
from highway_env.road.road import RoadNetwork

from sb3_chac.envs.driving.geometry import SPACING, wrap_angle
from sb3_chac.envs.safedrive.geometry import Pose, Segment, sample, turn
from sb3_chac.envs.safedrive.map import (
    ARM,
    AXIS,
    BEHIND,
    CROSSING,
    FILLET,
    HALF_WIDTH,
    LANE_WIDTH,
    LANES,
    RAMP_JOINT,
    RING,
    RING_ANGLE,
    Block,
    Map,
    way,
)

KERB = 0.4  # [m] width
LINE = 0.2  # [m] width of a marking
EDGE = 0.3  # [m] from the edge of a carriageway to the middle of its line
STRIPE, STRIPE_SPACING = 3.0, 7.0  # [m]
GIVE_WAY, GIVE_WAY_SPACING = 0.8, 1.25  # [m] across the road
CHUNK = int(16.0 / SPACING)  # points along a road that make one area

RIM = AXIS + HALF_WIDTH  # [m] from the axis of a road to its edge


class Area(NamedTuple):
    """Area of a map, to be painted."""

    kind: str  # "kerb", "asphalt", "route" (asphalt that the ego may drive on), "grass", "trees", "line" or "black"
    points: np.ndarray  # [m] corners, shape (n, 2)


# The network of lanes


def road_network(road_map: Map) -> RoadNetwork:
    """
    Every lane of the map once. Nodes lie on the middle of a carriageway; lanes are counted from the left. A ramp has one lane,
    which leaves or joins the right lane of the carriageway.

    :return: a network in which each lane begins where those before it end
    """
    network = RoadNetwork()
    nodes: list[Pose] = []

    def node(pose: Pose) -> str:
        for name, other in enumerate(nodes):
            if np.hypot(pose.x - other.x, pose.y - other.y) < 0.01 and abs(wrap_angle(pose.heading - other.heading)) < 0.01:
                return str(name)
        nodes.append(pose)
        return str(len(nodes) - 1)

    def add(start: Pose, segment: Segment, lines: bool = True) -> None:
        left = [LineType.CONTINUOUS_LINE, LineType.STRIPED] if lines else [LineType.NONE, LineType.NONE]
        right = [LineType.NONE, LineType.CONTINUOUS_LINE] if lines else [LineType.NONE, LineType.NONE]
        ends = node(start), node(segment.end(start))
        for offset, line_types in zip(LANES, (left, right), strict=True):
            network.add_lane(*ends, _lane(start.shifted(0.0, offset), segment.offset(offset), line_types))

    for block in road_map.blocks:
        if block.kind in "OTX":
            for start, segment, marked in _junction_pieces(block):
                add(start, segment, marked)
            continue
        pieces = [(block.start, _split(block))]
        pieces.append((block.end.shifted(0.0, -2 * AXIS, np.pi), block.opposing))
        for start, segments in pieces:
            for segment in segments:
                add(start, segment)
                start = segment.end(start)
        if block.ramp:
            start, segments = block.ramp
            for i, segment in enumerate(segments):
                end = segment.end(start)
                leaves, merges = block.ramp_leaves and i == 0, not block.ramp_leaves and i == len(segments) - 1
                ends = node(start.shifted(0.0, -LANES[1] * leaves)), node(end.shifted(0.0, -LANES[1] * merges))
                network.add_lane(*ends, _lane(start, segment, [LineType.CONTINUOUS_LINE, LineType.CONTINUOUS_LINE]))
                start = end
    return network


def _lane(start: Pose, segment: Segment, line_types: list[int]) -> AbstractLane:
    if segment.curvature == 0:
        return StraightLane(start[:2], segment.end(start)[:2], LANE_WIDTH, line_types)
    clockwise = segment.curvature > 0
    centre = start.shifted(0.0, 1 / segment.curvature)
    phase = start.heading - np.pi / 2 if clockwise else start.heading + np.pi / 2
    end_phase = phase + segment.length * segment.curvature
    return CircularLane(centre[:2], 1 / abs(segment.curvature), phase, end_phase, clockwise, LANE_WIDTH, line_types)


def _split(block: Block) -> list[Segment]:
    """The ego's carriageway, cut where a ramp leaves or joins it."""
    if not block.ramp:
        return block.route
    whole = block.route[0].length
    first = RAMP_JOINT if block.ramp_leaves else whole - RAMP_JOINT
    return [Segment(first), Segment(whole - first)]


def _junction_pieces(block: Block) -> list[tuple[Pose, Segment, bool]]:
    """List the pieces of carriageway: the start and course of each, and whether it has markings."""
    arms = [BEHIND, block.exit_arm, *block.side_arms]
    pieces = []
    for arm in block.side_arms:
        pieces += [(block.arm_start(arm), Segment(ARM), True), (_mouth(block, arm).shifted(0.0, AXIS), Segment(ARM), True)]
    if block.kind != "O":
        ways = [(arm, to) for arm in arms for to in arms if to != arm]
        return pieces + [(_entry(block, arm), way(block.kind, arm, to)[0], False) for arm, to in ways]
    fillet = turn(FILLET, np.pi / 2 - RING_ANGLE)
    for arm in arms:
        joins = fillet.end(_entry(block, arm))
        between, past = turn(RING, -(np.pi / 2 - 2 * RING_ANGLE)), turn(RING, -2 * RING_ANGLE)
        leaves = between.end(joins)
        pieces += [(_entry(block, arm), fillet, False), (joins, between, False)]
        pieces += [(leaves, past, False), (leaves, fillet, False)]
    return pieces


def _mouth(block: Block, arm: float) -> Pose:
    """Return the pose in which the axis of an arm meets the junction, heading outwards."""
    return block.centre.shifted(0.0, 0.0, arm).shifted(block.half_size)


def _entry(block: Block, arm: float) -> Pose:
    """Return the pose in which the middle of the carriageway from an arm enters the junction."""
    return _mouth(block, arm).shifted(0.0, -AXIS, np.pi)


# Areas


def areas(road_map: Map, finish: float) -> list[Area]:
    """
    Collect the areas of a map.

    :param finish: [m] along the route, where the destination is
    :return: what to paint, in this order
    """
    kerbs: list[np.ndarray] = []
    asphalt: list[np.ndarray] = []
    islands: list[Area] = []
    markings: list[np.ndarray] = []

    def pave(start: Pose, segments: list[Segment], half_width: float) -> None:
        around = half_width + KERB
        kerbs.extend(strips(start.shifted(-KERB), [Segment(KERB), *segments, Segment(KERB)], -around, around))
        asphalt.extend(strips(start, segments, -half_width, half_width))

    for block in road_map.blocks:
        if block.kind in "OTX":
            kerbs.append(outline(block, KERB))
            asphalt.append(outline(block))
            islands += _islands(block)
            for arm in block.side_arms:
                axis = _mouth(block, arm)
                pave(axis, [Segment(ARM)], RIM)
                islands += _median(axis, [Segment(ARM)])
                markings += _markings(axis.shifted(0.0, -AXIS), [Segment(ARM)]) + _markings(
                    axis.shifted(0.0, AXIS), [Segment(ARM)]
                )
            for arm in (BEHIND, block.exit_arm, *block.side_arms):
                markings += _give_way(_entry(block, arm))
            if block.kind == "O":
                ring = block.centre.shifted(0.0, -RING), [turn(RING, 2 * np.pi)]
                markings += dashes(*ring, 0.0) + strips(*ring, *_line(HALF_WIDTH - EDGE))
            continue
        axis, segments = block.start.shifted(0.0, -AXIS), [segment.offset(-AXIS) for segment in block.route]
        pave(axis, segments, RIM)
        islands += _median(axis, segments)
        markings += _markings(block.start, block.route, without_right=block.ramp is not None)
        markings += _markings(block.end.shifted(0.0, -2 * AXIS, np.pi), block.opposing)
        if block.ramp:
            pave(*block.ramp, LANE_WIDTH / 2)
            markings += _ramp_markings(block)
    route = strips(road_map.start, road_map.paths[0].segments, -HALF_WIDTH, HALF_WIDTH)
    layers = [Area("kerb", points) for points in kerbs] + [Area("asphalt", points) for points in asphalt]
    layers += [Area("route", points) for points in route] + islands
    layers += [Area("line", points) for points in markings]
    start_line = strip(along(road_map.start.shifted(8.0), [Segment(0.5)]), -HALF_WIDTH, HALF_WIDTH)
    return [*layers, Area("line", start_line), *_finish_line(road_map.route, finish)]


def along(start: Pose, segments: list[Segment]) -> np.ndarray:
    """
    Sample poses along a line.

    :return: poses every ``SPACING`` and at the end, shape (n, 3)
    """
    end = start
    for segment in segments:
        end = segment.end(end)
    return np.concatenate([sample(start, [s for s in segments if s.length > 0])[:, :3], [end]])


def strip(poses: np.ndarray, left: float, right: float) -> np.ndarray:
    """
    Make the area between two parallels.

    :param poses: shape (n, 3)
    :param left: [m] to the right of the poses, likewise ``right``
    :return: corners of the area between the two, shape (2 n, 2)
    """
    aside = np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1)
    return np.concatenate([poses[:, :2] + left * aside, (poses[:, :2] + right * aside)[::-1]])


def strips(start: Pose, segments: list[Segment], left: float, right: float) -> list[np.ndarray]:
    """
    Make the area between two parallels of a line in pieces.

    :return: each with its shape (n, 2)
    """
    poses = along(start, segments)
    pieces = [poses[i : i + CHUNK + 1] for i in range(0, len(poses) - 1, CHUNK)]
    return [strip(np.concatenate([piece[:-1:3], piece[-1:]]), left, right) for piece in pieces]


def dashes(start: Pose, segments: list[Segment], right: float) -> list[np.ndarray]:
    """
    Make the dashes of a broken line.

    :param right: [m] where the broken line is
    """
    poses = along(start, segments)
    stripe, spacing = int(STRIPE / SPACING), int(STRIPE_SPACING / SPACING)
    return [strip(poses[i : i + stripe + 1], *_line(right)) for i in range(spacing // 2, len(poses) - stripe, spacing)]


def _line(right: float) -> tuple[float, float]:
    return right - LINE / 2, right + LINE / 2


def _markings(start: Pose, segments: list[Segment], without_right: bool = False) -> list[np.ndarray]:
    """Markings of one carriageway: lines at its edges, a broken one between its lanes."""
    markings = dashes(start, segments, 0.0) + strips(start, segments, *_line(EDGE - HALF_WIDTH))
    return markings if without_right else markings + strips(start, segments, *_line(HALF_WIDTH - EDGE))


def _ramp_markings(block: Block) -> list[np.ndarray]:
    """Lines at the edges of a ramp and of the road beside it, broken where one may change between the two."""
    assert block.ramp
    ramp, road = along(*block.ramp), along(block.start.shifted(0.0, HALF_WIDTH - EDGE), block.route)
    to_ramp = np.linalg.norm(road[:, None, :2] - ramp[None, :, :2], axis=-1).min(axis=1)
    open_here = to_ramp < LANE_WIDTH / 2 + LINE
    markings = [strip(road[run], *_line(0.0)) for run in _runs(~open_here)]
    for run in _runs(open_here):
        markings += [strip(road[run][i : i + 3], *_line(0.0)) for i in range(1, run.stop - run.start - 2, 4)]
    heading, ahead = block.start.heading, np.array(block.start[:2])
    for side in (EDGE - LANE_WIDTH / 2, LANE_WIDTH / 2 - EDGE):
        edge = ramp.copy()
        edge[:, 0] -= side * np.sin(ramp[:, 2])
        edge[:, 1] += side * np.cos(ramp[:, 2])
        d = edge[:, :2] - ahead
        outside = d[:, 1] * np.cos(heading) - d[:, 0] * np.sin(heading) > HALF_WIDTH
        markings += [strip(edge[run], *_line(0.0)) for run in _runs(outside)]
    return markings


def _runs(mask: np.ndarray) -> list[slice]:
    """Stretches of at least two points for which ``mask``, shape (n,), holds."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(a, b) for a, b in zip(changes[::2], changes[1::2], strict=True) if b - a > 1]


def _give_way(entry: Pose) -> list[np.ndarray]:
    """A broken line across the carriageway."""
    places = np.arange(0.3 - HALF_WIDTH, HALF_WIDTH - GIVE_WAY, GIVE_WAY_SPACING)
    return [strip(along(entry.shifted(-0.7), [Segment(0.5)]), place, place + GIVE_WAY) for place in places]


def _median(start: Pose, segments: list[Segment]) -> list[Area]:
    """The green between two carriageways."""
    half = AXIS - HALF_WIDTH
    kerbs, green = strips(start, segments, -half, half), strips(start, segments, KERB - half, half - KERB)
    return [Area("kerb", points) for points in kerbs] + [Area("grass", points) for points in green]


def _islands(block: Block) -> list[Area]:
    """The ends of the medians, between the ways into the junction and those out of it, and the middle of a roundabout."""
    half, islands = AXIS - HALF_WIDTH, []
    tip = block.half_size - RING - HALF_WIDTH if block.kind == "O" else KERB
    for arm in (BEHIND, block.exit_arm, *block.side_arms):
        mouth = _mouth(block, arm)
        islands.append(Area("kerb", strip(np.array([mouth, mouth.shifted(-tip)]), -half, half)))
    if block.kind == "O":
        radius = RING - HALF_WIDTH
        for kind, r in (("kerb", radius), ("grass", radius - KERB), ("trees", radius / 2)):
            rim = along(block.centre.shifted(0.0, -r), [turn(r, 2 * np.pi)])
            islands.append(Area(kind, rim[::2, :2]))
    return islands


def outline(block: Block, margin: float = 0.0) -> np.ndarray:
    """
    Make the outline of a junction.

    :param margin: [m] that is added around it
    :return: the rim of a junction from arm to arm, shape (n, 2)
    """
    arms = sorted((BEHIND, block.exit_arm, *block.side_arms), key=lambda arm: arm % (2 * np.pi))
    corner, rim = AXIS + FILLET, RING + HALF_WIDTH + margin  # beside the axis, centre of the fillet; radius of the ring
    radius, sweep = FILLET - HALF_WIDTH - margin, np.pi / 2 - RING_ANGLE
    if block.kind != "O":
        corner, radius, sweep = CROSSING, CROSSING - RIM - margin, np.pi / 4
    fillet = np.linspace(0.0, sweep, 8)
    ahead, right = block.half_size - radius * np.sin(fillet), corner - radius * np.cos(fillet)
    ring = np.linspace(RING_ANGLE, np.pi / 2 - RING_ANGLE, 8)
    points = []
    for i, arm in enumerate(arms):
        following = arms[(i + 1) % len(arms)]
        here, there = block.centre.shifted(0.0, 0.0, arm), block.centre.shifted(0.0, 0.0, following)
        points.append(here.shifted(block.half_size, -RIM - margin))
        if np.isclose((following - arm) % (2 * np.pi), np.pi / 2):
            points += [here.shifted(a, r) for a, r in zip(ahead, right, strict=True)]
            if block.kind == "O":
                points += [here.shifted(rim * np.cos(angle), rim * np.sin(angle)) for angle in ring]
            points += [there.shifted(a, -r) for a, r in zip(ahead[::-1], right[::-1], strict=True)]
        else:
            points.append(here.shifted(block.half_size, RIM + margin))
    return np.array(points)[:, :2]


def _finish_line(route: np.ndarray, finish: float) -> list[Area]:
    """Two rows of squares across the carriageway."""
    squares, start = [], Pose(*route[int(finish / SPACING), :3])
    for row in range(2):
        for column, right in enumerate(np.arange(-HALF_WIDTH, HALF_WIDTH)):
            square = strip(along(start.shifted(float(row)), [Segment(1.0)]), right, right + 1.0)
            squares.append(Area("line" if (row + column) % 2 else "black", square))
    return squares
