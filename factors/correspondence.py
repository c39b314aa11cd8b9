"""Correspondences: the same landmark in two maps (measurement model, row 10)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapfuse.datasets import arms
from mapfuse.datasets.maps import Landmark, LandmarkMap

from .axes import wrapped
from .heading import arms_variance, headings_of, signatures_of
from .keys import LandmarkKey
from .measurement import Between
from .noise import Loss, PoseNoise

#: Two robots mean the same place to within this per axis [m] and in rotation [rad].
SAME_PLACE = 0.05
SAME_HEADING = 0.01


@dataclass(frozen=True, slots=True)
class Correspondence(Between):
    """Landmarks ``a`` and ``b`` of two maps are one; ``measured[2]`` is the turn between their headings."""

    @property
    def pair(self) -> tuple[LandmarkKey, LandmarkKey]:
        """The two landmarks."""
        assert isinstance(self.a, LandmarkKey)
        assert isinstance(self.b, LandmarkKey)
        return self.a, self.b

    @property
    def has_heading(self) -> bool:
        """Whether it ties the two landmarks' rotations as well as their positions."""
        return self.noise.tt > 0

    @property
    def dof(self) -> int:
        """Rows it measures: 3, or 2 without heading."""
        return 3 if self.has_heading else 2


def arm_turn(
    map1: LandmarkMap, landmark1: Landmark, map2: LandmarkMap, landmark2: Landmark, rotation: float
) -> tuple[float, float] | None:
    """``theta_b - theta_a`` of two landmarks that are one, and its variance beyond `SAME_HEADING`; None: unknown.

    ``rotation`` [rad] takes map 2 into map 1. An arm m stands at ``theta + alpha_m`` in the merged frame, alpha_m being
    its heading less the landmark's; the arms that meet are the same arm, so the difference is the mean of
    ``alpha_a,m - alpha_b,m'``. Its variance is that of the arms' own errors on both sides (`heading.arms_variance`).

    None where no arms meet, or one of the two has no heading, or only one of them has arms (its heading is then
    defined otherwise). Two landmarks without arms mean the same by their own headings: 0.
    """
    h1, h2 = headings_of(map1)[landmark1.id], headings_of(map2)[landmark2.id]
    if h1 is None or h2 is None:
        return None
    arms1, arms2 = signatures_of(map1)[landmark1.id], signatures_of(map2)[landmark2.id]
    if not arms1.headings and not arms2.headings:
        return 0.0, 0.0
    met = _one_to_one(arms1, arms2, rotation)
    if not met:
        return None
    # the error of a travelled arm is in its link already: such arms count only where there are no others, and half
    own = [(m, n) for m, n in met if not (_travelled(landmark1, arms1, m) or _travelled(landmark2, arms2, n))]
    used, share = (own, 1.0) if own else (met, 2.0)
    off = [wrapped(arms1.headings[m] - h1 - (arms2.headings[n] - h2)) for m, n in used]
    turn = off[0] + sum(wrapped(value - off[0]) for value in off) / len(off)
    variance = sum(
        arms_variance(recorded, landmark, len(used)) for recorded, landmark in ((map1, landmark1), (map2, landmark2))
    )
    return wrapped(turn), float(share * variance)


def _travelled(landmark: Landmark, signature: arms.ArmSignature, arm: int) -> bool:
    link = landmark.links[signature.links[arm]]
    return link.connected_to_id is not None and link.distance is not None


def _one_to_one(arms1: arms.ArmSignature, arms2: arms.ArmSignature, rotation: float) -> tuple[tuple[int, int], ...]:
    """Pairs of arms that meet, each arm of 1 with the nearest of 2 only."""
    nearest: dict[int, tuple[float, int]] = {}
    for m, n in arms.overlay(arms1, arms2, rotation).pairs:
        off = abs(wrapped(arms2.headings[n] + rotation - arms1.headings[m]))
        nearest[m] = min(nearest.get(m, (np.inf, n)), (off, n))
    return tuple((m, n) for m, (_, n) in sorted(nearest.items()))


def correspondence(
    map1: LandmarkMap,
    a: LandmarkKey,
    map2: LandmarkMap,
    b: LandmarkKey,
    rotation: float,
    loss: Loss | None = None,
    robots: int = 2,
) -> Correspondence:
    """Landmark ``a`` of map 1 and ``b`` of map 2 are one, under a hypothesis whose T12 has this rotation [rad].

    ``robots``: how many robots recorded the landmark, each two of them being tied by a correspondence. All n (n-1) / 2
    differences say what n - 1 of them do, so that each counts with 2 / n of its information: with r_k the robots' ideas
    of one place, ``sum over pairs |r_k - r_l|^2 = n sum |r_k - mean|^2``.

    Without a common heading only the positions are tied. The measured rotation then is the one that the hypothesis
    predicts: the full logarithm stretches position errors with the rotation's error, by 2 % even at 40 degrees.
    """
    landmark1, landmark2 = map1[a.id], map2[b.id]
    turned = arm_turn(map1, landmark1, map2, landmark2, rotation)
    place = SAME_PLACE * float(np.sqrt(robots / 2))
    if turned is None:
        predicted = wrapped(rotation + (headings_of(map2)[b.id] or 0.0) - (headings_of(map1)[a.id] or 0.0))
        return Correspondence(a, b, (0.0, 0.0, predicted), PoseNoise.from_sigmas(place, place, np.inf), loss)
    turn, variance = turned
    noise = PoseNoise.from_sigmas(place, place, float(np.sqrt((SAME_HEADING**2 + variance) * robots / 2)))
    return Correspondence(a, b, (0.0, 0.0, turn), noise, loss)
