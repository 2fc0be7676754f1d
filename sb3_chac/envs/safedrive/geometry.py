"""Plane geometry of roads and boxes. Metres and radians; x to the right, y down, so that positive angles turn right."""

from typing import NamedTuple

import numpy as np

from sb3_chac.envs.driving.geometry import SPACING


class Pose(NamedTuple):
    """Position [m] and heading [rad] in the plane."""

    x: float
    y: float
    heading: float

    def shifted(self, ahead: float, right: float = 0.0, turn: float = 0.0) -> "Pose":
        """
        Move and turn the pose.

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
        """
        Return where it ends.

        :param start: where it begins
        """
        if self.curvature == 0:
            return start.shifted(self.length)
        angle = self.length * self.curvature
        return start.shifted(np.sin(angle) / self.curvature, (1 - np.cos(angle)) / self.curvature, angle)

    def offset(self, right: float) -> "Segment":
        """
        Return the parallel segment.

        :param right: [m] how far to the right it is
        """
        shrink = 1 - right * self.curvature
        return Segment(self.length * shrink, self.curvature / shrink)

    def reverse(self) -> "Segment":
        """Return it as driven the other way."""
        return Segment(self.length, -self.curvature)


def turn(radius: float, angle: float) -> Segment:
    """
    Make the segment of a turn.

    :param radius: [m]
    :param angle: [rad], positive to the right
    """
    return Segment(radius * abs(angle), float(np.sign(angle)) / radius)


def chain(start: Pose, segments: list[Segment]) -> list[Pose]:
    """
    Compute the poses between segments.

    :return: the pose at the start of every segment, and at the end of the last
    """
    poses = [start]
    for segment in segments:
        poses.append(segment.end(poses[-1]))
    return poses


def sample(start: Pose, segments: list[Segment]) -> np.ndarray:
    """
    Sample points along segments.

    :return: one every ``SPACING``, shape (n, 4): x, y, heading, curvature
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
