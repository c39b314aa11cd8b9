"""One moment of the particle filter, compiled: each particle moves, decides what it sees, and learns from it.

Import through `mapfuse.datasets.compiled.kernels` only. What the arrays are: `particles`.
"""

from __future__ import annotations

import numpy as np

from ..compiled import kernel

NOTHING, NEW = -1, -2
#: What keeps the covariance of a pose from being singular [m^2, rad^2].
_LEAST = 1e-10


@kernel
def take(
    motion, by, Q, z, R, type_, uniform, normal,
    pose, systematic, weights, mean, P, key, types, hits, misses, next_key,
    gate, new_nats, false_nats, near, again, temper, miss, floor, plain, sure, most_misses, misses_per_hit,
):  # fmt: skip
    """Take in D detections of one moment; the number (N, D) of each one's landmark in each particle, -1 for none.

    ``motion`` (3,), ``by`` (3, 3), ``Q`` (3, 3): the way since the moment before, its derivatives by the systematic
    errors, its noise. ``z`` (D, 2), ``R`` (D, 2, 2), ``type_`` (D,): what was seen, in the robot's frame. ``uniform``
    (N, D), ``normal`` (N, 3): random numbers. From ``pose`` on: the particles, changed in place; each has room for D
    more landmarks. ``plain``: nearest and farthest distance and angle to either side that are plain sight.
    """
    out = np.full(uniform.shape, NOTHING, np.int64)
    used = np.zeros(key.shape[1], np.bool_)
    slot = np.empty(len(z), np.int64)
    m, C, t, nats = np.empty(3), np.empty((3, 3)), np.empty((2, 3)), np.empty(key.shape[1] + 2)
    for n in range(len(pose)):
        _move(pose[n], systematic[n], motion, by, Q, m, C)
        used[:] = False
        for d in range(len(z)):
            slot[d], likelihood = _decide(
                z[d], R[d], type_[d], uniform[n, d], m, C, t, nats, mean[n], P[n], key[n], types[n], used,
                gate, new_nats, false_nats, near, again,
            )  # fmt: skip
            weights[n] += temper * likelihood
        _drawn(m, C, normal[n], pose[n])
        weights[n] -= miss * _missed(pose[n], mean[n], key[n], hits[n], misses[n], used, plain, sure)
        for d in range(len(z)):
            if slot[d] == NOTHING:
                continue
            k = slot[d]
            if k == NEW:
                k = 0
                while key[n, k] >= 0:
                    k += 1
                key[n, k], types[n, k] = next_key[n], type_[d]
                hits[n, k], misses[n, k] = 0, 0
                next_key[n] += 1
                _learn(pose[n], z[d], R[d], floor, mean[n, k], P[n, k], True)
            else:
                _learn(pose[n], z[d], R[d], floor, mean[n, k], P[n, k], False)
            hits[n, k] += 1
            out[n, d] = key[n, k]
        for k in range(key.shape[1]):
            if key[n, k] >= 0 and misses[n, k] > most_misses + misses_per_hit * hits[n, k]:
                key[n, k] = -1
    return out


@kernel
def _move(pose, systematic, motion, by, Q, m, C):
    """The predicted pose ``m`` and its covariance ``C``."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for i in range(3):
        m[i] = motion[i] + by[i, 0] * systematic[0] + by[i, 1] * systematic[1] + by[i, 2] * systematic[2]
    m[0], m[1], m[2] = pose[0] + c * m[0] - s * m[1], pose[1] + s * m[0] + c * m[1], pose[2] + m[2]
    C[0, 0] = c * c * Q[0, 0] - 2 * c * s * Q[0, 1] + s * s * Q[1, 1]
    C[0, 1] = c * s * (Q[0, 0] - Q[1, 1]) + (c * c - s * s) * Q[0, 1]
    C[1, 1] = s * s * Q[0, 0] + 2 * c * s * Q[0, 1] + c * c * Q[1, 1]
    C[0, 2], C[1, 2], C[2, 2] = c * Q[0, 2] - s * Q[1, 2], s * Q[0, 2] + c * Q[1, 2], Q[2, 2]
    C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]


@kernel
def _decide(z, R, type_, uniform, m, C, t, nats, mean, P, key, types, used, gate, new_nats, false_nats, near, again):
    """Draw what a detection is: a landmark's place, or `NOTHING`, or `NEW`; and its log-likelihood.

    Pose ``m`` and covariance ``C`` are corrected by one that is taken for a known landmark.
    """
    room = len(key)
    nats[:] = -np.inf
    is_near = False
    c, s = np.cos(m[2]), np.sin(m[2])
    x, y = m[0] + c * z[0] - s * z[1], m[1] + s * z[0] + c * z[1]
    of_all = 2 * (C[0, 0] + C[1, 1]) + R[0, 0] + R[1, 1]
    for k in range(room):
        if key[k] < 0 or types[k] != type_:
            continue
        # an innovation has no variance beyond this: twice that of place and of turn by the lever, and the others'
        lever = (mean[k, 0] - m[0]) ** 2 + (mean[k, 1] - m[1]) ** 2
        most = of_all + 2 * C[2, 2] * lever + P[k, 0, 0] + P[k, 1, 1]
        if (mean[k, 0] - x) ** 2 + (mean[k, 1] - y) ** 2 > max(gate * most, near * near):
            continue
        r0, r1, a, b, d = _innovation(z, R, m, c, s, C, mean[k], P[k], t)
        if np.hypot(r0, r1) < near:
            is_near = True
        determinant = a * d - b * b
        squared = (d * r0 * r0 - 2 * b * r0 * r1 + a * r1 * r1) / determinant
        if squared < gate:
            is_near = True
            nats[k] = -squared / 2 - np.log(2 * np.pi) - 0.5 * np.log(determinant) - (again if used[k] else 0.0)
    if not is_near:
        nats[room] = new_nats
    nats[room + 1] = false_nats
    top = nats.max()
    total = 0.0
    for k in range(room + 2):
        nats[k] = np.exp(nats[k] - top)
        total += nats[k]
    pick, below = 0, nats[0]
    while below < uniform * total and pick < room + 1:
        pick += 1
        below += nats[pick]
    if pick < room:
        used[pick] = True
        _correct(z, R, m, c, s, C, mean[pick], P[pick], t)
    return (pick if pick < room else (NEW if pick == room else NOTHING)), top + np.log(total)


@kernel
def _innovation(z, R, m, c, s, C, mean, P, t):
    """Residual (r0, r1) of a detection of the landmark at ``mean``, and its covariance [[a, b], [b, d]].

    ``c``, ``s``: cosine and sine of the heading. ``t`` (2, 3): how the pose goes together with the two residuals, set
    here.
    """
    dx, dy = mean[0] - m[0], mean[1] - m[1]
    u, v = c * dx + s * dy, c * dy - s * dx
    for i in range(3):
        t[0, i] = -c * C[i, 0] - s * C[i, 1] + v * C[i, 2]
        t[1, i] = s * C[i, 0] - c * C[i, 1] - u * C[i, 2]
    P00, P01, P11 = P[0, 0], P[0, 1], P[1, 1]
    a = -c * t[0, 0] - s * t[0, 1] + v * t[0, 2] + c * c * P00 + 2 * c * s * P01 + s * s * P11 + R[0, 0]
    b = s * t[0, 0] - c * t[0, 1] - u * t[0, 2] + c * s * (P11 - P00) + (c * c - s * s) * P01 + R[0, 1]
    d = s * t[1, 0] - c * t[1, 1] - u * t[1, 2] + s * s * P00 - 2 * c * s * P01 + c * c * P11 + R[1, 1]
    return z[0] - u, z[1] - v, a, b, d


@kernel
def _correct(z, R, m, c, s, C, mean, P, t):
    """Correct the pose by a detection of the landmark at ``mean``."""
    r0, r1, a, b, d = _innovation(z, R, m, c, s, C, mean, P, t)
    determinant = a * d - b * b
    for i in range(3):
        gain0, gain1 = (d * t[0, i] - b * t[1, i]) / determinant, (a * t[1, i] - b * t[0, i]) / determinant
        m[i] += gain0 * r0 + gain1 * r1
        for j in range(3):
            C[i, j] -= gain0 * t[0, j] + gain1 * t[1, j]


@kernel
def _drawn(m, C, normal, pose):
    """Draw the pose from its normal distribution."""
    # Cholesky's factor by hand: numpy's makes an array each time, which costs more than all else here
    xx = np.sqrt(C[0, 0] + _LEAST)
    yx, tx = C[1, 0] / xx, C[2, 0] / xx
    yy = np.sqrt(max(C[1, 1] - yx * yx, 0.0) + _LEAST)
    ty = (C[2, 1] - tx * yx) / yy
    tt = np.sqrt(max(C[2, 2] - tx * tx - ty * ty, 0.0) + _LEAST)
    pose[0] = m[0] + xx * normal[0]
    pose[1] = m[1] + yx * normal[0] + yy * normal[1]
    pose[2] = m[2] + tx * normal[0] + ty * normal[1] + tt * normal[2]


@kernel
def _missed(pose, mean, key, hits, misses, used, plain, sure):
    """Count the landmarks in plain sight that were not seen; how many of these are sure ones."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    nearest, farthest, aside = plain[0] ** 2, plain[1] ** 2, np.tan(plain[2])
    count = 0
    for k in range(len(key)):
        if key[k] < 0 or used[k]:
            continue
        dx, dy = mean[k, 0] - pose[0], mean[k, 1] - pose[1]
        u, v = c * dx + s * dy, c * dy - s * dx
        if nearest < dx * dx + dy * dy < farthest and abs(v) < aside * u:
            misses[k] += 1
            count += hits[k] > sure
    return count


@kernel
def _learn(pose, z, R, floor, mean, P, is_new):
    """Correct a landmark by a detection from a known pose, or begin it."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[0] + c * z[0] - s * z[1], pose[1] + s * z[0] + c * z[1]
    R00 = c * c * R[0, 0] - 2 * c * s * R[0, 1] + s * s * R[1, 1]
    R01 = c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    R11 = s * s * R[0, 0] + 2 * c * s * R[0, 1] + c * c * R[1, 1]
    if is_new:
        mean[0], mean[1] = x, y
        P[0, 0], P[0, 1], P[1, 0], P[1, 1] = R00, R01, R01, R11
        return
    a, b, d = P[0, 0] + R00, P[0, 1] + R01, P[1, 1] + R11
    determinant = a * d - b * b
    r0, r1 = x - mean[0], y - mean[1]
    g00, g01 = (d * P[0, 0] - b * P[0, 1]) / determinant, (a * P[0, 1] - b * P[0, 0]) / determinant
    g10, g11 = (d * P[0, 1] - b * P[1, 1]) / determinant, (a * P[1, 1] - b * P[0, 1]) / determinant
    mean[0] += g00 * r0 + g01 * r1
    mean[1] += g10 * r0 + g11 * r1
    # readings of one landmark share errors, and it may be several that stand close together
    P00 = P[0, 0] - g00 * P[0, 0] - g01 * P[0, 1] + floor * floor
    P01 = P[0, 1] - g00 * P[0, 1] - g01 * P[1, 1]
    P11 = P[1, 1] - g10 * P[0, 1] - g11 * P[1, 1] + floor * floor
    P[0, 0], P[0, 1], P[1, 0], P[1, 1] = P00, P01, P01, P11
