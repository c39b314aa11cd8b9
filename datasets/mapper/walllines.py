"""Walls as lines that the smoother estimates: a point of a wall, seen from a keyframe, lies on the wall's line.

A line is a direction ``phi`` [rad] of its normal and an offset ``d`` [m] from an anchor, a point near the wall in the
map's frame: what lies at p is off by ``n(phi) . (p - anchor) - d``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False, slots=True)
class WallPoints:
    """Points (m, 2) [m] of walls in the frames of the keyframes ``keyframe`` (m,), on lines ``line`` (m,).

    ``sigma`` (m,) [m]: of each sideways. ``anchors`` (w, 2) [m]: of the lines, in the map's frame.
    """

    keyframe: Indices
    line: Indices
    points: Array
    sigma: Array
    anchors: Array

    def __len__(self) -> int:
        return len(self.line)

    def residuals(self, poses: Array, lines: Array) -> tuple[Array, Array, Array]:
        """Offsets in sigmas (m,) and their derivatives by the keyframe's pose (m, 3) and the line (m, 2)."""
        pose, line = poses[self.keyframe], lines[self.line]
        off = se2.transform(pose, self.points)
        arm = off - pose[:, :2]
        off = off - self.anchors[self.line]
        c, s = np.cos(line[:, 0]), np.sin(line[:, 0])
        r = c * off[:, 0] + s * off[:, 1] - line[:, 1]
        by_pose = np.stack([c, s, s * arm[:, 0] - c * arm[:, 1]], axis=1)
        by_line = np.stack([c * off[:, 1] - s * off[:, 0], -np.ones(len(r))], axis=1)
        return r / self.sigma, by_pose / self.sigma[:, None], by_line / self.sigma[:, None]

    def through(self, poses: Array, lines: Array) -> Array:
        """The lines (w, 2) that fit the points best, keyframes at ``poses``; ``lines`` say which way normals point.

        Total least squares; poses that turn by a tenth take walls along by metres, where the residuals' derivatives
        no longer hold.
        """
        count = len(lines)
        x, y = (se2.transform(poses[self.keyframe], self.points) - self.anchors[self.line]).T
        weight = self.sigma**-2.0

        def sums(values: Array) -> Array:
            return np.asarray(np.bincount(self.line, weight * values, count), dtype=float)

        total = sums(np.ones(len(x)))
        mx, my = sums(x) / total, sums(y) / total
        x, y = x - mx[self.line], y - my[self.line]
        along = np.arctan2(2 * sums(x * y), sums(x * x) - sums(y * y)) / 2
        # of the two normals the one that is nearer to the old one
        turned = np.remainder(along + np.pi / 2 - lines[:, 0] + np.pi / 2, np.pi) - np.pi / 2
        phi = lines[:, 0] + turned
        return np.column_stack([phi, np.cos(phi) * mx + np.sin(phi) * my])


def no_walls() -> WallPoints:
    """None at all."""
    nothing = np.zeros(0, dtype=np.intp)
    return WallPoints(nothing, nothing, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))
