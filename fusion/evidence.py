"""What speaks for and against a hypothesis: its log odds against "these maps show different places".

Derivation and what each term buys: docs/evidence.md. The terms are kept apart so that a reason can be given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

from mapfuse.datasets.se2 import wrap

from .background import Background
from .coincidence import corridor_matches, corridor_prior, point_matches, point_prior
from .config import EvidenceConfig
from .elastic import Several
from .growth import Growth
from .passing import per_arm, silences
from .prepared import PreparedMap
from .repetition import alias, another_floor, lacking_of_all

Array = NDArray[np.float64]

#: Probability that two different buildings stand on one street grid, so that they agree modulo a quarter turn.
ONE_GRID = 0.5
#: All of `EvidenceConfig.look_elsewhere` is taken off where what a regular building is worth less comes to so many
#: nats; half of it where it comes to none, and so many distances along corridors are known that a rhythm would show.
REGULAR_NATS, DISTANCES = 7.5, 20
#: The error rate of arms is believed as if it had been found from so many.
ARMS_BEFORE = 4.0
#: Probability that a compass agrees by chance although its robot was misled by steel everywhere.
STEEL_RATE = 0.001


@dataclass(frozen=True, slots=True)
class Terms:
    """The parts of a hypothesis' log odds [nats]; their sum is `total`.

    ``prior``: density of T12 before looking. ``matches``: corridor landmarks that coincide. ``points``: point landmarks
    that coincide. ``regular``: what corridor landmarks are worth less in a regular building. ``misses``: landmarks the
    other robot passed and didn't record. ``void``: emptiness both agree on.
    ``arms``: blocked arms that the other robot drove through, or that contradict. ``crossings``: corridors of either
    map that cross one of the other where neither has a landmark. ``compass``: agreement of north.
    ``known``: landmarks that the maps themselves say are the same (``same_as``). ``stated``: agreement with what the
    user knows of T12 (`mapfuse.fusion.known.KnownTransform`). ``walls``: walls that the other
    robot drove or saw through.
    """

    prior: float = 0.0
    matches: float = 0.0
    points: float = 0.0
    regular: float = 0.0
    misses: float = 0.0
    void: float = 0.0
    arms: float = 0.0
    crossings: float = 0.0
    compass: float = 0.0
    known: float = 0.0
    stated: float = 0.0
    walls: float = 0.0

    @property
    def emptiness(self) -> float:
        """What is said by what two robots did not see of each other's maps: all but what matches."""
        return self.misses + self.void + self.arms + self.crossings

    @property
    def total(self) -> float:
        """Sum of all terms."""
        return float(sum(_each_term(self)))

    @property
    def by_name(self) -> dict[str, float]:
        """All terms by their names."""
        return dict(zip(_NAMES, _each_term(self), strict=True))


_NAMES = tuple(f.name for f in fields(Terms))
_each_term = attrgetter(*_NAMES)


@dataclass(frozen=True, eq=False)
class Weighed:
    """A grown hypothesis with its evidence.

    ``apart`` [nats]: what tells it from an alias of the right place whatever is missing: blocked arms, bare crossings,
    compass and walls.
    ``lacking`` (6,): what is there and what is missing, as the odds of an alias that lacks each of
    `mapfuse.fusion.repetition.LACKING`. ``missed1``, ``missed2``: landmarks of map 1, map 2 that the other robot passed
    without recording them; ``through1``, ``through2``: how many blocked arms of each of these it drove through
    (`mapfuse.fusion.passing.Passing`). ``spared`` [nats]: what of `EvidenceConfig.look_elsewhere` it didn't pay.
    ``other_floor`` [nats]: log odds of what is there and missing on another floor of one plan against on the same one.
    """

    growth: Growth
    terms: Terms
    apart: float
    lacking: Array
    missed1: tuple[int, ...]
    missed2: tuple[int, ...]
    through1: tuple[int, ...]
    through2: tuple[int, ...]
    spared: float
    other_floor: float

    @cached_property
    def log_odds(self) -> float:
        """Log odds against no overlap [nats], before the overlap prior."""
        return self.terms.total

    def alias(self, of_building: Array | None = None) -> float:
        """Log odds of seeing this at an image of the right place against at the right place itself [nats], given what
        the maps say of such images (`mapfuse.fusion.repetition.alias`)."""
        return float(alias(self.lacking, of_building)) - self.apart

    @property
    def alike(self) -> float:
        """Log odds of seeing this on another floor of the same plan against on the same floor [nats].

        Arms and compass don't tell such floors apart. What is known of the two maps speaks against another floor where
        this placement agrees with it; where it doesn't, it is as wrong on either.
        """
        return self.other_floor - self.terms.known - max(self.terms.stated, 0.0)


def _compass(m1: PreparedMap, m2: PreparedMap, theta: Array) -> Array:
    """log density of rotations (g,) given both compasses, against any rotation."""
    if m1.north is None or m2.north is None:
        return np.zeros(len(theta))
    off = theta - (m1.north[0] - m2.north[0])
    variance = m1.north[1] ** 2 + m2.north[1] ** 2
    quarters = wrap(off[:, None] - np.arange(4) * (math.pi / 2))
    density = np.exp(-0.5 * quarters**2 / variance) / math.sqrt(2 * math.pi * variance)
    anyhow = (1 - ONE_GRID) / (2 * math.pi) + ONE_GRID * density.sum(axis=1) / 4
    return np.asarray(np.log((1 - STEEL_RATE) * density[:, 0] + STEEL_RATE / (2 * math.pi)) - np.log(anyhow))


def look_elsewhere(regular: ArrayLike, distances: ArrayLike, config: EvidenceConfig) -> Array:
    """What is taken off a hypothesis (...) [nats], since many are tried and fit by what the model leaves out.

    All of it where the building is regular, by what that takes off (``regular`` (...) [nats], not above 0), or where
    too few ``distances`` (...) between landmarks are known to tell; down to half of it where they show none.
    """
    known = np.minimum(np.asarray(distances) / DISTANCES, 1.0)
    irregular = np.maximum(1 + np.asarray(regular) / REGULAR_NATS, 0.0) * known
    return np.asarray((1 - irregular / 2) * config.look_elsewhere)


def contradictions(agree: ArrayLike, contradict: ArrayLike, config: EvidenceConfig) -> Array:
    """What arms of matched landmarks take off [nats] (...) that ``contradict`` (...), where so many others ``agree``.

    How often the robots sense arms wrongly isn't known but as if `ARMS_BEFORE` arms had been compared before, of which
    the share `EvidenceConfig.arm_error_rate` contradicted. Each arm is predicted from all before it (a beta-binomial
    distribution), those that agree first; under no overlap an arm is open or blocked with even odds.

    >>> contradictions([0, 30], [1, 1], EvidenceConfig(arm_error_rate=0.05)).round(2).tolist()
    [-2.3, -4.44]
    """
    wrong, c = ARMS_BEFORE * config.arm_error_rate, np.asarray(contradict)
    seen = ARMS_BEFORE + np.asarray(agree)
    return np.asarray(c * math.log(2) + gammaln(wrong + c) - gammaln(wrong) - gammaln(seen + c) + gammaln(seen))


def weigh(growth: Growth, background: Background, config: EvidenceConfig) -> Weighed:
    """The evidence of a grown hypothesis."""
    return weigh_all([growth], background, config)[0]


def weigh_all(growths: Sequence[Growth], background: Background, config: EvidenceConfig) -> list[Weighed]:
    """The evidence of grown hypotheses of one pair of maps, in a few compiled calls for all of them."""
    if not growths:
        return []
    several = Several.of(g.joined for g in growths)
    said = silences(several, background, config)
    agree, contradict = (several.sums(np.concatenate([one.arms_met[k] for one in several.each])) for k in (0, 1))
    arms = said.arms + contradictions(agree, contradict, config)
    compass = _compass(background.m1, background.m2, several.turns)
    angle = math.radians(config.corridor_angle_deg)
    matches, regular = corridor_matches(several, background, angle)
    prior = corridor_prior(background, said.overlap)
    distances = np.full(len(growths), background.regularity(angle).distances)
    if background.has_points:
        on_points = several.sums(~background.points1[several.i]) == 0
        distances[on_points] = 0
        if on_points.any():
            prior[on_points] = point_prior(background)
    searched = look_elsewhere(regular, distances, config)
    points = [point_matches(one, background) for one in several.each]
    columns = (prior - searched, matches, points, regular, said.misses, said.void, arms, said.crossings, compass)
    terms = [Terms(*row) for row in np.column_stack(columns).tolist()]
    lacking = lacking_of_all(
        2 * np.diff(several.begin),
        (said.missed1, 1 - background.unseen1),
        (said.missed2, 1 - background.unseen2),
    )
    # an image has the arms of the right place, but for some: that one is another way tells it less apart than a place
    # which has nothing to do with it
    apart = (said.arms + per_arm(config) * contradict + said.crossings + compass).tolist()
    spared = (config.look_elsewhere - searched).tolist()
    missed1, missed2 = _of_missed(said.missed1, said.through1), _of_missed(said.missed2, said.through2)
    return [
        Weighed(growth, of_terms, off, odds, one[0], two[0], one[1], two[1], left, other)
        for growth, of_terms, off, odds, one, two, left, other in zip(
            growths, terms, apart, lacking, missed1, missed2, spared, another_floor(lacking).tolist(), strict=True
        )
    ]


def _of_missed(missed: NDArray[np.bool_], through: NDArray[np.intp]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Of every hypothesis the places of the missed landmarks, and through how many blocked arms of each was driven."""
    of, k = missed.nonzero()
    ends = np.searchsorted(of, np.arange(len(missed) + 1)).tolist()
    places, arms = k.tolist(), through[of, k].tolist()
    return [(tuple(places[a:b]), tuple(arms[a:b])) for a, b in pairwise(ends)]
