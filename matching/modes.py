"""Which hypotheses are the same answer: T12s that move map 2's landmarks to the same places are one mode."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets import se2

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def displacement(T: ArrayLike, T_other: ArrayLike, points2: ArrayLike) -> Array:
    """Root mean square distance [m] between where two transformations take the points.

    ``T`` and ``T_other`` ``(..., 3)`` broadcast; ``points2`` (n, 2), n > 0, in frame 2. Closed form: with m the mean of
    the points and s their rms distance from it, ``|T m - T_other m|^2 + (2 s sin(dtheta / 2))^2``.

    >>> float(displacement([0, 0, 0], [0, 0, np.pi], [[1.0, 0.0], [-1.0, 0.0]]))
    2.0
    """
    T, T_other = np.asarray(T, dtype=float), np.asarray(T_other, dtype=float)
    points = np.asarray(points2, dtype=float)
    mean = points.mean(axis=0)
    spread = np.mean(np.sum((points - mean) ** 2, axis=1))
    moved = np.sum((se2.transform(T, mean) - se2.transform(T_other, mean)) ** 2, axis=-1)
    turned = 4 * spread * np.sin((T[..., 2] - T_other[..., 2]) / 2) ** 2
    return np.asarray(np.sqrt(moved + turned))


def distinct(T12s: ArrayLike, points2: ArrayLike, tolerance_m: float, limit: int) -> Indices:
    """Places of the distinct ones among transformations (k, 3) given best first; at most ``limit``.

    One is dropped when its `displacement` from a better one that is kept is ``tolerance_m`` or less.
    """
    T12s = np.asarray(T12s, dtype=float).reshape(-1, 3)
    left = np.arange(len(T12s))
    kept: list[int] = []
    while len(left) and len(kept) < limit:
        best = int(left[0])
        kept.append(best)
        left = left[1:]
        left = left[displacement(T12s[left], T12s[best], points2) > tolerance_m]
    return np.array(kept, dtype=np.intp)
