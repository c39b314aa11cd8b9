"""The loop of laying groups of maps on each other, compiled: which candidates agree with what one proposes.

Import through `mapfuse.datasets.compiled.kernels` only. Poses and covariances as in `mapfuse.datasets.se2`, whose
formulas these are.
"""

from __future__ import annotations

import numpy as np

from mapfuse.datasets.compiled import kernel


@kernel
def _wrapped(angle):
    return np.pi - (np.pi - angle) % (2 * np.pi)


@kernel
def _composed(P, Q, out):
    c, s = np.cos(P[2]), np.sin(P[2])
    x, y = P[0] + c * Q[0] - s * Q[1], P[1] + s * Q[0] + c * Q[1]
    out[2] = _wrapped(P[2] + Q[2])
    out[0], out[1] = x, y


@kernel
def _inverted(P, out):
    c, s = np.cos(P[2]), np.sin(P[2])
    x, y = -c * P[0] - s * P[1], s * P[0] - c * P[1]
    out[2] = _wrapped(-P[2])
    out[0], out[1] = x, y


@kernel
def _carried(C, by, out):
    """Add ``J C J'`` to ``out``, where J is the identity but for its last column's first two entries ``by``."""
    u, v = by
    for i in range(3):
        for j in range(3):
            out[i, j] += C[i, j]
    for j in range(3):
        out[0, j] += u * C[2, j]
        out[1, j] += v * C[2, j]
        out[j, 0] += u * C[j, 2]
        out[j, 1] += v * C[j, 2]
    out[0, 0] += u * u * C[2, 2]
    out[0, 1] += u * v * C[2, 2]
    out[1, 0] += u * v * C[2, 2]
    out[1, 1] += v * v * C[2, 2]


@kernel
def _turned(C, angle, out):
    """Add ``R C R'`` to ``out``, R turning x and y by ``angle``."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for l in range(3):
                    total += R[i, k] * C[k, l] * R[j, l]
            out[i, j] += total


@kernel
def _between(X, covariance, i, j, T, C):
    """Pose ``T`` of frame j in frame i and its covariance ``C`` from poses (n, 3) and joint covariance (n, n, 3, 3)."""
    C[:] = 0.0
    if i == j:
        T[:] = 0.0
        return
    back = np.empty(3)
    _inverted(X[i], back)
    _composed(back, X[j], T)
    # errors of both frames as an error of j - i in world axes, j's as seen with i's turn
    dx, dy = X[j, 0] - X[i, 0], X[j, 1] - X[i, 1]
    u, v = dy, -dx  # what a turn of frame i does to j's place, seen from i
    world = np.zeros((3, 3))
    _carried(covariance[i, i], (-u, -v), world)
    for a in range(3):
        for b in range(3):
            world[a, b] += covariance[j, j, a, b]
    # cross terms: -(J C_ij) and its transpose, J as in _carried
    for a in range(3):
        for b in range(3):
            cross = covariance[i, j, a, b]
            if a == 0:
                cross -= u * covariance[i, j, 2, b]
            elif a == 1:
                cross -= v * covariance[i, j, 2, b]
            world[a, b] -= cross
            world[b, a] -= cross
    _turned(world, -X[i, 2], C)


@kernel
def _distance(off, C):
    """Squared Mahalanobis distance of ``off`` (3,)."""
    # by the adjugate: three by three, positive definite
    a, b, c, d, e, f = C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2], C[2, 2]
    A, B, D = d * f - e * e, c * e - b * f, b * e - c * d
    E, F, G = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * A + b * B + c * D
    x, y, z = off
    return (A * x * x + E * y * y + G * z * z + 2 * (B * x * y + D * x * z + F * y * z)) / determinant


@kernel
def agreeing(rows, X_A, C_A, X_B, C_B, a, b, T, C, pair, coarse, gate):
    """Which candidates agree with those that propose (``rows``); (rows, k) bool.

    Candidate k says that frame ``b[k]`` of group B is at ``T[k]`` in frame ``a[k]`` of group A, with covariance
    ``C[k]``. ``X_A``, ``C_A``, ``X_B``, ``C_B``: poses and joint covariances of the groups' frames. ``coarse`` (3,):
    what is farther off is not looked at closely; ``gate``: of the squared Mahalanobis distance. Candidates of one
    ``pair`` don't agree with each other.
    """
    out = np.zeros((len(rows), len(T)), np.bool_)
    T_ca, T_bd, C_ca, C_bd = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    T_cb, T_cd, whole, half = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    off, inverse_m, inverse_b = np.empty(3), np.empty(3), np.empty(3)
    for r in range(len(rows)):
        n = rows[r]
        for m in range(len(T)):
            if pair[m] == pair[n]:
                continue
            _inverted(X_A[a[m]], inverse_m)
            _composed(inverse_m, X_A[a[n]], T_ca)
            _composed(T_ca, T[n], T_cb)
            _inverted(X_B[b[n]], inverse_b)
            _composed(inverse_b, X_B[b[m]], T_bd)
            _composed(T_cb, T_bd, T_cd)
            for k in range(3):
                off[k] = T[m, k] - T_cd[k]
            off[2] = _wrapped(off[2])
            if abs(off[0]) >= coarse[0] or abs(off[1]) >= coarse[1] or abs(off[2]) >= coarse[2]:
                continue
            _between(X_A, C_A, a[m], a[n], T_ca, C_ca)
            _between(X_B, C_B, b[n], b[m], T_bd, C_bd)
            # c to b: what is uncertain of a in c, and of b in a; then of d in b
            half[:] = 0.0
            _carried(C_ca, (T_ca[1] - T_cb[1], T_cb[0] - T_ca[0]), half)
            _turned(C[n], T_ca[2], half)
            whole[:] = C[m]
            _carried(half, (T_cb[1] - T_cd[1], T_cd[0] - T_cb[0]), whole)
            _turned(C_bd, T_cb[2], whole)
            out[r, m] = _distance(off, whole) < gate
    return out


@kernel
def weaker_leg(T_pq, T_pr, T_rq, weight_pr, weight_rq, shift, turn):
    """The weight [nats] of the heaviest cycle by a third group r that closes to within ``shift`` [m] and ``turn``
    [rad], a cycle weighing what its weaker leg does; -inf where none closes."""
    best = -np.inf
    T = np.empty(3)
    for i in range(len(T_pr)):
        for j in range(len(T_rq)):
            _composed(T_pr[i], T_rq[j], T)
            if np.hypot(T[0] - T_pq[0], T[1] - T_pq[1]) < shift and abs(_wrapped(T[2] - T_pq[2])) < turn:
                best = max(best, min(weight_pr[i], weight_rq[j]))
    return best
