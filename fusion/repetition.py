"""Does a building repeat itself? What makes one placement an alias of another, and what each map alone says of that.

Two placements of map 2 that both fit mean that the building looks alike at two places, or that one of them fits by
chance. If it looks alike, then map 2 moved from the one placement to the other lies on itself, and so does map 1:
each map is matched with itself (docs/evidence.md, "The repetition rule").
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2

from .background import Background
from .config import EvidenceConfig, FuseConfig, SolvingConfig
from .elastic import ArmOverlay
from .growth import Growth, compatible, grow
from .passing import passing_at

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Shares of its landmarks that the image of a place in a repeating building may lack, with their prior: half exact.
LACKING = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9])
LACKING_PRIOR = np.array([0.5, 0.1, 0.1, 0.1, 0.1, 0.1])
#: A landmark that lies this close [m] to its own image says nothing.
IMAGE_M = 1.5
#: A landmark is the image of another one of its kind where, before bending, they lie this far apart [m] or less.
SEED_M = 4.0
#: From so many pairs of them a map is grown onto itself; the largest match counts.
SEEDS = 4
#: A motion that turns by half a turn, to within this [rad], undone by itself.
INVOLUTION = 0.3


#: What is there, and as logarithms: it, the prior, and the prior of floors that lack something.
THERE = 1 - LACKING
LOG_THERE, LOG_PRIOR = np.log(THERE), np.log(LACKING_PRIOR)
LOG_OTHER_FLOOR = np.log(LACKING_PRIOR[1:] / LACKING_PRIOR[1:].sum())


def lacking_odds(hits: Array, misses: Array) -> Array:
    """log P(what was seen | the image lacks that share) - log P(... | it lacks nothing), for each of `LACKING` (6,).

    ``hits``, ``misses``: probability q that a landmark there is recorded, for those that were and those that weren't.
    """
    return np.asarray(lacking_of_all(np.array([len(hits)]), (np.ones((1, len(misses)), dtype=bool), misses))[0])


def lacking_of_all(hits: Array, *missed: tuple[NDArray[np.bool_], Array]) -> Array:
    """`lacking_odds` of g hypotheses (g, 6).

    ``hits`` (g,): how many landmarks were recorded; ``missed``: of each map which weren't (g, n), and q (n,) of all.
    """
    log_missed = np.zeros((len(hits), len(LACKING)))
    for which, q in missed:
        log_missed += which @ np.log1p(-q[:, None] * THERE)
    return np.asarray(hits[:, None] * LOG_THERE + (log_missed - log_missed[:, :1]))  # the first lacks nothing


def alias(odds: Array, of_building: Array | None = None) -> Array:
    """log odds of seeing what was seen at an image of the right place against at the right place itself (...) [nats].

    ``odds`` (..., 6): `lacking_odds` there; ``of_building`` (..., 6): what the maps themselves say of the building
    lacking such shares at its images, against what a building that doesn't repeat itself would show. Without it an
    excellent agreement never counts for more than log 2 against an alias: only what is missing tells.
    """
    told = LOG_PRIOR + odds
    return np.asarray(np.logaddexp.reduce(told if of_building is None else told + of_building, axis=-1))


def another_floor(odds: Array) -> Array:
    """log odds of seeing what was seen on another floor of the same plan against on the same floor (...) [nats].

    ``odds`` (..., 6): `lacking_odds`. Such a floor lacks some of the landmarks: one that lacked nothing could be told
    from this one by no map.

    >>> q = np.full(40, 0.9)  # of 40 landmarks that nine in ten times are recorded, some aren't
    >>> [round(float(another_floor(lacking_odds(q[k:], q[:k]))), 1) for k in (0, 4, 12)]
    [-5.8, -2.8, 4.4]
    """
    return np.asarray(np.logaddexp.reduce(LOG_OTHER_FLOOR + odds[..., 1:], axis=-1))


@dataclass(frozen=True, eq=False)
class SelfMatch:
    """One map, to be matched with itself; ``background``: of the map and itself."""

    background: Background
    evidence: EvidenceConfig
    solving: SolvingConfig

    def under(self, motion: Array) -> Array:
        """What the map says of its building lying on itself under a ``motion`` (3,) of its own frame, (6,).

        For each of `LACKING` the log probability of what it shows at the images of its landmarks, against that of a
        building which doesn't repeat itself (any of the shares, equally probable). 0 where the map has nothing to say.
        """
        hits, misses = self.seen(motion)
        odds = lacking_odds(hits, misses)
        if abs(abs(se2.wrap(motion[2])) - np.pi) < INVOLUTION:  # there and back are the same pairs
            odds = odds / 2
        return np.asarray(odds - (np.logaddexp.reduce(odds[1:]) - np.log(len(odds) - 1)))

    def seen(self, motion: Array) -> tuple[Array, Array]:
        """Rates q of landmarks that are an image or have one, and of those whose image was passed and isn't there.

        The map is bent onto itself as two maps are onto each other: drift would part a building from its image.
        """
        b, m = self.background, self.background.m1
        placed = (m.positions, np.asarray(se2.transform(motion, m.positions)))
        matched = (np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))
        grown = self._grown(motion)
        if grown is not None:
            motion, placed, matched = grown.joined.T12, grown.joined.corrected(), (grown.i, grown.j)
        way = passing_at(motion, placed, matched, b, self.evidence)
        itself = np.linalg.norm(placed[0] - placed[1], axis=1) < IMAGE_M
        missed = [missed[~itself[missed]] for missed in (way.missed1, way.missed2)]
        # two points can always be laid on each other's images, nearly
        told = slice(0 if m.headed[matched[0]].any() else 2, None)
        hits = np.concatenate([b.recorded1[matched[0][told]], b.recorded2[matched[1][told]]])
        return hits, 1 - np.concatenate([b.unseen1[missed[0]], b.unseen2[missed[1]]])

    def _grown(self, motion: Array) -> Growth | None:
        """The map matched with itself, from the landmarks that lie nearest to one of their kind; None without any."""
        m = self.background.m1
        away = se2.transform(motion, m.positions)[None, :, :] - m.positions[:, None, :]
        may = compatible(m, m) & (np.hypot(away[..., 0], away[..., 1]) < SEED_M)
        np.fill_diagonal(may, False)
        i, j = np.nonzero(may)
        if not len(i):
            return None
        agree = ArmOverlay.at(m, m, float(motion[2]), i, j).contradict == 0
        order = np.argsort(np.where(agree, np.hypot(*away[i, j].T), np.inf), kind="stable")[: agree.sum()]
        near = [(int(i[k]), int(j[k])) for k in order]
        grown = [grow(m, m, motion, self._seed(near[k:]), self.solving, may) for k in range(min(SEEDS, len(near)))]
        return max((g for g in grown if self._keeps(motion, g)), key=lambda g: len(g.i), default=None)

    def _seed(self, near: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
        """The first pair, which turns the map by its heading; where it has none, one of other landmarks besides."""
        a, b = near[0]
        if self.background.m1.headed[a] and self.background.m1.headed[b]:
            return (near[0],)
        others = (pair for pair in near[1:] if not {a, b} & set(pair))
        return (near[0], *islice(others, 1))

    def _keeps(self, motion: Array, grown: Growth) -> bool:
        """Whether a match with itself is still that of the motion it began with."""
        T, centre = grown.joined.T12, self.background.m1.positions.mean(axis=0)
        off = se2.transform(T, centre) - se2.transform(motion, centre)
        return bool(np.hypot(*off) < SEED_M and abs(se2.wrap(T[2] - motion[2])) < INVOLUTION)


def repeats(background: Background, config: FuseConfig, best: Array, rival: Array) -> Array:
    """What both maps say of the building lying on itself under the motion from the ``best`` T12 to a ``rival``, (6,).

    As `SelfMatch.under` says it, both maps together; kept with the background, since a verdict is given before graphs
    are solved and after.
    """
    asked = (config.evidence, config.solving, best.tobytes(), rival.tobytes())
    if asked not in background.repeated:
        in1, in2 = (SelfMatch(b, config.evidence, config.solving) for b in background.of_each)
        background.repeated[asked] = in1.under(np.asarray(se2.compose(rival, se2.inverse(best)))) + in2.under(
            np.asarray(se2.compose(se2.inverse(rival), best))
        )
    return background.repeated[asked]
