"""A fused pair against the truth: is the merge right, and do its covariances hold?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.truth import Truth

from .result import FusedMap, PairDecision

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PairScore:
    """How a fused pair compares with the truth.

    ``right``, ``reported``, ``common``: reported correspondences that are true, all reported, all true ones.
    ``displacement`` [m]: mean distance of the common landmarks from their true places, in the frame of the first map
    (NaN where nothing was merged). ``nees_T12``: normalised estimation error squared of T12, chi-square with 3 degrees
    of freedom where its covariance holds; ``nees_landmarks`` (k,): of every fused landmark that is one true place,
    each with 2.
    """

    decision: PairDecision
    probability: float
    right: int
    reported: int
    common: int
    displacement: float
    nees_T12: float
    nees_landmarks: Array

    @property
    def merged_wrongly(self) -> bool:
        """A merge with less than 80 % of its correspondences true, or its common landmarks off by more than 3 m."""
        return self.decision == "merged" and (self.right < 0.8 * self.reported or not self.displacement <= 3.0)


def score_pair(fused: FusedMap, truth: Truth) -> PairScore:
    """The score of two fused maps whose truth is known.

    >>> from mapfuse.datasets.simulation.pairs import simulated_pair
    >>> map1, map2, truth = simulated_pair(1)
    >>> from mapfuse.fusion import fuse
    >>> score = score_pair(fuse([map1, map2]), truth)
    >>> score.decision, score.merged_wrongly, score.right == score.reported
    ('merged', False, True)
    """
    pair = fused.pairs[0]
    true_pairs = set(truth.true_pairs(*pair.maps))
    right = len(true_pairs & set(pair.correspondences))
    displacement = nees_T12 = float("nan")
    nees: list[float] = []
    if pair.decision == "merged" and pair.T12 is not None:
        found = _errors(fused, truth)
        nees = [_nees(error, covariance) for error, covariance, _ in found]
        distances = [float(np.hypot(*error)) for error, _, common in found if common]
        displacement = float(np.mean(distances)) if distances else float("inf")
        error_T12 = pair.T12.array - truth.T12(*pair.maps).array
        error_T12[2] = se2.wrap(error_T12[2])
        nees_T12 = _nees(error_T12, np.asarray(pair.T12.covariance))
    return PairScore(
        pair.decision,
        pair.probability,
        right,
        len(pair.correspondences),
        len(true_pairs),
        displacement,
        nees_T12,
        np.array(nees),
    )


def _errors(fused: FusedMap, truth: Truth) -> list[tuple[Array, Array, bool]]:
    """Per fused landmark that is one true place: error (2,), covariance (2, 2), and whether both maps have it."""
    into_frame = se2.inverse(truth.frames[fused.groups[0][0]])
    found = []
    for landmark in fused.landmarks:
        places = {truth.landmarks[name][i] for name, ids in landmark.sources.items() for i in ids}
        place = places.pop() if len(places) == 1 else None
        if place is not None:
            error = np.array([landmark.x, landmark.y]) - se2.transform(into_frame, truth.places[place])
            found.append((error, landmark.covariance[:2, :2], len(landmark.sources) > 1))
    return found


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))
