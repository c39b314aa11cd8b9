"""The loops of weighing a hypothesis, compiled: who passed what, how much corridor is common, in which order matches
are come upon.

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
# A link shorter than this [m] has no direction to speak of.
SHORT_M = 0.5
# Constants of `mapfuse.fusion.regularity`.
REACH_M = 25.0
SAME_DISTANCE_M, SAME_DISTANCE_SHARE = 0.5, 0.03
ON_A_LINE, LINE_WIDTH_M, DOUBT = 0.5, 1.0, 2.0

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


class Rhythm(NamedTuple):
    """Distances along one map's straight corridors, as `mapfuse.fusion.regularity.Gaps` has them."""

    pairs: Index
    distance: Array
    origin: Index
    exposure: Array
    start: Index
    label: Index
    spatial: Flags


class Worth(NamedTuple):
    """What a match of each landmark of map 1 (n1,), and of map 2 (n2,), says by itself [nats].

    ``point``: in the open, no corridor leads there. ``there``: the log probability that it is there. ``kind``: what its
    arms say it is, as a number. ``rate`` [1/m]: how common its label is; ``ways``, ``rarity``: what arms that agree,
    and a kind that agrees, are worth; ``both``: the probability that two robots record it.
    """

    point1: Flags
    point2: Flags
    there1: Array
    there2: Array
    kind1: Index
    kind2: Index
    rate: Array
    ways: Array
    rarity: Array
    both: Array


class Limits(NamedTuple):
    """Half the ``width`` of a corridor [m], the ``angle`` [rad] within which directions are one, the ``margin`` [m] of
    links' ends; by what sine corridors cross at least, and how ``clear`` [m] of landmarks and ends."""

    width: float
    angle: float
    margin: float
    sine: float
    clear: float


@kernel
def passes(points, start, end, width, margin):
    """Which segments (start, end) pass which points: lateral offset below ``width`` [m], inside the ends by
    ``margin`` [m]; (points, segments)."""
    out = np.zeros((len(points), len(start)), np.bool_)
    for s in range(len(start)):
        dx, dy = end[s, 0] - start[s, 0], end[s, 1] - start[s, 1]
        length = np.hypot(dx, dy)
        dx, dy = dx / max(length, 1e-9), dy / max(length, 1e-9)
        for p in range(len(points)):
            x, y = points[p, 0] - start[s, 0], points[p, 1] - start[s, 1]
            along, across = x * dx + y * dy, y * dx - x * dy
            out[p, s] = margin < along < length - margin and abs(across) < width
    return out


@kernel
def covered(start1, end1, start2, end2, width, cosine):
    """Length [m] of the segments 1 that lies alongside one of 2: within ``width`` [m], parallel to ``cosine``."""
    total = 0.0
    low, high = np.empty(len(start2)), np.empty(len(start2))
    for a in range(len(start1)):
        dx, dy = end1[a, 0] - start1[a, 0], end1[a, 1] - start1[a, 1]
        length = np.hypot(dx, dy)
        dx, dy = dx / max(length, 1e-9), dy / max(length, 1e-9)
        found = 0
        for b in range(len(start2)):
            sx, sy = start2[b, 0] - start1[a, 0], start2[b, 1] - start1[a, 1]
            ex, ey = end2[b, 0] - start1[a, 0], end2[b, 1] - start1[a, 1]
            s, e = sx * dx + sy * dy, ex * dx + ey * dy
            other = np.hypot(ex - sx, ey - sy)
            parallel = abs(e - s) / max(other, 1e-9)
            if parallel <= cosine:
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
    inside1 = passes(p2, start1, end1, limits.width, limits.margin)
    inside2 = passes(p1, start2, end2, limits.width, limits.margin)
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
        any_of_each(passes(p1, start2, end2, limits.width, 0.0)),
        any_of_each(passes(p2, start1, end1, limits.width, 0.0)),
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


@kernel
def nearest(xy, of, to):
    """Place in ``of`` of the landmark whose distance to any of ``to`` is least."""
    best, distance = 0, np.inf
    for a in range(len(of)):
        for b in range(len(to)):
            x, y = xy[of[a], 0] - xy[to[b], 0], xy[of[a], 1] - xy[to[b], 1]
            if x * x + y * y < distance:
                best, distance = a, x * x + y * y
    return best


@kernel
def arrival(xy, arm, passable, node, before, earlier):
    """Direction (2,) of the corridor by which ``node`` was come upon: from ``before`` (-1: nowhere), else along the arm
    that points most to the nearest of the ``earlier`` landmarks; NaN where none does."""
    out = np.full(2, np.nan)
    if before >= 0:
        step = xy[node] - xy[before]
        length = np.hypot(step[0], step[1])
        if length > SHORT_M:
            return step / length
    if not len(earlier):
        return out
    here = np.empty(1, np.intp)
    here[0] = node
    to = earlier[nearest(xy, earlier, here)]
    off, largest = xy[node] - xy[to], -1.0
    for a in range(arm.shape[1]):
        if passable[node, a] and not np.isnan(arm[node, a]):
            x, y = np.cos(arm[node, a]), np.sin(arm[node, a])
            if abs(x * off[0] + y * off[1]) > largest:
                largest = abs(x * off[0] + y * off[1])
                out[0], out[1] = x, y
    return out


@kernel
def adjacency(n, corridors):
    """Neighbours of each landmark along corridors: those of k are ``neighbour[begin[k]:begin[k + 1]]``."""
    begin, neighbour = np.zeros(n + 1, np.intp), np.empty(2 * len(corridors), np.intp)
    for c in range(len(corridors)):
        begin[corridors[c, 0] + 1] += 1
        begin[corridors[c, 1] + 1] += 1
    begin = np.cumsum(begin)
    fill = begin[:-1].copy()
    for c in range(len(corridors)):
        a, b = corridors[c, 0], corridors[c, 1]
        neighbour[fill[a]], neighbour[fill[b]] = b, a
        fill[a] += 1
        fill[b] += 1
    return begin, neighbour


@kernel
def visited(xy, corridors, arm, passable, matched):
    """Order in which ``matched`` landmarks (k,) are come upon along the corridors (m, 2), as places in ``matched``,
    and the direction (k, 2) by which each is."""
    n, k = len(xy), len(matched)
    begin, neighbour = adjacency(n, corridors)
    place = np.full(n, -1, np.intp)
    place[matched] = np.arange(k)
    order, direction = np.empty(k, np.intp), np.empty((k, 2))
    middle = np.array([xy[matched, 0].mean(), xy[matched, 1].mean()])
    done_all = 0
    while done_all < k:
        remaining = np.sort(matched[place[matched] >= 0])
        if done_all:
            first = remaining[nearest(xy, remaining, matched[order[:done_all]])]
        else:
            off = xy[remaining] - middle
            first = remaining[np.argmin(off[:, 0] ** 2 + off[:, 1] ** 2)]
        queue = [(0.0, first, -1)]
        done = np.zeros(n, np.bool_)
        while queue:
            distance, node, before = heappop(queue)
            if done[node]:
                continue
            done[node] = True
            if place[node] >= 0:
                order[done_all] = place[node]
                direction[done_all] = arrival(xy, arm, passable, node, before, matched[order[:done_all]])
                place[node] = -1
                done_all += 1
                distance = 0.0
            for c in range(begin[node], begin[node + 1]):
                other = neighbour[c]
                if not done[other]:
                    step = np.hypot(xy[other, 0] - xy[node, 0], xy[other, 1] - xy[node, 1])
                    heappush(queue, (distance + step, other, node))
    return order, direction


@kernel
def gaps(xy, corridors, reach, cosine):
    """What is come upon along straight corridors: from landmark a to b at ``distance`` [m], up to ``reach``; and how
    far one could go on straight from each landmark in each direction it was left by (a, metres)."""
    n = len(xy)
    begin, neighbour = adjacency(n, corridors)
    ends, distances = [(0, 0)][:0], [0.0][:0]
    origin, exposure = [0][:0], [0.0][:0]
    for a in range(n):
        for c in range(begin[a], begin[a + 1]):
            before, node, travelled = a, neighbour[c], 0.0
            first = xy[node] - xy[a]
            length = np.hypot(first[0], first[1])
            if length < SHORT_M:
                continue
            while True:
                step = xy[node] - xy[before]
                travelled += np.hypot(step[0], step[1])
                if travelled > reach:
                    break
                ends.append((a, node))
                distances.append(travelled)
                following = -1
                for d in range(begin[node], begin[node + 1]):
                    other = xy[neighbour[d]] - xy[node]
                    far = np.hypot(other[0], other[1])
                    if far > SHORT_M and (other @ first) > cosine * far * length:
                        following = neighbour[d]
                if following < 0:
                    break
                before, node = node, following
            origin.append(a)
            exposure.append(min(travelled, reach))
    pairs = np.empty((len(ends), 2), np.intp)
    for k in range(len(ends)):
        pairs[k, 0], pairs[k, 1] = ends[k]
    return pairs, np.array(distances), np.array(origin, dtype=np.intp), np.array(exposure)


@kernel
def apart(distance, at, period):
    """By how much two distances differ [m], whole periods (0: there are none) apart or not."""
    off = abs(distance - at)
    if period > 0:
        off = off % period
        off = min(off, period - off)
    return off


@kernel
def times_met(pairs, distances, origin, exposure, start, label, a, b, at, tolerance, period, own):
    """How often in one map a landmark of label b stands ``at`` [m], or whole periods [m] from there, from one whose
    ``start`` is a along a straight corridor, and how often it could; the gap between the two ``own`` isn't counted."""
    met = 0
    for k in range(len(pairs)):
        p, q = pairs[k, 0], pairs[k, 1]
        mine = (p == own[0] and q == own[1]) or (p == own[1] and q == own[0])
        if start[p] == a and label[q] == b and not mine and apart(distances[k], at, period) < tolerance:
            met += 1
    could = 0
    first = at % period if period > 0 else at
    for k in range(len(origin)):
        beyond = exposure[k] - first + tolerance
        if start[origin[k]] == a and beyond > 0:
            could += 1 + int(beyond / period) if period > 0 else 1
    return met, could


@kernel
def same_distance(distance):
    """By how much [m] two distances like this one may differ and be the same."""
    return SAME_DISTANCE_M + SAME_DISTANCE_SHARE * distance


@kernel
def rhythm(G, H, pair1, pair2, at, rate, pitch):
    """Share of landmarks like the first of a pair that have one like the second ``at`` [m] from them, beyond chance.

    ``pair1``, ``pair2``: the same two landmarks in either map; ``rate`` [1/m]: how common those like the second are.
    """
    if at > REACH_M and not pitch:
        return 0.0
    a, b, tolerance = G.start[pair1[0]], G.label[pair1[1]], same_distance(at)
    met1, could1 = times_met(
        G.pairs, G.distance, G.origin, G.exposure, G.start, G.label, a, b, at, tolerance, pitch, pair1
    )
    met2, could2 = times_met(
        H.pairs, H.distance, H.origin, H.exposure, H.start, H.label, a, b, at, tolerance, pitch, pair2
    )
    met, could = met1 + met2, could1 + could2
    if pitch:
        return met / (could + DOUBT)
    by_chance = could * rate * 2 * tolerance
    return max(met - by_chance - np.sqrt(by_chance), 0.0) / (could + DOUBT)


@kernel
def shares(G, H, i, j, at, along, rate, pitch):
    """Share (k,) of other buildings of this style that have a landmark of match k's label where it stands, as
    `mapfuse.fusion.regularity.Regularity.shares` says."""
    out = np.zeros(len(i))
    corners = 0
    for k in range(len(i)):
        x, y = along[k]
        nearest_before, least = -1, np.inf
        on_a_line = False
        for m in range(k):
            dx, dy = at[k, 0] - at[m, 0], at[k, 1] - at[m, 1]
            ahead, beside = abs(dx * x + dy * y), abs(dy * x - dx * y)
            # on a grid of one pitch any corner tells where the others are, elsewhere only those of the same corridor
            on_corridor = beside < LINE_WIDTH_M and ahead > LINE_WIDTH_M
            before = (G.spatial[i[m]] or not corners) if pitch else on_corridor
            if before and ahead + beside < least:
                nearest_before, least = m, ahead + beside
            on_a_line |= ahead < LINE_WIDTH_M and beside > LINE_WIDTH_M and G.spatial[i[m]]
        if nearest_before >= 0:
            m = nearest_before
            ahead = abs((at[k, 0] - at[m, 0]) * x + (at[k, 1] - at[m, 1]) * y)
            out[k] = rhythm(G, H, (i[m], i[k]), (j[m], j[k]), ahead, rate[k], pitch)
        if G.spatial[i[k]] and on_a_line:
            out[k] = max(out[k], ON_A_LINE)
        corners += G.spatial[i[k]]
    return out


@kernel
def given_before(C, r):
    """Innovation (k, 3) and covariance (k, 3, 3) of each pair given those before it: C (3k, 3k) of residuals r."""
    L = np.linalg.cholesky(C)
    k = len(r) // 3
    innovation, V = np.zeros((k, 3)), np.zeros((k, 3, 3))
    z = np.empty(3 * k)
    for row in range(3 * k):
        z[row] = (r[row] - L[row, :row] @ z[:row]) / L[row, row]
        n, a = row // 3, row % 3
        for l in range(a + 1):
            innovation[n, a] += L[row, 3 * n + l] * z[3 * n + l]
            for b in range(3):
                V[n, a, b] += L[row, 3 * n + l] * L[3 * n + b, 3 * n + l]
    return innovation, V


@kernel
def least_known(V):
    """Direction (x, y) in which a covariance (2, 2 or more) of positions is widest."""
    angle = np.arctan2(2 * V[0, 1], V[0, 0] - V[1, 1]) / 2
    return np.cos(angle), np.sin(angle)


@kernel
def in_line(C, r, order, along):
    """Log density (k,) [nats per m] of the residuals of the matches ``order`` (k,) along their directions (k, 2), given
    those before. Where there is no direction (NaN) it is the least known one, which is written there.

    C, r: covariance and residuals of all matches.
    """
    k = len(order)
    own_C, own_r = np.empty((3 * k, 3 * k)), np.empty(3 * k)
    for n in range(k):
        for a in range(3):
            own_r[3 * n + a] = r[3 * order[n] + a]
            for m in range(k):
                for b in range(3):
                    own_C[3 * n + a, 3 * m + b] = C[3 * order[n] + a, 3 * order[m] + b]
    innovation, V = given_before(own_C, own_r)
    density = np.empty(k)
    for n in range(k):
        if np.isnan(along[n, 0]):
            along[n, 0], along[n, 1] = least_known(V[n])
        x, y = along[n]
        u = x * innovation[n, 0] + y * innovation[n, 1]
        v = x * x * V[n, 0, 0] + 2 * x * y * V[n, 0, 1] + y * y * V[n, 1, 1]
        density[n] = -0.5 * u * u / v - 0.5 * np.log(TWO_PI * v)
    return density


@kernel
def on_corridors(A, B, G, H, W, pitch, turn, i, j, coincide, contradict, C, r, p1):
    """What matched corridor landmarks say [nats], and what a regular building takes off that.

    A, B, G, H: `Ways` and `Rhythm` of both maps, map 2 turned by ``turn`` [rad]; W: `Worth`. The matches i, j (k,) with
    how many of their arms ``coincide`` and ``contradict``, covariance C and residuals r; ``p1`` (n1, 2): where the
    landmarks of map 1 then are.
    """
    on = np.flatnonzero(~W.point1[i] & ~W.point2[j])
    worth = densities = regular = 0.0
    for n in on:
        worth += W.there1[i[n]] + W.there2[j[n]] - np.log(W.rate[i[n]])
        if coincide[n] >= 2 and contradict[n] == 0:
            worth += W.ways[i[n]]
            if W.kind1[i[n]] == W.kind2[j[n]]:
                worth += W.rarity[i[n]]
    if len(on) < 2:  # a single one is what places map 2: its density is the prior of T12
        return worth, 0.0
    for second in range(2):
        ways, matched, by = (B, j[on], turn) if second else (A, i[on], 0.0)
        order, along = visited(ways.xy, ways.corridors, ways.arm, ways.passable, matched)
        c, s = np.cos(by), np.sin(by)
        for n in range(len(along)):
            x, y = along[n]
            along[n, 0], along[n, 1] = c * x - s * y, s * x + c * y
        order = on[order]
        density = in_line(C, r, order, along)
        at, rate = p1[i[order]], W.rate[i[order]]
        share = shares(G, H, i[order], j[order], at, along, rate, pitch)
        for n in range(1, len(order)):
            densities += density[n] / 2
            regular -= np.log1p(share[n] * np.exp(density[n]) / rate[n]) / 2
            regular -= share[n] * W.both[i[order[n]]] / 2
    return worth + densities, regular
