"""Recorded positions: least squares over the displacements that the links say, loop closures included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..values import frozen_array

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Displacement:
    """``xy`` (2,) [m, map frame] from landmark ``a`` to ``b``; ``sigma`` [m] per axis, None: to be kept as it is."""

    a: int
    b: int
    xy: Array
    sigma: float | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy", frozen_array(self.xy))


def solve_positions(count: int, anchor: int, at: Array, displacements: Sequence[Displacement]) -> Array:
    """Positions (count, 2) with landmark ``anchor`` held ``at`` (2,): the Karush-Kuhn-Tucker system, both axes at once.

    The displacements must link all landmarks, and those to be kept must not close a loop.

    >>> ways = [Displacement(0, 1, np.array([2.0, 0.0]), 1.0), Displacement(0, 1, np.array([4.0, 0.0]), 1.0)]
    >>> solve_positions(2, 0, np.zeros(2), ways).tolist()
    [[0.0, 0.0], [3.0, 0.0]]
    """
    kept = [d for d in displacements if d.sigma is None]
    rows = 1 + len(kept)
    A, b = np.zeros((count + rows, count + rows)), np.zeros((count + rows, 2))
    for d in displacements:
        if d.sigma is not None:
            difference = np.zeros(count)
            difference[d.a], difference[d.b] = -1.0, 1.0
            A[:count, :count] += np.outer(difference, difference) / d.sigma**2
            b[:count] += np.outer(difference, d.xy) / d.sigma**2
    A[count, anchor] = A[anchor, count] = 1.0
    b[count] = at
    for row, d in enumerate(kept, start=count + 1):
        A[row, d.a] = A[d.a, row] = -1.0
        A[row, d.b] = A[d.b, row] = 1.0
        b[row] = d.xy
    return np.asarray(np.linalg.solve(A, b)[:count], dtype=float)
