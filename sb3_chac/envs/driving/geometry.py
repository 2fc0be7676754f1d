"""Angles and boxes in the plane, metres and radians."""

import numpy as np

SPACING = 0.5  # [m] between the points of a sampled path


def wrap_angle(angle):
    """
    Bring an angle into one turn.

    :param angle: [rad], a float or an array
    :return: the same angle within [-pi, pi)
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi


def half_extents(length, width, angle):
    """
    Measure how far a rotated box reaches from its centre.

    :return: half of the extent of a box of ``length`` x ``width`` [m], rotated by ``angle`` [rad], along and across the axes
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
    Test whether rectangles overlap: they do unless one of their four axes separates them (separating axis theorem).

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
