"""The loops of the matcher, compiled: turns of arm patterns, votes in SE(2), assignment, alignment and score.

Import through `mapfuse.datasets.compiled.kernels` only. Arrays are C-contiguous float64, int32, int8, uint8 or uint64;
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
MAX_TURNS = 4
ROTATION_BINS = 180
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
    """Constants of `assess`: see `voting.Settings`."""

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
def turns_of_patterns(arms1, open1, label1, arms2, open2, label2):
    """Turns of every pair of patterns: how many (p1, p2), and their offsets (p1, p2, MAX_TURNS) [rad].

    A landmark of pattern a turned by ``heading1 - heading2 + offset`` lies on one of pattern b with all arms that meet
    agreeing, as `mapfuse.datasets.arms.turns` has it; without arms by its heading alone.
    """
    n1, n2 = len(label1), len(label2)
    count = np.zeros((n1, n2), dtype=np.int32)
    offset = np.zeros((n1, n2, MAX_TURNS))
    k1, k2 = arms1.shape[1], arms2.shape[1]
    for a in range(n1):
        for b in range(n2):
            if label1[a] != label2[b]:
                continue
            if open1[a].max() < 0 or open2[b].max() < 0:
                count[a, b] = 1
                continue
            most, n = 0, 0
            for m1 in range(k1):
                for m2 in range(k2):
                    if open1[a, m1] < 0 or open2[b, m2] < 0:
                        continue
                    rotation = arms1[a, m1] - arms2[b, m2]
                    same, against, shift = 0, 0, 0.0
                    for q2 in range(k2):
                        if open2[b, q2] < 0:
                            continue
                        nearest, least = -1, ARM
                        for q1 in range(k1):
                            if open1[a, q1] >= 0:
                                off = abs(_wrap(arms2[b, q2] + rotation - arms1[a, q1]))
                                if off < least:
                                    nearest, least = q1, off
                        if nearest >= 0:
                            shift += _wrap(arms1[a, nearest] - arms2[b, q2] - rotation)
                            if open1[a, nearest] == open2[b, q2]:
                                same += 1
                            else:
                                against += 1
                    if against > 0 or same == 0 or same < most:
                        continue
                    rotation = _wrap(rotation + shift / same)
                    if same > most:
                        most, n = same, 0
                    known = n >= MAX_TURNS
                    for t in range(n):
                        known = known or abs(_wrap(rotation - offset[a, b, t])) < ARM
                    if not known:
                        offset[a, b, n] = rotation
                        n += 1
            count[a, b] = n
    return count, offset


@kernel
def votes_of_patterns(start1, count):
    """How many votes a landmark of each pattern of map 2 casts (p2,)."""
    votes = np.zeros(count.shape[1], dtype=np.int64)
    for a in range(count.shape[0]):
        for b in range(count.shape[1]):
            votes[b] += count[a, b] * (start1[a + 1] - start1[a])
    return votes


@kernel
def rotations(start1, heading1, pattern2, heading2, count, offset):
    """How often pairs propose each rotation: votes (ROTATION_BINS,) over the full turn."""
    scale = ROTATION_BINS / TWO_PI
    of_pattern = np.zeros((len(start1) - 1, ROTATION_BINS))
    for a in range(len(start1) - 1):
        for k in range(start1[a], start1[a + 1]):
            of_pattern[a, int(np.floor(heading1[k] * scale)) % ROTATION_BINS] += 1
    votes = np.zeros(ROTATION_BINS)
    for j in range(len(pattern2)):
        b = pattern2[j]
        for a in range(len(start1) - 1):
            few = start1[a + 1] - start1[a] < ROTATION_BINS
            for t in range(count[a, b]):
                turn = offset[a, b, t] - heading2[j]
                if few:
                    for k in range(start1[a], start1[a + 1]):
                        votes[int(np.floor((heading1[k] + turn) * scale)) % ROTATION_BINS] += 1
                else:
                    shift = int(np.floor(turn * scale + 0.5))
                    for k in range(ROTATION_BINS):
                        votes[(k + shift) % ROTATION_BINS] += of_pattern[a, k]
    return votes


@kernel
def strongest_rotations(votes, reach, limit):
    """Peaks of a histogram over the circle, strongest first, in bins, until 98 % are within ``reach`` of one.

    The middle of a plateau counts as its peak. Votes are whole numbers.
    """
    n = len(votes)
    left, within = votes.copy(), np.zeros(n)
    centres = np.zeros(limit)
    remain = np.sum(votes)
    enough = 0.02 * remain
    found = 0
    while found < limit:
        best, k = -1.0, 0
        for b in range(n):
            total = 0.0
            for d in range(-reach, reach + 1):
                total += left[(b + d) % n]
            within[b] = total
            if total > best:
                best, k = total, b
        if best <= 0 or (found > 0 and remain <= enough):
            break
        shift, equal = 0, 0
        for b in range(n):
            if within[b] >= best * (1 - 1e-12):
                shift += (b - k + n // 2) % n - n // 2
                equal += 1
        plateau = shift / equal
        if abs(plateau) <= reach:
            k = int(np.rint(k + plateau)) % n
        total, moment = 0.0, 0.0
        for d in range(-reach, reach + 1):
            b = (k + d) % n
            total += left[b]
            moment += left[b] * d
            remain -= left[b]
            left[b] = 0.0
        centres[found] = k + 0.5 + (moment / total if total > 0 else 0.0)
        found += 1
    return centres[:found]


@kernel
def all_turns(members1, start1, heading1, members2, pattern2, heading2, count, offset, xy1, xy2, total):
    """Every T12 (total, 3) that a pair of landmarks proposes, and the pair's places (total, 2)."""
    T12s = np.zeros((total, 3))
    pair = np.zeros((total, 2), dtype=np.int32)
    n = 0
    for j in range(len(pattern2)):
        x2, y2 = xy2[members2[j], 0], xy2[members2[j], 1]
        b = pattern2[j]
        for a in range(len(start1) - 1):
            for t in range(count[a, b]):
                for k in range(start1[a], start1[a + 1]):
                    theta = _wrap(heading1[k] - heading2[j] + offset[a, b, t])
                    c, s = np.cos(theta), np.sin(theta)
                    i = members1[k]
                    T12s[n, 0] = xy1[i, 0] - c * x2 + s * y2
                    T12s[n, 1] = xy1[i, 1] - s * x2 - c * y2
                    T12s[n, 2] = theta
                    pair[n, 0], pair[n, 1] = i, members2[j]
                    n += 1
    return T12s[:n], pair[:n]


@kernel
def _first_at_least(values, begin, end, bound):
    while begin < end:
        middle = (begin + end) // 2
        if values[middle] < bound:
            begin = middle + 1
        else:
            end = middle
    return begin


@inlined
def _first_from(values, begin, end, k, bound):
    """`_first_at_least`, sought from ``k``: short where that is near."""
    while k < end and values[k] < bound:
        k += 1
    while k > begin and values[k - 1] >= bound:
        k -= 1
    return k


@inlined
def _first_above_from(values, begin, end, k, bound):
    """The first that is greater than ``bound``, sought from ``k``."""
    while k < end and values[k] <= bound:
        k += 1
    while k > begin and values[k - 1] > bound:
        k -= 1
    return k


@inlined
def _interval(part, heading1, begin, end, near, middle, width):
    """Places [begin, end) of the headings within ``width`` of ``middle``, or none.

    Headings are sorted within (-pi, pi]; the interval may stick out at one end: its other ``part``. ``near`` (2,):
    where the last one's first part began and ended, near which the next one's does.
    """
    low, high = middle - width, middle + width
    if part == 1:
        if low < -np.pi:
            low, high = low + TWO_PI, np.pi + 1e-9
        elif high > np.pi:
            low, high = -np.pi - 1e-9, high - TWO_PI
        else:
            return 0, 0
        first = _first_at_least(heading1, begin, end, low)
        last = first
        while last < end and heading1[last] <= high:
            last += 1
        return first, last
    near[0] = _first_from(heading1, begin, end, near[0], low)
    near[1] = _first_above_from(heading1, begin, end, near[1], high)
    return near[0], near[1]


@kernel
def _cast(start1, heading1, x1, y1, pattern2, heading2, rx, ry, count, offset, theta, width, x0, y0, scale, grid):
    """All votes, counted in the cells of ``grid``."""
    nx, ny = grid.shape
    cells = grid.reshape(-1)
    near = np.zeros((len(start1) - 1, MAX_TURNS, 2), dtype=np.int64)
    for a in range(len(start1) - 1):
        near[a] = start1[a]
    for j in range(len(pattern2)):
        b = pattern2[j]
        for a in range(len(start1) - 1):
            for t in range(count[a, b]):
                middle = _wrap(theta + heading2[j] - offset[a, b, t])
                for part in range(2):
                    first, last = _interval(part, heading1, start1[a], start1[a + 1], near[a, t], middle, width)
                    for k in range(first, last):
                        cx, cy = int((x1[k] - rx[j] - x0) * scale) + 1, int((y1[k] - ry[j] - y0) * scale) + 1
                        if cx >= nx:
                            cx %= nx
                        if cy >= ny:
                            cy %= ny
                        cell = np.uint64(cx * ny + cy)
                        if cells[cell] < 65535:
                            cells[cell] += np.uint16(1)


@kernel
def vote(start1, heading1, xy1, pattern2, heading2, xy2, count, offset, theta, width, size, grid, n_peaks):
    """Translations that pairs with a rotation within ``width`` of ``theta`` [rad] vote for; the strongest peaks.

    ``xy1`` and ``heading1`` by pattern, then heading; ``xy2`` (v, 2) of the voters; ``grid`` (nx, ny) uint16 of zeros,
    cells of ``size`` [m], which the plane is folded onto where it is larger; zeros again at the end. Returns T12s
    (k, 3), the mean place (k, 2) of those who voted for each, in frame 2, and their number (k,), strongest first.
    """
    nx, ny = grid.shape
    c, s = np.cos(theta), np.sin(theta)
    rx, ry = c * xy2[:, 0] - s * xy2[:, 1], s * xy2[:, 0] + c * xy2[:, 1]
    x1, y1 = xy1[:, 0].copy(), xy1[:, 1].copy()
    x0, y0 = x1.min() - rx.max(), y1.min() - ry.max()
    scale = 1 / size
    n_patterns = len(start1) - 1

    cell_x, cell_y = np.zeros(n_peaks, dtype=np.int32), np.zeros(n_peaks, dtype=np.int32)
    strength = np.zeros(n_peaks, dtype=np.int64)
    whole = np.zeros((n_peaks, 2), dtype=np.int64)  # unfolded cell of the majority, and its lead
    sums = np.zeros((n_peaks, 6))
    folded = (x1.max() - rx.min() - x0) * scale >= nx or (y1.max() - ry.min() - y0) * scale >= ny
    _cast(start1, heading1, x1, y1, pattern2, heading2, rx, ry, count, offset, theta, width, x0, y0, scale, grid)
    found = _peaks(grid, cell_x, cell_y, strength)
    _paint(grid, cell_x, cell_y, strength, found)
    # those who voted for a peak are known well enough from some hundred
    every = 1 + len(pattern2) // 300
    cells, near = grid.reshape(-1), np.zeros((n_patterns, MAX_TURNS, 2), dtype=np.int64)
    for turn in range(1, 3):
        if turn == 1 and not folded:
            continue
        for a in range(n_patterns):
            near[a] = start1[a]
        for j in range(0, len(pattern2), every):
            b = pattern2[j]
            for a in range(n_patterns):
                for t in range(count[a, b]):
                    middle = _wrap(theta + heading2[j] - offset[a, b, t])
                    for part in range(2):
                        first, last = _interval(part, heading1, start1[a], start1[a + 1], near[a, t], middle, width)
                        for k in range(first, last):
                            x, y = x1[k] - rx[j], y1[k] - ry[j]
                            ux, uy = int((x - x0) * scale) + 1, int((y - y0) * scale) + 1
                            cx, cy = ux, uy
                            if cx >= nx:
                                cx %= nx
                            if cy >= ny:
                                cy %= ny
                            p = np.int64(cells[np.uint64(cx * ny + cy)]) - 1
                            if p < 0:
                                continue
                            fold = (ux // nx) * 65536 + uy // ny if folded else 0
                            if turn == 1:
                                if whole[p, 0] == fold:
                                    whole[p, 1] += 1
                                elif whole[p, 1] == 0:
                                    whole[p, 0], whole[p, 1] = fold, 1
                                else:
                                    whole[p, 1] -= 1
                            elif whole[p, 0] == fold:
                                sums[p, 0] += 1
                                sums[p, 1] += x
                                sums[p, 2] += y
                                sums[p, 3] += xy2[j, 0]
                                sums[p, 4] += xy2[j, 1]
                                sums[p, 5] += _wrap(heading1[k] - middle)
    grid[:] = 0
    T12s, centre, votes = np.zeros((found, 3)), np.zeros((found, 2)), np.zeros(found)
    n = 0
    for p in range(found):
        if sums[p, 0] == 0:
            continue  # those who voted for it weren't asked again
        x2, y2 = sums[p, 3] / sums[p, 0], sums[p, 4] / sums[p, 0]
        at_x, at_y = sums[p, 1] / sums[p, 0] + c * x2 - s * y2, sums[p, 2] / sums[p, 0] + s * x2 + c * y2
        turned = _wrap(theta + sums[p, 5] / sums[p, 0])
        T12s[n, 0] = at_x - np.cos(turned) * x2 + np.sin(turned) * y2
        T12s[n, 1] = at_y - np.sin(turned) * x2 - np.cos(turned) * y2
        T12s[n, 2] = turned
        centre[n, 0], centre[n, 1] = x2, y2
        votes[n] = strength[p]
        n += 1
    return T12s[:n], centre[:n], votes[:n]


@kernel
def _box(grid, x, y):
    """Votes of a cell and its eight neighbours; 0 where a neighbour has more, the first of equals counting."""
    own, total = grid[x, y], 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            other = grid[x + dx, y + dy]
            if other > own or (other == own and (dx < 0 or (dx == 0 and dy < 0))):
                return 0
            total += other
    return total


@kernel
def _peaks(grid, cell_x, cell_y, strength):
    """The strongest local maxima, as many as there is room for; returns how many."""
    most = 4096
    histogram = np.zeros(most, dtype=np.int64)
    nx, ny = grid.shape
    least, total, found = 1, 0, 0
    # only cells that are among the fullest: so many that the local maxima among them suffice
    for x in range(nx):
        for y in range(ny):
            if grid[x, y] > 0:
                histogram[min(grid[x, y], most - 1)] += 1
    fullest, n = most - 1, 0
    while fullest > 1 and n < 20 * len(strength):
        n += histogram[fullest]
        fullest -= 1
    n = np.sum(histogram[fullest:])
    maximum = np.zeros((n, 3), dtype=np.int32)
    n = 0
    histogram[:] = 0
    for x in range(1, nx - 1):
        for y in range(1, ny - 1):
            # nine times the middle is the most that a peak can have
            if grid[x, y] < fullest:
                continue
            box = _box(grid, x, y)
            if box == 0:
                continue
            maximum[n, 0], maximum[n, 1], maximum[n, 2] = x, y, box
            n += 1
            box = min(box, most - 1)
            if box >= least:
                histogram[box] += 1
                total += 1
                # the bound rises as long as enough are above it
                while total - histogram[least] >= len(strength):
                    total -= histogram[least]
                    least += 1
    for k in range(n):
        x, y, box = maximum[k, 0], maximum[k, 1], maximum[k, 2]
        if box >= least and found < len(strength):
            if min(box, most - 1) > least or total <= len(strength):
                cell_x[found], cell_y[found], strength[found] = x, y, box
                found += 1
            else:
                # as many of those at the bound as fit
                total -= 1
    return found


@kernel
def _paint(grid, cell_x, cell_y, strength, found):
    """The grid made a map of peaks: each one's number plus one on its nine cells, the stronger one's where two meet."""
    grid[:] = 0
    order = np.argsort(strength[:found])
    for p in order:
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                grid[cell_x[p] + dx, cell_y[p] + dy] = np.uint16(p + 1)


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
    fx, fy = (x - seen.x) * seen.per_m, (y - seen.y) * seen.per_m
    if fx >= 0 and fy >= 0 and fx < seen.cells.shape[0] and fy < seen.cells.shape[1]:
        return seen.cells[int(fx), int(fy)]
    return np.uint8(0)


@kernel
def _common_ways(seen, other, x, y, theta):
    """How many samples of ``other``, moved by (x, y, theta), lie along ways of ``seen``."""
    c, s = np.cos(theta), np.sin(theta)
    n = 0
    for k in range(len(other.samples)):
        px, py = other.samples[k, 0], other.samples[k, 1]
        bits = _passed(seen, c * px - s * py + x, s * px + c * py + y)
        if bits != 0:
            direction = int(np.floor((other.samples[k, 2] + theta) / np.pi * 8)) % 8
            near = (1 << direction) | (1 << ((direction + 1) % 8)) | (1 << ((direction + 7) % 8))
            if bits & near:
                n += 1
    return n


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
        x, y, theta, c, s = 0.0, 0.0, 0.0, 1.0, 0.0
        for turn in range(len(looseness)):
            x, y, theta = T12s[k, 0], T12s[k, 1], T12s[k, 2]
            c, s = np.cos(theta), np.sin(theta)
            sectors = int(np.floor(theta / TWO_PI * 64 + 0.5)) % 64
            loose = looseness[turn] ** 2
            if turn > 0:
                for j in range(n2):
                    if mine[j] >= 0:
                        holder[mine[j]] = -1
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
            if turn + 1 < len(looseness):
                _align(T12s, centres, k, mine, of_match, one, two, rules)
        # x, y, theta, c and s are those of the last turn, which doesn't align
        total, n, most = 0.0, 0, -np.inf
        for j in range(n2):
            i = mine[j]
            if i >= 0:
                total += held[i]
                n += 1
                # a pair to grow from has headings, and is sure
                off = _wrap(one.values[i, HEADING] - two.values[j, HEADING])
                sure = held[i] if abs(off) <= TWO_PI else held[i] - 1e6
                if sure > most:
                    seed[k], most = j, sure
            elif two.values[j, MISS] < 0:
                px, py = two.values[j, X], two.values[j, Y]
                if _passed(seen1, c * px - s * py + x, s * px + c * py + y) != 0:
                    total += two.values[j, MISS]
        if both_ways:
            for i in range(n1):
                if holder[i] < 0 and one.values[i, MISS] < 0:
                    px, py = one.values[i, X] - x, one.values[i, Y] - y
                    if _passed(seen2, c * px + s * py, c * py - s * px) != 0:
                        total += one.values[i, MISS]
        if seen2.void > 0:
            total += seen2.void * _common_ways(seen1, seen2, x, y, theta)
        if both_ways and seen1.void > 0:
            total += seen1.void * _common_ways(seen2, seen1, -(c * x + s * y), s * x - c * y, -theta)
        score[k], count[k] = total, n
        for j in range(n2):
            if mine[j] >= 0:
                holder[mine[j]] = -1
    return T12s, centres, score, count, partner, seed


@kernel
def _align(T12s, centres, k, mine, of_match, one, two, rules):
    """T12 by weighted least squares of the matches' positions and headings, in place; untouched without matches."""
    weight, w1x, w1y, w2x, w2y = 0.0, 0.0, 0.0, 0.0, 0.0
    turned, sure = 0.0, 0.0
    theta = T12s[k, 2]
    for j in range(len(mine)):
        i = mine[j]
        if i >= 0:
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
    for j in range(len(mine)):
        i = mine[j]
        if i >= 0:
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
            turned = np.sin((T12s[k, 2] - T12s[kept[m], 2]) / 2)
            apart = (x - at[m, 0]) ** 2 + (y - at[m, 1]) ** 2 + 4 * spread * turned * turned
            if apart <= tolerance * tolerance:
                new = False
                break
        if new:
            kept[n], at[n, 0], at[n, 1] = k, x, y
            n += 1
            if n == limit:
                break
    return kept[:n]
