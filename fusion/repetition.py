"""Does a building repeat itself? What makes one placement an alias of another, and what each map alone says of that.

Two placements of map 2 that both fit mean that the building looks alike at two places, or that one of them fits by
chance. If it looks alike, then map 2 moved from the one placement to the other lies on itself, and so does map 1:
each map is matched with itself (docs/evidence.md, "The repetition rule").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2

from .background import Background, recorded_rates
from .config import EvidenceConfig
from .coverage import SeenArea, Segments, passed
from .elastic import ArmOverlay
from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Shares of its landmarks that the image of a place in a repeating building may lack, with their prior: half exact.
LACKING = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9])
LACKING_PRIOR = np.array([0.5, 0.1, 0.1, 0.1, 0.1, 0.1])
#: A landmark is the image of another one where they are this far apart [m] or less.
IMAGE_M = 1.5
#: A motion that turns by half a turn, to within this [rad], undone by itself.
INVOLUTION = 0.3


def lacking_odds(hits: Array, misses: Array) -> Array:
    """log P(what was seen | the image lacks that share) - log P(... | it lacks nothing), for each of `LACKING` (6,).

    ``hits``, ``misses``: probability q that a landmark there is recorded, for those that were and those that weren't.
    """
    there = 1 - LACKING
    odds = len(hits) * np.log(there) + np.log1p(-misses[:, None] * there).sum(axis=0) - np.log1p(-misses).sum()
    return np.asarray(odds)


def alias(odds: Array, of_building: Array | None = None) -> float:
    """log odds of seeing what was seen at an image of the right place against at the right place itself [nats].

    ``odds``: `lacking_odds` there; ``of_building`` (6,): what the maps themselves say of the building lacking such
    shares at its images, against what a building that doesn't repeat itself would show. Without it an excellent
    agreement never counts for more than log 2 against an alias: only what is missing tells.
    """
    known = np.zeros(len(LACKING)) if of_building is None else of_building
    return float(np.logaddexp.reduce(np.log(LACKING_PRIOR) + odds + known))


@dataclass(frozen=True, eq=False)
class SelfMatch:
    """One map, to be matched with itself: which landmarks are ``points`` (n,), and the ``area`` that was seen."""

    m: PreparedMap
    points: NDArray[np.bool_]
    area: SeenArea
    config: EvidenceConfig

    def under(self, motion: Array) -> Array:
        """What the map says of its building lying on itself under a ``motion`` (3,) of its own frame, (6,).

        For each of `LACKING` the log probability of what it shows at the images of its landmarks, against that of a
        building which doesn't repeat itself (any of the shares, equally probable). 0 where the map has nothing to say.
        """
        forward = self._trials(motion)
        back = self._trials(np.asarray(se2.inverse(motion)))
        if abs(abs(se2.wrap(motion[2])) - np.pi) < INVOLUTION:  # there and back are the same pairs
            back = (np.zeros(0), np.zeros(0))
        hits, misses = (np.concatenate(both) for both in zip(forward, back, strict=True))
        odds = lacking_odds(hits, misses)
        return np.asarray(odds - (np.logaddexp.reduce(odds[1:]) - np.log(len(odds) - 1)))

    @cached_property
    def _rates(self) -> Array:
        return recorded_rates(self.m, self.m)

    def _trials(self, motion: Array) -> tuple[Array, Array]:
        """Rates q of landmarks whose image is recorded in the same map, and of those whose image was passed."""
        m = self.m
        placed = np.asarray(se2.transform(motion, m.positions))
        distance = np.linalg.norm(placed[:, None, :] - m.positions[None, :, :], axis=2)
        types = np.array(m.map.types)
        itself = np.diag(distance) < IMAGE_M
        i, j = np.nonzero((distance < IMAGE_M) & (types[:, None] == types[None, :]) & ~np.eye(len(m), dtype=bool))
        image = np.zeros(len(m), dtype=bool)
        if len(i):
            arms = ArmOverlay.at(m, m, float(-motion[2]), i, j)
            image[i[arms.contradict == 0]] = True
        by = passed(placed, Segments.of(m, m.positions), self.config.corridor_width_m).any(axis=1)
        by = np.where(self.points, self.area.contains(placed), by)
        return self._rates[image & ~itself], self._rates[by & ~image & ~itself]


def repeats(background: Background, config: EvidenceConfig, best: Array, rival: Array) -> Array:
    """What both maps say of the building lying on itself under the motion from the ``best`` T12 to a ``rival``, (6,).

    As `SelfMatch.under` says it, both maps together.
    """
    in1 = SelfMatch(background.m1, background.points1, background.area1, config)
    in2 = SelfMatch(background.m2, background.points2, background.area2, config)
    return in1.under(np.asarray(se2.compose(rival, se2.inverse(best)))) + in2.under(
        np.asarray(se2.compose(se2.inverse(rival), best))
    )
