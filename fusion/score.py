"""A fused pair against the truth: is the merge right, and do its covariances hold?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth

from .result import FusedMap, PairDecision

Array = NDArray[np.float64]

#: A merge is wrong with a smaller share of right correspondences, or common landmarks further off [m] on average than
#: the first map alone has them: a map's own drift is no fault of a merge, and none can mend it.
LEAST_RIGHT, MOST_OFF_M = 0.8, 3.0


@dataclass(frozen=True, slots=True)
class PairScore:
    """How a fused pair compares with the truth.

    ``right``, ``reported``, ``common``: reported correspondences that are true, all reported, all true ones.
    ``displacement`` [m]: mean distance of the common landmarks from their true places, in the frame of the first map,
    and ``own_displacement`` [m] of the same landmarks as the first map alone has them (NaN where nothing was merged).
    ``nees_T12``: normalised estimation error squared of T12, chi-square with 3 degrees of freedom where its covariance
    holds (`nees_of_transform`); ``nees_landmarks`` (k,): of every fused landmark that is one true place, each with 2.
    """

    decision: PairDecision
    probability: float
    right: int
    reported: int
    common: int
    displacement: float
    own_displacement: float
    nees_T12: float
    nees_landmarks: Array

    @property
    def merged_wrongly(self) -> bool:
        """A merge with less than `LEAST_RIGHT` of its correspondences true, or its common landmarks `MOST_OFF_M`
        further off than in the first map alone."""
        off = self.displacement - self.own_displacement
        return self.decision == "merged" and (self.right < LEAST_RIGHT * self.reported or not off <= MOST_OFF_M)


def score_pair(fused: FusedMap, truth: Truth) -> PairScore:
    """The score of two fused maps whose truth is known. Raises `KeyError` for a result that doesn't hold its maps.

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
    displacement = own = nees_T12 = float("nan")
    nees: list[float] = []
    if pair.decision == "merged" and pair.T12 is not None:
        found = _errors(fused, truth)
        nees = [_nees(landmark.error, landmark.covariance) for landmark in found]
        common = [landmark for landmark in found if landmark.common]
        displacement = float(np.mean([np.hypot(*l.error) for l in common])) if common else float("inf")
        own = float(np.mean([np.hypot(*l.own_error) for l in common])) if common else 0.0
        nees_T12 = nees_of_transform(pair.T12, truth.T12(*pair.maps))
    return PairScore(
        pair.decision,
        pair.probability,
        right,
        len(pair.correspondences),
        len(true_pairs),
        displacement,
        own,
        nees_T12,
        np.array(nees),
    )


@dataclass(frozen=True, slots=True)
class _Placed:
    """A fused landmark that is one true place: its error (2,) [m] in the frame of the first map, with its covariance
    (2, 2); whether both maps have it; and then its error (2,) as the first map alone has it."""

    error: Array
    covariance: Array
    common: bool
    own_error: Array


def _errors(fused: FusedMap, truth: Truth) -> list[_Placed]:
    first = fused.groups[0][0]
    own = fused.sources[first]
    into_frame = se2.inverse(truth.frames[first])
    found = []
    for landmark in fused.landmarks:
        places = {truth.landmarks[name][i] for name, ids in landmark.sources.items() for i in ids}
        place = places.pop() if len(places) == 1 else None
        if place is not None:
            there = se2.transform(into_frame, truth.places[place])
            at = np.array([landmark.x, landmark.y])
            recorded = [own.positions[own.index_from_id[i]] for i in landmark.sources.get(first, ())]
            own_error = np.mean(recorded or [at], axis=0) - there
            found.append(_Placed(at - there, landmark.covariance[:2, :2], len(landmark.sources) > 1, own_error))
    return found


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def nees_of_transform(found: Transform, true: Transform) -> float:
    """Normalised estimation error squared of a transformation with covariance, chi-square with 3 degrees of freedom.

    The error is told as a turn about the point that shift and turn are uncorrelated about by the covariance itself, and
    the shift of that point: to second order exponential coordinates (Long, Wolfe, Mashner and Chirikjian, "The banana
    distribution is Gaussian", RSS 2012). A frame whose origin is 50 m from there and which is turned by 0.1 rad leaves
    its tangent by 0.25 m; a covariance in the axes of the frame, which is one to first order, knows nothing of it. For
    small turns this is the usual NEES.

    >>> C = np.array([[25.01, 0.0, 0.5], [0.0, 0.01, 0.0], [0.5, 0.0, 0.01]])  # known to 0.1 rad, 50 m from there
    >>> found = Transform(0.0, 0.0, 0.0, C)
    >>> turned = Transform(50 * np.sin(0.1), 50 - 50 * np.cos(0.1), 0.1)  # off by just that, about that point
    >>> round(nees_of_transform(found, turned), 3)
    1.0
    """
    C = np.asarray(found.covariance)
    turn = float(se2.wrap(found.theta - true.theta))
    tangent = C[:2, 2] / C[2, 2]
    from_centre = np.array([tangent[1], -tangent[0]])
    arc = from_centre - se2.rotation(-turn) @ from_centre
    shift = found.array[:2] - true.array[:2] - arc
    return _nees(shift, C[:2, :2] - np.outer(C[:2, 2], tangent)) + turn**2 / float(C[2, 2])
