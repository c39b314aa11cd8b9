"""The loops of the index of maps, compiled: triangles that are alike, and their votes.

Import through `mapfuse.datasets.compiled.kernels` only. What triangles, points and labels are: `triangles`.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import kernel

#: Cells of the grid in each direction; points beyond the last one lie in the last one.
SIDE = 1 << 10


@kernel
def cells(points, label, reach):
    """The cell of each point (k, 3) in a grid of ``reach``; those of one ``label`` and row come behind each other."""
    out = np.empty(len(points), np.int64)
    for k in range(len(points)):
        out[k] = _cell(label[k], *_at(points[k], reach))
    return out


@kernel
def _at(point, reach):
    x = min(max(int(np.floor(point[0] / reach)) + SIDE // 2, 1), SIDE - 2)
    y = min(max(int(np.floor(point[1] / reach)) + SIDE // 2, 1), SIDE - 2)
    z = min(max(int(np.floor(point[2] / reach)) + SIDE // 2, 1), SIDE - 2)
    return x, y, z


@kernel
def _cell(label, x, y, z):
    return ((label * SIDE + x) * SIDE + y) * SIDE + z


@kernel
def alike(points, label, stored, stored_label, cell, reach, map_of, own, bare, maps, many, common):
    """Pairs (k, 2) of triangles that are alike and tell something: places in ``points`` and in ``stored``.

    ``points`` (c, n, 3): what is asked, as it compares with triangles of each class of noise; ``stored`` (m, 3) stands
    in the order of its cells ``cell`` (m,), labels ``stored_label`` (m,) being c times the triangle's and the class.
    Alike are points of one label no farther apart than ``reach``, in another map (``map_of`` (m,)) than ``own``. Of
    triangles without arms (``bare`` (n,)) that are like many and vote with less than ``common``, nothing is told.
    """
    classes = len(points)
    found = np.empty((4 * len(label) + 64, 2), np.int64)
    last = np.full(maps, -1, np.int64)
    count = 0
    for k in range(len(label)):
        begin, others = count, 0
        for c in range(classes):
            p, wanted = points[c, k], label[k] * classes + c
            x, y, z = _at(p, reach)
            for i in range(x - 1, x + 2):
                for j in range(y - 1, y + 2):
                    first = np.searchsorted(cell, _cell(wanted, i, j, z - 1), side="left")
                    end = np.searchsorted(cell, _cell(wanted, i, j, z + 1), side="right")
                    for m in range(first, end):
                        dx, dy, dz = stored[m, 0] - p[0], stored[m, 1] - p[1], stored[m, 2] - p[2]
                        far = dx * dx + dy * dy + dz * dz > reach * reach
                        if far or stored_label[m] != wanted or map_of[m] == own:
                            continue
                        if count == len(found):
                            larger = np.empty((2 * count, 2), np.int64)
                            larger[:count] = found
                            found = larger
                        found[count, 0], found[count, 1] = k, m
                        count += 1
                        if last[map_of[m]] != k:
                            last[map_of[m]] = k
                            others += 1
        if bare[k] and count - begin >= many and np.log(maps / max(others, 1)) < common:
            count = begin
    return found[:count].copy()


@kernel
def placements(corners1, corners2, positions, ways, walls, near_ways, near_walls, sectors):
    """Of triangles that are alike (h, 3): shift (h, 2) and turn (h,) that lay the second on the first, and how many
    arms then meet one that says the opposite (h,).

    ``ways``, ``walls``: bits of the sectors that arms of a landmark point to; ``near_``: with those beside them.
    """
    n = len(corners1)
    shift, turn, against = np.empty((n, 2)), np.empty(n), np.zeros(n, np.int64)
    every = (1 << sectors) - 1
    for h in range(n):
        x1 = y1 = x2 = y2 = 0.0
        for k in range(3):
            x1 += positions[corners1[h, k], 0] / 3
            y1 += positions[corners1[h, k], 1] / 3
            x2 += positions[corners2[h, k], 0] / 3
            y2 += positions[corners2[h, k], 1] / 3
        sine = cosine = 0.0
        for k in range(3):
            ax, ay = positions[corners1[h, k], 0] - x1, positions[corners1[h, k], 1] - y1
            bx, by = positions[corners2[h, k], 0] - x2, positions[corners2[h, k], 1] - y2
            sine += bx * ay - by * ax
            cosine += bx * ax + by * ay
        angle = np.arctan2(sine, cosine)
        c, s = np.cos(angle), np.sin(angle)
        turn[h] = angle
        shift[h, 0], shift[h, 1] = x1 - c * x2 + s * y2, y1 - s * x2 - c * y2
        steps = int(np.round(angle * sectors / (2 * np.pi))) % sectors
        for k in range(3):
            a, b = corners1[h, k], corners2[h, k]
            against[h] += _bits(ways[a] & _turned(near_walls[b], steps, sectors, every))
            against[h] += _bits(walls[a] & _turned(near_ways[b], steps, sectors, every))
    return shift, turn, against


@kernel
def _turned(bits, steps, sectors, every):
    wide = bits << steps
    return (wide | (wide >> sectors)) & every


@kernel
def _bits(value):
    count = 0
    while value:
        value &= value - 1
        count += 1
    return count


@kernel
def weights(asked, map_of, against, maps, rarest, contradicted):
    """What each vote counts [nats]: the log of how rare the asked triangle is, less where arms contradict."""
    out = np.empty(len(asked))
    last = np.full(maps, -1, np.int64)
    first = 0
    while first < len(asked):
        end, others = first, 0
        while end < len(asked) and asked[end] == asked[first]:
            if last[map_of[end]] != first:
                last[map_of[end]] = first
                others += 1
            end += 1
        rare = min(max(np.log(maps / max(others, 1)), 0.0), rarest)
        for h in range(first, end):
            out[h] = rare * contradicted ** against[h]
        first = end
    return out


@kernel
def fullest(map_of, shift, turn, weight, size, faint):
    """Other maps (k,) in their order, and the weight (k,) of the fullest cell of all votes for each.

    Cells are ``size`` [m, m, rad], on grids that are shifted by half a cell each way. Votes of maps whose votes for
    about one turn are together worth less than ``faint`` aren't looked at.
    """
    order = np.argsort(map_of, kind="mergesort")
    turns = int(np.ceil(2 * np.pi / size[2]))
    wide = int(np.pi / size[2])
    maps, best = np.empty(len(order), np.int64), np.empty(len(order))
    count, first = 0, 0
    while first < len(order):
        end = first
        while end < len(order) and map_of[order[end]] == map_of[order[first]]:
            end += 1
        votes = order[first:end]
        enough = _enough(turn[votes], weight[votes], wide, faint)
        first = end
        if not enough.any():
            continue
        kept = votes[enough]
        top = 0.0
        for half in range(8):
            key = np.empty(len(kept), np.int64)
            for k in range(len(kept)):
                h = kept[k]
                x = int(np.floor(shift[h, 0] / size[0] + (half & 1) / 2)) + (1 << 20)
                y = int(np.floor(shift[h, 1] / size[1] + (half >> 1 & 1) / 2)) + (1 << 20)
                angle = int(np.floor(turn[h] % (2 * np.pi) / size[2] + (half >> 2) / 2)) % turns
                key[k] = (x * (1 << 21) + y) * turns + angle
            ranked = np.argsort(key, kind="mergesort")
            total = 0.0
            for k in range(len(ranked)):
                if k and key[ranked[k]] != key[ranked[k - 1]]:
                    total = 0.0
                total += weight[kept[ranked[k]]]
                top = max(top, total)
        maps[count], best[count] = map_of[votes[0]], top
        count += 1
    return maps[:count].copy(), best[:count].copy()


@kernel
def _enough(turn, weight, wide, faint):
    """Which votes stand with others for about that turn that are together worth ``faint``."""
    out = np.zeros(len(turn), np.bool_)
    for half in range(2):
        total = np.zeros(wide)
        at = np.empty(len(turn), np.int64)
        for k in range(len(turn)):
            at[k] = int(np.floor(turn[k] % (2 * np.pi) / (2 * np.pi) * wide + half / 2)) % wide
            total[at[k]] += weight[k]
        for k in range(len(turn)):
            out[k] |= total[at[k]] >= faint
    return out
