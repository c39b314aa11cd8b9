"""Candidates matched one to one, aligned and scored, compiled.

Import through `mapfuse.datasets.compiled.kernels` only. Arrays are C-contiguous float64, int32, uint8 or uint64;
a side of a comparison is a `Side`, its landmarks sorted into cells a `Cells`, where its robot has been a `Seen`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.compiled import inlined, kernel

Array = NDArray[np.float64]
Codes = NDArray[np.int32]

TWO_PI = 2 * np.pi
ARM = np.pi / 6  # `mapfuse.datasets.arms.ARM_TOLERANCE`
# Candidates of one place that are looked at; more stand there only if the map is a heap.
MOST_LOOKED_AT = 256
# Landmarks of map 2 whose partners are sought at a time: what is known of them stays in the processor's nearest memory.
BLOCK = 64


# columns of `Side.values`: a landmark's numbers lie together in memory, as they are looked at together
X, Y, VARIANCE, HEADING, WORTH, MISS = range(6)
# and of `Side.arms`
OPEN, BLOCKED, NEAR_OPEN, NEAR_BLOCKED = range(4)


class Side(NamedTuple):
    """n landmarks of one map: see `mapfuse.matching.landmark_arrays.Facing`; ``label`` (n,): shared by both maps."""

    values: Array
    arms: NDArray[np.uint64]
    label: Codes
    linear: NDArray[np.uint8]


class Cells(NamedTuple):
    """Points in square cells; each cell lists the points that are within one cell's size of a place in it.

    There are ``layers`` of them, a label's points in the one of its code modulo their number.
    """

    x: float
    y: float
    per_m: float
    nx: int
    ny: int
    layers: int
    start: Codes
    members: Codes


class Suitors(NamedTuple):
    """Room for a block of map 2's landmarks, and for whom each of them may be matched with.

    Of each (BLOCK,): ``x`` and ``y`` in frame 1, ``spread`` [m^2]: variance of its place by distance, ``cell``; and
    ``start`` (BLOCK + 1,): where its matches begin. Of each match: ``place`` in map 1, ``asks``: in map 2, ``squared``
    residual, ``variance`` and ``gain`` [nats].
    """

    x: Array
    y: Array
    spread: Array
    cell: Codes
    start: Codes
    place: Codes
    asks: Codes
    squared: Array
    variance: Array
    gain: Array


class Seen(NamedTuple):
    """`Travelled`, and ``void``: what a sample says [nats] that lies where the other robot has been, too."""

    x: float
    y: float
    per_m: float
    cells: NDArray[np.uint8]
    samples: Array
    void: float


class Rules(NamedTuple):
    """Constants of `assess`: see `mapfuse.matching.settings`."""

    gate: float
    bend: float
    most_variance: float
    arm: float
    contradiction: float
    least_gain: float
    heading_sigma: float


@kernel
def _wrap(angle):
    return angle - TWO_PI * np.floor(angle / TWO_PI + 0.5)


@kernel
def sorted_into_cells(xy, label, per_m, nx, ny, layers, x, y):
    """`Cells.start` and `Cells.members` of points (n, 2 or more)."""
    n_cells = nx * ny * layers
    start = np.zeros(n_cells + 1, dtype=np.int32)
    members = np.zeros(9 * len(xy), dtype=np.int32)
    for turn in range(2):
        for i in range(len(xy)):
            cx, cy = int((xy[i, 0] - x) * per_m), int((xy[i, 1] - y) * per_m)
            own = (label[i] % layers) * nx * ny + cx * ny + cy
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    cell = own + dx * ny + dy
                    if turn == 0:
                        start[cell + 1] += 1
                    else:
                        members[start[cell]] = i
                        start[cell] += 1
        if turn == 0:
            for k in range(n_cells):
                start[k + 1] += start[k]
        else:
            for k in range(n_cells, 0, -1):
                start[k] = start[k - 1]
            start[0] = 0
    return start, members


@inlined
def _ones(bits):
    """How many bits are set, without a branch: sums of two, of four, of eight bits, and of all bytes at once."""
    bits = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    bits = (bits & np.uint64(0x3333333333333333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))


@inlined
def _turned(bits, sectors):
    """Directions turned by a number of sectors in 0..63."""
    if sectors == 0:
        return bits
    return (bits << np.uint64(sectors)) | (bits >> np.uint64(64 - sectors))


@inlined
def _gain(i, j, squared, variance, theta, sectors, one, two, rules):
    """What the match of two landmarks says [nats]."""
    gain = one.values[i, WORTH] + two.values[j, WORTH] - squared / (2 * variance)
    normal = -0.5 * np.log(TWO_PI * variance)
    gain += normal if one.linear[i] and two.linear[j] else 2 * normal
    open1, blocked1 = one.arms[i, OPEN], one.arms[i, BLOCKED]
    if (open1 | blocked1) != np.uint64(0) and (two.arms[j, OPEN] | two.arms[j, BLOCKED]) != np.uint64(0):
        open2, blocked2 = _turned(two.arms[j, OPEN], sectors), _turned(two.arms[j, BLOCKED], sectors)
        near_open, near_blocked = one.arms[i, NEAR_OPEN], one.arms[i, NEAR_BLOCKED]
        same = _ones(open2 & near_open) + _ones(blocked2 & near_blocked)
        against = _ones(open2 & near_blocked & ~near_open) + _ones(blocked2 & near_open & ~near_blocked)
        gain += rules.arm * same - rules.contradiction * against
    elif abs(_wrap(one.values[i, HEADING] - two.values[j, HEADING] - theta)) > ARM:  # never of NaN
        gain -= rules.contradiction
    return gain


@inlined
def _best(j, x, y, theta, sectors, spread, cells, one, two, rules, held, holder):
    """The landmark of map 1 that likes landmark j at (x, y) better than whom it holds, and is liked best; or -1."""
    cx, cy = (x - cells.x) * cells.per_m, (y - cells.y) * cells.per_m
    best, most, best_variance = -1, rules.least_gain, 1.0
    if not (cx >= 0 and cy >= 0 and cx < cells.nx and cy < cells.ny):
        return best, most, best_variance
    cell = ((two.label[j] % cells.layers) * cells.nx + int(cx)) * cells.ny + int(cy)
    begin, end = cells.start[cell], cells.start[cell + 1]
    for m in range(begin, min(end, begin + MOST_LOOKED_AT)):
        i = cells.members[m]
        if one.label[i] != two.label[j]:
            continue
        squared = (one.values[i, X] - x) ** 2 + (one.values[i, Y] - y) ** 2
        variance = min(one.values[i, VARIANCE] + two.values[j, VARIANCE] + spread, rules.most_variance)
        if squared > rules.gate * rules.gate * variance:
            continue
        gain = _gain(i, j, squared, variance, theta, sectors, one, two, rules)
        if gain > most and (holder[i] < 0 or gain > held[i]):
            best, most, best_variance = i, gain, variance
    return best, most, best_variance


@kernel
def _suitors(
    first, n, x, y, theta, c, s, sectors, centre_x, centre_y, loose, x2, y2, layer, cells, one, two, rules, out
):
    """The landmarks of map 1 within the gate of ``n`` of map 2 from ``first``, and what each match says [nats]."""
    nx, ny = cells.nx, cells.ny
    for b in range(n):
        px, py = x2[first + b], y2[first + b]
        away = (px - centre_x) ** 2 + (py - centre_y) ** 2
        out.spread[b] = rules.bend * np.sqrt(away) + loose * away
        at_x, at_y = c * px - s * py + x, s * px + c * py + y
        out.x[b], out.y[b] = at_x, at_y
        cx, cy = (at_x - cells.x) * cells.per_m, (at_y - cells.y) * cells.per_m
        inside = (cx >= 0) & (cy >= 0) & (cx < nx) & (cy < ny)
        out.cell[b] = (layer[first + b] + int(cx)) * ny + int(cy) if inside else -1
    found = 0
    limit, most = rules.gate * rules.gate, rules.most_variance
    start, members, values, label = cells.start, cells.members, one.values, one.label
    place, asks, squares, variances = out.place, out.asks, out.squared, out.variance
    for b in range(n):
        out.start[b] = found
        own = out.cell[b]
        if own < 0:
            continue
        j = first + b
        begin, end = start[own], start[own + 1]
        at_x, at_y, spread = out.x[b], out.y[b], out.spread[b]
        wide, own_label = two.values[j, VARIANCE], two.label[j]
        for m in range(begin, min(end, begin + MOST_LOOKED_AT)):
            i = members[m]
            squared = (values[i, X] - at_x) ** 2 + (values[i, Y] - at_y) ** 2
            variance = min(values[i, VARIANCE] + wide + spread, most)
            place[found], asks[found] = i, j
            squares[found], variances[found] = squared, variance
            # counted without a branch, which nobody could foresee
            found += (label[i] == own_label) & (squared <= limit * variance)
    out.start[n] = found
    for q in range(found):
        out.gain[q] = _gain(place[q], asks[q], squares[q], variances[q], theta, sectors, one, two, rules)


@inlined
def _passed(seen, x, y):
    """Along which ways (bits) a place was passed; without a branch, which nobody could foresee."""
    nx, ny = seen.cells.shape
    fx, fy = (x - seen.x) * seen.per_m, (y - seen.y) * seen.per_m
    inside = (fx >= 0) & (fy >= 0) & (fx < nx) & (fy < ny)
    column, row = (np.uint64(fx), np.uint64(fy)) if inside else (np.uint64(0), np.uint64(0))
    return np.int64(seen.cells[column, row]) * inside


@kernel
def _common_ways(seen, other, x, y, theta):
    """How many samples of ``other``, moved by (x, y, theta), lie along ways of ``seen``."""
    c, s = np.cos(theta), np.sin(theta)
    n = 0
    for k in range(len(other.samples)):
        px, py = other.samples[k, 0], other.samples[k, 1]
        bits = _passed(seen, c * px - s * py + x, s * px + c * py + y)
        direction = int(np.floor((other.samples[k, 2] + theta) * (8 / np.pi))) & 7
        # the direction and its neighbours, of eight in a ring
        near = (0x83 << direction) | (0x83 >> (8 - direction))
        n += (bits & near & 0xFF) != 0
    return n


@kernel
def _misses(side, matched, seen, x, y, theta):
    """What it says [nats] that landmarks have no match where the other robot passed; moved by (x, y, theta)."""
    c, s = np.cos(theta), np.sin(theta)
    total = 0.0
    for k in range(len(matched)):
        px, py = side.values[k, X], side.values[k, Y]
        missed = (_passed(seen, c * px - s * py + x, s * px + c * py + y) != 0) & (matched[k] < 0)
        total += side.values[k, MISS] * missed
    return total


@kernel
def assess(T12s, centres, looseness, both_ways, one, two, cells, seen1, seen2, rules):
    """Match, align and score each T12 (k, 3), in turns of as many as ``looseness`` has entries; the last one scores.

    ``centres`` (k, 2): where in frame 2 a T12 is best known; each entry of ``looseness`` [rad] is by how much its
    rotation may be off. ``both_ways``: also charge what map 1 has and map 2 lacks. Returns T12s (k, 3), centres (k, 2),
    scores (k,), numbers of matches (k,), the partner of each landmark of map 2 (k, n2) or -1, and the landmark (k,) of
    map 2 whose match is the surest, one with heading if there is one, or -1.
    """
    n1, n2 = len(one.values), len(two.values)
    T12s, centres = T12s.copy(), centres.copy()
    score, count = np.zeros(len(T12s)), np.zeros(len(T12s), dtype=np.int32)
    partner = np.full((len(T12s), n2), -1, dtype=np.int32)
    seed = np.full(len(T12s), -1, dtype=np.int32)
    matched = np.empty(n2, dtype=np.int32)
    holder, held, of_match = np.full(n1, -1, dtype=np.int32), np.zeros(n1), np.zeros(n1)
    layer = ((two.label % cells.layers) * cells.nx).astype(np.int32)
    x2, y2 = two.values[:, X].copy(), two.values[:, Y].copy()
    # a cell lists no landmark twice
    room = min(BLOCK, n2) * min(MOST_LOOKED_AT, n1)
    suitors = Suitors(
        np.empty(BLOCK),
        np.empty(BLOCK),
        np.empty(BLOCK),
        np.empty(BLOCK, dtype=np.int32),
        np.zeros(BLOCK + 1, dtype=np.int32),
        np.empty(room, dtype=np.int32),
        np.empty(room, dtype=np.int32),
        np.empty(room),
        np.empty(room),
        np.empty(room),
    )
    for k in range(len(T12s)):
        mine = partner[k]
        x, y, theta, c, s, n = 0.0, 0.0, 0.0, 1.0, 0.0, 0
        for turn in range(len(looseness)):
            x, y, theta = T12s[k, 0], T12s[k, 1], T12s[k, 2]
            c, s = np.cos(theta), np.sin(theta)
            sectors = int(np.floor(theta / TWO_PI * 64 + 0.5)) % 64
            loose = looseness[turn] ** 2
            steps = 0
            for first in range(0, n2, BLOCK):
                n_asking = min(BLOCK, n2 - first)
                _suitors(
                    first,
                    n_asking,
                    x,
                    y,
                    theta,
                    c,
                    s,
                    sectors,
                    centres[k, 0],
                    centres[k, 1],
                    loose,
                    x2,
                    y2,
                    layer,
                    cells,
                    one,
                    two,
                    rules,
                    suitors,
                )
                for b in range(n_asking):
                    j = first + b
                    mine[j] = -1
                    if steps >= 4 * n2:
                        continue
                    steps += 1
                    i, gain, variance = -1, rules.least_gain, 1.0
                    for q in range(suitors.start[b], suitors.start[b + 1]):
                        of, its = suitors.place[q], suitors.gain[q]
                        if its > gain and (holder[of] < 0 or its > held[of]):
                            i, gain, variance = of, its, suitors.variance[q]
                    # deferred acceptance: who is displaced by a better one asks again
                    while i >= 0:
                        displaced = holder[i]
                        holder[i], held[i], of_match[i] = j, gain, variance
                        mine[j] = i
                        if displaced < 0:
                            break
                        mine[displaced] = -1
                        if steps >= 4 * n2:
                            break
                        steps += 1
                        j = displaced
                        px, py = two.values[j, X], two.values[j, Y]
                        away = (px - centres[k, 0]) ** 2 + (py - centres[k, 1]) ** 2
                        i, gain, variance = _best(
                            j,
                            c * px - s * py + x,
                            s * px + c * py + y,
                            theta,
                            sectors,
                            rules.bend * np.sqrt(away) + loose * away,
                            cells,
                            one,
                            two,
                            rules,
                            held,
                            holder,
                        )
            # gathered without a branch, which nobody could foresee
            n = 0
            for j in range(n2):
                matched[n] = j
                n += mine[j] >= 0
            if turn + 1 < len(looseness):
                _align(T12s, centres, k, matched[:n], mine, of_match, one, two, rules)
                for m in range(n):
                    holder[mine[matched[m]]] = -1
        # x, y, theta, c and s are those of the last turn, which doesn't align
        total, most = 0.0, -np.inf
        for m in range(n):
            j = matched[m]
            i = mine[j]
            total += held[i]
            # a pair to grow from has headings, and is sure
            off = _wrap(one.values[i, HEADING] - two.values[j, HEADING])
            sure = held[i] if abs(off) <= TWO_PI else held[i] - 1e6
            if sure > most:
                seed[k], most = j, sure
        total += _misses(two, mine, seen1, x, y, theta)
        if both_ways:
            total += _misses(one, holder, seen2, -(c * x + s * y), s * x - c * y, -theta)
        if seen2.void > 0:
            total += seen2.void * _common_ways(seen1, seen2, x, y, theta)
        if both_ways and seen1.void > 0:
            total += seen1.void * _common_ways(seen2, seen1, -(c * x + s * y), s * x - c * y, -theta)
        score[k], count[k] = total, n
        for m in range(n):
            holder[mine[matched[m]]] = -1
    return T12s, centres, score, count, partner, seed


@kernel
def _align(T12s, centres, k, matched, mine, of_match, one, two, rules):
    """T12 by weighted least squares of the matches' positions and headings, in place; untouched without matches.

    ``matched``: the landmarks of map 2 that have one.
    """
    weight, w1x, w1y, w2x, w2y = 0.0, 0.0, 0.0, 0.0, 0.0
    turned, sure = 0.0, 0.0
    theta = T12s[k, 2]
    for j in matched:
        i = mine[j]
        w = 1 / of_match[i]
        weight += w
        w1x += w * one.values[i, X]
        w1y += w * one.values[i, Y]
        w2x += w * two.values[j, X]
        w2y += w * two.values[j, Y]
        off = _wrap(one.values[i, HEADING] - two.values[j, HEADING] - theta)
        if abs(off) < ARM:
            turned += off
            sure += 1
    if weight == 0:
        return
    w1x, w1y, w2x, w2y = w1x / weight, w1y / weight, w2x / weight, w2y / weight
    cross, dot = 0.0, 0.0
    for j in matched:
        i = mine[j]
        w = 1 / of_match[i]
        ax, ay = one.values[i, X] - w1x, one.values[i, Y] - w1y
        bx, by = two.values[j, X] - w2x, two.values[j, Y] - w2y
        cross += w * (bx * ay - by * ax)
        dot += w * (bx * ax + by * ay)
    information = np.hypot(cross, dot)
    by_headings = 1 / rules.heading_sigma**2
    if information + sure > 1e-9:
        by_points = _wrap(np.arctan2(cross, dot) - theta) if information > 1e-9 else 0.0
        theta += (information * by_points + by_headings * turned) / (information + by_headings * sure)
    c, s = np.cos(theta), np.sin(theta)
    T12s[k, 0], T12s[k, 1] = w1x - c * w2x + s * w2y, w1y - s * w2x - c * w2y
    T12s[k, 2] = _wrap(theta)
    centres[k, 0], centres[k, 1] = w2x, w2y


@kernel
def in_map_order(partner, kept, order1, order2):
    """Of the rows ``kept`` of `assess`'s partners, in the order of map 2, the places in map 1; -1 stays."""
    out = np.full((len(kept), len(order2)), -1, dtype=np.int32)
    for k in range(len(kept)):
        for j in range(len(order2)):
            i = partner[kept[k], j]
            if i >= 0:
                out[k, order2[j]] = order1[i]
    return out


@kernel
def first_of_each(T12s, mean, spread, tolerance, limit):
    """Places of the distinct ones of T12s (k, 3), best first: `mapfuse.matching.modes.distinct`, compiled.

    ``mean`` (2,) and ``spread`` [m^2]: mean place of the points in frame 2 and their mean squared distance from it.
    """
    kept = np.zeros(limit, dtype=np.int64)
    at = np.zeros((limit, 2))
    n = 0
    for k in range(len(T12s)):
        c, s = np.cos(T12s[k, 2]), np.sin(T12s[k, 2])
        x, y = c * mean[0] - s * mean[1] + T12s[k, 0], s * mean[0] + c * mean[1] + T12s[k, 1]
        new = True
        for m in range(n):
            apart = (x - at[m, 0]) ** 2 + (y - at[m, 1]) ** 2
            if apart > tolerance * tolerance:
                continue
            turned = np.sin((T12s[k, 2] - T12s[kept[m], 2]) / 2)
            apart += 4 * spread * turned * turned
            if apart <= tolerance * tolerance:
                new = False
                break
        if new:
            kept[n], at[n, 0], at[n, 1] = k, x, y
            n += 1
            if n == limit:
                break
    return kept[:n]
