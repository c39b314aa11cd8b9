"""The loops of growing a hypothesis, compiled: two maps as one Gaussian, and which of their landmarks are the same.

Import through `mapfuse.datasets.compiled.kernels` only. The formulas are those of docs/evidence.md, "Elastic match";
a side of a comparison is a `Side`. Everything is in one file, since numba's cache looks at no other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.compiled import inlined, kernel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.intp]

TWO_PI = 2 * np.pi
ARM = np.pi / 6  # `mapfuse.datasets.arms.ARM_TOLERANCE`
SAME_PLACE, SAME_HEADING = 0.05, 0.01  # `mapfuse.factors.correspondence`
NO_HEADING_SIGMA = 10.0
ARMS = 4
# Pairs that are predicted at once, so that what is worked out for them stays small.
BATCH = 512


class Side(NamedTuple):
    """n landmarks of one map, as `mapfuse.fusion.prepared.PreparedMap` has them; ``half_variance`` [rad^2]: of one
    arm's own error, ``within``: the share of it that ``covariance`` holds, ``bare``: without arms."""

    xy: Array
    heading: Array
    covariance: Array
    arm: Array
    passable: Flags
    travelled: Flags
    bare: Flags
    within: Array
    half_variance: float
    density: Array


class Limits(NamedTuple):
    """What a match must pass: ``odds`` [nats], ``gate2``, ``gate3`` (chi-square without, with heading), the cost of a
    contradiction [nats], rounds, and the standard deviations (3,) of T12's prior."""

    odds: float
    gate2: float
    gate3: float
    contradiction: float
    rounds: int
    prior_sigma: Array


@inlined
def wrap(angle):
    """An angle in (-pi, pi] [rad]; no division for one that is off by less than two turns, as most are."""
    if angle > np.pi:
        angle -= TWO_PI
    elif angle <= -np.pi:
        angle += TWO_PI
    if -np.pi < angle <= np.pi:
        return angle
    return -((np.pi - angle) % TWO_PI - np.pi)


@inlined
def overlay(A, i, B, j, rotation):
    """Arms of landmark i of map 1 and j of map 2 laid on each other: how many meet one of the same passability, how
    many one of the other, the mean heading difference (NaN: none) and its variance beyond the maps' covariance."""
    met = same = standing = 0
    total = total_standing = 0.0
    for a in range(ARMS):
        for b in range(ARMS):
            off = wrap(A.arm[i, a] - B.arm[j, b] - rotation)
            if abs(off) < ARM:  # NaN compares false
                met += 1
                same += A.passable[i, a] == B.passable[j, b]
                total += off
                # as in factors.correspondence: a travelled arm's error is in its link, and counts where no other is
                if not A.travelled[i, a] and not B.travelled[j, b]:
                    standing += 1
                    total_standing += off
    used = standing if standing else met
    plain = wrap(A.heading[i] - B.heading[j] - rotation)
    if A.bare[i] and B.bare[j] and not np.isnan(plain):
        return same, met - same, plain, SAME_HEADING**2
    if not met:
        return same, met - same, np.nan, NO_HEADING_SIGMA**2
    own = A.half_variance * max(1 / used - A.within[i], 0.0) + B.half_variance * max(1 / used - B.within[j], 0.0)
    if not standing:
        return same, met - same, total / met, SAME_HEADING**2 + 2 * own
    return same, met - same, total_standing / standing, SAME_HEADING**2 + own


@kernel
def overlays(A, i, B, j, rotation):
    """`overlay` of many pairs: (k,) each."""
    k = len(i)
    same, other = np.empty(k, np.intp), np.empty(k, np.intp)
    shift, variance = np.empty(k), np.empty(k)
    for n in range(k):
        same[n], other[n], shift[n], variance[n] = overlay(A, i[n], B, j[n], rotation)
    return same, other, shift, variance


@inlined
def lever(xy, j, c, s):
    """The two entries of the Jacobian of ``T p2`` by T that aren't 0 or 1, of landmark j of map 2 turned by an angle
    of cosine c and sine s."""
    x, y = xy[j, 0], xy[j, 1]
    return -s * x - c * y, c * x - s * y


@kernel
def levers(B, T0, j):
    """`lever` of many landmarks of map 2, (k,) each."""
    c, s = np.cos(T0[2]), np.sin(T0[2])
    x, y = np.empty(len(j)), np.empty(len(j))
    for n in range(len(j)):
        x[n], y[n] = lever(B.xy, j[n], c, s)
    return x, y


@inlined
def shared_block(A, i, k, B, j, m, c, s, prior_sigma, out):
    """Covariance (3, 3) of the residuals of the pairs (i, j) and (k, m), their own noise left out, into ``out``:
    ``P1[i, k] + R P2[j, m] R' + J_j S J_m'``, R being of cosine c and sine s."""
    P = B.covariance
    a, b = 3 * j, 3 * m
    for n in range(3):  # rows turned
        x, y = P[a, b + n], P[a + 1, b + n]
        out[0, n], out[1, n], out[2, n] = c * x - s * y, s * x + c * y, P[a + 2, b + n]
    for n in range(3):
        x, y = out[n, 0], out[n, 1]
        out[n, 0], out[n, 1] = c * x - s * y, s * x + c * y
    for a in range(3):
        for b in range(3):
            out[a, b] += A.covariance[3 * i + a, 3 * k + b]
    x1, y1 = lever(B.xy, j, c, s)
    x2, y2 = lever(B.xy, m, c, s)
    xx, yy, tt = prior_sigma[0] ** 2, prior_sigma[1] ** 2, prior_sigma[2] ** 2
    out[0, 0] += xx + x1 * x2 * tt
    out[0, 1] += x1 * y2 * tt
    out[1, 0] += y1 * x2 * tt
    out[1, 1] += yy + y1 * y2 * tt
    out[0, 2] += x1 * tt
    out[2, 0] += x2 * tt
    out[1, 2] += y1 * tt
    out[2, 1] += y2 * tt
    out[2, 2] += tt


@kernel
def residuals(A, B, T0, i, j, shift):
    """``p1 - T0 p2`` and the heading difference (0 where there is none) of each pair, (3k,)."""
    c, s = np.cos(T0[2]), np.sin(T0[2])
    r = np.empty(3 * len(i))
    for n in range(len(i)):
        x, y = B.xy[j[n], 0], B.xy[j[n], 1]
        r[3 * n] = A.xy[i[n], 0] - (T0[0] + c * x - s * y)
        r[3 * n + 1] = A.xy[i[n], 1] - (T0[1] + s * x + c * y)
        r[3 * n + 2] = 0.0 if np.isnan(shift[n]) else shift[n]
    return r


@kernel
def covariance(A, B, T0, i, j, variance, prior_sigma):
    """Of the residuals of all pairs, T12's prior included (3k, 3k)."""
    k = len(i)
    c, s = np.cos(T0[2]), np.sin(T0[2])
    C = np.empty((3 * k, 3 * k))
    block = np.empty((3, 3))
    for n in range(k):
        for m in range(n + 1):
            shared_block(A, i[n], i[m], B, j[n], j[m], c, s, prior_sigma, block)
            for a in range(3):
                for b in range(3):
                    C[3 * n + a, 3 * m + b] = block[a, b]
                    C[3 * m + b, 3 * n + a] = block[a, b]
        for a in range(2):
            C[3 * n + a, 3 * n + a] += SAME_PLACE**2
        C[3 * n + 2, 3 * n + 2] += variance[n]
    return C


@kernel
def inverse_of_factor(L):
    """Inverse of a lower triangular matrix."""
    n = len(L)
    X = np.zeros((n, n))
    for row in range(n):
        inverse = 1 / L[row, row]
        for k in range(row):
            factor = L[row, k] * inverse
            if factor != 0.0:
                for column in range(k + 1):
                    X[row, column] -= factor * X[k, column]
        X[row, row] = inverse
    return X


@kernel
def joined(A, B, T0, i, j, prior_sigma):
    """Two maps joined at pairs: residuals r (3k,), inverse L^-1 of their covariance's Cholesky factor (3k, 3k),
    weights C^-1 r (3k,) and T12's posterior mean (3,)."""
    _, _, shift, variance = overlays(A, i, B, j, T0[2])
    C = covariance(A, B, T0, i, j, variance, prior_sigma)
    return solved(B, T0, j, residuals(A, B, T0, i, j, shift), C, prior_sigma)


@kernel
def solved(B, T0, j, r, C, prior_sigma):
    """`joined`, given the residuals r (3k,) and their covariance C (3k, 3k)."""
    inverse = inverse_of_factor(np.linalg.cholesky(C))
    weights = inverse.T @ (inverse @ r)
    step = np.zeros(3)
    c, s = np.cos(T0[2]), np.sin(T0[2])
    for n in range(len(j)):
        x, y = lever(B.xy, j[n], c, s)
        step[0] += weights[3 * n]
        step[1] += weights[3 * n + 1]
        step[2] += x * weights[3 * n] + y * weights[3 * n + 1] + weights[3 * n + 2]
    T12 = T0 + prior_sigma**2 * step
    T12[2] = wrap(T12[2])
    return r, inverse, weights, T12


@kernel
def bent(A, B, T0, T12, i, j, weights):
    """Where the landmarks of both maps then are in frame 1, (n1, 2) and (n2, 2): each map bent onto the other."""
    p1, p2 = A.xy.copy(), np.empty_like(B.xy)
    for row in range(len(p1)):
        for n in range(len(i)):
            for b in range(3):
                w = weights[3 * n + b]
                p1[row, 0] -= A.covariance[3 * row, 3 * i[n] + b] * w
                p1[row, 1] -= A.covariance[3 * row + 1, 3 * i[n] + b] * w
    c, s = np.cos(T0[2]), np.sin(T0[2])
    local = np.empty(3)
    q = B.xy.copy()
    for n in range(len(i)):  # the error of map 2 enters the residual turned and with the other sign
        local[0] = c * weights[3 * n] + s * weights[3 * n + 1]
        local[1] = -s * weights[3 * n] + c * weights[3 * n + 1]
        local[2] = weights[3 * n + 2]
        for row in range(len(q)):
            for b in range(3):
                q[row, 0] += B.covariance[3 * row, 3 * j[n] + b] * local[b]
                q[row, 1] += B.covariance[3 * row + 1, 3 * j[n] + b] * local[b]
    c, s = np.cos(T12[2]), np.sin(T12[2])
    p2[:, 0] = T12[0] + c * q[:, 0] - s * q[:, 1]
    p2[:, 1] = T12[1] + s * q[:, 0] + c * q[:, 1]
    return p1, p2


@kernel
def at_rest(A, B, T0, i, j, prior_sigma):
    """What is asked of two maps joined at pairs: their arms laid on each other (`overlays`), covariance and residuals,
    T12's posterior mean and covariance, and where the landmarks of both maps then are (`bent`)."""
    same, other, shift, variance = overlays(A, i, B, j, T0[2])
    C = covariance(A, B, T0, i, j, variance, prior_sigma)
    r, inverse, weights, T12 = solved(B, T0, j, residuals(A, B, T0, i, j, shift), C, prior_sigma)
    p1, p2 = bent(A, B, T0, T12, i, j, weights)
    known = T12_covariance(B, T0, j, inverse, prior_sigma)
    return same, other, shift, variance, C, r, T12, known, p1, p2


@kernel
def T12_covariance(B, T0, j, inverse, prior_sigma):
    """Posterior covariance (3, 3) of T12: ``S - S J' C^-1 J S`` with its prior S and the pairs' Jacobians J."""
    c, s = np.cos(T0[2]), np.sin(T0[2])
    J = np.zeros((3 * len(j), 3))
    for n in range(len(j)):
        x, y = lever(B.xy, j[n], c, s)
        for a in range(3):
            J[3 * n + a, a] = prior_sigma[a] ** 2
        J[3 * n, 2], J[3 * n + 1, 2] = x * prior_sigma[2] ** 2, y * prior_sigma[2] ** 2
    X = inverse @ J
    return np.diag(prior_sigma**2) - X.T @ X


@kernel
def predicted(A, B, T0, i, j, inverse, weights, at_i, at_j, prior_sigma):
    """Innovation (m, 3) and covariance (m, 3, 3) of further pairs (at_i, at_j), given the pairs (i, j)."""
    _, _, shift, variance = overlays(A, at_i, B, at_j, T0[2])
    return foretold(A, B, T0, i, j, inverse, weights, at_i, at_j, shift, variance, prior_sigma)


@kernel
def foretold(A, B, T0, i, j, inverse, weights, at_i, at_j, shift, variance, prior_sigma):
    """`predicted`, given the shift and variance (m,) of the further pairs' `overlays`."""
    m, k = len(at_i), len(i)
    innovation = residuals(A, B, T0, at_i, at_j, shift).reshape(m, 3)
    V = np.empty((m, 3, 3))
    block = np.empty((3, 3))
    c, s = np.cos(T0[2]), np.sin(T0[2])
    for begin in range(0, m, BATCH):
        end = min(begin + BATCH, m)
        cross = np.empty((3 * (end - begin), 3 * k))
        for n in range(begin, end):
            for l in range(k):
                shared_block(A, at_i[n], i[l], B, at_j[n], j[l], c, s, prior_sigma, block)
                for a in range(3):
                    for b in range(3):
                        cross[3 * (n - begin) + a, 3 * l + b] = block[a, b]
        explained = cross @ weights
        X = cross @ inverse.T
        for n in range(begin, end):
            shared_block(A, at_i[n], at_i[n], B, at_j[n], at_j[n], c, s, prior_sigma, block)
            first = 3 * (n - begin)
            for a in range(3):
                innovation[n, a] -= explained[first + a]
                for b in range(a + 1):
                    value = block[a, b]
                    for l in range(3 * k):
                        value -= X[first + a, l] * X[first + b, l]
                    V[n, a, b] = V[n, b, a] = value
            V[n, 0, 0] += SAME_PLACE**2
            V[n, 1, 1] += SAME_PLACE**2
            V[n, 2, 2] += variance[n]
    return innovation, V


@kernel
def inverse3(M):
    """Inverse of a symmetric (3, 3)."""
    a, b, c, d, e, f = M[0, 0], M[0, 1], M[0, 2], M[1, 1], M[1, 2], M[2, 2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return out / (a * out[0, 0] + b * out[0, 1] + c * out[0, 2])


@kernel
def left_out(inverse, weights):
    """Innovation (k, 3) and covariance (k, 3, 3) of each pair given all the others."""
    k = len(weights) // 3
    innovation, V = np.empty((k, 3)), np.empty((k, 3, 3))
    Q = np.empty((3, 3))
    for n in range(k):
        columns = inverse[3 * n :, 3 * n : 3 * n + 3]
        for a in range(3):
            for b in range(a + 1):
                value = 0.0
                for row in range(len(columns)):
                    value += columns[row, a] * columns[row, b]
                Q[a, b] = Q[b, a] = value
        V[n] = inverse3(Q)
        for a in range(3):
            innovation[n, a] = 0.0
            for b in range(3):
                innovation[n, a] += V[n, a, b] * weights[3 * n + b]
    return innovation, V


@kernel
def densities(innovation, V):
    """Log normal density of each position [nats per m^2] and the squared Mahalanobis distance of the whole, (k,)."""
    k = len(innovation)
    density, d2 = np.empty(k), np.empty(k)
    for n in range(k):
        x, y, t = innovation[n, 0], innovation[n, 1], innovation[n, 2]
        a, b, c = V[n, 0, 0], V[n, 0, 1], V[n, 0, 2]
        d, e, f = V[n, 1, 1], V[n, 1, 2], V[n, 2, 2]
        determinant = a * d - b * b
        near = (x * x * d - 2 * x * y * b + y * y * a) / determinant
        density[n] = -0.5 * near - 0.5 * np.log(determinant) - np.log(TWO_PI)
        # the adjugate of V, whose first row also makes its determinant
        xx, xy, xt = d * f - e * e, c * e - b * f, b * e - c * d
        whole = x * x * xx + y * y * (a * f - c * c) + t * t * determinant
        whole += 2 * (x * y * xy + x * t * xt + y * t * (b * c - a * e))
        d2[n] = whole / (a * xx + b * xy + c * xt)
    return density, d2


@kernel
def assigned(gain):
    """Best one-to-one choice of a table of gains (rows, columns), none negative: the column of each row, or -1.

    The Hungarian method with potentials (Kuhn 1955; Jonker and Volgenant 1987), shortest augmenting paths by row.
    """
    if gain.shape[0] > gain.shape[1]:
        row_of = assigned_wide(gain.T)
        column_of = np.full(gain.shape[0], -1, np.intp)
        for column in range(gain.shape[1]):
            column_of[row_of[column]] = column
        return column_of
    return assigned_wide(gain)


@kernel
def assigned_wide(gain):
    """`assigned`, where there are at least as many columns as rows."""
    rows, columns = gain.shape
    u, v = np.zeros(rows + 1), np.zeros(columns + 1)
    matched, way = np.zeros(columns + 1, np.intp), np.zeros(columns + 1, np.intp)
    for row in range(1, rows + 1):
        matched[0] = row
        column = 0
        shortest = np.full(columns + 1, np.inf)
        used = np.zeros(columns + 1, np.bool_)
        while True:
            used[column] = True
            delta, nearest = np.inf, 0
            for other in range(1, columns + 1):
                if not used[other]:
                    cost = -gain[matched[column] - 1, other - 1] - u[matched[column]] - v[other]
                    if cost < shortest[other]:
                        shortest[other], way[other] = cost, column
                    if shortest[other] < delta:
                        delta, nearest = shortest[other], other
            for other in range(columns + 1):
                if used[other]:
                    u[matched[other]] += delta
                    v[other] -= delta
                else:
                    shortest[other] -= delta
            column = nearest
            if matched[column] == 0:
                break
        while column:
            matched[column] = matched[way[column]]
            column = way[column]
    column_of = np.full(rows, -1, np.intp)
    for other in range(1, columns + 1):
        if matched[other]:
            column_of[matched[other] - 1] = other - 1
    return column_of


@kernel
def one_to_one(i, j, gain, n1, n2):
    """Which of the pairs are the one-to-one choice with the greatest total gain (all gains positive)."""
    of_i, of_j = np.zeros(n1, np.intp), np.zeros(n2, np.intp)
    for n in range(len(i)):
        of_i[i[n]] += 1
        of_j[j[n]] += 1
    chosen = np.zeros(len(i), np.bool_)
    row, column = np.full(n1, -1, np.intp), np.full(n2, -1, np.intp)
    rows = columns = 0
    for n in range(len(i)):
        if of_i[i[n]] == 1 and of_j[j[n]] == 1:
            chosen[n] = True
            continue
        if row[i[n]] < 0:
            row[i[n]], rows = rows, rows + 1
        if column[j[n]] < 0:
            column[j[n]], columns = columns, columns + 1
    if rows:
        table, place = np.zeros((rows, columns)), np.full((rows, columns), -1, np.intp)
        for n in range(len(i)):
            if not chosen[n]:
                table[row[i[n]], column[j[n]]] = gain[n]
                place[row[i[n]], column[j[n]]] = n
        column_of = assigned(table)
        for a in range(rows):
            if column_of[a] >= 0 and place[a, column_of[a]] >= 0:
                chosen[place[a, column_of[a]]] = True
    return chosen


@kernel
def sorted_pairs(partner):
    """Partners of map 1's landmarks (n1,), -1 without, as pairs i, j in order."""
    i = np.flatnonzero(partner >= 0)
    return i, partner[i]


@kernel
def near_pairs(p1, p2, may, partner, reach):
    """Pairs that may be the same, aren't matched with each other, and lie within ``reach`` [m]."""
    near = np.empty((len(p1), len(p2)), np.bool_)
    count = 0
    for a in range(len(p1)):
        x1, y1 = p1[a, 0], p1[a, 1]
        for b in range(len(p2)):
            x, y = x1 - p2[b, 0], y1 - p2[b, 1]
            near[a, b] = (x * x + y * y < reach * reach) & may[a, b] & (partner[a] != b)
            count += near[a, b]
    i, j = np.empty(count, np.intp), np.empty(count, np.intp)
    count = 0
    for a in range(len(p1)):
        for b in range(len(p2)):
            if near[a, b]:
                i[count], j[count] = a, b
                count += 1
    return i, j


@kernel
def associated(A, B, T0, partner, may, reach, limits):
    """The best one-to-one matches (partners of map 1's landmarks) under what is joined so far; pairs already matched
    are judged by the others, the first two are kept."""
    old_i, old_j = sorted_pairs(partner)
    _, inverse, weights, T12 = joined(A, B, T0, old_i, old_j, limits.prior_sigma)
    p1, p2 = bent(A, B, T0, T12, old_i, old_j, weights)
    i, j = near_pairs(p1, p2, may, partner, reach)
    _, other, shift, variance = overlays(A, i, B, j, T0[2])
    innovation, V = foretold(A, B, T0, old_i, old_j, inverse, weights, i, j, shift, variance, limits.prior_sigma)
    judged = len(old_i) > 2
    if judged:
        own_innovation, own_V = left_out(inverse, weights)
        _, own_other, _, own_variance = overlays(A, old_i, B, old_j, T0[2])
        i, j = np.concatenate((old_i, i)), np.concatenate((old_j, j))
        innovation, V = np.concatenate((own_innovation, innovation)), np.concatenate((own_V, V))
        other, variance = np.concatenate((own_other, other)), np.concatenate((own_variance, variance))
    density, d2 = densities(innovation, V)
    gain = np.empty(len(i))
    passes = np.zeros(len(i), np.bool_)
    taken = np.zeros(len(p2), np.bool_)
    taken[old_j] = True
    for n in range(len(i)):
        clutter = np.log(max(A.density[i[n]], B.density[j[n]]))
        gain[n] = density[n] - clutter - limits.contradiction * other[n] - limits.odds
        gate = limits.gate3 if variance[n] < NO_HEADING_SIGMA**2 else limits.gate2
        free = judged or (partner[i[n]] < 0 and not taken[j[n]])
        passes[n] = gain[n] > 0 and d2[n] < gate and free
    kept = np.flatnonzero(passes)
    chosen = kept[one_to_one(i[kept], j[kept], gain[kept], len(p1), len(p2))]
    found = np.full(len(p1), -1, np.intp) if judged else partner.copy()
    for n in chosen:
        found[i[n]] = j[n]
    return found


@kernel
def pruned(A, B, T0, partner, known, limits):
    """Drop, one by one, the pair that fits the others worst, until all pass the gate; ``known`` (n1,) ones stay.

    The partners left, and T12 (3,) of the two maps joined at them.
    """
    partner = partner.copy()
    while True:
        i, j = sorted_pairs(partner)
        if len(i) <= 2:
            return partner, optimum(A, B, T0, partner, limits)
        _, inverse, weights, T12 = joined(A, B, T0, i, j, limits.prior_sigma)
        _, d2 = densities(*left_out(inverse, weights))
        for n in range(len(i)):
            if known[i[n]] == j[n]:
                d2[n] = 0.0
        worst = int(np.argmax(d2))
        if d2[worst] < limits.gate3:
            return partner, T12
        partner[i[worst]] = -1


@kernel
def optimum(A, B, T0, partner, limits):
    """T12 (3,) of the two maps joined at the pairs."""
    i, j = sorted_pairs(partner)
    return joined(A, B, T0, i, j, limits.prior_sigma)[3]


@kernel
def grown(A, B, T0, partner, may, known, limits):
    """From seed pairs at ``T0`` to all that are the same: places i of map 1's landmarks and j of map 2's; T12 (3,) at
    which they are linearised; rounds; and all that is asked of them (`at_rest`). ``known`` (n1,): partners that stay,
    or -1."""
    partner, T0, rounds = stood_still(A, B, T0, partner, may, known, limits)
    i, j = sorted_pairs(partner)
    return i, j, T0, rounds, at_rest(A, B, T0, i, j, limits.prior_sigma)


@kernel
def stood_still(A, B, T0, partner, may, known, limits):
    """The partners of map 1's landmarks (n1,), T12 and the rounds of `grown`."""
    T0 = optimum(A, B, T0, partner, limits)
    seen = np.empty((limits.rounds, len(partner)), np.intp)
    rounds = 0
    while rounds < limits.rounds:
        rounds += 1
        found = associated(A, B, T0, partner, may, 5.0 + 2.0 * rounds, limits)
        for a in range(len(found)):
            if known[a] >= 0:
                found[a] = known[a]
        if (found >= 0).sum() < 2:
            break
        T0 = optimum(A, B, T0, found, limits)
        partner, T0 = pruned(A, B, T0, found, known, limits)
        for before in range(rounds - 1):
            if (seen[before] == partner).all():
                return partner, T0, rounds
        seen[rounds - 1] = partner
    return partner, T0, rounds


class Proposals(NamedTuple):
    """h hypotheses to grow: ``T12s`` (h, 3), and with how many matches each was proposed (h,). ``seeds``, ``matches``
    (h, n1): partners of map 1's landmarks to begin with, and of all that were proposed; -1 without."""

    T12s: Array
    expected: Index
    seeds: Index
    matches: Index


@kernel
def grown_all(A, B, P, may, enough, turn, limits):
    """All distinct P (`Proposals`) `grown` from their seeds; and where that comes to fewer matches than were proposed,
    which are ``enough``, from all of these, too.

    One whose seed an earlier one explains, not turned by ``turn`` [rad] against it, is the same answer. Of g that were
    grown: T12s (g, 3) at which they are linearised, rounds (g,), the partners of map 1's landmarks (g, n1).
    """
    n1 = len(may)
    T0s, rounds = np.empty((2 * len(P.expected), 3)), np.empty(2 * len(P.expected), np.intp)
    partners, seeds = np.empty((len(rounds), n1), np.intp), np.empty((len(rounds), n1), np.intp)
    turns = np.empty(len(rounds))
    free = np.full(n1, -1, np.intp)
    g = 0
    for h in range(len(P.expected)):
        known = False
        for e in range(g):
            if not known and abs(wrap(P.T12s[h, 2] - turns[e])) < turn:
                known = explains(partners[e], seeds[e], P.seeds[h])
        if known:
            continue
        for start in (P.seeds[h], P.matches[h]):
            partners[g], T0s[g], rounds[g] = stood_still(A, B, P.T12s[h], start, may, free, limits)
            turns[g], seeds[g] = optimum(A, B, T0s[g], partners[g], limits)[2], P.seeds[h]
            g += 1
            if P.expected[h] < enough or (partners[g - 1] >= 0).sum() >= P.expected[h]:
                break
    return T0s[:g].copy(), rounds[:g].copy(), partners[:g].copy()


@kernel
def explains(partner, seed, other):
    """Whether all the pairs of ``other`` are among those of ``partner`` and ``seed``; partners of landmarks (n1,)."""
    return ((other < 0) | (partner == other) | (seed == other)).all()


@kernel
def all_at_rest(A, B, T0s, partners, prior_sigma):
    """`at_rest` of g hypotheses with these partners of map 1's landmarks (g, n1), linearised at T0s (g, 3).

    The matches of hypothesis h are those from ``begin[h]`` to ``begin[h + 1]`` of i and j, whose numbers stand one
    hypothesis after the other, as do those of the covariances.
    """
    g, count = len(T0s), (partners >= 0).sum(axis=1)
    begin, ends = np.zeros(g + 1, np.intp), np.zeros(g + 1, np.intp)
    begin[1:], ends[1:] = np.cumsum(count), np.cumsum(9 * count * count)
    i, j = np.empty(begin[-1], np.intp), np.empty(begin[-1], np.intp)
    same, other = np.empty(begin[-1], np.intp), np.empty(begin[-1], np.intp)
    shift, variance = np.empty(begin[-1]), np.empty(begin[-1])
    C, r = np.empty(ends[-1]), np.empty(3 * begin[-1])
    T12s, known = np.empty((g, 3)), np.empty((g, 3, 3))
    p1, p2 = np.empty((g, len(A.xy), 2)), np.empty((g, len(B.xy), 2))
    for h in range(g):
        a, b = begin[h], begin[h + 1]
        i[a:b], j[a:b] = sorted_pairs(partners[h])
        same[a:b], other[a:b], shift[a:b], variance[a:b], own_C, r[3 * a : 3 * b], T12s[h], known[h], p1[h], p2[h] = (
            at_rest(A, B, T0s[h], i[a:b], j[a:b], prior_sigma)
        )
        C[ends[h] : ends[h + 1]] = own_C.ravel()
    return begin, i, j, same, other, shift, variance, C, r, T12s, known, p1, p2
