"""What speaks for and against a hypothesis: its log odds against "these maps show different places".

Derivation and what each term buys: docs/evidence.md. The terms are kept apart so that a reason can be given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.arms import wrap

from .background import Background
from .coincidence import corridor_matches, corridor_prior, point_matches, point_prior
from .config import EvidenceConfig
from .growth import Growth
from .passing import emptiness, passing_at, per_arm
from .prepared import PreparedMap
from .repetition import alias, another_floor, lacking_odds

Array = NDArray[np.float64]

#: Probability that two different buildings stand on one street grid, so that they agree modulo a quarter turn.
ONE_GRID = 0.5
#: All of `EvidenceConfig.look_elsewhere` is taken off where what a regular building is worth less comes to so many
#: nats; half of it where it comes to none, and so many distances along corridors are known that a rhythm would show.
REGULAR_NATS, DISTANCES = 7.5, 20
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
    """

    growth: Growth
    terms: Terms
    apart: float
    lacking: Array
    missed1: tuple[int, ...]
    missed2: tuple[int, ...]
    through1: tuple[int, ...] = ()
    through2: tuple[int, ...] = ()
    spared: float = 0.0

    @property
    def log_odds(self) -> float:
        """Log odds against no overlap [nats], before the overlap prior."""
        return self.terms.total

    def alias(self, of_building: Array | None = None) -> float:
        """Log odds of seeing this at an image of the right place against at the right place itself [nats], given what
        the maps say of such images (`mapfuse.fusion.repetition.alias`)."""
        return float(alias(self.lacking, of_building)) - self.apart

    @cached_property
    def alike(self) -> float:
        """Log odds of seeing this on another floor of the same plan against on the same floor [nats].

        Arms and compass don't tell such floors apart. What is known of the two maps speaks against another floor where
        this placement agrees with it; where it doesn't, it is as wrong on either.
        """
        return float(another_floor(self.lacking)) - self.terms.known - max(self.terms.stated, 0.0)


def _normal_log(x: float, variance: float) -> float:
    return -0.5 * x * x / variance - 0.5 * math.log(2 * math.pi * variance)


def _compass(m1: PreparedMap, m2: PreparedMap, theta: float) -> float:
    """log density of the rotation given both compasses, against any rotation."""
    if m1.north is None or m2.north is None:
        return 0.0
    off = wrap(theta - (m1.north[0] - m2.north[0]))
    variance = m1.north[1] ** 2 + m2.north[1] ** 2
    quarters = [math.exp(_normal_log(wrap(off - k * math.pi / 2), variance)) for k in range(4)]
    anyhow = (1 - ONE_GRID) / (2 * math.pi) + ONE_GRID * sum(quarters) / 4
    return math.log((1 - STEEL_RATE) * quarters[0] + STEEL_RATE / (2 * math.pi)) - math.log(anyhow)


def look_elsewhere(regular: float, distances: int, config: EvidenceConfig) -> float:
    """What is taken off a hypothesis [nats], since many are tried and fit by what the model leaves out.

    All of it where the building is regular, by what that takes off (``regular`` [nats], not above 0), or where too few
    ``distances`` between landmarks are known to tell; down to half of it where they show none.
    """
    irregular = max(1 + regular / REGULAR_NATS, 0.0) * min(distances / DISTANCES, 1.0)
    return (1 - irregular / 2) * config.look_elsewhere


def weigh(growth: Growth, background: Background, config: EvidenceConfig) -> Weighed:
    """The evidence of a grown hypothesis."""
    joined = growth.joined
    way = passing_at(joined.T12, joined.corrected(), (joined.i, joined.j), background, config)
    misses, void, arms, crossings = emptiness(way, background, config)
    arms += per_arm(config) * int(joined.arms.contradict.sum())
    compass = _compass(joined.m1, joined.m2, float(joined.T12[2]))
    angle = math.radians(config.corridor_angle_deg)
    matches, regular = corridor_matches(joined, background, angle)
    on_corridors = not background.has_points or not background.points1[joined.i].all()
    prior = corridor_prior(background, way.overlap) if on_corridors else point_prior(background)
    searched = look_elsewhere(regular, background.regularity(angle).distances if on_corridors else 0, config)
    terms = Terms(
        prior=prior - searched,
        matches=matches,
        points=point_matches(joined, background),
        regular=regular,
        misses=misses,
        void=void,
        arms=arms,
        crossings=crossings,
        compass=compass,
    )
    hits = np.concatenate([background.recorded1[joined.i], background.recorded2[joined.j]])
    gone = 1 - np.concatenate([background.unseen1[way.missed1], background.unseen2[way.missed2]])
    return Weighed(
        growth,
        terms,
        arms + crossings + compass,
        lacking_odds(hits, gone),
        tuple(way.missed1.tolist()),
        tuple(way.missed2.tolist()),
        *way.of_missed,
        spared=config.look_elsewhere - searched,
    )
