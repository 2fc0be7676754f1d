"""Plane geometry of roads and boxes. Metres and radians; x to the right, y down, so that positive angles turn right."""

from typing import NamedTuple

import numpy as np

SPACING = 0.5  # [m] between the points of a sampled path


class Pose(NamedTuple):
    x: float
    y: float
    heading: float

    def shifted(self, ahead: float, right: float = 0.0, turn: float = 0.0) -> "Pose":
        """
        :param ahead: [m] along the heading
        :param right: [m] to the right of it
        :param turn: [rad] added to the heading
        """
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return Pose(self.x + ahead * cos - right * sin, self.y + ahead * sin + right * cos, self.heading + turn)


class Segment(NamedTuple):
    """A piece of line (curvature 0) or of circle: of ``length`` [m], turning right where ``curvature`` [1/m] is positive."""

    length: float
    curvature: float = 0.0

    def end(self, start: Pose) -> Pose:
        if self.curvature == 0:
            return start.shifted(self.length)
        angle = self.length * self.curvature
        return start.shifted(np.sin(angle) / self.curvature, (1 - np.cos(angle)) / self.curvature, angle)

    def offset(self, right: float) -> "Segment":
        """
        :param right: [m]
        :return: the parallel segment at that distance to the right
        """
        shrink = 1 - right * self.curvature
        return Segment(self.length * shrink, self.curvature / shrink)

    def reverse(self) -> "Segment":
        return Segment(self.length, -self.curvature)


def turn(radius: float, angle: float) -> Segment:
    """
    :param radius: [m]
    :param angle: [rad], positive to the right
    """
    return Segment(radius * abs(angle), float(np.sign(angle)) / radius)


def chain(start: Pose, segments: list[Segment]) -> list[Pose]:
    """
    :return: the pose at the start of every segment, and at the end of the last
    """
    poses = [start]
    for segment in segments:
        poses.append(segment.end(poses[-1]))
    return poses


def sample(start: Pose, segments: list[Segment]) -> np.ndarray:
    """
    :return: points every ``SPACING`` along the segments, shape (n, 4): x, y, heading, curvature
    """
    starts = np.cumsum([0.0, *(segment.length for segment in segments)])
    s = np.arange(0, starts[-1], SPACING)
    index = np.minimum(np.searchsorted(starts, s, side="right") - 1, len(segments) - 1)
    poses = np.array(chain(start, segments))[index]
    curvature = np.array([segment.curvature for segment in segments])[index]
    along = s - starts[index]
    angle = along * curvature
    bent = np.where(curvature == 0, 1.0, curvature)
    ahead = np.where(curvature == 0, along, np.sin(angle) / bent)
    right = np.where(curvature == 0, 0.0, (1 - np.cos(angle)) / bent)
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0] + ahead * cos - right * sin, poses[:, 1] + ahead * sin + right * cos
    return np.stack([x, y, poses[:, 2] + angle, curvature], axis=1)


def wrap_angle(angle):
    """
    :param angle: [rad], a float or an array
    :return: the same angle within [-pi, pi)
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi


def half_extents(length, width, angle):
    """
    :return: half of what a box of ``length`` x ``width``, rotated by ``angle``, extends along and across the axes
    """
    cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    return (length * cos + width * sin) / 2, (length * sin + width * cos) / 2


def boxes_overlap(
    position: np.ndarray,
    heading: np.ndarray | float,
    length: float,
    width: float,
    positions: np.ndarray,
    headings: np.ndarray,
    lengths: np.ndarray | float,
    widths: np.ndarray | float,
) -> np.ndarray:
    """
    Rectangles overlap unless one of their four axes separates them (separating axis theorem).

    :param position: centres, shape (..., 2)
    :return: whether the boxes overlap, shape (...)
    """
    dx, dy = positions[..., 0] - position[..., 0], positions[..., 1] - position[..., 1]
    cos, sin = np.cos(heading), np.sin(heading)
    along, across = half_extents(lengths, widths, headings - heading)
    apart = (np.abs(dx * cos + dy * sin) > length / 2 + along) | (np.abs(dy * cos - dx * sin) > width / 2 + across)
    cos, sin = np.cos(headings), np.sin(headings)
    along, across = half_extents(length, width, headings - heading)
    apart |= (np.abs(dx * cos + dy * sin) > lengths / 2 + along) | (np.abs(dy * cos - dx * sin) > widths / 2 + across)
    return ~apart
