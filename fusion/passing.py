"""Who passed what: what two robots did not see of each other's maps, and how much both travelled.

A landmark of one map that lies where the other robot travelled, and isn't in its map, is a miss; a blocked arm through
which it drove contradicts, and so do corridors that cross where neither map has a landmark; emptiness that both agree
on speaks for an overlap (docs/evidence.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .background import Background
from .config import EvidenceConfig
from .coverage import CROSSING_CLEAR_M, CROSSING_DEG, passing_kernels
from .elastic import Several

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Flags = NDArray[np.bool_]

#: A blocked arm of a landmark this close [m] to the end of a link isn't driven through: the link may turn there.
END_MARGIN_M = 1.0


@dataclass(frozen=True, eq=False)
class Passing:
    """Who passed what: places of unmatched landmarks that the other robot passed, and blocked arms driven through.

    ``blocked``: how many blocked arms of matched landmarks were driven through. ``through1`` (n1,), ``through2`` (n2,):
    the same of each landmark, where a corner that the other robot drove straight across counts as one at least,
    whatever its arms. ``clash1``, ``clash2`` (c,): places of unmatched corners and junctions of map 1, map 2 that stand
    at one place although they are of different types.
    ``crossed``: how many corridors of either map cross one of the other where neither has a landmark.
    ``overlap`` [m]: corridor that both travelled; ``area_overlap`` [m^2]: where both would have seen points.
    """

    missed1: Index
    missed2: Index
    blocked: int
    through1: Index
    through2: Index
    clash1: Index
    clash2: Index
    crossed: int
    overlap: float
    area_overlap: float

    @property
    def of_missed(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """``through1`` and ``through2`` of the missed landmarks."""
        return tuple(self.through1[self.missed1].tolist()), tuple(self.through2[self.missed2].tolist())


def passing_at(
    T12: Array,
    placed: tuple[Array, Array],
    matched: tuple[Index, Index],
    background: Background,
    config: EvidenceConfig,
) -> Passing:
    """What each robot passed of the other's map, map 2 lying at ``T12`` (3,).

    ``placed``: where the landmarks of both maps then are, (n1, 2) and (n2, 2) in frame 1; ``matched``: places of those
    that both recorded, (k1,) and (k2,).
    """
    p1, p2 = (np.ascontiguousarray(p) for p in placed)
    kernels, turn = passing_kernels(), float(T12[2])
    by1, by2, through1, through2, blocked, (clash1, clash2), overlap, crossed = kernels.passing(
        *background.ways, turn, p1, p2, *matched, _limits(config.corridor_width_m, config.corridor_angle_deg)
    )
    area_overlap = 0.0
    if background.has_points:
        # where both have a landmark of another kind the place was recorded, only differently
        in_sight1, in_sight2, area_overlap = _seen_at(T12, p1, p2, background)
        by1 = np.where(background.points1, in_sight1, by1)
        by2 = np.where(background.points2, in_sight2, by2)
    by1[matched[0]], by2[matched[1]] = False, False
    missed1, missed2 = by1.nonzero()[0], by2.nonzero()[0]
    return Passing(missed1, missed2, blocked, through1, through2, clash1, clash2, crossed, overlap, area_overlap)


@cache
def _limits(width_m: float, angle_deg: float) -> Any:
    """When a robot passed a landmark, and when corridors cross (`_passing_kernels.Limits`)."""
    angle, sine = math.radians(angle_deg), math.sin(math.radians(CROSSING_DEG))
    return passing_kernels().Limits(float(width_m), angle, END_MARGIN_M, sine, CROSSING_CLEAR_M)


def emptiness(way: Passing, background: Background, config: EvidenceConfig) -> tuple[float, float, float, float]:
    """Misses, void, arms and crossings [nats]: what is said by what two robots did not see of each other's maps."""
    arm = per_arm(config)
    misses, arms = passing_kernels().silence(
        *(background.m1.false, background.unseen1, way.missed1, way.through1),
        *(background.m2.false, background.unseen2, way.missed2, way.through2),
        *(way.clash1, way.clash2, arm),
    )
    void, crossings = _void_and_crossings(background, way.overlap, way.area_overlap, way.crossed)
    return misses, float(void), arms + arm * way.blocked, float(crossings)


@dataclass(frozen=True, eq=False)
class Silence:
    """What g hypotheses say [nats] by what two robots did not see of each other's maps, (g,) each, as `emptiness`.

    ``overlap`` (g,) [m]: corridor that both travelled. ``missed1`` (g, n1), ``missed2`` (g, n2): which landmarks the
    other robot passed without recording them; ``through1``, ``through2``: through how many blocked arms of each.
    """

    misses: Array
    void: Array
    arms: Array
    crossings: Array
    overlap: Array
    missed1: NDArray[np.bool_]
    missed2: NDArray[np.bool_]
    through1: Index
    through2: Index


def silences(several: Several, background: Background, config: EvidenceConfig) -> Silence:
    """`passing_at` and `emptiness` of hypotheses of one pair of maps, all at once."""
    in_sight, area_overlap = _seen_as_points(several, background)
    of_maps = (
        (background.m1, background.unseen1, background.points1),
        (background.m2, background.unseen2, background.points2),
    )
    unseen = (
        passing_kernels().Unseen(m.false, either, points, seen)
        for (m, either, points), seen in zip(of_maps, in_sight, strict=True)
    )
    misses, arms, overlap, crossed, *who = passing_kernels().silences(
        *(*background.ways, several.turns, several.p1, several.p2, several.begin, several.i, several.j),
        *(*unseen, per_arm(config), _limits(config.corridor_width_m, config.corridor_angle_deg)),
    )
    void, crossings = _void_and_crossings(background, overlap, area_overlap, crossed)
    return Silence(misses, void, arms, crossings, overlap, *who)


def _seen_as_points(several: Several, background: Background) -> tuple[tuple[Flags, Flags], Array]:
    """Which landmarks of map 1 (g, n1), of map 2 (g, n2) the other robot would have seen if they are points, and how
    much area both robots saw (g,) [m^2]; nothing, where there are no points."""
    in_sight1, in_sight2 = (np.zeros(p.shape[:2], dtype=bool) for p in (several.p1, several.p2))
    area = np.zeros(len(several.each))
    if background.has_points:
        for h, T12 in enumerate(several.T12s):
            in_sight1[h], in_sight2[h], area[h] = _seen_at(T12, several.p1[h], several.p2[h], background)
    return (in_sight1, in_sight2), area


def _seen_at(T12: Array, p1: Array, p2: Array, background: Background) -> tuple[Flags, Flags, float]:
    """The same of one hypothesis."""
    moved = background.area2.moved(T12)
    return moved.contains(p1), background.area1.contains(p2), background.area1.area(moved)


def _void_and_crossings(background: Background, overlap: Any, area_overlap: Any, crossed: Any) -> tuple[Any, Any]:
    """What emptiness that both robots agree on says, and what corridors that cross bare take off (...) [nats]."""
    void = background.common * overlap
    if np.any(area_overlap):
        void = void + background.area_common * area_overlap
    return void, (per_crossing(background) if np.any(crossed) else 0.0) * crossed


def per_crossing(background: Background) -> float:
    """What two corridors that cross without a landmark take off [nats]: both robots missed it, or there is none."""
    missed = (1 - background.m1.map.noise.detection_rate) * (1 - background.m2.map.noise.detection_rate)
    return float(np.log((1 - background.bridges) * missed + background.bridges))


def per_arm(config: EvidenceConfig) -> float:
    """What an arm that contradicts takes off [nats]."""
    return math.log(config.arm_error_rate / 0.5)
