"""Two maps joined at some landmarks as one Gaussian: what the matches so far say about every other pair.

The residual of a pair k = (i, j) is ``r_k = p1_i - T12 p2_j`` with the difference of headings below it. Over pairs
its covariance is ``P1[i, i'] + B P2[j, j'] B' + J S_T J' + [same pair] R`` (docs/evidence.md, "Elastic match"):
the maps bend as their own covariances allow, and two pairs share the errors of both maps. T12 has a wide prior S_T.
The loops are compiled (`_growth_kernels`), and are those that grow a hypothesis.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets.compiled import kernels

from .prepared import PreparedMap
from .regularity import corridor_kernels

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Standard deviation [rad] that stands for "no heading to compare".
NO_HEADING_SIGMA = 10.0
#: Standard deviation of T12's prior [m, m, rad]: wide, so that the matches decide; the evidence has its own volume.
PRIOR_SIGMA = np.array([100.0, 100.0, np.pi])


def growth_kernels() -> ModuleType:
    """The compiled loops (`_growth_kernels`)."""
    return kernels("_growth_kernels", __package__, "what grows a hypothesis")


_sides: WeakKeyDictionary[PreparedMap, Any] = WeakKeyDictionary()


def side(m: PreparedMap) -> Any:
    """A map as the compiled loops take it (`_growth_kernels.Side`); made once for each."""
    found = _sides.get(m)
    if found is None:
        found = _sides[m] = _side(m)
    return found


def _side(m: PreparedMap) -> Any:
    times = m.noise_scale**2
    return growth_kernels().Side(
        m.positions,
        m.headings,
        m.covariance if times == 1.0 else m.covariance * times,
        m.arm_headings,
        m.arm_passable,
        m.arm_travelled,
        ~m.has_arms,
        m.arms_in_covariance,
        times * m.map.noise.heading_sigma**2 / 2,
        m.local_density,
    )


@dataclass(frozen=True, eq=False)
class ArmOverlay:
    """Arms of k pairs of landmarks laid on each other under one rotation; all arrays are (k,).

    ``coincide``, ``contradict``: how many arms meet one of the same, of the other passability. ``shift`` [rad]: mean
    heading difference of those that meet (NaN where none do). ``variance`` [rad^2]: of the heading difference beyond
    the maps' own covariance: same place, and arms that only one map has; where there is no heading at all, wide.
    """

    coincide: Index
    contradict: Index
    shift: Array
    variance: Array

    @classmethod
    def at(cls, m1: PreparedMap, m2: PreparedMap, rotation: float, i: Index, j: Index) -> ArmOverlay:
        """Overlay of landmarks ``i`` of map 1 and ``j`` of map 2 under a rotation [rad] of map 2 into map 1."""
        return cls(*growth_kernels().overlays(side(m1), i, side(m2), j, float(rotation)))


@dataclass(frozen=True, eq=False)
class Joined:
    """Two maps given that the landmarks ``i`` of map 1 are the landmarks ``j`` of map 2, linearised at ``T0``.

    ``known``: what the compiled loop that found them has worked out already (`_growth_kernels.at_rest`).
    """

    m1: PreparedMap
    m2: PreparedMap
    T0: Array
    i: Index
    j: Index
    known: tuple[Any, ...] | None = field(default=None, repr=False)

    @cached_property
    def _sides(self) -> tuple[Any, Any]:
        return side(self.m1), side(self.m2)

    @property
    def _at_rest(self) -> tuple[Any, ...]:
        """What is asked most, in one compiled call."""
        return self._worked_out if self.known is None else self.known

    @cached_property
    def _worked_out(self) -> tuple[Any, ...]:
        found: tuple[Any, ...] = growth_kernels().at_rest(*self._sides, self.T0, self.i, self.j, PRIOR_SIGMA)
        return found

    @cached_property
    def _solved(self) -> tuple[Any, ...]:
        found: tuple[Any, ...] = growth_kernels().joined(*self._sides, self.T0, self.i, self.j, PRIOR_SIGMA)
        return found

    @property
    def arms_met(self) -> tuple[Index, Index]:
        """How many arms of each pair meet one of the same, of the other passability (k,)."""
        return self._at_rest[0], self._at_rest[1]

    @cached_property
    def arms(self) -> ArmOverlay:
        """Arms of the pairs laid on each other."""
        return ArmOverlay(*self._at_rest[:4])

    @cached_property
    def J(self) -> Array:
        """Jacobians of the pairs by T12 (3k, 3), for errors added to (x, y, theta) of T12."""
        J = np.tile(np.eye(3), (len(self.j), 1, 1))
        J[:, 0, 2], J[:, 1, 2] = growth_kernels().levers(self._sides[1], self.T0, self.j)
        return J.reshape(-1, 3)

    @property
    def covariance(self) -> Array:
        """Of the residuals, T12's prior included (3k, 3k)."""
        return np.asarray(self._at_rest[4])

    @property
    def r(self) -> Array:
        """Residuals at ``T0`` (3k,)."""
        return np.asarray(self._at_rest[5])

    @property
    def inverse_factor(self) -> Array:
        """Inverse of the Cholesky factor of `covariance` (3k, 3k), lower triangular."""
        return np.asarray(self._solved[1])

    @property
    def weights(self) -> Array:
        """C^-1 r (3k,)."""
        return np.asarray(self._solved[2])

    @property
    def T12(self) -> Array:
        """Posterior mean of T12 (3,)."""
        return np.asarray(self._at_rest[6])

    @property
    def T12_covariance(self) -> Array:
        """Posterior covariance of T12 (3, 3)."""
        return np.asarray(self._at_rest[7])

    def corrected(self) -> tuple[Array, Array]:
        """Posterior positions of both maps' landmarks in frame 1, (n1, 2) and (n2, 2): each map bent onto the other."""
        return self._at_rest[8], self._at_rest[9]

    def predict(self, i: Index, j: Index) -> tuple[Array, Array]:
        """Innovation (k, 3) and its covariance (k, 3, 3) of further pairs, given the pairs so far."""
        found: tuple[Array, Array] = growth_kernels().predicted(
            *self._sides, self.T0, self.i, self.j, self.inverse_factor, self.weights, i, j, PRIOR_SIGMA
        )
        return found

    def leave_one_out(self) -> tuple[Array, Array]:
        """Innovation (k, 3) and covariance (k, 3, 3) of each pair given all the others."""
        found: tuple[Array, Array] = growth_kernels().left_out(self.inverse_factor, self.weights)
        return found

    def sequential(self) -> tuple[Array, Array]:
        """Innovation (k, 3) and covariance (k, 3, 3) of each pair given those before it, T12's prior included."""
        found: tuple[Array, Array] = corridor_kernels().given_before(self.covariance, self.r)
        return found


def joined_each(m1: PreparedMap, m2: PreparedMap, T0s: Array, partners: Index) -> list[Joined]:
    """Two maps joined in g ways, linearised at ``T0s`` (g, 3).

    ``partners`` (g, n1): of map 1's landmarks in map 2, -1 without.
    """
    found = growth_kernels().all_at_rest(side(m1), side(m2), T0s, partners, PRIOR_SIGMA)
    begin, i, j, *arms, C, r, T12s, covariances, p1, p2 = found
    joined, at = [], 0
    for h, (a, b) in enumerate(pairwise(begin.tolist())):
        rows, of = 3 * (b - a), slice(a, b)
        own_C, at = C[at : at + rows * rows].reshape(rows, rows), at + rows * rows
        known = (*(x[of] for x in arms), own_C, r[3 * a : 3 * b], T12s[h], covariances[h], p1[h], p2[h])
        joined.append(Joined(m1, m2, T0s[h], i[of], j[of], known))
    return joined


@dataclass(frozen=True, eq=False)
class Several:
    """g hypotheses of one pair of maps, each with a match at least, as compiled loops take them all at once.

    The matches of hypothesis h are those from ``begin[h]`` to ``begin[h + 1]`` of ``i`` and ``j``, ``begin`` (g + 1,).
    ``T12s`` (g, 3): their T12, ``turns`` (g,) its rotation; ``p1`` (g, n1, 2), ``p2`` (g, n2, 2): where all landmarks
    then are (`Joined.corrected`).
    """

    each: tuple[Joined, ...]
    begin: Index
    i: Index
    j: Index
    T12s: Array
    turns: Array
    p1: Array
    p2: Array

    @classmethod
    def of(cls, joined: Iterable[Joined]) -> Several:
        """Of one hypothesis at least."""
        each = tuple(joined)
        begin = np.zeros(len(each) + 1, dtype=np.intp)
        np.cumsum([len(one.i) for one in each], out=begin[1:])
        i, j = (np.concatenate([getattr(one, name) for one in each]) for name in ("i", "j"))
        p1, p2 = (np.stack(side) for side in zip(*(one.corrected() for one in each), strict=True))
        T12s = np.stack([one.T12 for one in each])
        return cls(each, begin, i, j, T12s, T12s[:, 2].copy(), p1, p2)

    def sums(self, of_matches: ArrayLike) -> Array:
        """Sum (g,) over each one's matches of a number of every match (k,)."""
        return np.asarray(np.add.reduceat(of_matches, self.begin[:-1]))
