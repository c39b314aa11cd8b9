"""Who passed what: what two robots did not see of each other's maps, and how much both travelled.

A landmark of one map that lies where the other robot travelled, and isn't in its map, is a miss; a blocked arm through
which it drove contradicts, and so do corridors that cross where neither map has a landmark; emptiness that both agree
on speaks for an overlap (docs/evidence.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .background import Background
from .config import EvidenceConfig
from .coverage import Segments, bare_crossings, overlap_length, passed
from .regularity import evidence_kernels

Array = NDArray[np.float64]
Index = NDArray[np.intp]

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
    that are the same.
    """
    m1, m2 = background.m1, background.m2
    p1, p2 = placed
    width, angle = config.corridor_width_m, float(np.deg2rad(config.corridor_angle_deg))
    s1, s2 = Segments.of(m1, p1), Segments.of(m2, p2)
    through = evidence_kernels().blocked_ways
    inside1, inside2 = passed(p2, s1, width, END_MARGIN_M), passed(p1, s2, width, END_MARGIN_M)
    through2 = through(inside1, m2.arm_headings, m2.arm_passable, float(T12[2]), s1.start, s1.end, angle)
    through1 = through(inside2, m1.arm_headings, m1.arm_passable, 0.0, s2.start, s2.end, angle)
    blocked = int(through1[matched[0]].sum() + through2[matched[1]].sum())
    through1 = np.maximum(through1, background.corners1 & inside2.any(axis=1))
    through2 = np.maximum(through2, background.corners2 & inside1.any(axis=1))
    by1: NDArray[np.bool_] = np.asarray(passed(p2, s1, width).any(axis=1))
    by2: NDArray[np.bool_] = np.asarray(passed(p1, s2, width).any(axis=1))
    area_overlap = 0.0
    if background.points1.any() or background.points2.any():
        # where both have a landmark of another kind the place was recorded, only differently
        moved = background.area2.moved(T12)
        by1 = np.asarray(np.where(background.points2, background.area1.contains(p2), by1))
        by2 = np.asarray(np.where(background.points1, moved.contains(p1), by2))
        area_overlap = background.area1.area(moved)
    by2[matched[0]], by1[matched[1]] = False, False
    overlap = overlap_length(s1, s2, width, angle)
    crossed = len(bare_crossings(s1, s2, np.concatenate([p1, p2])))
    clash1, clash2 = _clashes(background, p1, p2, matched, width)
    missed1, missed2 = np.flatnonzero(by2), np.flatnonzero(by1)
    return Passing(missed1, missed2, blocked, through1, through2, clash1, clash2, crossed, overlap, area_overlap)


def _clashes(
    background: Background, p1: Array, p2: Array, matched: tuple[Index, Index], width: float
) -> tuple[Index, Index]:
    """Unmatched corners and junctions of both maps that stand within ``width`` [m] of one of the other type, nearest
    first, each in one pair at most."""
    free1, free2 = background.spatial1.copy(), background.spatial2.copy()
    free1[matched[0]], free2[matched[1]] = False, False
    i, j = np.flatnonzero(free1), np.flatnonzero(free2)
    apart = np.hypot(*(p1[i, None] - p2[None, j]).transpose(2, 0, 1))
    apart[background.corners1[i, None] == background.corners2[None, j]] = np.inf
    found: list[tuple[int, int]] = []
    while apart.size and apart.min() < width:
        a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
        found.append((int(i[a]), int(j[b])))
        apart[a, :], apart[:, b] = np.inf, np.inf
    pairs = np.array(found, dtype=np.intp).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def emptiness(way: Passing, background: Background, config: EvidenceConfig) -> tuple[float, float, float, float]:
    """Misses, void, arms and crossings [nats]: what is said by what two robots did not see of each other's maps."""
    sides = (
        (background.m1.false, background.unseen1, way.missed1, way.through1),
        (background.m2.false, background.unseen2, way.missed2, way.through2),
    )
    misses, arms = 0.0, per_arm(config) * way.blocked
    false, unseen = [], []
    for wrong, either, missed, through in sides:
        # a landmark that isn't there says nothing of its arms
        seen = np.log(either)
        driven = np.log(wrong + np.exp(per_arm(config) * through) * np.maximum(either - wrong, 0.0))
        misses += float(seen[missed].sum())
        arms += float((driven - seen)[missed].sum())
        false.append(wrong)
        unseen.append(np.exp(driven))
    if len(way.clash1):
        # two robots were there, and one of them is wrong: all cases but that both are right
        counted1, counted2 = np.isin(way.clash1, way.missed1), np.isin(way.clash2, way.missed2)
        f1, f2 = false[0][way.clash1], false[1][way.clash2]
        u1, u2 = unseen[0][way.clash1], unseen[1][way.clash2]
        one_wrong = np.log(u1 * u2 - (u1 - f1) * (u2 - f2))
        misses += float((one_wrong - counted1 * np.log(u1) - counted2 * np.log(u2)).sum())
    void = background.common * way.overlap
    if way.area_overlap:
        void += background.area_common * way.area_overlap
    crossings = per_crossing(background) * way.crossed if way.crossed else 0.0
    return misses, float(void), float(arms), crossings


def per_crossing(background: Background) -> float:
    """What two corridors that cross without a landmark take off [nats]: both robots missed it, or there is none."""
    missed = (1 - background.m1.map.noise.detection_rate) * (1 - background.m2.map.noise.detection_rate)
    return float(np.log((1 - background.bridges) * missed + background.bridges))


def per_arm(config: EvidenceConfig) -> float:
    """What an arm that contradicts takes off [nats]."""
    return float(np.log(config.arm_error_rate / 0.5))
