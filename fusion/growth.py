"""A hypothesis grows: associate with the predicted covariances as gates, solve, associate again until it stands still.

From a local seed the match spreads along both maps: where the prediction is still wide nothing beats the local density
of landmarks, so far ends are matched only once what lies between has pulled the maps together. Two maps whose ends
disagree by metres through drift still match as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .config import SolvingConfig, chi2_gate
from .elastic import NO_HEADING_SIGMA, PRIOR_SIGMA, Joined, growth_kernels, joined_each, side
from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Pairs = tuple[tuple[int, int], ...]

#: So many proposed matches place map 2 by themselves.
ENOUGH = 4
#: Turned by so much [rad] against each other, two hypotheses are different answers although they share their pairs.
ANOTHER_TURN = 0.5
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

    @property
    def places_map2(self) -> bool:
        """Whether the matches determine T12: a single one does so only by its heading."""
        return len(self.i) > 1 or bool(self.joined.arms.variance[0] < NO_HEADING_SIGMA**2)


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


def grow(
    m1: PreparedMap,
    m2: PreparedMap,
    T12: Array,
    seed: Pairs,
    config: SolvingConfig,
    may_match: NDArray[np.bool_] | None = None,
    known: Pairs = (),
) -> Growth:
    """Grow a hypothesis from seed pairs (places in map 1, in map 2) at ``T12`` (3,) until the matches stand still.

    ``may_match`` (n1, n2): which pairs may be the same (`compatible`, worked out once for all hypotheses).
    ``known``: pairs that are matches whatever their residuals say.
    """
    may = compatible(m1, m2) if may_match is None else may_match
    start, fixed = (_partners(len(m1), pairs) for pairs in (seed, known))
    i, j, T0, rounds, at_rest = growth_kernels().grown(
        side(m1), side(m2), np.asarray(T12, dtype=float), start, may, fixed, _limits(config)
    )
    return Growth(Joined(m1, m2, T0, i, j, at_rest), rounds)


def grow_distinct(
    m1: PreparedMap,
    m2: PreparedMap,
    T12s: Array,
    count: Index,
    seeds: Index,
    matches: Index,
    config: SolvingConfig,
    may_match: NDArray[np.bool_],
) -> list[Growth]:
    """Every distinct one of h hypotheses at ``T12s`` (h, 3) grown.

    Those whose seed an earlier one explains are the same answer.

    Where growth from the seed comes to fewer matches than were proposed, ``count`` (h,), it also starts from all of
    these: a single heading that is off, or noise that is stated too small, would else lose the place. ``seeds``,
    ``matches`` (h, n1): partners of map 1's landmarks, -1 without.
    """
    kernels = growth_kernels()
    proposals = kernels.Proposals(T12s, count, seeds, matches)
    T0s, rounds, partners = kernels.grown_all(
        side(m1), side(m2), proposals, may_match, ENOUGH, ANOTHER_TURN, _limits(config)
    )
    return [Growth(one, n) for one, n in zip(joined_each(m1, m2, T0s, partners), rounds.tolist(), strict=True)]


def _partners(n1: int, pairs: Pairs) -> Index:
    """Of each of n1 landmarks of map 1 its partner in map 2, or -1; (n1,)."""
    partner = np.full(n1, -1, dtype=np.intp)
    for i, j in pairs:
        partner[i] = j
    return partner


def _limits(config: SolvingConfig) -> Any:
    """What a match must pass (`_growth_kernels.Limits`)."""
    gate2, gate3 = _gates(config.gate_probability)
    return growth_kernels().Limits(
        float(config.match_odds), gate2, gate3, CONTRADICTION, config.max_rounds, PRIOR_SIGMA
    )


@cache
def _gates(probability: float) -> tuple[float, float]:
    """Chi-square gates of two and of three degrees of freedom."""
    return float(chi2_gate(probability, 2)), float(chi2_gate(probability, 3))
