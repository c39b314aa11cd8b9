"""The compass: its readings of a stretch as one, and the bend by steel as a field over the places.

Steel bends the compass by an angle that depends on the place. White noise, or a process along the time, would count
the same bend at a second visit as new information. It is a Gaussian field instead, with values at *nodes* as states:
two nodes at one place are one, whenever the robot came by.
"""

from __future__ import annotations

from math import atan2, cos, hypot, log, sin

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Added to the field's variance at each node, as a share, so that nodes at one place stay solvable.
JITTER = 1e-4


def bend_covariance(points1: ArrayLike, points2: ArrayLike, sigma: float, length: float) -> Array:
    """Covariance (n, m) [rad^2] of the bend at points (n, 2) with that at points (m, 2) [m].

    >>> bend_covariance([[0, 0]], [[0, 0], [4, 0]], 0.1, 4.0).round(5).tolist()
    [[0.01, 0.00607]]
    """
    p1, p2 = np.asarray(points1, dtype=float).reshape(-1, 2), np.asarray(points2, dtype=float).reshape(-1, 2)
    squared = np.sum((p1[:, None] - p2[None]) ** 2, axis=2)
    return np.asarray(sigma**2 * np.exp(-squared / (2 * length**2)), dtype=float)


def conditional(nodes: ArrayLike, point: ArrayLike, sigma: float, length: float) -> tuple[Array, float]:
    """Weights (n,) of the bend at ``nodes`` in that at a ``point``, and the variance [rad^2] that they leave."""
    nodes = np.asarray(nodes, dtype=float).reshape(-1, 2)
    cross = bend_covariance(point, nodes, sigma, length)[0]
    own = bend_covariance(nodes, nodes, sigma, length)
    own[np.diag_indices(len(nodes))] += JITTER * sigma**2
    weights = np.linalg.solve(own, cross)
    return weights, float(max(sigma**2 - weights @ cross, 0.0) + JITTER * sigma**2)


class CompassWindow(msgspec.Struct):
    """Readings of the last metres, each less the robot's turn since the keyframe; their mean is one reading.

    ``readings``: way [m] and difference [rad] of each.
    """

    readings: list[tuple[float, float]] = []

    def add(self, way: float, difference: float, window: float) -> None:
        """A reading less the turn since the keyframe; those further back than ``window`` [m] go."""
        self.readings.append((way, difference))
        if self.readings[0][0] < way - window or len(self.readings) > 400:
            self.readings = [r for r in self.readings if r[0] >= way - window][-200:]

    def turned(self, theta: float) -> None:
        """The next keyframe is turned by ``theta`` [rad] from the last one."""
        self.readings = [(way, difference + theta) for way, difference in self.readings]

    def mean(self) -> tuple[float, int]:
        """Mean direction [rad] of the window and the number of readings in it."""
        s = sum(sin(d) for _, d in self.readings)
        c = sum(cos(d) for _, d in self.readings)
        return atan2(s, c), len(self.readings)

    def spread(self) -> float:
        """Circular variance [rad^2] of the window's readings."""
        s = sum(sin(d) for _, d in self.readings)
        c = sum(cos(d) for _, d in self.readings)
        share = hypot(s, c) / max(1, len(self.readings))
        return -2 * log(max(share, 1e-9))
