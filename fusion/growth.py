"""A hypothesis grows: associate with the predicted covariances as gates, solve, associate again until it stands still.

From a local seed the match spreads along both maps: where the prediction is still wide nothing beats the local density
of landmarks, so far ends are matched only once what lies between has pulled the maps together. Two maps whose ends
disagree by metres through drift still match as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mapfuse.datasets import se2

from .config import SolvingConfig, chi2_gate
from .elastic import NO_HEADING_SIGMA, ArmOverlay, Joined
from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Pairs = tuple[tuple[int, int], ...]

#: Standard deviation of T12's prior [m, m, rad]: wide, so that the matches decide; the evidence has its own volume.
PRIOR_SIGMA = np.array([100.0, 100.0, np.pi])
#: Taken off a match [nats] for every arm that meets one of the other passability.
CONTRADICTION = 2.5


@dataclass(frozen=True, eq=False)
class Growth:
    """A hypothesis at rest: which landmarks are the same, and both maps joined there."""

    joined: Joined
    rounds: int

    @property
    def i(self) -> Index:
        """Matched landmarks of map 1 (k,)."""
        return self.joined.i

    @property
    def j(self) -> Index:
        """Matched landmarks of map 2 (k,)."""
        return self.joined.j

    @cached_property
    def pairs(self) -> frozenset[tuple[int, int]]:
        """The matches as (place in map 1, place in map 2)."""
        return frozenset(zip(self.i.tolist(), self.j.tolist(), strict=True))

    @cached_property
    def placed2(self) -> Array:
        """All of map 2's landmarks where T12 takes them (n2, 2) [m, frame 1]."""
        return np.asarray(se2.transform(self.joined.T12, self.joined.m2.positions))

    @property
    def places_map2(self) -> bool:
        """Whether the matches determine T12: a single one does so only by its heading."""
        return len(self.i) > 1 or bool(self.joined.arms.variance[self.i, self.j].min() < NO_HEADING_SIGMA**2)


def compatible(m1: PreparedMap, m2: PreparedMap, known: Pairs = ()) -> NDArray[np.bool_]:
    """Pairs of landmarks that may be the same: equal types (H1), (n1, n2).

    A landmark whose partner is ``known`` (places in map 1, in map 2) may be no other.
    """
    may = np.asarray(np.array(m1.map.types)[:, None] == np.array(m2.map.types)[None, :])
    for i, j in known:
        may[i, :] = may[:, j] = False
    for i, j in known:
        may[i, j] = True
    return may


def _one_to_one(i: Index, j: Index, gain: Array) -> NDArray[np.bool_]:
    """The one-to-one choice of pairs with the greatest total gain (all gains positive)."""
    chosen = np.zeros(len(i), dtype=bool)
    alone = (np.bincount(i)[i] == 1) & (np.bincount(j)[j] == 1)
    chosen[alone] = True
    rest = np.flatnonzero(~alone)
    if len(rest):
        rows, row = np.unique(i[rest], return_inverse=True)
        columns, column = np.unique(j[rest], return_inverse=True)
        table = np.zeros((len(rows), len(columns)))
        place = np.full(table.shape, -1)
        table[row, column] = gain[rest]
        place[row, column] = rest
        picked = place[linear_sum_assignment(table, maximize=True)]
        chosen[picked[picked >= 0]] = True
    return chosen


def _log_density(innovation: Array, V: Array) -> tuple[Array, Array]:
    """Log normal density of the position part [nats per m^2] and squared Mahalanobis distance of the whole."""
    xy, C = innovation[:, :2], V[:, :2, :2]
    d2 = np.einsum("ki,ki->k", xy, np.linalg.solve(C, xy[..., None])[..., 0])
    density = -0.5 * d2 - 0.5 * np.log(np.linalg.det(C)) - np.log(2 * np.pi)
    whole = np.einsum("ki,ki->k", innovation, np.linalg.solve(V, innovation[..., None])[..., 0])
    return density, whole


def _associate(
    joined: Joined, open_pairs: NDArray[np.bool_], config: SolvingConfig, reach: float
) -> tuple[Index, Index]:
    """The best one-to-one matches under what is joined so far; pairs already matched are judged by the others."""
    m1, m2 = joined.m1, joined.m2
    near = open_pairs & (np.linalg.norm(joined.quick_innovation(), axis=2) < reach)
    near[joined.i, joined.j] = False
    i, j = np.nonzero(near)
    innovation, V = joined.predict(i, j)
    if len(joined.i) > 2:
        loo_innovation, loo_V = joined.leave_one_out()
        i, j = np.concatenate([joined.i, i]), np.concatenate([joined.j, j])
        innovation, V = np.concatenate([loo_innovation, innovation]), np.concatenate([loo_V, V])
    if not len(i):
        return joined.i, joined.j
    density, d2 = _log_density(innovation, V)
    clutter = np.log(np.maximum(m1.local_density[i], m2.local_density[j]))
    gain = density - clutter - CONTRADICTION * joined.arms.contradict[i, j]
    dof = np.where(joined.arms.variance[i, j] < NO_HEADING_SIGMA**2, 3, 2)
    passes = (gain > config.match_odds) & (d2 < chi2_gate(config.gate_probability, dof))
    if len(joined.i) <= 2:
        free = passes & ~np.isin(i, joined.i) & ~np.isin(j, joined.j)
        kept = np.flatnonzero(free)[_one_to_one(i[free], j[free], gain[free] - config.match_odds)]
        return np.concatenate([joined.i, i[kept]]), np.concatenate([joined.j, j[kept]])
    kept = np.flatnonzero(passes)[_one_to_one(i[passes], j[passes], gain[passes] - config.match_odds)]
    return i[kept], j[kept]


def _with_known(i: Index, j: Index, known: Pairs) -> tuple[Index, Index]:
    """The matches, and the known ones where they aren't among them."""
    lacking = [pair for pair in known if pair not in set(zip(i.tolist(), j.tolist(), strict=True))]
    more_i, more_j = (np.array(side, dtype=np.intp) for side in (zip(*lacking, strict=True) if lacking else ((), ())))
    return np.concatenate([i, more_i]), np.concatenate([j, more_j])


def _prune(joined: Joined, config: SolvingConfig, known: Pairs = ()) -> Joined:
    """Drop, one by one, the pair that fits the others worst, until all pass the gate; known ones stay."""
    while len(joined.i) > 2:
        innovation, V = joined.leave_one_out()
        _, d2 = _log_density(innovation, V)
        d2 = np.where([pair in known for pair in zip(joined.i.tolist(), joined.j.tolist(), strict=True)], 0.0, d2)
        worst = int(np.argmax(d2))
        if d2[worst] < chi2_gate(config.gate_probability, 3):
            break
        keep = np.arange(len(joined.i)) != worst
        joined = joined_at(joined, joined.T0, joined.i[keep], joined.j[keep])
    return joined


def joined_at(like: Joined, T0: Array, i: Index, j: Index) -> Joined:
    """The same two maps joined at other pairs, linearised at ``T0`` (3,)."""
    order = np.lexsort((j, i))
    arms = like.arms if abs(T0[2] - like.T0[2]) < 1e-9 else ArmOverlay.at(like.m1, like.m2, float(T0[2]))
    return Joined(like.m1, like.m2, T0, arms, i[order], j[order], PRIOR_SIGMA)


def grow(
    m1: PreparedMap,
    m2: PreparedMap,
    T12: Array,
    seed: tuple[tuple[int, int], ...],
    config: SolvingConfig,
    may_match: NDArray[np.bool_] | None = None,
    known: Pairs = (),
) -> Growth:
    """Grow a hypothesis from seed pairs (places in map 1, in map 2) at ``T12`` (3,) until the matches stand still.

    ``may_match`` (n1, n2): which pairs may be the same (`compatible`, worked out once for all hypotheses).
    ``known``: pairs that are matches whatever their residuals say.
    """
    may = compatible(m1, m2) if may_match is None else may_match
    i, j = (np.array(side, dtype=np.intp) for side in zip(*seed, strict=True))
    T12 = np.asarray(T12, dtype=float)
    joined = Joined(m1, m2, T12, ArmOverlay.at(m1, m2, float(T12[2])), i, j, PRIOR_SIGMA)
    joined = joined_at(joined, joined.T12, i, j)
    seen: set[tuple[tuple[int, int], ...]] = set()
    rounds = 0
    for rounds in range(1, config.max_rounds + 1):
        i, j = _associate(joined, may, config, reach=5.0 + 2.0 * rounds)
        i, j = _with_known(i, j, known)
        if len(i) < 2:
            break
        grown = joined_at(joined, joined.T0, i, j)
        grown = _prune(joined_at(grown, grown.T12, grown.i, grown.j), config, known)
        pairs = tuple(zip(grown.i.tolist(), grown.j.tolist(), strict=True))
        joined = joined_at(grown, grown.T12, grown.i, grown.j)
        if pairs in seen:
            break
        seen.add(pairs)
    return Growth(joined, rounds)
