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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.transform import Transform

from .config import FuseConfig, chi2_gate
from .decide import log_alike, probabilities
from .pairwise import Comparison
from .posegraph import Edge, PoseGraph

Array = NDArray[np.float64]
Pair = tuple[str, str]
Landmark = tuple[str, int]
#: What a placement lays on each other: evidence [nats, at most 0] of two maps that overlap without a single match.
Against = Callable[[str, str, Array], float]

#: Candidates that far below a pair's best [nats] support no placement.
FAINT = 25.0
#: Placements that far below the best one [nats] aren't looked at closely, and candidates propose none.
HOPELESS = 15.0
#: How often a choice is made again to give overruled pairs their chance.
MAX_APPEALS = 20
#: Overruled pairs that are heard before the best of them is followed, those that may win most: so many, and fewer
#: where there are so many maps that each takes long.
APPEALS_AT_ONCE, APPEALS_TIMES_MAPS = 8, 400
#: Placements that differ by more [m, m, rad] are not looked at as the same, whatever their covariances.
COARSE = np.array([20.0, 20.0, 0.8])
#: Placements that differ by less [m], [rad] may be the same: a cycle's covariance is looked at when it is closed.
NEAR = (3.0, 0.2)
#: Placements of a leg that a cycle is looked for among.
LEGS = 8
#: Steps per nat in which a cut is counted.
CUT_STEPS = 1000
#: The rotation error [rad] and the shift [m] that pose graphs of map frames leave open at least.
SLACK = np.array([0.05, 0.05, 0.005])


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


@dataclass(frozen=True, eq=False)
class _Group:
    """Maps that share a frame, by the candidates that were chosen for their pairs."""

    names: tuple[str, ...]
    chosen: Mapping[Pair, int] = field(default_factory=dict)
    place: Mapping[Landmark, Landmark] = field(default_factory=dict)
    probability: float = 1.0
    edges: tuple[Edge, ...] = ()
    start: Array | None = None

    @cached_property
    def made_of(self) -> tuple[tuple[str, ...], tuple[tuple[Pair, int], ...]]:
        """What tells this group from others: its maps, and what was chosen in which order."""
        return self.names, tuple(self.chosen.items())

    @cached_property
    def graph(self) -> PoseGraph:
        return PoseGraph(self.names, self.edges, self.start)

    @cached_property
    def index(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    def place_of(self, landmark: Landmark) -> Landmark:
        """The landmark that stands for all that are the same."""
        return self.place.get(landmark, landmark)


@dataclass(frozen=True, eq=False)
class _Placement:
    """One way to lay group B on group A: the candidates that agree with it, by pair, and their ``weight`` [nats].

    ``alike`` [nats]: the least odds, of any of these, that it is another floor of one plan.
    """

    agreeing: Mapping[Pair, int]
    weight: float
    alike: float
    T_AB: Array


@dataclass(frozen=True, eq=False)
class _Meeting:
    """All ways to lay one group on another, best first, and how sure the best one is."""

    placements: tuple[_Placement, ...]
    probability: float
    margin: float

    @cached_property
    def legs(self) -> tuple[Array, Array, Array]:
        """The best few placements (k, 3), their inverses, and their weights (k,)."""
        T = np.array([placement.T_AB for placement in self.placements[:LEGS]])
        return T, np.asarray(se2.inverse(T)), np.array([placement.weight for placement in self.placements[:LEGS]])


@dataclass(frozen=True, eq=False, slots=True)
class _Candidates:
    """The candidates of one pair that may be chosen, heaviest first, one frame in the other: places ``k`` in the
    comparison, ``T`` (k, 3), ``covariance`` (k, 3, 3), ``weight`` (k,)."""

    k: NDArray[np.intp]
    T: Array
    covariance: Array
    weight: Array


_Groups = Mapping[int, _Group]
_Meetings = Mapping[tuple[int, int], _Meeting]
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
    chooser = _Chooser(comparisons, config, against, forbidden)
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


def own_weight(comparison: Comparison, k: int) -> float:
    """What candidate ``k`` of a pair shows by itself [nats].

    A rival of the pair's best candidate weighs more than it shows, for it may be right where the best one is its image.
    That much explains one pair, and is no evidence that several pairs could add up.
    """
    return float(min(comparison.weights[k], comparison.candidates[k].log_odds))


def group_kernels() -> ModuleType:
    """The compiled loop of laying groups on each other."""
    return kernels("_group_kernels", __package__, "the choice between many maps' answers")


def _key(a: str, b: str) -> Pair:
    return (a, b) if a < b else (b, a)


class _Chooser:
    """One run of merges; keeps what doesn't change between runs."""

    def __init__(
        self,
        comparisons: Mapping[Pair, Comparison],
        config: FuseConfig,
        against: Against | None,
        forbidden: frozenset[tuple[Pair, int]],
    ) -> None:
        self.comparisons = comparisons
        self.forbidden = forbidden
        self.edges: dict[tuple[str, str, int], Edge] = {}
        self.candidates: dict[tuple[str, str, bool], _Candidates] = {}
        self.met: dict[tuple[object, object], _Meeting] = {}
        self.beside: dict[str, list[str]] = {}
        for a, b in comparisons:
            self.beside.setdefault(a, []).append(b)
            self.beside.setdefault(b, []).append(a)
        self.config = config
        self.against = against
        none = float(np.log1p(-config.decision.overlap_prior) - np.log(config.decision.overlap_prior))
        #: Placements that weigh no more than this are neither sure nor legs of a cycle.
        self.nothing = min(0.0, none) if config.decision.accept >= 0.5 else -np.inf
        self.gate = float(chi2_gate(config.solving.gate_probability, 3))

    def run(self, names: Sequence[str], first: Sequence[Pair]) -> Choice:
        """Merge until nothing is sure any more; the pairs ``first`` before all others, by their own best candidate."""
        groups: dict[int, _Group] = {k: _Group((name,)) for k, name in enumerate(names)}
        for pair in first:
            p, q = sorted(next(k for k, group in groups.items() if name in group.names) for name in pair)
            if p != q:
                placement = self._placement(groups[p], groups[q], pair)
                probability = float(self.comparisons[pair].probabilities[0])
                groups[p] = self._merged(groups[p], groups.pop(q), placement, probability)
        at = {name: k for k, group in groups.items() for name in group.names}
        beside: dict[int, set[int]] = {k: set() for k in groups}
        for a, b in self.comparisons:
            if a in at and b in at and at[a] != at[b]:
                beside[at[a]].add(at[b])
                beside[at[b]].add(at[a])
        meetings = {(p, q): self.meet(groups[p], groups[q]) for p in groups for q in beside[p] if p < q}
        supports: dict[tuple[int, int], float] = {}
        while (key := self._next(groups, meetings, beside, supports)) is not None:
            p, q = key
            meeting = meetings[key]
            around = (beside[p] | beside.pop(q)) - {p, q}
            groups[p] = self._merged(groups[p], groups.pop(q), meeting.placements[0], meeting.probability)
            meetings = {other: meeting for other, meeting in meetings.items() if not {p, q} & set(other)}
            supports = {k: s for k, s in supports.items() if not ({p, q} & set(k) or around.issuperset(k))}
            beside[p] = around
            for other in around:
                beside[other] = (beside[other] - {q}) | {p}
                one, two = sorted((p, other))
                meetings[one, two] = self.meet(groups[one], groups[two])
        return self._choice(sorted(groups.values(), key=lambda group: group.names))

    def unheard(self, choice: Choice) -> list[Pair]:
        """Pairs that are sure of themselves, that the choice doesn't follow, and that might outweigh what it follows.

        To follow one, the pairs that tie its two maps to each other otherwise have to be given up, at least a minimum
        cut of them; what can be won is its own weight and that of those that ask for the same move.
        """
        sure = [pair for pair, comparison in self.comparisons.items() if comparison.decision == "merged"]
        asking = [pair for pair in sure if choice.chosen.get(pair) != 0 and (pair, 0) not in self.forbidden]
        weight = {pair: own_weight(self.comparisons[pair], k) for pair, k in choice.chosen.items()}
        moves = {pair: self._move(pair, choice) for pair in asking}
        together = {pair for pair in asking if any(set(pair) <= set(names) for names in choice.groups)}
        heard = []
        for pair in sorted(asking):
            alike = [o for o in asking if o not in together or bool(_near(moves[pair], moves[o]))]
            won = sum(self._weight(other, 0) for other in {pair, *alike})
            lost = _strength(*pair, weight) if pair in together else 0.0
            if won > lost:
                heard.append((lost - won, pair))
        return [pair for _, pair in sorted(heard)]

    def _move(self, pair: Pair, choice: Choice) -> Array:
        """How following a pair would move its second map's frame and all that goes with it, in the group's frame."""
        X_a, X_b = (choice.frames[name].array for name in pair)
        T_ab = self._edge(*pair, 0).T
        return np.asarray(se2.compose(se2.compose(X_a, T_ab), se2.inverse(X_b)))

    def _next(
        self, groups: _Groups, meetings: _Meetings, beside: _Beside, supports: dict[tuple[int, int], float]
    ) -> tuple[int, int] | None:
        """The merge to do first: of those that are sure, the one with most support by its cycles.

        ``supports``: what is known of it from before, and kept for later.
        """
        sure = [key for key, m in meetings.items() if m.placements and m.probability >= self.config.decision.accept]
        if len(sure) < 2:
            return sure[0] if sure else None
        for key in sure:
            if key not in supports:
                supports[key] = self._support(key, meetings, beside)
        ranked = [(meetings[key].margin + supports[key], groups[key[0]].names, key) for key in sure]
        return max(ranked, key=lambda item: (item[0], item[1], groups[item[2][1]].names))[2]

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
            elif min(one.probability, two.probability) >= self.config.decision.accept:
                total -= min(one.margin, two.margin)
        return total

    def meet(self, A: _Group, B: _Group) -> _Meeting:
        """All placements of B on A that the pairs across propose, weighed; looked up where an earlier run met them."""
        key = (A.made_of, B.made_of)
        if key not in self.met:
            self.met[key] = self._meet(A, B)
        return self.met[key]

    def _meet(self, A: _Group, B: _Group) -> _Meeting:
        placements = self._placements(A, B, self._across(A, B))
        if not placements:
            return _Meeting((), 0.0, -np.inf)
        weight = np.array([p.weight for p in placements])
        other_floor = self._other_floor(A, B, placements)
        weights = probabilities(weight - other_floor, self.config.decision.overlap_prior)
        probability = float(weights[0])
        rest = float(weights.sum() - weights[0])
        margin = float(np.log(max(probability, 1e-300)) - np.log(max(rest, 1e-300)))
        return _Meeting(tuple(placements), probability, margin)

    def _other_floor(self, A: _Group, B: _Group, placements: Sequence[_Placement]) -> float:
        """What no overlap weighs more [nats], since the groups may be two floors of one plan; of single maps as for
        their pair."""
        if len(A.names) == len(B.names) == 1:
            found = self.comparisons[_key(A.names[0], B.names[0])].candidates
            odds, alike = [c.log_odds for c in found], [c.alike for c in found]
        else:
            odds, alike = [p.weight for p in placements], [p.alike for p in placements]
        return log_alike(np.array(odds), np.array(alike), self.config.evidence)

    def _across(self, A: _Group, B: _Group) -> list[Pair]:
        """The pairs that were compared between two groups."""
        few, many = sorted((A.names, B.names), key=len)
        inside = set(many)
        return sorted(_key(a, b) for a in few for b in self.beside.get(a, ()) if b in inside)

    def _candidates(self, a: str, b: str, all_of_them: bool) -> _Candidates:
        """Those of a pair that may be chosen; without the faint ones unless ``all_of_them``."""
        key = (a, b, all_of_them)
        if key not in self.candidates:
            pair = _key(a, b)
            weights = np.asarray(self.comparisons[pair].weights)
            heavy = weights > (-np.inf if all_of_them else np.max(weights, initial=0.0) - FAINT)
            free = [k for k in np.flatnonzero(heavy).tolist() if (pair, k) not in self.forbidden]
            k = np.array(sorted(free, key=lambda k: (-weights[k], k)), dtype=np.intp)
            found = [self.comparisons[pair].candidates[place].T12 for place in k.tolist()]
            T = np.array([T12.array for T12 in found]).reshape(-1, 3)
            covariance = np.array([T12.covariance for T12 in found], dtype=float).reshape(-1, 3, 3)
            if (a, b) != pair:
                T, covariance = np.asarray(se2.inverse(T)), se2.inverse_covariance(T, covariance)
            self.candidates[key] = _Candidates(k, T, covariance + np.diag(SLACK**2), weights[k])
        return self.candidates[key]

    def _placement(self, A: _Group, B: _Group, pair: Pair) -> _Placement:
        """How a pair's own best candidate lays B on A."""
        a, b = pair if pair[0] in A.index else pair[::-1]
        T_AB = se2.compose(se2.compose(A.graph.pose(a), self._edge(a, b, 0).T), se2.inverse(B.graph.pose(b)))
        return _Placement({pair: 0}, self._weight(pair, 0), self._alike(pair, 0), np.asarray(T_AB))

    def _placements(self, A: _Group, B: _Group, pairs: Sequence[Pair]) -> list[_Placement]:
        """One placement by each candidate, with the candidates of all other pairs that agree and what pairs without
        one there say against it; the best first, and none that don't count: hopeless ones, and all below nothing."""
        ways = [pair if pair[0] in A.index else pair[::-1] for pair in pairs]
        of_pairs = [self._candidates(a, b, len(pairs) == 1) for a, b in ways]
        if not sum(len(c.k) for c in of_pairs):
            return []
        first = np.cumsum([0, *(len(c.k) for c in of_pairs)])
        of = np.repeat(np.arange(len(pairs)), np.diff(first))
        k, T, covariance, weight = (
            np.concatenate([getattr(c, name) for c in of_pairs]) for name in ("k", "T", "covariance", "weight")
        )
        if weight.max() <= self.nothing:
            return []
        a = np.array([A.index[way[0]] for way in ways])[of]
        b = np.array([B.index[way[1]] for way in ways])[of]
        # what a placement is worth is at most a little more than its best candidate, where that one weighs little
        rows = np.flatnonzero(weight > weight.max() - HOPELESS)
        agrees = np.zeros((len(rows), len(of)), dtype=bool)
        if len(pairs) > 1:
            graphs = (*A.graph.solved, *B.graph.solved)
            agrees = group_kernels().agreeing(rows, *graphs, a, b, T, covariance, of, COARSE, self.gate)
        agrees[np.arange(len(rows)), rows] = True
        full = np.flatnonzero(np.diff(first))
        # of each pair the heaviest that agrees: more than all of them together a placement can't be worth
        worth = np.maximum.reduceat(np.where(agrees, weight, -np.inf), first[full], axis=1)
        most = worth.max(axis=1) + np.maximum(np.sort(worth, axis=1)[:, :-1], 0.0).sum(axis=1)
        T_AB = se2.compose(se2.compose(A.graph.solved[0][a[rows]], T[rows]), se2.inverse(B.graph.solved[0][b[rows]]))
        found: dict[tuple[tuple[Pair, int], ...], _Placement] = {}
        best = -np.inf
        for row in np.lexsort((rows, -most)).tolist():
            if most[row] <= max(best - HOPELESS, self.nothing):
                break
            with_it = np.flatnonzero(agrees[row]).tolist()
            heaviest = {pairs[of[m]]: int(k[m]) for m in reversed(with_it)}  # of one pair the first is the heaviest
            chosen = tuple(sorted(heaviest.items()))
            if chosen not in found:
                least = max(best - HOPELESS, self.nothing)
                found[chosen] = self._weighed_placement(A, B, dict(chosen), T_AB[row], pairs, least)
                best = max(best, found[chosen].weight)
        kept = [placement for placement in found.values() if placement.weight > max(best - HOPELESS, self.nothing)]
        return sorted(kept, key=lambda p: (-p.weight, sorted(p.agreeing.items())))

    def _weighed_placement(
        self, A: _Group, B: _Group, agreeing: Mapping[Pair, int], T_AB: Array, pairs: Sequence[Pair], least: float
    ) -> _Placement:
        """A placement; that it weighs no more than ``least`` is all that is worked out of one that doesn't."""
        weight = self._weighed(A, B, agreeing)
        if self.against is not None and len(pairs) > 1:
            others = (pair for pair in pairs if pair not in agreeing)
            while weight > least and (pair := next(others, None)) is not None:
                weight += self._against(A, B, T_AB, pair)
        return _Placement(agreeing, weight, min(self._alike(pair, k) for pair, k in agreeing.items()), T_AB)

    def _weight(self, pair: Pair, k: int) -> float:
        return float(self.comparisons[pair].weights[k])

    def _alike(self, pair: Pair, k: int) -> float:
        return self.comparisons[pair].candidates[k].alike

    def _edge(self, a: str, b: str, k: int) -> Edge:
        """Candidate ``k`` of the pair as frame b in frame a."""
        if (a, b, k) not in self.edges:
            T = self.comparisons[_key(a, b)].candidates[k].T12
            T = T if a < b else T.inverse()
            assert T.covariance is not None
            self.edges[a, b, k] = Edge(a, b, T.array, T.covariance + np.diag(SLACK**2))
        return self.edges[a, b, k]

    def _weighed(self, A: _Group, B: _Group, agreeing: Mapping[Pair, int]) -> float:
        """What candidates that agree weigh together [nats], every landmark counted once.

        Two maps of one group share landmarks, and what a third map has in common with one it has with the other: the
        second adds what it shows by itself, and only by the share of its matches between landmarks not yet counted.
        What its robots did not see of each other's maps they say all the same, and all of that together may speak
        against the placement; what each robot says of a landmark counts about once.
        """
        weight = {pair: self._weight(pair, k) for pair, k in agreeing.items()}
        used: set[Landmark] = set()
        total, empty = max(weight.values()), 0.0
        for n, pair in enumerate(sorted(agreeing, key=lambda pair: (-weight[pair], pair))):
            own = own_weight(self.comparisons[pair], agreeing[pair])
            candidate = self.comparisons[pair].candidates[agreeing[pair]]
            if n and own <= 0.0:
                empty += candidate.terms.emptiness
                continue
            matched = [self._places(A, B, pair, match) for match in candidate.matches]
            if n:
                fresh = sum(not used & set(places) for places in matched) / max(len(matched), 1)
                total += own * fresh
                empty += candidate.terms.emptiness * (1 - fresh)
            used.update(place for places in matched for place in places)
        # a landmark that several maps of one group have is missed by a robot of the other one once, not once for each
        maps = {name for pair in agreeing for name in pair}
        inside = len(maps & A.index.keys())
        return total + min(0.0, empty) / max(inside, len(maps) - inside)

    def _places(self, A: _Group, B: _Group, pair: Pair, match: tuple[int, int]) -> tuple[Landmark, Landmark]:
        first, second = (pair[0], match[0]), (pair[1], match[1])
        return (
            (A if pair[0] in A.index else B).place_of(first),
            (A if pair[1] in A.index else B).place_of(second),
        )

    def _against(self, A: _Group, B: _Group, T_AB: Array, pair: Pair) -> float:
        """What a pair that has no candidate for a placement says against it [nats], at most 0."""
        assert self.against is not None
        a, b = pair if pair[0] in A.index else pair[::-1]
        T_ab = np.asarray(se2.compose(se2.between(A.graph.pose(a), T_AB), B.graph.pose(b)))
        return self.against(*pair, T_ab if (a, b) == pair else np.asarray(se2.inverse(T_ab)))

    def _merged(self, A: _Group, B: _Group, placement: _Placement, probability: float) -> _Group:
        edges = tuple(self._edge(*pair, k) for pair, k in placement.agreeing.items())
        chosen = {**A.chosen, **B.chosen, **placement.agreeing}
        names = tuple(sorted((*A.names, *B.names)))
        pose = dict(zip(A.names, A.graph.solved[0], strict=True))
        pose |= dict(zip(B.names, np.asarray(se2.compose(placement.T_AB, B.graph.solved[0])), strict=True))
        return _Group(
            names=names,
            chosen=chosen,
            place=places_of(chosen, self.comparisons),
            probability=A.probability * B.probability * probability,
            edges=(*A.edges, *B.edges, *edges),
            start=np.asarray(se2.between(pose[names[0]], np.array([pose[name] for name in names]))),
        )

    def _choice(self, groups: Sequence[_Group]) -> Choice:
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


def places_of(chosen: Mapping[Pair, int], comparisons: Mapping[Pair, Comparison]) -> dict[Landmark, Landmark]:
    """Which landmark stands for each matched one: identity is transitive, and one to one in each map.

    Matches of better supported pairs come first; one that would make two landmarks of one map the same is left out.
    """
    members: dict[Landmark, dict[str, int]] = {}
    root: dict[Landmark, Landmark] = {}
    ranked = sorted(chosen, key=lambda pair: (-comparisons[pair].weights[chosen[pair]], pair))
    for pair in ranked:
        for i, j in comparisons[pair].candidates[chosen[pair]].matches:
            a, b = (root.setdefault(l, l) for l in ((pair[0], i), (pair[1], j)))
            for l in (a, b):
                members.setdefault(l, {l[0]: l[1]})
            if a == b or members[a].keys() & members[b].keys():
                continue
            keep, gone = min(a, b), max(a, b)
            members[keep] |= members.pop(gone)
            root |= dict.fromkeys(members[keep].items(), keep)
    return root
