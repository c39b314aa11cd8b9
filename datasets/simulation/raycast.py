"""Rays against wall segments, all at once: ranges as a laser or a sonar ring would measure them, and free sight."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Walls count as this much longer [m] at either end, so that no ray slips through where two of them meet.
JOINT = 1e-6


def distances(points: ArrayLike, segments: Array) -> Array:
    """Distance [m] from each of ``points`` (k, 2) to each of ``segments`` (n, 2, 2), as (k, n).

    >>> distances([[0.0, 2.0]], np.array([[[1.0, 0.0], [5.0, 0.0]]])).round(3).tolist()
    [[2.236]]
    """
    away = np.asarray(points, dtype=float)[:, None] - nearest_points(points, segments)
    return np.hypot(away[..., 0], away[..., 1])


def nearest_points(points: ArrayLike, segments: Array) -> Array:
    """The point of each of ``segments`` (n, 2, 2) that is nearest to each of ``points`` (k, 2), as (k, n, 2)."""
    points = np.asarray(points, dtype=float)
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    square = np.maximum(np.einsum("ni,ni->n", along, along), np.finfo(float).tiny)
    share = np.einsum("kni,ni->kn", points[:, None] - start, along) / square
    return np.asarray(start + np.clip(share, 0, 1)[..., None] * along, dtype=float)


def cast(origin: ArrayLike, directions: ArrayLike, walls: Array, reach: float = np.inf) -> Array:
    """Distance [m] from ``origin`` (2,) to the first of ``walls`` (n, 2, 2) along each of ``directions`` (k,) [rad].

    Infinite where nothing stands within ``reach`` [m]. Only walls within reach are looked at, so that a scan costs
    what stands around it and not the size of the building.

    >>> wall = np.array([[[2.0, -1.0], [2.0, 1.0]]])
    >>> cast([0.0, 0.0], [0.0, np.pi], wall).tolist(), cast([0.0, 0.0], [0.0], wall, reach=1.0).tolist()
    ([2.0, inf], [inf])
    """
    origin, directions = np.asarray(origin, dtype=float), np.asarray(directions, dtype=float)
    near = walls[distances(origin[None], walls)[0] <= reach] if np.isfinite(reach) else walls
    if not len(near):
        return np.full(directions.shape, np.inf)
    start, along = near[:, 0] - origin, near[:, 1] - near[:, 0]
    # origin + r (c, s) = start + u along, solved for r and u by Cramer's rule
    c, s = np.cos(directions)[:, None], np.sin(directions)[:, None]
    determinant = c * along[:, 1] - s * along[:, 0]
    parallel = np.abs(determinant) < 1e-15
    safe = np.where(parallel, 1.0, determinant)
    r = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / safe
    u = (start[:, 0] * s - start[:, 1] * c) / safe
    slack = JOINT / np.maximum(np.hypot(along[:, 0], along[:, 1]), JOINT)
    hit = ~parallel & (u >= -slack) & (u <= 1 + slack) & (r >= 0) & (r <= reach)
    return np.asarray(np.where(hit, r, np.inf).min(axis=1), dtype=float)


def clear(origin: ArrayLike, points: ArrayLike, walls: Array) -> NDArray[np.bool_]:
    """Whether no wall stands between ``origin`` (2,) and each of ``points`` (k, 2)."""
    away = np.asarray(points, dtype=float) - np.asarray(origin, dtype=float)
    if not len(away):
        return np.zeros(0, dtype=bool)
    distance = np.hypot(away[:, 0], away[:, 1])
    directions = np.arctan2(away[:, 1], away[:, 0])
    near = walls[distances(np.asarray(origin, dtype=float)[None], walls)[0] <= distance.max()]
    return np.asarray(cast(origin, directions, near) >= distance, dtype=bool)
