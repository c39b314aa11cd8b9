"""The loops of who passed what, compiled: landmarks, blocked arms, crossings, and how much corridor is common.

Import through `mapfuse.datasets.compiled.kernels` only. Corridors are straight, travelled links; docs/evidence.md has
the formulas.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.compiled import kernel

TWO_PI = 2 * np.pi

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.intp]


class Ways(NamedTuple):
    """n landmarks of one map and the corridors (m, 2) between them, as `mapfuse.fusion.prepared.PreparedMap` has them;
    ``corner``, ``spatial`` (n,): which are corners by their type, which corners or junctions."""

    xy: Array
    corridors: Index
    arm: Array
    passable: Flags
    corner: Flags
    spatial: Flags


class Limits(NamedTuple):
    """Half the ``width`` of a corridor [m], the ``angle`` [rad] within which directions are one, the ``margin`` [m] of
    links' ends; by what sine corridors cross at least, and how ``clear`` [m] of landmarks and ends."""

    width: float
    angle: float
    margin: float
    sine: float
    clear: float


@kernel
def passed(points, start, end, width, margin):
    """Which segments (start, end) pass which points: lateral offset below ``width`` [m], inside the ends by
    ``margin`` [m]; (points, segments). And of each point (points,) whether any does, whatever the margin."""
    inside, anyhow = np.zeros((len(points), len(start)), np.bool_), np.zeros(len(points), np.bool_)
    for s in range(len(start)):
        dx, dy = end[s, 0] - start[s, 0], end[s, 1] - start[s, 1]
        length = np.hypot(dx, dy)
        dx, dy = dx / max(length, 1e-9), dy / max(length, 1e-9)
        for p in range(len(points)):
            x, y = points[p, 0] - start[s, 0], points[p, 1] - start[s, 1]
            along, across = x * dx + y * dy, y * dx - x * dy
            near = abs(across) < width
            inside[p, s] = near and margin < along < length - margin
            anyhow[p] |= near and 0.0 < along < length
    return inside, anyhow


@kernel
def covered(start1, end1, start2, end2, width, cosine):
    """Length [m] of the segments 1 that lies alongside one of 2: within ``width`` [m], parallel to ``cosine``."""
    total = 0.0
    low, high, length2 = np.empty(len(start2)), np.empty(len(start2)), np.empty(len(start2))
    for b in range(len(start2)):
        length2[b] = max(np.hypot(end2[b, 0] - start2[b, 0], end2[b, 1] - start2[b, 1]), 1e-9)
    for a in range(len(start1)):
        dx, dy = end1[a, 0] - start1[a, 0], end1[a, 1] - start1[a, 1]
        length = np.hypot(dx, dy)
        dx, dy = dx / max(length, 1e-9), dy / max(length, 1e-9)
        found = 0
        for b in range(len(start2)):
            sx, sy = start2[b, 0] - start1[a, 0], start2[b, 1] - start1[a, 1]
            ex, ey = end2[b, 0] - start1[a, 0], end2[b, 1] - start1[a, 1]
            s, e = sx * dx + sy * dy, ex * dx + ey * dy
            if abs(e - s) <= cosine * length2[b]:  # not parallel
                continue
            first = min(max(min(s, e), 0.0), length)
            last = min(max(s, e, 0.0), length)
            if last <= first:
                continue
            # across at the middle of the stretch that lies alongside
            share = ((first + last) / 2 - s) / (e - s) if abs(e - s) > 1e-9 else 0.5
            mx, my = sx + share * (ex - sx), sy + share * (ey - sy)
            if abs(my * dx - mx * dy) < width:
                low[found], high[found] = first, last
                found += 1
        order = np.argsort(low[:found])
        reach = -np.inf
        for k in order:
            total += max(high[k] - max(low[k], reach), 0.0)
            reach = max(reach, high[k])
    return total


@kernel
def painted(centres, radius, low, step, shape):
    """Which cells of a grid have their middle in one of the discs around ``centres`` (k, 2); bool of ``shape``.

    ``low`` (2,): corner of the first cell; ``step``: side of a cell.
    """
    inside = np.zeros(shape, np.bool_)
    for k in range(len(centres)):
        cx, cy = centres[k, 0] - low[0], centres[k, 1] - low[1]
        first_x, last_x = max(int((cx - radius) / step) - 1, 0), min(int((cx + radius) / step) + 1, shape[0] - 1)
        first_y, last_y = max(int((cy - radius) / step) - 1, 0), min(int((cy + radius) / step) + 1, shape[1] - 1)
        for i in range(first_x, last_x + 1):
            dx = (i + 0.5) * step - cx
            for j in range(first_y, last_y + 1):
                dy = (j + 0.5) * step - cy
                if dx * dx + dy * dy < radius * radius:
                    inside[i, j] = True
    return inside


@kernel
def blocked_ways(by, arm, passable, turn, start, end, angle):
    """How many blocked arms of each passed landmark (n,) point along the other robot's way, within ``angle`` [rad].

    ``by`` (n, segments): which segments pass which landmark; ``turn`` [rad]: of the arms' map in the segments' frame.
    """
    count = np.zeros(len(by), np.intp)
    for s in range(len(start)):
        way = np.arctan2(end[s, 1] - start[s, 1], end[s, 0] - start[s, 0])
        for k in range(len(by)):
            if not by[k, s]:
                continue
            ahead = behind = False
            for a in range(arm.shape[1]):
                if np.isnan(arm[k, a]) or passable[k, a]:
                    continue
                off = abs((arm[k, a] + turn - way + np.pi) % TWO_PI - np.pi)
                ahead |= off < angle
                behind |= np.pi - off < angle
            count[k] += ahead
            count[k] += behind
    return count


@kernel
def crossings(start1, end1, start2, end2, marks, clear, sine):
    """Points (k, 2) where segments of the one cross segments of the other: by an angle of that ``sine`` at least, more
    than ``clear`` [m] inside all ends and away from all ``marks`` (n, 2). Those closer together are one."""
    found = np.empty((len(start1) * len(start2), 2))
    count = 0
    for i in range(len(start1)):
        ax, ay = end1[i, 0] - start1[i, 0], end1[i, 1] - start1[i, 1]
        a = np.hypot(ax, ay)
        if a <= 2 * clear:
            continue
        for j in range(len(start2)):
            bx, by = end2[j, 0] - start2[j, 0], end2[j, 1] - start2[j, 1]
            b = np.hypot(bx, by)
            turn = ax * by - ay * bx
            if b <= 2 * clear or abs(turn) < sine * a * b:
                continue
            dx, dy = start2[j, 0] - start1[i, 0], start2[j, 1] - start1[i, 1]
            t, u = (dx * by - dy * bx) / turn, (dx * ay - dy * ax) / turn
            if not (clear < t * a < a - clear and clear < u * b < b - clear):
                continue
            x, y = start1[i, 0] + t * ax, start1[i, 1] + t * ay
            if _is_clear(x, y, marks, len(marks), clear) and _is_clear(x, y, found, count, clear):
                found[count, 0], found[count, 1] = x, y
                count += 1
    return found[:count].copy()


@kernel
def _is_clear(x, y, marks, count, clear):
    """Whether none of the first ``count`` marks is within ``clear`` [m] of a point."""
    near = False
    for k in range(count):
        near |= np.hypot(marks[k, 0] - x, marks[k, 1] - y) <= clear
    return not near


@kernel
def ends_of(xy, corridors):
    """Both ends (m, 2) of corridors between landmarks at ``xy`` (n, 2)."""
    start, end = np.empty((len(corridors), 2)), np.empty((len(corridors), 2))
    for c in range(len(corridors)):
        for axis in range(2):
            start[c, axis], end[c, axis] = xy[corridors[c, 0], axis], xy[corridors[c, 1], axis]
    return start, end


@kernel
def any_of_each(table):
    """Which rows of a table hold anything."""
    out = np.zeros(len(table), np.bool_)
    for row in range(len(table)):
        for column in range(table.shape[1]):
            out[row] |= table[row, column]
    return out


@kernel
def clashes(p1, p2, corner1, corner2, free1, free2, width):
    """Pairs (k,), (k,) of free landmarks within ``width`` [m] of one of the other type, nearest first, each in one pair
    at most; of equally near ones the first."""
    near = [(0.0, 0, 0)][:0]
    for i in range(len(p1)):
        for j in range(len(p2)):
            if free1[i] and free2[j] and corner1[i] != corner2[j]:
                apart = np.hypot(p1[i, 0] - p2[j, 0], p1[i, 1] - p2[j, 1])
                if apart < width:
                    heappush(near, (apart, i, j))
    free1, free2 = free1.copy(), free2.copy()
    first, second, count = np.empty(len(near), np.intp), np.empty(len(near), np.intp), 0
    while near:
        _, i, j = heappop(near)
        if free1[i] and free2[j]:
            first[count], second[count] = i, j
            free1[i] = free2[j] = False
            count += 1
    return first[:count].copy(), second[:count].copy()


@kernel
def passing(A, B, turn, p1, p2, i, j, limits):
    """What each robot passed of the other's map, whose landmarks lie at ``p1`` (n1, 2) and ``p2`` (n2, 2), map 2
    turned by ``turn`` [rad], the landmarks i (k1,) and j (k2,) being recorded by both; as
    `mapfuse.fusion.passing.Passing` has it.

    Which landmarks of map 1, of map 2 were passed; through how many blocked arms of each, and of matched ones; clashes;
    corridor of both [m]; how many corridors cross bare.
    """
    start1, end1 = ends_of(p1, A.corridors)
    start2, end2 = ends_of(p2, B.corridors)
    inside1, by2 = passed(p2, start1, end1, limits.width, limits.margin)
    inside2, by1 = passed(p1, start2, end2, limits.width, limits.margin)
    through1 = blocked_ways(inside2, A.arm, A.passable, 0.0, start2, end2, limits.angle)
    through2 = blocked_ways(inside1, B.arm, B.passable, turn, start1, end1, limits.angle)
    blocked = 0
    free1, free2 = A.spatial.copy(), B.spatial.copy()
    # not necessarily pairs: of some only that they are recorded by both is known, and there may be more in one map
    for n in range(len(i)):
        blocked += through1[i[n]]
        free1[i[n]] = False
    for n in range(len(j)):
        blocked += through2[j[n]]
        free2[j[n]] = False
    # a corner that the other robot drove straight across contradicts, whatever its arms
    across1, across2 = any_of_each(inside2), any_of_each(inside1)
    for k in range(len(p1)):
        if A.corner[k] and across1[k] and not through1[k]:
            through1[k] = 1
    for k in range(len(p2)):
        if B.corner[k] and across2[k] and not through2[k]:
            through2[k] = 1
    cosine = np.cos(limits.angle)
    overlap = covered(start1, end1, start2, end2, limits.width, cosine)
    overlap += covered(start2, end2, start1, end1, limits.width, cosine)
    crossed = crossings(start1, end1, start2, end2, np.concatenate((p1, p2)), limits.clear, limits.sine)
    return (
        by1,
        by2,
        through1,
        through2,
        blocked,
        clashes(p1, p2, A.corner, B.corner, free1, free2, limits.width),
        overlap / 2,
        len(crossed),
    )


@kernel
def unseen(false, either, through, k, per_arm):
    """Log probability of what the other robot shows at landmark k, by that it passed it unseen, and by that and the
    blocked arms that it drove ``through``, each worth ``per_arm`` [nats].

    ``false`` (n,): that the landmark isn't there, ``either`` (n,): that, or that it was missed. A landmark that isn't
    there says nothing of its arms.
    """
    driven = np.log(false[k] + np.exp(per_arm * through[k]) * max(either[k] - false[k], 0.0))
    return np.log(either[k]), driven


@kernel
def silence(false1, either1, missed1, through1, false2, either2, missed2, through2, clash1, clash2, per_arm):
    """Misses and arms [nats] of what two robots did not see of each other's landmarks: ``missed`` (k,) ones of either
    map, and those that ``clash`` (m,); ``false``, ``either`` and ``through`` as in `unseen`."""
    misses = arms = 0.0
    for k in missed1:
        seen, driven = unseen(false1, either1, through1, k, per_arm)
        misses += seen
        arms += driven - seen
    for k in missed2:
        seen, driven = unseen(false2, either2, through2, k, per_arm)
        misses += seen
        arms += driven - seen
    for n in range(len(clash1)):
        a, b = clash1[n], clash2[n]
        one, other = unseen(false1, either1, through1, a, per_arm)[1], unseen(false2, either2, through2, b, per_arm)[1]
        # two robots were there, and one of them is wrong: all cases but that both are right
        right = (np.exp(one) - false1[a]) * (np.exp(other) - false2[b])
        misses += np.log(np.exp(one) * np.exp(other) - right)
        misses -= one * (missed1 == a).any() + other * (missed2 == b).any()
    return misses, arms


class Unseen(NamedTuple):
    """Probability that each landmark of a map (n,) isn't there, and that it isn't or was missed (`unseen`); which are
    ``point`` landmarks, and of each of g hypotheses which the other robot would have seen if they were (g, n)."""

    false: Array
    either: Array
    point: Flags
    in_sight: Flags


@kernel
def silences(A, B, turns, p1, p2, begin, i, j, U, V, per_arm, limits):
    """What g hypotheses say by what two robots did not see of each other's maps; the landmarks of both lie at ``p1``
    (g, n1, 2) and ``p2`` (g, n2, 2), and of hypothesis h those ``begin[h]`` to ``begin[h + 1]`` of i and j are recorded
    by both. U, V: `Unseen` of map 1, map 2.

    Misses, and arms that contradict [nats]; corridor of both [m]; how many cross bare (g,). Which landmarks of map 1
    and of map 2 were missed, and through how many blocked arms of each the other robot drove (g, n).
    """
    g = len(turns)
    misses, arms, overlap, crossed = np.empty(g), np.empty(g), np.empty(g), np.empty(g, np.intp)
    missed1, missed2 = np.empty(p1.shape[:2], np.bool_), np.empty(p2.shape[:2], np.bool_)
    through1, through2 = np.empty(p1.shape[:2], np.intp), np.empty(p2.shape[:2], np.intp)
    for h in range(g):
        own_i, own_j = i[begin[h] : begin[h + 1]], j[begin[h] : begin[h + 1]]
        missed1[h], missed2[h], through1[h], through2[h], blocked, (clash1, clash2), overlap[h], crossed[h] = passing(
            A, B, turns[h], p1[h], p2[h], own_i, own_j, limits
        )
        lacking(missed1[h], own_i, U.point, U.in_sight[h])
        lacking(missed2[h], own_j, V.point, V.in_sight[h])
        gone1, gone2 = np.flatnonzero(missed1[h]), np.flatnonzero(missed2[h])
        misses[h], arms[h] = silence(
            U.false, U.either, gone1, through1[h], V.false, V.either, gone2, through2[h], clash1, clash2, per_arm
        )
        arms[h] += per_arm * blocked
    return misses, arms, overlap, crossed, missed1, missed2, through1, through2


@kernel
def lacking(passed, matched, point, in_sight):
    """Of the landmarks ``passed`` along corridors leaves those that the other map lacks: ``point`` landmarks go by
    whether they were ``in_sight``, and those that are ``matched`` aren't missed."""
    for k in range(len(passed)):
        if point[k]:
            passed[k] = in_sight[k]
    for k in matched:
        passed[k] = False
