"""Which hypotheses of many pairs of maps can be true together: the most probable choice, and what it overrules.

Groups of maps grow one merge at a time, the best supported first. A merge lays one group on another; every pair of maps
across the two that has a candidate for that placement speaks for it, and a placement that other pairs speak for is its
rival. So a pair that is ambiguous alone is decided by the maps around it, and a wrong one is outvoted. Afterwards each
pair that was sure of itself and was not followed is given its chance: the choice is made again with it as the first
merge, and the choice that more evidence agrees with stays.

Derivation of the sums, and what was measured: docs/groups.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform

from .config import FuseConfig
from .pairwise import Comparison
from .placing import Against, Group, Meeting, Pair, Placer, group_kernels, own_weight

Array = NDArray[np.float64]

#: How often a choice is made again to give overruled pairs their chance.
MAX_APPEALS = 20
#: Overruled pairs that are heard before the best of them is followed, those that may win most: so many, and fewer
#: where there are so many maps that each takes long.
APPEALS_AT_ONCE, APPEALS_TIMES_MAPS = 8, 400
#: Placements that differ by less [m], [rad] may be the same: a cycle's covariance is looked at when it is closed.
NEAR = (3.0, 0.2)
#: Steps per nat in which a cut is counted.
CUT_STEPS = 1000


@dataclass(frozen=True, eq=False)
class Choice:
    """Groups of maps that share a frame, what placed them, and which pairs were overruled.

    ``groups``: names in alphabetical order; alone ones too. ``frames``: of every map the pose in its group's first
    map. ``chosen``: of the pairs that agree with their group the place of the candidate that does. ``overruled``: the
    cycle of maps that speaks against a pair's own answer. ``probability``: per group that all its merges are right.
    """

    groups: tuple[tuple[str, ...], ...]
    frames: Mapping[str, Transform]
    chosen: Mapping[Pair, int]
    overruled: Mapping[Pair, tuple[str, ...]]
    probability: tuple[float, ...]

    def agreement(self, comparisons: Mapping[Pair, Comparison]) -> float:
        """What all pairs that agree with the choice weigh [nats]."""
        return float(sum(own_weight(comparisons[pair], k) for pair, k in self.chosen.items()))


_Groups = Mapping[int, Group]
_Meetings = Mapping[tuple[int, int], Meeting]
#: Groups that pairs were compared across with each.
_Beside = Mapping[int, set[int]]


def choose(
    names: Iterable[str],
    comparisons: Mapping[Pair, Comparison],
    config: FuseConfig,
    against: Against | None = None,
    forbidden: frozenset[tuple[Pair, int]] = frozenset(),
) -> Choice:
    """The most probable consistent choice of at most one candidate per pair.

    ``comparisons``: by the pair's names in alphabetical order. ``against``: what the emptiness of two maps says
    against laying them on each other at ``T12`` where they have no candidate. ``forbidden``: candidates (pair, place)
    that must not be chosen. The result does not depend on the order of anything.
    """
    chooser = _Chooser(Placer(comparisons, config, against, forbidden))
    ordered = sorted(names)
    best, first = chooser.run(ordered, ()), tuple[Pair, ...]()
    for _ in range(MAX_APPEALS):
        agreement = best.agreement(comparisons)
        heard = chooser.unheard(best)[: max(1, min(APPEALS_AT_ONCE, APPEALS_TIMES_MAPS // max(len(ordered), 1)))]
        appeals = [(pair, chooser.run(ordered, (*first, pair))) for pair in heard]
        pair, other = max(appeals, key=lambda item: item[1].agreement(comparisons), default=(None, best))
        if pair is None or other.agreement(comparisons) <= agreement + 1e-9:
            return best
        best, first = other, (*first, pair)
    return best


class _Chooser:
    """Runs of merges; what one finds of two groups the next ones look up."""

    def __init__(self, placer: Placer) -> None:
        self.placer = placer
        self.comparisons = placer.comparisons
        self.accept = placer.config.decision.accept

    def run(self, names: Sequence[str], first: Sequence[Pair]) -> Choice:
        """Merge until nothing is sure any more; the pairs ``first`` before all others, by their own best candidate."""
        groups: dict[int, Group] = {k: Group((name,)) for k, name in enumerate(names)}
        for pair in first:
            p, q = sorted(next(k for k, group in groups.items() if name in group.names) for name in pair)
            if p != q:
                placement = self.placer.own_placement(groups[p], groups[q], pair)
                probability = float(self.comparisons[pair].probabilities[0])
                groups[p] = self.placer.merged(groups[p], groups.pop(q), placement, probability)
        at = {name: k for k, group in groups.items() for name in group.names}
        beside: dict[int, set[int]] = {k: set() for k in groups}
        for a, b in self.comparisons:
            if a in at and b in at and at[a] != at[b]:
                beside[at[a]].add(at[b])
                beside[at[b]].add(at[a])
        meetings = {(p, q): self.placer.meet(groups[p], groups[q]) for p in groups for q in beside[p] if p < q}
        supports: dict[tuple[int, int], float] = {}
        while (key := self._next(groups, meetings, beside, supports)) is not None:
            p, q = key
            meeting = meetings[key]
            around = (beside[p] | beside.pop(q)) - {p, q}
            groups[p] = self.placer.merged(groups[p], groups.pop(q), meeting.placements[0], meeting.probability)
            meetings = {other: meeting for other, meeting in meetings.items() if not {p, q} & set(other)}
            supports = {k: s for k, s in supports.items() if not ({p, q} & set(k) or around.issuperset(k))}
            beside[p] = around
            for other in around:
                beside[other] = (beside[other] - {q}) | {p}
                one, two = sorted((p, other))
                meetings[one, two] = self.placer.meet(groups[one], groups[two])
        return self._choice(sorted(groups.values(), key=lambda group: group.names))

    def unheard(self, choice: Choice) -> list[Pair]:
        """Pairs that are sure of themselves, that the choice doesn't follow, and that might outweigh what it follows.

        To follow one, the pairs that tie its two maps to each other otherwise have to be given up, at least a minimum
        cut of them; what can be won is its own weight and that of those that ask for the same move.
        """
        sure = [pair for pair, comparison in self.comparisons.items() if comparison.decision == "merged"]
        asking = [pair for pair in sure if choice.chosen.get(pair) != 0 and (pair, 0) not in self.placer.forbidden]
        weight = {pair: own_weight(self.comparisons[pair], k) for pair, k in choice.chosen.items()}
        moves = {pair: self._move(pair, choice) for pair in asking}
        together = {pair for pair in asking if any(set(pair) <= set(names) for names in choice.groups)}
        heard = []
        for pair in sorted(asking):
            alike = [o for o in asking if o not in together or bool(_near(moves[pair], moves[o]))]
            won = sum(self.placer.weight(other, 0) for other in {pair, *alike})
            lost = _strength(*pair, weight) if pair in together else 0.0
            if won > lost:
                heard.append((lost - won, pair))
        return [pair for _, pair in sorted(heard)]

    def _move(self, pair: Pair, choice: Choice) -> Array:
        """How following a pair would move its second map's frame and all that goes with it, in the group's frame."""
        X_a, X_b = (choice.frames[name].array for name in pair)
        T_ab = self.placer.edge(*pair, 0).T
        return np.asarray(se2.compose(se2.compose(X_a, T_ab), se2.inverse(X_b)))

    def _next(
        self, groups: _Groups, meetings: _Meetings, beside: _Beside, supports: dict[tuple[int, int], float]
    ) -> tuple[int, int] | None:
        """The merge to do first: of those that are sure, the one with most support by its cycles.

        ``supports``: what is known of it from before, and kept for later.
        """
        sure = [key for key, meeting in meetings.items() if self._is_sure(groups[key[0]], groups[key[1]], meeting)]
        if len(sure) < 2:
            return sure[0] if sure else None
        for key in sure:
            if key not in supports:
                supports[key] = self._support(key, meetings, beside)
        ranked = [(meetings[key].margin + supports[key], groups[key[0]].names, key) for key in sure]
        return max(ranked, key=lambda item: (item[0], item[1], groups[item[2][1]].names))[2]

    def _is_sure(self, one: Group, other: Group, meeting: Meeting) -> bool:
        """Whether the best placement of two groups on each other may be followed; of two single maps their own answer
        is all that there is to go by."""
        if not meeting.placements or meeting.probability < self.accept:
            return False
        if len(one.names) > 1 or len(other.names) > 1:
            return True
        a, b = sorted((one.names[0], other.names[0]))
        return self.comparisons[a, b].decision == "merged"

    def _support(self, key: tuple[int, int], meetings: _Meetings, beside: _Beside) -> float:
        """What third groups say of the best placement [nats].

        Two legs by a third group that close the cycle are worth the weaker leg; two that are both sure and don't close
        it speak against it by as much.
        """
        p, q = key
        T_pq, weaker_leg = meetings[key].placements[0].T_AB, group_kernels().weaker_leg
        total = 0.0
        for r in sorted(beside[p] & beside[q]):
            one, two = (meetings[min(n, r), max(n, r)] for n in key)
            if not one.placements or not two.placements:
                continue
            T_pr, T_rq = one.legs[0 if p < r else 1], two.legs[0 if r < q else 1]
            weaker = weaker_leg(T_pq, T_pr, T_rq, one.legs[2], two.legs[2], *NEAR)
            if weaker > -np.inf:
                total += max(0.0, weaker)
            elif min(one.probability, two.probability) >= self.accept:
                total -= min(one.margin, two.margin)
        return total

    def _choice(self, groups: Sequence[Group]) -> Choice:
        chosen = {pair: k for group in groups for pair, k in group.chosen.items()}
        frames = {name: group.graph.transform(name) for group in groups for name in group.names}
        overruled = {}
        for group in groups:
            for pair in combinations(group.names, 2):
                own = self.comparisons.get(pair)
                if own is None or own.decision == "no_overlap" or group.chosen.get(pair, -1) == 0:
                    continue
                if pair not in group.chosen or own.decision == "merged":
                    overruled[pair] = _way(*pair, [p for p in group.chosen if p != pair])
        return Choice(
            tuple(group.names for group in groups),
            frames,
            chosen,
            {pair: cycle for pair, cycle in overruled.items() if cycle},
            tuple(group.probability for group in groups),
        )


def _near(T: Array, others: Array) -> NDArray[np.bool_]:
    """Which placements may be the same as one, coarsely."""
    shift = np.hypot(others[..., 0] - T[0], others[..., 1] - T[1])
    return np.asarray((shift < NEAR[0]) & (np.abs(se2.wrap(others[..., 2] - T[2])) < NEAR[1]))


def _strength(start: str, end: str, chosen: Mapping[Pair, float]) -> float:
    """Least weight [nats] of the chosen pairs that would have to be given up to part two maps (minimum cut)."""
    names = sorted({name for pair in chosen for name in pair} | {start, end})
    place = {name: k for k, name in enumerate(names)}
    a, b = (np.array([place[pair[k]] for pair in chosen], dtype=np.intp) for k in (0, 1))
    capacity = np.array([max(0, round(CUT_STEPS * weight)) for weight in chosen.values()], dtype=np.int32)
    shape = (len(names), len(names))
    both = csr_array((np.tile(capacity, 2), (np.append(a, b), np.append(b, a))), shape=shape)
    return float(maximum_flow(both, place[start], place[end]).flow_value) / CUT_STEPS


def _way(start: str, end: str, pairs: Iterable[Pair]) -> tuple[str, ...]:
    """Shortest way between two maps along pairs that agree (the first by name of several), () where there is none."""
    neighbours: dict[str, set[str]] = {}
    for a, b in pairs:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    before: dict[str, str] = {start: start}
    todo = deque([start])
    while todo and end not in before:
        here = todo.popleft()
        for there in sorted(neighbours.get(here, ())):
            if there not in before:
                before[there] = here
                todo.append(there)
    if end not in before:
        return ()
    way = [end]
    while way[-1] != start:
        way.append(before[way[-1]])
    return tuple(way[::-1])
