"""`Comparison`: what two maps alone say of each other, as a small value that outlives the matrices it came from.

Everything that decides between more than two maps works on these, so that the memory for many maps is that of their
answers, not of their joint covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.transform import Transform

from .config import FuseConfig
from .evidence import Terms, Weighed
from .growth import Pairs
from .known import KnownTransform
from .pair import PairOutcome, fuse_pair
from .prepared import PreparedMap
from .reason import reason
from .result import PairDecision
from .solve import Solution

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """One way to lay map 2 on map 1.

    ``matches``: places (in map 1, in map 2) of the landmarks that are then the same. ``missed1``, ``missed2``:
    landmarks that the other robot passed unrecorded; ``through1``, ``through2``: through how many of their blocked arms
    it drove (`mapfuse.fusion.passing.Passing`). ``alike`` [nats]: odds of what it shows on another floor of one plan
    against on the same one (`mapfuse.fusion.evidence.Weighed.alike`).
    """

    T12: Transform
    matches: Pairs
    terms: Terms
    missed1: tuple[int, ...] = ()
    missed2: tuple[int, ...] = ()
    through1: tuple[int, ...] = ()
    through2: tuple[int, ...] = ()
    alike: float = -np.inf

    @property
    def log_odds(self) -> float:
        """Log odds against no overlap [nats], before the overlap prior."""
        return self.terms.total


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """Two maps compared, named in alphabetical order: candidates best first with their ``probabilities`` (k,).

    ``weights`` (k,) [nats]: what each weighs against no overlap, rivals of a repeating building considered
    (`mapfuse.fusion.decide.log_weights`), before the overlap prior.
    ``reasons``: the sentence that says why, and the same with the maps' names swapped. ``rates1``, ``rates2``: how
    common true landmarks like each one are, [1/m] along corridors or [1/m^2] for points. ``solution``: the graph of
    the best candidate, where it was solved and kept.
    """

    maps: tuple[str, str]
    candidates: tuple[Candidate, ...]
    probabilities: Array
    weights: Array
    no_overlap: float
    decision: PairDecision
    reasons: tuple[str, str]
    rates1: Array
    rates2: Array
    solution: Solution | None = None


def compare(
    m1: PreparedMap,
    m2: PreparedMap,
    config: FuseConfig,
    *,
    known: Sequence[KnownTransform] = (),
    keep_solution: bool = False,
) -> Comparison:
    """Compare two prepared maps; the answer is the same whichever is given first. ``known``: what the user knows."""
    first, second = sorted((m1, m2), key=lambda m: m.map.name)
    of_these = [T for stated in known if (T := stated.between(first.map.name, second.map.name)) is not None]
    outcome = fuse_pair(first, second, config, of_these[0] if of_these else None)
    verdict = outcome.verdict
    return Comparison(
        maps=(first.map.name, second.map.name),
        candidates=tuple(_candidate(outcome, rank, w) for rank, w in enumerate(verdict.ranked)),
        probabilities=verdict.probabilities,
        weights=verdict.weights,
        no_overlap=verdict.no_overlap,
        decision=verdict.decision,
        reasons=(reason(verdict, swapped=False), reason(verdict, swapped=True)),
        rates1=outcome.background.rates1,
        rates2=outcome.background.rates2,
        solution=outcome.solutions.get(0) if keep_solution else None,
    )


def _candidate(outcome: PairOutcome, rank: int, w: Weighed) -> Candidate:
    """With T12 of its graph where that was solved, else of the elastic match."""
    joined = w.growth.joined
    if rank in outcome.solutions:
        T12 = outcome.solutions[rank].transform(1)
    else:
        T12 = Transform.from_array(joined.T12, joined.T12_covariance)
    matches = tuple(zip(joined.i.tolist(), joined.j.tolist(), strict=True))
    return Candidate(T12, matches, w.terms, w.missed1, w.missed2, w.through1, w.through2, w.alike)
