"""What the maps of a merged group say of its landmarks: which are one, who passed without seeing it, is it there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2

from .background import Background
from .config import EvidenceConfig
from .consistent import Choice
from .coverage import SeenArea
from .existence import existence
from .joint import Joint
from .joint import Members as Place
from .pairwise import Candidate, Comparison
from .passing import Passing, emptiness, passing_at, per_arm
from .placing import Pair
from .prepared import PreparedMap

Array = NDArray[np.float64]

#: Landmarks of one type no further apart [m] may be the same although no candidate says so; neither was missed then.
MAY_BE_SAME_M = 2.0


@dataclass(frozen=True, eq=False)
class Emptiness:
    """What two maps laid on each other say by what neither robot saw, without any match between them."""

    prepared: Mapping[str, PreparedMap]
    config: EvidenceConfig
    _backgrounds: dict[Pair, Background] = field(default_factory=dict, repr=False)
    _reaches: dict[str, tuple[Array, float]] = field(default_factory=dict, repr=False)

    def passing(self, a: str, b: str, T_ab: Array) -> Passing:
        """Who passed what, map b lying at ``T_ab`` (3,) on map a; landmarks that may be the same count as matched."""
        background = self._background(a, b)
        m1, m2 = background.m1, background.m2
        p1, p2 = m1.positions, np.asarray(se2.transform(T_ab, m2.positions))
        return passing_at(T_ab, (p1, p2), _near_of_type(m1, m2, p1, p2), background, self.config)

    def against(self, a: str, b: str, T_ab: Array) -> float:
        """Log odds [nats], at most 0, of laying b on a at ``T_ab`` where no candidate of theirs agrees with it."""
        if self.apart(a, b, T_ab):
            return 0.0
        return min(0.0, sum(emptiness(self.passing(a, b, T_ab), self._background(a, b), self.config)))

    def apart(self, a: str, b: str, T_ab: Array) -> bool:
        """Whether neither robot was near what the other recorded."""
        (middle_a, reach_a), (middle_b, reach_b) = self._reach(a), self._reach(b)
        return float(np.hypot(*(se2.transform(T_ab, middle_b) - middle_a))) > reach_a + reach_b

    def _reach(self, name: str) -> tuple[Array, float]:
        """Middle of a map (2,), and how far from it [m] its robot may have seen anything."""
        if name not in self._reaches:
            m = self.prepared[name]
            middle = m.positions.mean(axis=0) if len(m.positions) else np.zeros(2)
            seen = SeenArea.of(m, np.arange(len(m.positions)))
            at = np.concatenate([m.positions, seen.centres])
            farthest = float(np.hypot(*(at - middle).T).max(initial=0.0))
            self._reaches[name] = middle, farthest + max(seen.radius, self.config.corridor_width_m)
        return self._reaches[name]

    def _background(self, a: str, b: str) -> Background:
        if (a, b) not in self._backgrounds:
            self._backgrounds[a, b] = Background(self.prepared[a], self.prepared[b])
        return self._backgrounds[a, b]


def _near_of_type(m1: PreparedMap, m2: PreparedMap, p1: Array, p2: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Landmarks of either map that have one of the same type near by in the other."""
    if not len(p1) or not len(p2):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    near = cKDTree(p1).sparse_distance_matrix(cKDTree(p2), MAY_BE_SAME_M, output_type="ndarray")
    types1, types2 = np.array(m1.map.types), np.array(m2.map.types)
    same = types1[near["i"]] == types2[near["j"]]
    return np.unique(near["i"][same]).astype(np.intp), np.unique(near["j"][same]).astype(np.intp)


@dataclass(frozen=True, eq=False)
class Members:
    """A merged group: its maps ``names`` (alphabetical, as in ``joint``), and what was found of its pairs."""

    names: tuple[str, ...]
    joint: Joint
    comparisons: Mapping[Pair, Comparison]
    choice: Choice
    emptiness: Emptiness

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """All landmarks of the group as the recorded ones that they are, shared or not."""
        shared = {member for place in self.joint.shared for member in place}
        alone = [((r, k),) for r, m in enumerate(self.joint.maps) for k in range(len(m)) if (r, k) not in shared]
        return (*self.joint.shared, *alone)

    @cached_property
    def _missed(self) -> dict[tuple[int, int], dict[int, int]]:
        """Of each recorded landmark the maps (by place in `names`) whose robots passed without recording it, and
        through how many of its blocked arms they drove."""
        found: dict[tuple[int, int], dict[int, int]] = {}
        for r, s in combinations(range(len(self.names)), 2):
            pair = (self.names[r], self.names[s])
            way: Candidate | Passing
            if pair in self.choice.chosen:
                way = self.comparisons[pair].candidates[self.choice.chosen[pair]]
                through1, through2 = way.through1, way.through2
            else:
                T_rs = np.asarray(se2.between(*(self.joint.solution.frame(n) for n in (r, s))))
                if self.emptiness.apart(*pair, T_rs):
                    continue
                way = self.emptiness.passing(*pair, T_rs)
                through1, through2 = way.of_missed
            for k, through in zip(way.missed1, through1, strict=True):
                found.setdefault((r, int(k)), {})[s] = through
            for k, through in zip(way.missed2, through2, strict=True):
                found.setdefault((s, int(k)), {})[r] = through
        return found

    @cached_property
    def _rates(self) -> tuple[Array, ...]:
        """How common true landmarks like each one are, per map: the mean over the group's pairs that were compared."""
        rates: list[list[Array]] = [[] for _ in self.names]
        for (r, a), (s, b) in combinations(enumerate(self.names), 2):
            if (a, b) in self.comparisons:
                rates[r].append(self.comparisons[a, b].rates1)
                rates[s].append(self.comparisons[a, b].rates2)
        return tuple(np.mean(of_map, axis=0) for of_map in rates)

    def existence(self, place: Place) -> float:
        """Probability that a landmark of the group is there."""
        has = {r for r, _ in place}
        passed = {s: n for member in place for s, n in self._missed.get(member, {}).items() if s not in has}
        r, k = place[0]
        seen = [(self.joint.maps[n], m) for n, m in place]
        against = per_arm(self.emptiness.config) * sum(passed.values())
        return existence(seen, [self.joint.maps[n] for n in sorted(passed)], float(self._rates[r][k]), against)
