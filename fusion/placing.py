"""Laying one group of maps on another: the placements that pairs of maps across the two propose, and what they weigh.

Every pair with a candidate for a placement speaks for it, each landmark counted once; what robots did not see of each
other's maps speaks against it. Derivation of the sums: docs/groups.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels

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
#: Placements that differ by more [m, m, rad] are not looked at as the same, whatever their covariances.
COARSE = np.array([20.0, 20.0, 0.8])
#: Placements of a leg that a cycle is looked for among.
LEGS = 8
#: The rotation error [rad] and the shift [m] that pose graphs of map frames leave open at least.
SLACK = np.array([0.05, 0.05, 0.005])


@dataclass(frozen=True, eq=False)
class Group:
    """Maps that share a frame, by the candidates that were chosen for their pairs."""

    names: tuple[str, ...]
    chosen: Mapping[Pair, int] = field(default_factory=dict)
    place: Mapping[Landmark, Landmark] = field(default_factory=dict)
    probability: float = 1.0
    edges: tuple[Edge, ...] = ()
    start: Array | None = None

    @cached_property
    def made_of(self) -> bytes:
        """What tells this group from others: its maps, and what was chosen in which order. Bytes keep their hash."""
        return repr((self.names, tuple(self.chosen.items()))).encode()

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
class Placement:
    """One way to lay group B on group A: the candidates that agree with it, by pair, and their ``weight`` [nats].

    ``alike`` [nats]: the least odds, of any of these, that it is another floor of one plan.
    """

    agreeing: Mapping[Pair, int]
    weight: float
    alike: float
    T_AB: Array


@dataclass(frozen=True, eq=False)
class Meeting:
    """All ways to lay one group on another, best first, and how sure the best one is."""

    placements: tuple[Placement, ...]
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


class Placer:
    """Lays groups on each other, and keeps what it found for later runs of merges."""

    def __init__(
        self,
        comparisons: Mapping[Pair, Comparison],
        config: FuseConfig,
        against: Against | None,
        forbidden: frozenset[tuple[Pair, int]],
    ) -> None:
        self.comparisons = comparisons
        self.config = config
        self.against = against
        self.forbidden = forbidden
        self.edges: dict[tuple[str, str, int], Edge] = {}
        self.candidates: dict[tuple[str, str, bool], _Candidates] = {}
        self.met: dict[tuple[bytes, bytes], Meeting] = {}
        self.joined: dict[tuple[object, ...], Group] = {}
        self.beside: dict[str, list[str]] = {}
        for a, b in comparisons:
            self.beside.setdefault(a, []).append(b)
            self.beside.setdefault(b, []).append(a)
        none = float(np.log1p(-config.decision.overlap_prior) - np.log(config.decision.overlap_prior))
        #: Placements that weigh no more than this are neither sure nor legs of a cycle.
        self.nothing = min(0.0, none) if config.decision.accept >= 0.5 else -np.inf
        self.gate = float(chi2_gate(config.solving.gate_probability, 3))

    def meet(self, A: Group, B: Group) -> Meeting:
        """All placements of B on A that the pairs across propose, weighed; looked up where an earlier run met them."""
        key = (A.made_of, B.made_of)
        if key not in self.met:
            self.met[key] = self._meet(A, B)
        return self.met[key]

    def merged(self, A: Group, B: Group, placement: Placement, probability: float) -> Group:
        """Both groups as one, all merges of which are right with a probability; the same one where it was made before,
        for its graph is solved then."""
        all_right = A.probability * B.probability * probability
        key = (A.made_of, B.made_of, tuple(placement.agreeing.items()), placement.T_AB.tobytes(), all_right)
        if key not in self.joined:
            self.joined[key] = self._merged(A, B, placement, all_right)
        return self.joined[key]

    def _merged(self, A: Group, B: Group, placement: Placement, probability: float) -> Group:
        edges = tuple(self.edge(*pair, k) for pair, k in placement.agreeing.items())
        chosen = {**A.chosen, **B.chosen, **placement.agreeing}
        names = tuple(sorted((*A.names, *B.names)))
        pose = dict(zip(A.names, A.graph.solved[0], strict=True))
        pose |= dict(zip(B.names, np.asarray(se2.compose(placement.T_AB, B.graph.solved[0])), strict=True))
        return Group(
            names=names,
            chosen=chosen,
            place=places_of(chosen, self.comparisons),
            probability=probability,
            edges=(*A.edges, *B.edges, *edges),
            start=np.asarray(se2.between(pose[names[0]], np.array([pose[name] for name in names]))),
        )

    def own_placement(self, A: Group, B: Group, pair: Pair) -> Placement:
        """How a pair's own best candidate lays B on A."""
        a, b = pair if pair[0] in A.index else pair[::-1]
        T_AB = se2.compose(se2.compose(A.graph.pose(a), self.edge(a, b, 0).T), se2.inverse(B.graph.pose(b)))
        return Placement({pair: 0}, self.weight(pair, 0), self._alike(pair, 0), np.asarray(T_AB))

    def edge(self, a: str, b: str, k: int) -> Edge:
        """Candidate ``k`` of the pair as frame b in frame a."""
        if (a, b, k) not in self.edges:
            T = self.comparisons[_key(a, b)].candidates[k].T12
            T = T if a < b else T.inverse()
            assert T.covariance is not None
            self.edges[a, b, k] = Edge(a, b, T.array, T.covariance + np.diag(SLACK**2))
        return self.edges[a, b, k]

    def _meet(self, A: Group, B: Group) -> Meeting:
        placements = self._placements(A, B, self._across(A, B))
        if not placements:
            return Meeting((), 0.0, -np.inf)
        weight = np.array([p.weight for p in placements])
        other_floor = self._other_floor(A, B, placements)
        weights = probabilities(weight - other_floor, self.config.decision.overlap_prior)
        probability = float(weights[0])
        rest = float(weights.sum() - weights[0])
        margin = float(np.log(max(probability, 1e-300)) - np.log(max(rest, 1e-300)))
        return Meeting(tuple(placements), probability, margin)

    def _other_floor(self, A: Group, B: Group, placements: Sequence[Placement]) -> float:
        """What no overlap weighs more [nats], since the groups may be two floors of one plan; of single maps as for
        their pair."""
        if len(A.names) == len(B.names) == 1:
            found = self.comparisons[_key(A.names[0], B.names[0])].candidates
            odds, alike = [c.log_odds for c in found], [c.alike for c in found]
        else:
            odds, alike = [p.weight for p in placements], [p.alike for p in placements]
        return log_alike(np.array(odds), np.array(alike), self.config.evidence)

    def _across(self, A: Group, B: Group) -> list[Pair]:
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

    def _placements(self, A: Group, B: Group, pairs: Sequence[Pair]) -> list[Placement]:
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
        found: dict[tuple[tuple[Pair, int], ...], Placement] = {}
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
        self, A: Group, B: Group, agreeing: Mapping[Pair, int], T_AB: Array, pairs: Sequence[Pair], least: float
    ) -> Placement:
        """A placement; that it weighs no more than ``least`` is all that is worked out of one that doesn't."""
        weight = self._weighed(A, B, agreeing)
        if self.against is not None and len(pairs) > 1:
            others = (pair for pair in pairs if pair not in agreeing)
            while weight > least and (pair := next(others, None)) is not None:
                weight += self._against(A, B, T_AB, pair)
        return Placement(agreeing, weight, min(self._alike(pair, k) for pair, k in agreeing.items()), T_AB)

    def weight(self, pair: Pair, k: int) -> float:
        return float(self.comparisons[pair].weights[k])

    def _alike(self, pair: Pair, k: int) -> float:
        return self.comparisons[pair].candidates[k].alike

    def _weighed(self, A: Group, B: Group, agreeing: Mapping[Pair, int]) -> float:
        """What candidates that agree weigh together [nats], every landmark counted once.

        Two maps of one group share landmarks, and what a third map has in common with one it has with the other: the
        second adds what it shows by itself, and only by the share of its matches between landmarks not yet counted.
        What its robots did not see of each other's maps they say all the same, and all of that together may speak
        against the placement; what each robot says of a landmark counts about once.
        """
        weight = {pair: self.weight(pair, k) for pair, k in agreeing.items()}
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

    def _places(self, A: Group, B: Group, pair: Pair, match: tuple[int, int]) -> tuple[Landmark, Landmark]:
        first, second = (pair[0], match[0]), (pair[1], match[1])
        return (
            (A if pair[0] in A.index else B).place_of(first),
            (A if pair[1] in A.index else B).place_of(second),
        )

    def _against(self, A: Group, B: Group, T_AB: Array, pair: Pair) -> float:
        """What a pair that has no candidate for a placement says against it [nats], at most 0."""
        assert self.against is not None
        a, b = pair if pair[0] in A.index else pair[::-1]
        T_ab = np.asarray(se2.compose(se2.between(A.graph.pose(a), T_AB), B.graph.pose(b)))
        return self.against(*pair, T_ab if (a, b) == pair else np.asarray(se2.inverse(T_ab)))


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
