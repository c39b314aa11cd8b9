"""What matches are worth: how much closer matched landmarks lie than landmarks of two places would by chance.

Along corridors only the residual along the corridor counts, given the matches before; point landmarks count in the
plane (docs/evidence.md, "Why one dimension along corridors").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .background import Background
from .elastic import PRIOR_SIGMA, Joined, Several, growth_kernels
from .regularity import corridor_kernels

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def corridor_matches(several: Several, background: Background, angle: float) -> tuple[Array, Array]:
    """Matched corridor landmarks of g hypotheses (g,) [nats]: density of the residual along the corridor, given those
    before; and what a regular building takes off that. Corridors go straight on within ``angle`` [rad].

    The order and the corridors are those of either map; the mean of both, so that neither map is the first.
    """
    regularity, each = background.regularity(angle), several.each
    coincide, contradict = (np.concatenate(side) for side in zip(*(one.arms_met for one in each), strict=True))
    matches, regular = corridor_kernels().all_on_corridors(
        *(*background.corridors, regularity.gaps1.table, regularity.gaps2.table, background.worth, regularity.pitch),
        *(several.turns, several.begin, several.i, several.j, coincide, contradict),
        *(np.concatenate([one.covariance.ravel() for one in each]), np.concatenate([one.r for one in each])),
        several.p1,
    )
    return matches, regular


def _in_order(joined: Joined, order: Index) -> tuple[Array, Array]:
    """Innovation (k, 3) and covariance (k, 3, 3) of each of the pairs ``order`` given those before it."""
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    found: tuple[Array, Array] = corridor_kernels().given_before(joined.covariance[np.ix_(rows, rows)], joined.r[rows])
    return found


def point_matches(joined: Joined, background: Background) -> float:
    """Matched point landmarks [nats]: density of the residual in the plane, given the corridor landmarks and those
    before."""
    if not background.has_points:
        return 0.0
    is_point = background.points1[joined.i] & background.points2[joined.j]
    if not is_point.any():
        return 0.0
    order = np.concatenate([np.flatnonzero(~is_point), np.flatnonzero(is_point)])
    first = int((~is_point).sum())
    density, _ = growth_kernels().densities(*_in_order(joined, order))
    i, j = joined.i[order[first:]], joined.j[order[first:]]
    worth = background.there1[i] + background.there2[j] - np.log(background.rates1[i])
    return float((density[first:] + worth).sum())


def corridor_prior(background: Background, overlap: Array) -> Array:
    """Density of T12 before looking (...) [nats per m], where corridors lie on corridors along ``overlap`` (...) [m].

    A random stretch of corridor 1 lies on a random stretch of corridor 2, in one of two directions.
    """
    lengths = [max(m.corridor_length, 1.0) for m in (background.m1, background.m2)]
    return np.log(np.maximum(overlap, 1.0) / (2 * lengths[0] * lengths[1]))


def point_prior(background: Background) -> float:
    """Density of T12 before looking [nats], where only points place map 2.

    Uniform over the turns and over the shifts that let the two seen areas touch, in place of the wide normal prior
    under which the residuals were weighed.
    """
    extent = sum(float(np.sqrt(max(area.own_area, 1.0) / np.pi)) for area in (background.area1, background.area2))
    wide = float(np.log(2 * np.pi) * 1.5 + np.log(PRIOR_SIGMA).sum())
    return wide - float(np.log(np.pi * extent**2 * 2 * np.pi))
