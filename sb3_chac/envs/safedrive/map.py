"""Procedural maps: blocks laid end to end, two carriageways of two lanes each, people drive on the right."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sb3_chac.envs.driving.geometry import wrap_angle
from sb3_chac.envs.driving.guidance import Junction, way_through
from sb3_chac.envs.safedrive.geometry import Pose, Segment, chain, sample, turn

LANE_WIDTH = 4.0  # [m]
LANES = (-LANE_WIDTH / 2, LANE_WIDTH / 2)  # [m] offsets of the left and the right lane from the middle of a carriageway
HALF_WIDTH = LANE_WIDTH  # [m] of a carriageway
AXIS = 5.0  # [m] from the axis of a road to the middle of a carriageway
BLOCKS = "SCROTX"  # straight, curve, ramp, roundabout, T-intersection, intersection

START_STRAIGHT = 25.0  # [m] before the first block
CONNECTION = 28.0  # [m] of straight road between two blocks
RUN_OUT = 30.0  # [m] of road beyond the destination
ARRIVES_BEFORE_END = 5.0  # [m]
ARM = 60.0  # [m] length of the side roads
CLEARANCE = 28.0  # [m] between the axes of roads that do not belong together

CROSSING = AXIS + HALF_WIDTH + 7.0  # [m] from the middle of an intersection to where its roads begin
RING, FILLET = 20.0, 12.0  # [m] radii of a roundabout's ring and of the ways into and out of it
RING_ANGLE = float(np.arcsin((AXIS + FILLET) / (RING + FILLET)))  # [rad] from an arm to where its fillet meets the ring
ROUNDABOUT = float(np.sqrt((RING + FILLET) ** 2 - (AXIS + FILLET) ** 2))  # [m] from its middle to where its roads begin
BEHIND = np.pi  # [rad] direction of the arm by which the ego comes

RAMP_RADIUS, RAMP_ANGLE = 40.0, 0.35  # [m], [rad]
RAMP_JOINT = 10.0  # [m] from the beginning of the block to where a ramp leaves, and from where one merges to its end
_SHIFT = float(np.arccos(1 - LANE_WIDTH / (2 * RAMP_RADIUS)))  # [rad] of two opposite arcs that change by one lane
ON_RAMP = [Segment(30.0), turn(RAMP_RADIUS, RAMP_ANGLE), Segment(15.0), turn(RAMP_RADIUS, -_SHIFT), turn(RAMP_RADIUS, _SHIFT)]
OFF_RAMP = [turn(RAMP_RADIUS, _SHIFT), turn(RAMP_RADIUS, -_SHIFT), Segment(15.0), turn(RAMP_RADIUS, RAMP_ANGLE), Segment(30.0)]

OBSTACLE_SIZES = {"cone": (1.0, 1.0), "triangle": (1.4, 1.4), "parked": (5.0, 2.0)}  # [m] length, width


class Path(NamedTuple):
    """A way that traffic takes through the map."""

    kind: str  # "route", "opposing", "side" (from a side road), "leaves" (the route) or "merges" (from a ramp)
    start: Pose
    segments: list[Segment]
    meets: float = 0.0  # [m] along the path, where it comes to the block that it belongs to
    block_start: float = 0.0  # [m] along the route, where that block begins
    lanes: tuple[float, ...] = LANES  # [m] offsets at which it may be driven
    shared: tuple[float, float] = (np.inf, np.inf)  # [m] from where to where along the path it runs on the ego's route
    ahead_of_route: float = 0.0  # [m] along the route less [m] along the path, where shared


class Obstacle(NamedTuple):
    """Obstacle on the carriageway of the route."""

    kind: str  # of OBSTACLE_SIZES
    s: float  # [m] along the route
    lateral: float  # [m] to the right of the middle of the carriageway


@dataclass
class Block:
    """Block of a map: a piece of the route with its side roads."""

    kind: str  # of BLOCKS, or "-" for the straight road between them
    start: Pose  # where the middle of the ego's carriageway enters
    route: list[Segment]  # the ego's carriageway
    opposing: list[Segment]  # the other carriageway, in its own direction of travel
    exit_arm: float = 0.0  # [rad] direction of the arm by which the ego leaves, against the heading at its entry
    side_arms: tuple[float, ...] = ()  # [rad] directions of the other arms
    ramp: tuple[Pose, list[Segment]] | None = None
    ramp_leaves: bool = False

    @property
    def end(self) -> Pose:
        """End of the block's route."""
        return chain(self.start, self.route)[-1]

    @property
    def half_size(self) -> float:
        """[m] from the middle of a junction to its mouths."""
        return ROUNDABOUT if self.kind == "O" else CROSSING

    @property
    def centre(self) -> Pose:
        """The middle of a junction, heading as its entry."""
        return self.start.shifted(self.half_size, -AXIS)

    def arm_start(self, arm: float) -> Pose:
        """The far end of a side road, on the carriageway that leads to the junction."""
        return self.centre.shifted(0.0, 0.0, arm + np.pi).shifted(-self.half_size - ARM, AXIS)

    def axes(self) -> np.ndarray:
        """Points every 4 m along its roads, shape (n, 2)."""
        points = [sample(self.start, self.route)[::8, :2]]
        points += [sample(self.arm_start(arm), [Segment(ARM)])[::8, :2] for arm in self.side_arms]
        if self.ramp:
            points.append(sample(*self.ramp)[::8, :2])
        return np.concatenate(points)


def length(segments: list[Segment]) -> float:
    """Add up the lengths [m] of segments."""
    return sum(segment.length for segment in segments)


def way(kind: str, arm: float, to: float) -> list[Segment]:
    """
    Find the way through a junction.

    :param kind: "O", "T" or "X"
    :param arm: [rad] direction of the arm that one comes from, seen from the middle of the junction
    :param to: [rad] direction of the arm that one leaves by
    :return: the middle of the carriageway through the junction
    """
    angle = float(np.round(wrap_angle(to - arm - np.pi) / (np.pi / 2)) * np.pi / 2)
    if kind == "O":
        fillet = turn(FILLET, np.pi / 2 - RING_ANGLE)
        return [fillet, turn(RING, -(np.pi - 2 * RING_ANGLE - angle)), fillet]
    if angle == 0:
        return [Segment(2 * CROSSING)]
    return [turn(CROSSING - AXIS if angle > 0 else CROSSING + AXIS, angle)]


def _road(kind: str, start: Pose, route: list[Segment]) -> Block:
    """A road without junctions: the other carriageway runs parallel."""
    return Block(kind, start, route, [segment.offset(-2 * AXIS).reverse() for segment in reversed(route)])


def _straight(start: Pose, rng: np.random.Generator) -> Block:
    return _road("S", start, [Segment(rng.uniform(40, 60))])


def _curve(start: Pose, rng: np.random.Generator) -> Block:
    return _road(
        "C", start, [turn(rng.uniform(28, 50), rng.choice([-1, 1]) * rng.uniform(0.6, 1.5)), Segment(rng.uniform(10, 25))]
    )


def _ramp(start: Pose, rng: np.random.Generator) -> Block:
    block = _road("R", start, [Segment(85.0)])
    block.ramp_leaves = bool(rng.random() < 0.5)
    if block.ramp_leaves:
        block.ramp = start.shifted(RAMP_JOINT, LANES[1]), OFF_RAMP
    else:  # laid backwards from where it merges
        merge = block.end.shifted(-RAMP_JOINT, LANES[1], np.pi)
        start_of_ramp = chain(merge, [segment.reverse() for segment in reversed(ON_RAMP)])[-1]
        block.ramp = start_of_ramp.shifted(0.0, 0.0, -np.pi), ON_RAMP
    return block


def _junction(kind: str) -> Callable[[Pose, np.random.Generator], Block]:
    def build(start: Pose, rng: np.random.Generator) -> Block:
        arms = [0.0, np.pi / 2, -np.pi / 2]
        if kind == "T":
            arms.pop(rng.integers(3))
        exit_arm = arms.pop(rng.integers(len(arms)))
        return Block(kind, start, way(kind, BEHIND, exit_arm), way(kind, exit_arm, BEHIND), exit_arm, tuple(arms))

    return build


_BUILDERS = {"S": _straight, "C": _curve, "R": _ramp, **{kind: _junction(kind) for kind in "OTX"}}


class Map:
    """
    A route through a sequence of blocks, the ways that others may take on it, and the obstacles that stand on it.

    :param scenario: any integer; the same one gives the same map
    :param blocks: how many random blocks, or their letters in order (of "SCROTX")
    :param obstacle_density: share of the places for obstacles (about every 30 m of road that is not a junction) that have some
    :raises ValueError: if no layout was found in which the roads keep clear of each other
    """

    def __init__(self, scenario: int, blocks: int | str, obstacle_density: float) -> None:
        self.scenario = scenario
        rng = np.random.default_rng([abs(scenario), int(scenario < 0)])
        for _ in range(200):
            if self._lay_out(self._draw(rng, blocks) if isinstance(blocks, int) else blocks, rng):
                break
        else:
            raise ValueError(
                f"blocks={blocks!r}: found no layout for scenario {scenario} in which these blocks keep clear of each other. "
                "Use fewer blocks, or fewer curves and junctions among them."
            )
        self.start = self.blocks[0].start
        segments = [segment for block in self.blocks for segment in block.route]
        self.length = length(segments) - RUN_OUT
        self.finish = self.length - ARRIVES_BEFORE_END  # [m] along the route
        self.route = sample(self.start, segments)
        joints = [0.0, *np.cumsum([length(block.route) for block in self.blocks]).tolist()]
        self.junctions = [  # of the route
            Junction(start, end, way_through(block.exit_arm), block.kind == "O")
            for block, start, end in zip(self.blocks, joints[:-1], joints[1:], strict=True)
            if block.kind in "OTX"
        ]
        self.paths = [Path("route", self.start, segments, shared=(0.0, np.inf)), *self._other_paths()]
        self.obstacles = self._place_obstacles(rng, obstacle_density)

    @staticmethod
    def _draw(rng: np.random.Generator, number: int) -> str:
        """Every kind once before one comes again."""
        rounds = [rng.permutation(list(BLOCKS)) for _ in range(-(-number // len(BLOCKS)))]
        return "".join(np.concatenate(rounds)[:number])

    def _lay_out(self, kinds: str, rng: np.random.Generator) -> bool:
        self.blocks = [_road("-", Pose(0.0, 0.0, rng.uniform(-np.pi, np.pi)), [Segment(START_STRAIGHT)])]
        for i, kind in enumerate(kinds, start=1):
            for _ in range(10):
                block = _BUILDERS[kind](self.blocks[-1].end, rng)
                after = _road("-", block.end, [Segment(RUN_OUT + CONNECTION if i == len(kinds) else CONNECTION)])
                if self._is_clear(np.concatenate([block.axes(), after.axes()]), np.array(block.start[:2])):
                    break
            else:
                return False
            self.blocks += [block, after]
        return True

    def _is_clear(self, points: np.ndarray, joint: np.ndarray) -> bool:
        """
        Tell whether new roads keep clear of those that are there.

        :param points: along the axes of new roads
        :param joint: where they join the last block; close to it they may be close to each other
        """
        theirs = np.concatenate([block.axes() for block in self.blocks])
        near = np.linalg.norm(points[:, None] - theirs, axis=-1) < CLEARANCE
        at_joint = np.linalg.norm(points - joint, axis=-1) < 2 * CLEARANCE
        return not (near & ~(at_joint[:, None] & (np.linalg.norm(theirs - joint, axis=-1) < 2 * CLEARANCE))).any()

    def _other_paths(self) -> list[Path]:
        """Every way but the ego's route. Each goes on to the end of a road."""
        opposing_start = self.blocks[-1].end.shifted(0.0, -2 * AXIS, np.pi)
        opposing = [block.opposing for block in self.blocks]
        route = [block.route for block in self.blocks]

        def join(parts: list[list[Segment]]) -> list[Segment]:
            return [segment for part in parts for segment in part]

        paths = [Path("opposing", opposing_start, join(opposing[::-1]))]
        for i, block in enumerate(self.blocks):
            before, after, block_start = join(route[:i]), join(route[i + 1 :]), length(join(route[:i]))
            block_end = block_start + length(block.route)
            if block.ramp:  # one lane, as the right one of a carriageway
                start, ramp = block.ramp[0].shifted(0.0, -LANES[1]), [segment.offset(-LANES[1]) for segment in block.ramp[1]]
                straight, right = [Segment(RAMP_JOINT)], LANES[1:]
                if block.ramp_leaves:
                    leaves = block_start + RAMP_JOINT
                    paths.append(
                        Path("leaves", self.start, before + straight + ramp, leaves, block_start, right, (0.0, leaves))
                    )
                else:
                    joins = length(ramp)
                    shift = block_end - RAMP_JOINT - joins
                    shared = (joins, np.inf)
                    paths.append(
                        Path("merges", start, ramp + straight + after, joins - 12.0, block_start, right, shared, shift)
                    )
            for arm in block.side_arms:
                start, lead = block.arm_start(arm), [Segment(ARM)]
                joining = lead + way(block.kind, arm, block.exit_arm)
                joins, lanes = length(joining), _lanes(arm, block.exit_arm)
                shared = (joins, np.inf)
                paths.append(Path("side", start, joining + after, ARM, block_start, lanes, shared, block_end - joins))
                ends = {BEHIND: join(opposing[:i][::-1]), **{to: lead for to in block.side_arms if to != arm}}
                for to, rest in ends.items():
                    segments = lead + way(block.kind, arm, to) + rest
                    paths.append(Path("side", start, segments, ARM, block_start, _lanes(arm, to)))
                segments, lanes = before + way(block.kind, BEHIND, arm) + lead, _lanes(BEHIND, arm)
                paths.append(Path("leaves", self.start, segments, block_start, block_start, lanes, (0.0, block_start)))
                coming, lanes = join(opposing[i + 1 :][::-1]), _lanes(block.exit_arm, arm)
                segments = coming + way(block.kind, block.exit_arm, arm) + lead
                paths.append(Path("side", opposing_start, segments, length(coming), block_start, lanes))
        return paths

    def _place_obstacles(self, rng: np.random.Generator, density: float) -> list[Obstacle]:
        """Place obstacles in one lane at a time, on roads without junctions, far enough apart to pass them in turn."""
        obstacles: list[Obstacle] = []
        s, next_free = 0.0, START_STRAIGHT + 15.0
        for block in self.blocks:
            start, s = s, s + length(block.route)
            if block.kind in "OTX":
                next_free = s + 8.0
                continue
            while (place := max(start, next_free)) + 14.0 < min(s, self.length - 15.0):
                next_free = place + 10.0
                if rng.random() < density:
                    scene = self._scene(rng, place)
                    obstacles += scene
                    next_free = scene[-1].s + 30.0
        return obstacles

    @staticmethod
    def _scene(rng: np.random.Generator, s: float) -> list[Obstacle]:
        lane, kind = rng.choice(LANES), rng.choice(["cones", "triangle", "breakdown"])
        if kind == "cones":
            return [Obstacle("cone", s + 3.0 * i, lane + rng.uniform(-0.5, 0.5)) for i in range(5)]
        warning = Obstacle("triangle", s, lane + rng.uniform(-0.6, 0.6))
        return [warning] if kind == "triangle" else [warning, Obstacle("parked", s + 12.0, lane + rng.uniform(-0.3, 0.3))]


def _lanes(arm: float, to: float) -> tuple[float, ...]:
    """Return the lanes to take: keep right to turn right, left to turn left."""
    angle = wrap_angle(to - arm - np.pi)
    return LANES if abs(angle) < 0.1 else (LANES[int(angle > 0)],)
