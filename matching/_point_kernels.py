"""The search among landmarks without heading, compiled; imported through `mapfuse.datasets.compiled.kernels` only.

Conventions: map 1 is looked up, map 2 is moved; ``grid`` is a `SpatialGrid` as four arguments (start, members, corner
and size, shape); all landmarks are those of `PointArrays`, in its order. Loops over neighbours are bounded, so that
landmarks that crowd at one spot cost no more than others.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import kernel

BINS = 64
ANGLE_STEPS = 65536
_SHIFT = 10  # ANGLE_STEPS / BINS = 2 ** 10
_EDGES = 4
_SCANNED = 48
_KRIGED = 6


@kernel
def vote(length1, angle1, near_label1, label1, length2, angle2, near_label2, label2, tolerance2, shortest, anchors):
    """For each (anchor of map 2, landmark of map 1): the rotation that most equal distances speak for.

    Lists (n, k) of neighbours by length [m]; angles in steps, `ANGLE_STEPS` a turn, seen from the nearest neighbour,
    so that no frame decides where votes are cut into bins. Returns ``strength`` and ``turn`` [rad], (anchors, n1):
    votes of the strongest rotation above what chance gives, in its standard deviations.
    """
    n1, k1, k2 = len(label1), length1.shape[1], length2.shape[1]
    strength = np.full((len(anchors), n1), -1.0, dtype=np.float32)
    turn = np.zeros((len(anchors), n1), dtype=np.float32)
    votes = np.zeros(BINS + 2, dtype=np.int32)
    first1 = np.zeros(n1, dtype=np.int32)
    for i in range(n1):
        while first1[i] < k1 and length1[i, first1[i]] < shortest:
            first1[i] += 1
    for a in range(len(anchors)):
        j = anchors[a]
        for i in range(n1):
            if label1[i] != label2[j]:
                continue
            votes[:] = 0
            total = 0
            low = first1[i]
            lengths, angles, labels = length1[i], angle1[i], near_label1[i]
            for b in range(k2):
                length = length2[j, b]
                if length < shortest:
                    continue
                least, most = length - tolerance2[j, b], length + tolerance2[j, b]
                angle, label = angle2[j, b], near_label2[j, b]
                while low < k1 and lengths[low] < least:
                    low += 1
                if low == k1:
                    break
                for k in range(low, k1):
                    if lengths[k] > most:
                        break
                    if labels[k] == label:
                        votes[1 + (((angles[k] - angle) & 65535) >> _SHIFT)] += 1
                        total += 1
            if total < 1:
                continue
            votes[0], votes[BINS + 1] = votes[BINS], votes[1]
            best, at = -1, 0
            for k in range(1, BINS + 1):
                together = 2 * votes[k] + votes[k - 1] + votes[k + 1]
                if together > best:
                    best, at = together, k
            chance = total * 2.0 / BINS
            strength[a, i] = (best / 2.0 - chance) / np.sqrt(chance + 1.0)
            shift = (votes[at + 1] - votes[at - 1]) / float(best)
            turn[a, i] = (at - 0.5 + shift) * (2 * np.pi / BINS)
    return strength, turn


@kernel
def _cell(x, y, box, shape):
    """Column and row of the cell of a place, clipped to one ring outside the grid."""
    column = min(max(np.floor((x - box[0]) / box[2]), -1.0), float(shape[0]))
    row = min(max(np.floor((y - box[1]) / box[2]), -1.0), float(shape[1]))
    return int(column), int(row)


@kernel
def _candidates(x, y, label, reach2, xy1, label1, start, members, box, shape, found, squared):
    """The nearest landmarks of that label within reach, nearest first, at most `_EDGES`; how many."""
    column, row = _cell(x, y, box, shape)
    n = 0
    for c in range(max(column - 1, 0), min(column + 2, shape[0])):
        begin = start[c * shape[1] + max(row - 1, 0)] if row - 1 < shape[1] else 0
        end = start[c * shape[1] + min(row + 2, shape[1])] if row + 2 > 0 and row - 1 < shape[1] else 0
        for place in range(begin, min(end, begin + _SCANNED)):
            i = members[place]
            if label1[i] != label:
                continue
            dx, dy = xy1[i, 0] - x, xy1[i, 1] - y
            d2 = dx * dx + dy * dy
            if d2 > reach2:
                continue
            k = min(n, _EDGES - 1)
            if n == _EDGES and d2 >= squared[k]:
                continue
            while k > 0 and squared[k - 1] > d2:
                squared[k], found[k] = squared[k - 1], found[k - 1]
                k -= 1
            squared[k], found[k] = d2, i
            n = min(n + 1, _EDGES)
    return n


@kernel
def _aligned(xy1, xy2, index1, index2, weight, n, T):
    """Weighted closed-form alignment of n matches into ``T`` (3,); returns centre x, y in frame 2 and the spread."""
    total = 0.0
    a1x, a1y, a2x, a2y = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        w, i, j = weight[k], index1[k], index2[k]
        total += w
        a1x += w * xy1[i, 0]
        a1y += w * xy1[i, 1]
        a2x += w * xy2[j, 0]
        a2y += w * xy2[j, 1]
    a1x, a1y, a2x, a2y = a1x / total, a1y / total, a2x / total, a2y / total
    cross, dot, spread = 0.0, 0.0, 0.0
    for k in range(n):
        w, i, j = weight[k], index1[k], index2[k]
        ux, uy = xy1[i, 0] - a1x, xy1[i, 1] - a1y
        vx, vy = xy2[j, 0] - a2x, xy2[j, 1] - a2y
        cross += w * (vx * uy - vy * ux)
        dot += w * (vx * ux + vy * uy)
        spread += w * (vx * vx + vy * vy)
    if np.hypot(cross, dot) > 1e-9 * total:
        T[2] = np.arctan2(cross, dot)
    c, s = np.cos(T[2]), np.sin(T[2])
    T[0] = a1x - c * a2x + s * a2y
    T[1] = a1y - s * a2x - c * a2y
    return a2x, a2y, spread


@kernel
def refine_near(
    T12s, anchors, xy1, variance1, label1, rarity1, xy2, variance2, label2, rarity2,
    near2, n_near, start, members, box, shape, around, gate
):  # fmt: skip
    """Match each seed's anchor and its neighbours one-to-one, align, twice; ``T12s`` (s, 3) in place.

    ``rarity`` (n,): log of what a match is worth but for its residual, half of it from each map; ``around`` [rad]:
    by what the rotation may be off. Returns the gain [nats] (s,).
    """
    gain = np.full(len(T12s), -1e9)
    k2 = min(near2.shape[1], n_near)
    index1, index2 = np.zeros(k2 + 1, dtype=np.int64), np.zeros(k2 + 1, dtype=np.int64)
    value, weight = np.zeros(k2 + 1), np.zeros(k2 + 1)
    found, squared = np.zeros(_EDGES, dtype=np.int64), np.zeros(_EDGES)
    for s in range(len(T12s)):
        T = T12s[s]
        j0 = anchors[s]
        cx, cy = xy2[j0, 0], xy2[j0, 1]
        for turn in range(3):
            c, sn = np.cos(T[2]), np.sin(T[2])
            wide = around / 2.0**turn
            n, total = 0, 0.0
            for b in range(k2 + 1):
                j = j0 if b == 0 else near2[j0, b - 1]
                dx, dy = xy2[j, 0] - cx, xy2[j, 1] - cy
                variance = variance2[j] + wide * wide * (dx * dx + dy * dy)
                x = T[0] + c * xy2[j, 0] - sn * xy2[j, 1]
                y = T[1] + sn * xy2[j, 0] + c * xy2[j, 1]
                reach2 = min(gate * gate * (variance + variance1[0]), box[2] * box[2])
                m = _candidates(x, y, label2[j], reach2, xy1, label1, start, members, box, shape, found, squared)
                for e in range(m):
                    i = found[e]
                    v = variance + variance1[i]
                    worth = rarity1[i] + rarity2[j] - np.log(v) - squared[e] / (2 * v)
                    rival = -1
                    for k in range(n):
                        if index1[k] == i:
                            rival = k
                            break
                    if rival >= 0 and value[rival] >= worth:
                        continue
                    if rival < 0:
                        rival = n
                        n += 1
                    else:
                        total -= value[rival]
                    index1[rival], index2[rival], value[rival] = i, j, worth
                    weight[rival] = 1 / v
                    total += worth
                    break
            if n < 2:
                total = -1e9
                break
            cx, cy, _ = _aligned(xy1, xy2, index1, index2, weight, n, T)
            gain[s] = total
    return gain


@kernel
def _krige(j, partner, error, noise, xy2, near2, length2, sigma2, scale2, earlier, out, places, L, right):
    """Mean and variance of the bend at landmark j from its nearest matched neighbours; ``out``: x, y, variance, metres
    to the nearest of them. ``earlier``: only from those that come before j. The last three are to work in."""
    n = 0
    out[3] = length2[j, length2.shape[1] - 1] if length2.shape[1] else 0.0
    for b in range(near2.shape[1]):
        k = near2[j, b]
        if partner[k] < 0 or (earlier and k > j):
            continue
        if n == 0:
            out[3] = length2[j, b]
        places[n] = k
        n += 1
        if n == _KRIGED:
            break
    out[0], out[1], out[2] = 0.0, 0.0, sigma2
    if n == 0 or sigma2 <= 0:
        return
    for a in range(n):
        p = places[a]
        dx, dy = xy2[p, 0] - xy2[j, 0], xy2[p, 1] - xy2[j, 1]
        right[a, 0] = sigma2 * np.exp(-(dx * dx + dy * dy) / scale2)
        right[a, 1], right[a, 2] = error[p, 0], error[p, 1]
        for b in range(a + 1):
            q = places[b]
            dx, dy = xy2[p, 0] - xy2[q, 0], xy2[p, 1] - xy2[q, 1]
            value = sigma2 * np.exp(-(dx * dx + dy * dy) / scale2)
            if a == b:
                value += noise[p]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            L[a, b] = np.sqrt(max(value, 1e-12)) if a == b else value / L[b, b]
    for column in range(3):
        for a in range(n):
            value = right[a, column]
            for k in range(a):
                value -= L[a, k] * right[k, column]
            right[a, column] = value / L[a, a]
    for a in range(n):
        out[0] += right[a, 0] * right[a, 1]
        out[1] += right[a, 0] * right[a, 2]
        out[2] -= right[a, 0] * right[a, 0]
    out[2] = max(out[2], 0.0)


@kernel
def grow(
    T12s, anchors, xy1, variance1, label1, rarity1, xy2, variance2, label2, rarity2,
    near2, length2, n_near, start, members, box, shape,
    bend, scale, around, gate, least, rounds, least_gain
):  # fmt: skip
    """Grow each mode from its anchor's neighbourhood over the map; ``T12s`` (s, 3) in place.

    A landmark is looked for where the alignment and the bend of its matched neighbours predict it, as far as the
    prediction is sure enough. Returns ``partner`` (s, n2), -1 where none; ``gain``, ``normalised`` (s,): what matches
    are worth [nats] but for their residuals, the sum of their squared normalised residuals; ``freedom``: Laplace term.
    """
    n1, n2, n_modes = len(xy1), len(xy2), len(T12s)
    partner = np.full((n_modes, n2), -1, dtype=np.int32)
    gain, normalised, freedom = np.full(n_modes, -1e9), np.zeros(n_modes), np.zeros(n_modes)
    sigma2, scale2 = bend * bend, 2 * scale * scale
    edge = np.zeros((n2, _EDGES), dtype=np.int64)
    worth = np.zeros((n2, _EDGES))
    edges = np.zeros(n2, dtype=np.int64)
    owner = np.zeros(n1, dtype=np.int64)
    error, noise = np.zeros((n2, 2)), np.zeros(n2)
    index1, index2, weight = np.zeros(n2, dtype=np.int64), np.zeros(n2, dtype=np.int64), np.zeros(n2)
    found, squared, out = np.zeros(_EDGES, dtype=np.int64), np.zeros(_EDGES), np.zeros(4)
    new = np.zeros(n2, dtype=np.int32)
    local, at = np.zeros(n2, dtype=np.bool_), np.zeros((n2, 3))
    places, L, right = np.zeros(_KRIGED, dtype=np.int64), np.zeros((_KRIGED, _KRIGED)), np.zeros((_KRIGED, 3))
    for s in range(n_modes):
        T, mine, j0 = T12s[s], partner[s], anchors[s]
        cx, cy, spread, count = xy2[j0, 0], xy2[j0, 1], 0.0, 0
        local[:] = False
        local[j0] = True
        for b in range(min(n_near, near2.shape[1])):
            local[near2[j0, b]] = True
        for turn in range(rounds):
            c, sn = np.cos(T[2]), np.sin(T[2])
            slope2 = around * around
            level = 0.0
            if count >= 2:
                reach = np.sqrt(spread / count)
                slope2 = (bend / max(scale, reach)) ** 2
                level = 1.0 / count
            for j in range(n2):
                edges[j] = 0
                new[j] = -1
                if count < 2:
                    if not local[j]:
                        continue
                    dx, dy = xy2[j, 0] - cx, xy2[j, 1] - cy
                    out[0], out[1] = 0.0, 0.0
                    wide = slope2 * (dx * dx + dy * dy)
                else:
                    _krige(j, mine, error, noise, xy2, near2, length2, sigma2, scale2, False, out, places, L, right)
                    dx, dy = xy2[j, 0] - cx, xy2[j, 1] - cy
                    wide = min(out[2] + slope2 * out[3] * out[3], 1.5 * sigma2)
                    wide += least * (level + (dx * dx + dy * dy) / max(spread, 1e-9))
                variance = variance2[j] + wide
                reach2 = gate * gate * (variance + variance1[0])
                if reach2 > box[2] * box[2]:
                    if count >= 2 and wide > 1.5 * sigma2 + 3 * least:
                        continue
                    reach2 = box[2] * box[2]
                x = T[0] + c * xy2[j, 0] - sn * xy2[j, 1] + out[0]
                y = T[1] + sn * xy2[j, 0] + c * xy2[j, 1] + out[1]
                at[j, 0], at[j, 1], at[j, 2] = x, y, variance + variance1[0]
                m = _candidates(x, y, label2[j], reach2, xy1, label1, start, members, box, shape, found, squared)
                for e in range(m):
                    v = variance + variance1[found[e]]
                    value = rarity1[found[e]] + rarity2[j] - np.log(v) - squared[e] / (2 * v)
                    if value > least_gain:
                        edge[j, edges[j]], worth[j, edges[j]] = found[e], value
                        edges[j] += 1
            owner[:] = -1
            _assign(edge, worth, edges, owner, new)
            _swap(new, xy1, label2, near2, at)
            n, same = 0, True
            for j in range(n2):
                same = same and new[j] == mine[j]
                mine[j] = new[j]
                if new[j] >= 0:
                    index1[n], index2[n] = new[j], j
                    weight[n] = 1 / (variance1[new[j]] + variance2[j])
                    n += 1
            count = n
            if n < 2:
                break
            cx, cy, spread = _aligned(xy1, xy2, index1, index2, weight, n, T)
            mean = 0.0
            for k in range(n):
                mean += weight[k] / n
            spread = spread / mean
            c, sn = np.cos(T[2]), np.sin(T[2])
            for k in range(n):
                i, j = index1[k], index2[k]
                error[j, 0] = xy1[i, 0] - (T[0] + c * xy2[j, 0] - sn * xy2[j, 1])
                error[j, 1] = xy1[i, 1] - (T[1] + sn * xy2[j, 0] + c * xy2[j, 1])
                noise[j] = 1 / weight[k]
            if same and turn > 1:
                break
        if count < 2:
            continue
        total, chi2 = 0.0, 0.0
        for k in range(count):
            i, j = index1[k], index2[k]
            _krige(j, mine, error, noise, xy2, near2, length2, sigma2, scale2, True, out, places, L, right)
            v = variance1[i] + variance2[j] + out[2]
            chi2 += ((error[j, 0] - out[0]) ** 2 + (error[j, 1] - out[1]) ** 2) / v
            total += rarity1[i] + rarity2[j] - np.log(v)
        gain[s], normalised[s] = total, chi2
        freedom[s] = 1.5 * np.log(least + sigma2) - np.log(float(count)) - 0.5 * np.log(max(spread, least))
    return partner, gain, normalised, freedom


@kernel
def _assign(edge, worth, edges, owner, new):
    """One-to-one: what is worth most first. ``owner`` (n1,): -1 on entry; ``new`` (n2,): -1 on entry."""
    for _ in range(8):
        changed = False
        for j in range(len(new)):
            if new[j] >= 0:
                continue
            best = -1
            for e in range(edges[j]):
                i = edge[j, e]
                held = owner[i]
                if held >= 0:
                    # what its owner has of it
                    other = -1e300
                    for f in range(edges[held]):
                        if edge[held, f] == i:
                            other = worth[held, f]
                    if other >= worth[j, e]:
                        continue
                if best < 0 or worth[j, e] > worth[j, best]:
                    best = e
            if best >= 0:
                i = edge[j, best]
                if owner[i] >= 0:
                    new[owner[i]] = -1
                owner[i] = j
                new[j] = i
                changed = True
        if not changed:
            break


@kernel
def _swap(new, xy1, label2, near2, at):
    """Neighbours exchange their partners where both together are nearer then, by what ``at`` (n2, 3) predicts: x, y,
    variance. What is worth most first may leave a landmark the partner of its neighbour."""
    for _ in range(2):
        for j in range(len(new)):
            if new[j] < 0:
                continue
            for b in range(min(8, near2.shape[1])):
                k = near2[j, b]
                if k < j or new[k] < 0 or label2[j] != label2[k]:
                    continue
                i, l = new[j], new[k]
                straight = _squared(at, j, xy1, i) + _squared(at, k, xy1, l)
                crossed = _squared(at, j, xy1, l) + _squared(at, k, xy1, i)
                if crossed < straight - 1e-9:
                    new[j], new[k] = l, i


@kernel
def _squared(at, j, xy1, i):
    """Squared normalised distance of landmark i of map 1 from where landmark j of map 2 is predicted."""
    return ((xy1[i, 0] - at[j, 0]) ** 2 + (xy1[i, 1] - at[j, 1]) ** 2) / at[j, 2]


@kernel
def distinct(T12s, x, y, spread, tolerance2, limit):
    """Places of the distinct ones among T12s (s, 3) given best first, at most ``limit``: see `modes.distinct`.

    Map 2's mean is at ``x``, ``y``; ``spread``: mean squared distance from it; ``tolerance2``: squared, all [m].
    """
    kept = np.zeros(len(T12s), dtype=np.int64)
    moved = np.zeros((len(T12s), 2))
    n = 0
    for s in range(len(T12s)):
        c, sn = np.cos(T12s[s, 2]), np.sin(T12s[s, 2])
        moved[s, 0], moved[s, 1] = T12s[s, 0] + c * x - sn * y, T12s[s, 1] + sn * x + c * y
        new = True
        for k in range(n):
            other = kept[k]
            dx, dy = moved[s, 0] - moved[other, 0], moved[s, 1] - moved[other, 1]
            turned = np.sin((T12s[s, 2] - T12s[other, 2]) / 2)
            if dx * dx + dy * dy + 4 * spread * turned * turned <= tolerance2:
                new = False
                break
        if new:
            kept[n] = s
            n += 1
            if n == limit:
                break
    return kept[:n]


@kernel
def looked_at(x, y, xy1, reach1, start, members, box, shape):
    """Which of the places lie within the reach of a landmark of map 1, (m,)."""
    out = np.zeros(len(x), dtype=np.bool_)
    for p in range(len(x)):
        column, row = _cell(x[p], y[p], box, shape)
        for col in range(max(column - 1, 0), min(column + 2, shape[0])):
            begin = start[col * shape[1] + max(row - 1, 0)] if row - 1 < shape[1] else 0
            end = start[col * shape[1] + min(row + 2, shape[1])] if row + 2 > 0 and row - 1 < shape[1] else 0
            for place in range(begin, min(end, begin + 4 * _SCANNED)):
                i = members[place]
                dx, dy = xy1[i, 0] - x[p], xy1[i, 1] - y[p]
                if dx * dx + dy * dy <= reach1[i] * reach1[i]:
                    out[p] = True
                    break
            if out[p]:
                break
    return out
