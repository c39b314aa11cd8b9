"""`run_trials`: pairs of maps with known truth fused one after the other, and how far off each answer was."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.truth import Truth

from ..config import FuseConfig
from ..groups import fuse
from ..result import FusedMap
from ..score import PairScore, score_pair
from .consistency import Consistency, consistency

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Trial:
    """One pair fused: ``error`` (3,) of the best hypothesis' T12 [m, m, rad], the ``covariance`` (3, 3) stated for it,
    ``matches`` it has, and how the result scores. NaN where there is no hypothesis."""

    score: PairScore
    error: Array
    covariance: Array
    matches: int

    @property
    def merged(self) -> bool:
        """Whether the two maps were merged."""
        return self.score.decision == "merged"


@dataclass(frozen=True, eq=False)
class Trials:
    """Several pairs fused. Statistics are of the merged ones, which are counted beside them."""

    all: tuple[Trial, ...]

    def __len__(self) -> int:
        return len(self.all)

    @cached_property
    def merged(self) -> tuple[Trial, ...]:
        """Those that were merged, rightly or not."""
        return tuple(trial for trial in self.all if trial.merged)

    @property
    def merged_wrongly(self) -> int:
        """How many merges are wrong."""
        return sum(trial.score.merged_wrongly for trial in self.merged)

    @cached_property
    def errors(self) -> Array:
        """Errors (n, 3) of T12 in the merged ones."""
        return np.array([trial.error for trial in self.merged]).reshape(-1, 3)

    @cached_property
    def covariances(self) -> Array:
        """Covariances (n, 3, 3) stated for them."""
        return np.array([trial.covariance for trial in self.merged]).reshape(-1, 3, 3)

    @property
    def consistency(self) -> Consistency:
        """NEES of T12 in the merged ones; raises `MapfuseError` where there are none."""
        return consistency(self.errors, self.covariances)


def run_trials(
    pairs: Iterable[tuple[LandmarkMap, LandmarkMap, Truth]],
    config: FuseConfig | None = None,
    fusing: Callable[[Sequence[LandmarkMap], FuseConfig | None], FusedMap] = fuse,
) -> Trials:
    """Fuse each pair, associations not given, and compare with its truth. ``fusing``: what fuses, by default `fuse`.

    >>> from mapfuse.datasets.simulation import simulated_pair
    >>> trials = run_trials(simulated_pair(seed) for seed in (1, 2))
    >>> len(trials), len(trials.merged), trials.merged_wrongly, trials.errors.shape
    (2, 2, 0, (2, 3))
    """
    return Trials(tuple(_trial(fusing([map1, map2], config), truth) for map1, map2, truth in pairs))


def _trial(fused: FusedMap, truth: Truth) -> Trial:
    pair, score = fused.pairs[0], score_pair(fused, truth)
    if pair.T12 is None:
        return Trial(score, np.full(3, np.nan), np.full((3, 3), np.nan), 0)
    error = pair.T12.array - truth.T12(*pair.maps).array
    error[2] = se2.wrap(error[2])
    covariance = np.full((3, 3), np.nan) if pair.T12.covariance is None else pair.T12.covariance
    return Trial(score, error, covariance, len(pair.correspondences))
