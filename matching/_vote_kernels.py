"""Votes for translations at one rotation, compiled, and their peaks.

Import through `mapfuse.datasets.compiled.kernels` only. Arrays are C-contiguous float64, int32 or uint16.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import inlined, kernel

TWO_PI = 2 * np.pi
# Counters that are looked at one by one only if the fullest of them counts: as many as are compared in one go.
COUNTERS = 64


@kernel
def _wrap(angle):
    return angle - TWO_PI * np.floor(angle / TWO_PI + 0.5)


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
    near = np.zeros((len(start1) - 1, offset.shape[2], 2), dtype=np.int64)
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
    cells, near = grid.reshape(-1), np.zeros((n_patterns, offset.shape[2], 2), dtype=np.int64)
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


@inlined
def _fullest(counters):
    most = np.uint16(0)
    for k in range(len(counters)):
        most = max(most, counters[k])
    return most


@kernel
def _least_of_the_fullest(cells, enough, most):
    """One vote less than what ``enough`` of the ``cells`` have, which are counted up to ``most``; 1 at least."""
    histogram = np.zeros(most + 1, dtype=np.int64)
    # ``above`` have more than ``least`` votes; those that have fewer no longer count
    least, above = 1, 0
    for begin in range(0, len(cells), COUNTERS):
        block = cells[begin : begin + COUNTERS]
        if _fullest(block) < least:
            continue
        for k in range(len(block)):
            own = min(np.int64(block[k]), most)
            if own < least:
                continue
            histogram[own] += 1
            above += own > least
            while above - histogram[least + 1] >= enough:
                above -= histogram[least + 1]
                least += 1
    return least, above + histogram[least]


@kernel
def _peaks(grid, cell_x, cell_y, strength):
    """The strongest local maxima, as many as there is room for; returns how many."""
    most = 4096
    nx, ny = grid.shape
    cells = grid.reshape(-1)
    # only cells that are among the fullest: so many that the local maxima among them suffice
    fullest, n = _least_of_the_fullest(cells, 20 * len(strength), most - 1)
    maximum = np.zeros((n, 3), dtype=np.int32)
    histogram = np.zeros(most, dtype=np.int64)
    least, total, found = 1, 0, 0
    n = 0
    for begin in range(0, len(cells), COUNTERS):
        block = cells[begin : begin + COUNTERS]
        if _fullest(block) < fullest:
            continue
        for k in range(len(block)):
            # nine times the middle is the most that a peak can have
            if block[k] < fullest:
                continue
            x, y = (begin + k) // ny, (begin + k) % ny
            if x == 0 or y == 0 or x == nx - 1 or y == ny - 1:
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
