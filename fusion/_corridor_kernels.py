"""The loops of what matches along corridors are worth, compiled: in which order they are come upon, how surely
something stands there whichever building it is, and the density of the residuals.

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
ON_A_LINE, LINE_WIDTH_M, DOUBT, SAME_WAY = 0.5, 1.0, 2.0, 0.7

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.intp]


class Corridors(NamedTuple):
    """n landmarks of one map, their arms (n, 4), and the corridors (m, 2) between them by their ``ends``, as
    `mapfuse.fusion.prepared.PreparedMap` has them."""

    xy: Array
    ends: Index
    arm: Array
    passable: Flags


class Rhythm(NamedTuple):
    """Distances along one map's straight corridors, as `mapfuse.fusion.regularity.Gaps` has them."""

    pairs: Index
    distance: Array
    toward: Array
    origin: Index
    exposure: Array
    outward: Array
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
def rows_of(listed):
    """A list of (x, y) as an array (k, 2), an empty one as well."""
    out = np.empty((len(listed), 2))
    for k in range(len(listed)):
        out[k, 0], out[k, 1] = listed[k]
    return out


@kernel
def gaps(xy, corridors, reach, cosine):
    """What is come upon along straight corridors: from landmark a to b at a distance [m], up to ``reach``, and in which
    direction it was left; and how far one could go on straight from each landmark in each direction (a, metres)."""
    n = len(xy)
    begin, neighbour = adjacency(n, corridors)
    ends, distances, toward = [(0, 0)][:0], [0.0][:0], [(0.0, 0.0)][:0]
    origin, exposure, outward = [0][:0], [0.0][:0], [(0.0, 0.0)][:0]
    for a in range(n):
        for c in range(begin[a], begin[a + 1]):
            before, node, travelled = a, neighbour[c], 0.0
            first = xy[node] - xy[a]
            length = np.hypot(first[0], first[1])
            if length < SHORT_M:
                continue
            way = (first[0] / length, first[1] / length)
            while True:
                step = xy[node] - xy[before]
                travelled += np.hypot(step[0], step[1])
                if travelled > reach:
                    break
                ends.append((a, node))
                distances.append(travelled)
                toward.append(way)
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
            outward.append(way)
    pairs = np.empty((len(ends), 2), np.intp)
    for k in range(len(ends)):
        pairs[k, 0], pairs[k, 1] = ends[k]
    left = np.array(origin, dtype=np.intp), np.array(exposure), rows_of(outward)
    return pairs, np.array(distances), rows_of(toward), *left


@kernel
def apart(distance, at, period):
    """By how much two distances differ [m], whole periods (0: there are none) apart or not."""
    off = abs(distance - at)
    if period > 0:
        off = off % period
        off = min(off, period - off)
    return off


@kernel
def as_far(off, tolerance):
    """How far two distances that differ by ``off`` [m] count as the same: half at the ``tolerance`` [m], and wholly or
    not at all a quarter below and above it, so that rounding decides nothing."""
    return min(max((1.25 * tolerance - off) / (0.5 * tolerance), 0.0), 1.0)


@kernel
def times_met(G, a, b, at, tolerance, period, own, x, y):
    """How often in one map a landmark of label b stands ``at`` [m], or whole periods [m] from there, from one whose
    ``start`` is a along a straight corridor, and how often it could; then both of the direction (x, y) alone. The gap
    between the two ``own`` isn't counted."""
    met = met_that_way = 0.0
    could = could_that_way = 0
    for k in range(len(G.pairs)):
        p, q = G.pairs[k, 0], G.pairs[k, 1]
        mine = (p == own[0] and q == own[1]) or (p == own[1] and q == own[0])
        if G.start[p] == a and G.label[q] == b and not mine:
            same = as_far(apart(G.distance[k], at, period), tolerance)
            met += same
            if G.toward[k, 0] * x + G.toward[k, 1] * y > SAME_WAY:
                met_that_way += same
    first = at % period if period > 0 else at
    for k in range(len(G.origin)):
        beyond = G.exposure[k] - first + tolerance
        if G.start[G.origin[k]] == a and beyond > 0:
            times = 1 + int(beyond / period) if period > 0 else 1
            could += times
            if G.outward[k, 0] * x + G.outward[k, 1] * y > SAME_WAY:
                could_that_way += times
    return met, could, met_that_way, could_that_way


@kernel
def same_distance(distance):
    """By how much [m] two distances like this one may differ and be the same."""
    return SAME_DISTANCE_M + SAME_DISTANCE_SHARE * distance


@kernel
def beyond_chance(met, could, per_place):
    """How many of those met weren't met by chance, ``per_place`` of the places where they could be having one."""
    by_chance = could * per_place
    return max(met - by_chance - np.sqrt(by_chance), 0.0)


@kernel
def rhythm(G, H, pair1, pair2, step, turn, rate, pitch, one_way):
    """Share of landmarks like the first of a pair that have one like the second so far from them, beyond chance.

    ``pair1``, ``pair2``: the same two landmarks in either map, one ``step`` (x, y) [m] of map 1 apart along a corridor;
    ``turn`` [rad]: of map 2; ``rate`` [1/m]: how common those like the second are. ``one_way``: the share in that
    direction alone, as far as it is known, where that is more.
    """
    at = np.hypot(step[0], step[1])
    if at > REACH_M and not pitch:
        return 0.0
    a, b, tolerance = G.start[pair1[0]], G.label[pair1[1]], same_distance(at)
    x, y = (step[0] / at, step[1] / at) if at > 0 else (0.0, 0.0)
    c, s = np.cos(turn), np.sin(turn)
    met1, could1, that_way1, could_that_way1 = times_met(G, a, b, at, tolerance, pitch, pair1, x, y)
    met2, could2, that_way2, could_that_way2 = times_met(
        H, a, b, at, tolerance, pitch, pair2, c * x + s * y, c * y - s * x
    )
    could, could_that_way = could1 + could2, could_that_way1 + could_that_way2
    per_place = 0.0 if pitch else 2 * tolerance * rate
    share = beyond_chance(met1 + met2, could, per_place) / (could + DOUBT)
    if one_way:
        beyond = beyond_chance(that_way1 + that_way2, could_that_way, per_place)
        share = max(share, (beyond + DOUBT * share) / (could_that_way + DOUBT))
    return share


@kernel
def shares(G, H, i, j, at, along, turn, rate, pitch):
    """Share (k,) of other buildings of this style that have a landmark of match k's label where it stands, as
    `mapfuse.fusion.regularity.Regularity.shares` says."""
    out = np.zeros(len(i))
    corners = 0
    for k in range(len(i)):
        x, y = along[k]
        nearest_before, least = -1, np.inf
        on_a_line = one_way = False
        for m in range(k):
            dx, dy = at[k, 0] - at[m, 0], at[k, 1] - at[m, 1]
            ahead, beside = abs(dx * x + dy * y), abs(dy * x - dx * y)
            # on a grid of one pitch any corner tells where the others are, elsewhere only those of the same corridor
            on_corridor = beside < LINE_WIDTH_M and ahead > LINE_WIDTH_M
            before = (G.spatial[i[m]] or not corners) if pitch else on_corridor
            if before and ahead + beside < least:
                nearest_before, least = m, ahead + beside
            on_a_line |= ahead < LINE_WIDTH_M and beside > LINE_WIDTH_M and G.spatial[i[m]]
            # corridors cross whichever way one comes; for all else the first match shows whether the ways agree
            one_way |= not G.spatial[i[k]] and G.label[i[m]] == G.label[i[k]]
        if nearest_before >= 0:
            m = nearest_before
            ahead = (at[k, 0] - at[m, 0]) * x + (at[k, 1] - at[m, 1]) * y
            step = (ahead * x, ahead * y)
            out[k] = rhythm(G, H, (i[m], i[k]), (j[m], j[k]), step, turn, rate[k], pitch, one_way)
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

    A, B, G, H: `Corridors` and `Rhythm` of both maps, map 2 turned by ``turn`` [rad]; W: `Worth`. The matches i, j (k,)
    with how many of their arms ``coincide`` and ``contradict``, covariance C and residuals r; ``p1`` (n1, 2): where the
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
        order, along = visited(ways.xy, ways.ends, ways.arm, ways.passable, matched)
        c, s = np.cos(by), np.sin(by)
        for n in range(len(along)):
            x, y = along[n]
            along[n, 0], along[n, 1] = c * x - s * y, s * x + c * y
        order = on[order]
        density = in_line(C, r, order, along)
        at, rate = p1[i[order]], W.rate[i[order]]
        share = shares(G, H, i[order], j[order], at, along, turn, rate, pitch)
        for n in range(1, len(order)):
            densities += density[n] / 2
            regular -= np.log1p(share[n] * np.exp(density[n]) / rate[n]) / 2
            regular -= share[n] * W.both[i[order[n]]] / 2
    return worth + densities, regular


@kernel
def all_on_corridors(A, B, G, H, W, pitch, turns, begin, i, j, coincide, contradict, C, r, p1):
    """`on_corridors` of g hypotheses, (g,) each: of hypothesis h the matches ``begin[h]`` to ``begin[h + 1]``.

    ``turns`` (g,); what is of matches is one hypothesis after the other, as are the numbers of C and r; ``p1``
    (g, n1, 2).
    """
    g = len(turns)
    matches, regular = np.empty(g), np.empty(g)
    first = 0
    for h in range(g):
        of = slice(begin[h], begin[h + 1])
        rows = 3 * (begin[h + 1] - begin[h])
        own_C = C[first : first + rows * rows].reshape(rows, rows)
        own_r = r[3 * begin[h] : 3 * begin[h + 1]]
        first += rows * rows
        matches[h], regular[h] = on_corridors(
            A, B, G, H, W, pitch, turns[h], i[of], j[of], coincide[of], contradict[of], own_C, own_r, p1[h]
        )
    return matches, regular
