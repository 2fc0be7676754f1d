"""Paths along MetaDrive's lanes: the ego's route, and where vehicles of the traffic go."""

import re
from typing import Any

import numpy as np

from sb3_chac.envs.driving.geometry import SPACING
from sb3_chac.envs.driving.guidance import Junction, way_through

BLOCK = re.compile(r"-?(\d+)([A-Za-z])")  # number and kind, at the beginning of a checkpoint's name
JUNCTIONS = "XTO"  # intersection, T-intersection, roundabout
RUN_OUT = 60.0  # [m] by which paths go straight on beyond their ends


class Path:
    """
    The middle of a chain of lanes, sampled; laterals are to the right of it.

    :param lanes: MetaDrive's
    """

    def __init__(self, lanes: list[Any]) -> None:
        points, starts = [], [0.0]
        for lane in lanes:
            n = max(1, int(np.ceil(lane.length / SPACING)))
            at = np.arange(n) * (lane.length / n)
            points += [(*lane.position(s, 0.0)[:2], lane.heading_theta_at(s), starts[-1] + s) for s in at]
            starts.append(starts[-1] + lane.length)
        x, y, heading, s = np.array(points).T
        heading = np.unwrap(heading)
        beyond = np.arange(0.0, RUN_OUT, SPACING)
        end, way = lanes[-1].position(lanes[-1].length, 0.0), heading[-1]
        self.starts = np.array(starts)  # [m] of the lanes, and the end of the last
        self.s = np.concatenate([s, self.starts[-1] + beyond])
        self.x = np.concatenate([x, end[0] + np.cos(way) * beyond])
        self.y = np.concatenate([y, end[1] + np.sin(way) * beyond])
        self.heading = np.concatenate([heading, np.full(len(beyond), way)])
        bend = np.gradient(self.heading, self.s)
        self.curvature = np.convolve(np.pad(bend, 4, "edge"), np.ones(9) / 9, "valid")  # [1/m], positive to the left

    def index(self, s: Any) -> Any:
        """Return the index of the last point before ``s`` [m], an array of any shape."""
        return np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)

    def poses(self, s: np.ndarray, lateral: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """
        Convert coordinates along the path; beyond its end it goes straight on.

        :param s: [m] along the path
        :param lateral: [m] to the right of it
        :return: positions [m], shape (..., 2), and headings [rad]
        """
        i = self.index(s)
        along, heading = s - self.s[i], self.heading[i]
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = self.x[i] + along * cos + lateral * sin, self.y[i] + along * sin - lateral * cos
        return np.stack([x, y], axis=-1), heading

    def locate(self, position: np.ndarray, low: float, high: float) -> tuple[float, float, int]:
        """
        Find the nearest point of a part of the path.

        :param position: [m], shape (2,)
        :param low: [m] where along the path to look, up to ``high`` [m]
        :return: s [m] and lateral [m] of the nearest point, and its index
        """
        first, last = self.index(low), self.index(high) + 1
        dx, dy = position[0] - self.x[first:last], position[1] - self.y[first:last]
        i = int(np.argmin(dx**2 + dy**2))
        cos, sin = np.cos(self.heading[first + i]), np.sin(self.heading[first + i])
        return float(self.s[first + i] + dx[i] * cos + dy[i] * sin), float(dx[i] * sin - dy[i] * cos), first + i


class Route(Path):
    """
    The ego's route: the leftmost lanes of the roads between the checkpoints of MetaDrive's navigation.

    :param navigation: MetaDrive's
    """

    def __init__(self, navigation: Any) -> None:
        self.map, self.checkpoints = navigation.map, list(navigation.checkpoints)
        graph = self.map.road_network.graph
        roads = [graph[start][end] for start, end in zip(self.checkpoints[:-1], self.checkpoints[1:], strict=True)]
        super().__init__([road[0] for road in roads])
        self.lane_width = float(roads[0][0].width)
        lanes = np.ones(len(self.s))  # side by side, without those that have not begun or have ended
        for road, start, end in zip(roads, self.starts[:-1], self.starts[1:], strict=True):
            for k, lane in enumerate(road[1:], start=1):
                begin, finish = 0.0, end - start  # circular lanes are there from end to end
                if not hasattr(lane, "angle"):
                    begin, left = road[0].local_coordinates(lane.start)
                    finish, right = road[0].local_coordinates(lane.end)
                    if max(abs(left - k * self.lane_width), abs(right - k * self.lane_width)) > 0.5:
                        continue  # it comes from elsewhere
                there = (self.s > start + begin - 0.1) & (self.s < min(start + finish, end))
                lanes[there & (lanes == k)] = k + 1
        lanes[self.s >= self.starts[-1]] = len(roads[-1])
        self.left, self.right = -self.lane_width / 2, (lanes - 0.5) * self.lane_width  # [m] its edges
        self.targets = self.lane_width * np.arange(min(len(road) for road in roads))  # [m] middles of the lanes all along it
        self.targets = np.clip(self.targets, self.left + 2.05, self.targets[-1] + self.lane_width / 2 - 2.05)

    @property
    def junctions(self) -> list[Junction]:
        """Junctions on the route."""
        spans: dict[str, tuple[float, float]] = {}  # of the blocks [m]
        for name, start, end in zip(self.checkpoints[1:], self.starts[:-1], self.starts[1:], strict=True):
            block = BLOCK.match(name)
            if block and block[2] in JUNCTIONS:
                spans[block[0]] = spans.get(block[0], (start, end))[0], end
        headings = {place: self.heading[self.index(place)] for span in spans.values() for place in span}
        return [
            Junction(float(start), float(end), way_through(float(headings[start] - headings[end])), name.endswith("O"))
            for name, (start, end) in spans.items()
        ]

    def now(self, navigation: Any) -> tuple[float, float]:
        """
        Tell where on the route the ego is to be looked for.

        :param navigation: MetaDrive's, of this route
        :return: [m] from where to where along it
        """
        k = min(max(int(navigation._target_checkpoints_index[0]), 0), len(self.starts) - 2)
        return self.starts[k] - 10.0, self.starts[k + 1] + 20.0

    def is_of(self, navigation: Any) -> bool:
        """Tell whether this is the route of a navigation as it is now."""
        return self.map is navigation.map and self.checkpoints == navigation.checkpoints
