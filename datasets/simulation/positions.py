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


def first_to_each(count: int, displacements: Sequence[Displacement]) -> list[Displacement]:
    """Of displacements in the order in which they were driven those that lead to something new: no loop is closed.

    Those that are to be kept as they are come before the others, since they must hold.

    >>> round_trip = [Displacement(a, (a + 1) % 3, np.ones(2), 1.0) for a in range(3)]
    >>> [(d.a, d.b) for d in first_to_each(3, round_trip)]
    [(0, 1), (1, 2)]
    """
    part = list(range(count))
    chosen = []
    for d in sorted(displacements, key=lambda d: d.sigma is not None):
        a, b = part[d.a], part[d.b]
        if a != b:
            part = [a if p == b else p for p in part]
            chosen.append(d)
    return chosen
