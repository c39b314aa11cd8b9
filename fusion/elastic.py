"""Two maps joined at some landmarks as one Gaussian: what the matches so far say about every other pair.

The residual of a pair k = (i, j) is ``r_k = p1_i - T12 p2_j`` with the difference of headings below it. Over pairs
its covariance is ``P1[i, i'] + B P2[j, j'] B' + J S_T J' + [same pair] R`` (docs/evidence.md, "Elastic match"):
the maps bend as their own covariances allow, and two pairs share the errors of both maps. T12 has a wide prior S_T.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from mapfuse.datasets import se2
from mapfuse.datasets.arms import ARM_TOLERANCE
from mapfuse.factors.correspondence import SAME_HEADING, SAME_PLACE

from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Standard deviation [rad] that stands for "no heading to compare".
NO_HEADING_SIGMA = 10.0


@dataclass(frozen=True, eq=False)
class ArmOverlay:
    """Arms of every pair of landmarks laid on each other under one rotation; all arrays are (n1, n2).

    ``coincide``, ``contradict``: how many arms meet one of the same, of the other passability. ``shift`` [rad]: mean
    heading difference of those that meet (NaN where none do). ``variance`` [rad^2]: of the heading difference beyond
    the maps' own covariance: same place, and arms that only one map has; where there is no heading at all, wide.
    """

    coincide: NDArray[np.intp]
    contradict: NDArray[np.intp]
    shift: Array
    variance: Array

    @classmethod
    def at(cls, m1: PreparedMap, m2: PreparedMap, rotation: float) -> ArmOverlay:
        """Overlay under a rotation [rad] of map 2 into map 1."""
        rows = [cls._rows(m1, m2, rotation, rows) for rows in _batches(len(m1))]
        return cls(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))

    @staticmethod
    def _rows(m1: PreparedMap, m2: PreparedMap, rotation: float, rows: slice) -> tuple[Index, Index, Array, Array]:
        off = se2.wrap(m1.arm_headings[rows, None, :, None] - m2.arm_headings[None, :, None, :] - rotation)
        meets = np.abs(off) < ARM_TOLERANCE  # NaN compares false
        same = m1.arm_passable[rows, None, :, None] == m2.arm_passable[None, :, None, :]
        met = meets.sum(axis=(2, 3))
        coincide = (meets & same).sum(axis=(2, 3))
        # as in factors.correspondence: a travelled arm's error is in its link, and counts where there is no other
        standing = meets & ~m1.arm_travelled[rows, None, :, None] & ~m2.arm_travelled[None, :, None, :]
        only_travelled = np.asarray(~standing.any(axis=(2, 3)))
        used = np.where(only_travelled[:, :, None, None], meets, standing)
        n_used = used.sum(axis=(2, 3))
        with np.errstate(invalid="ignore"):
            shift = np.where(used, off, 0).sum(axis=(2, 3)) / n_used
        plain = se2.wrap(m1.headings[rows, None] - m2.headings[None, :] - rotation)
        bare = ~m1.has_arms[rows, None] & ~m2.has_arms[None, :] & ~np.isnan(plain)
        shift = np.where(bare, plain, np.where(met > 0, shift, np.nan))
        own = np.zeros(met.shape)
        for m, within in ((m1, m1.arms_in_covariance[rows, None]), (m2, m2.arms_in_covariance[None, :])):
            own = own + m.map.noise.heading_sigma**2 / 2 * np.maximum(1 / np.maximum(n_used, 1) - within, 0)
        own = np.where(bare, 0.0, np.where(only_travelled, 2 * own, own))
        variance = np.where(np.isnan(shift), NO_HEADING_SIGMA**2, SAME_HEADING**2 + own)
        return coincide, met - coincide, shift, variance


def _batches(rows: int, size: int = 256) -> list[slice]:
    """Slices that cover so many rows, so that what is worked out per batch stays small."""
    return [slice(k, k + size) for k in range(0, max(rows, 1), size)]


def jacobian(T12: Array, points2: Array) -> Array:
    """d(T12 p2, heading)/dT12, (k, 3, 3), for errors added to (x, y, theta) of T12."""
    J = np.zeros((len(points2), 3, 3))
    J[:] = np.eye(3)
    J[:, :2] = se2.transform_jacobians(T12, points2)[0]
    return J


def residuals(m1: PreparedMap, m2: PreparedMap, T12: Array, arms: ArmOverlay, i: Index, j: Index) -> Array:
    """``p1_i - T12 p2_j`` and the heading difference (0 where there is none), (k, 3)."""
    xy = m1.positions[i] - se2.transform(T12, m2.positions[j])
    return np.column_stack([xy, np.nan_to_num(arms.shift[i, j])])


def _own_noise(arms: ArmOverlay, i: Index, j: Index) -> Array:
    """Per-pair noise R (k, 3, 3)."""
    R = np.zeros((len(i), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = SAME_PLACE**2
    R[:, 2, 2] = arms.variance[i, j]
    return R


def _blocks(covariance: Array, rows: Index, columns: Index) -> Array:
    """The 3x3 blocks [rows, columns] as one (3r, 3c) matrix."""
    n = covariance.shape[0] // 3
    picked = covariance.reshape(n, 3, n, 3)[rows][:, :, columns]
    return picked.reshape(3 * len(rows), 3 * len(columns))


def _turn(theta: float) -> Array:
    B = np.eye(3)
    B[:2, :2] = se2.rotation(theta)
    return B


@dataclass(frozen=True, eq=False)
class Joined:
    """Two maps given that the landmarks ``i`` of map 1 are the landmarks ``j`` of map 2, linearised at ``T0``.

    ``prior_sigma`` (3,): of T12 around ``T0`` [m, m, rad].
    """

    m1: PreparedMap
    m2: PreparedMap
    T0: Array
    arms: ArmOverlay
    i: Index
    j: Index
    prior_sigma: Array

    @cached_property
    def J(self) -> Array:
        """Jacobians of the pairs by T12 (3k, 3)."""
        return jacobian(self.T0, self.m2.positions[self.j]).reshape(-1, 3)

    @cached_property
    def r(self) -> Array:
        """Residuals at ``T0`` (3k,)."""
        return residuals(self.m1, self.m2, self.T0, self.arms, self.i, self.j).reshape(-1)

    @cached_property
    def _shared1(self) -> Array:
        """cov(error of every landmark of map 1, residuals) (3 n1, 3k)."""
        return _blocks(self.m1.covariance, np.arange(len(self.m1)), self.i)

    @cached_property
    def _shared2(self) -> Array:
        """cov(error of every landmark of map 2, residuals) (3 n2, 3k)."""
        B = _turn(self.T0[2])
        P = _blocks(self.m2.covariance, np.arange(len(self.m2)), self.j)
        return -(P.reshape(-1, len(self.j), 3) @ B.T).reshape(P.shape)

    @cached_property
    def covariance(self) -> Array:
        """Of the residuals, T12's prior included (3k, 3k)."""
        k = len(self.i)
        own = np.zeros((k, 3, k, 3))
        own[np.arange(k), :, np.arange(k), :] = _own_noise(self.arms, self.i, self.j)
        from1 = self._shared1.reshape(-1, 3, 3 * k)[self.i].reshape(3 * k, 3 * k)
        from2 = -(_turn(self.T0[2]) @ self._shared2.reshape(-1, 3, 3 * k)[self.j]).reshape(3 * k, 3 * k)
        total = from1 + from2 + (self.J * self.prior_sigma**2) @ self.J.T + own.reshape(3 * k, 3 * k)
        return (total + total.T) / 2

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        return cho_factor(self.covariance, lower=True)

    @cached_property
    def weights(self) -> Array:
        """C^-1 r (3k,)."""
        return cho_solve(self._factor, self.r)

    @cached_property
    def T12(self) -> Array:
        """Posterior mean of T12 (3,)."""
        step = self.prior_sigma**2 * (self.J.T @ self.weights)
        return np.array([*(self.T0[:2] + step[:2]), float(se2.wrap(self.T0[2] + step[2]))])

    @cached_property
    def T12_covariance(self) -> Array:
        """Posterior covariance of T12 (3, 3)."""
        S = np.diag(self.prior_sigma**2)
        posterior: Array = S - S @ self.J.T @ cho_solve(self._factor, self.J @ S)
        return (posterior + posterior.T) / 2

    def corrected(self) -> tuple[Array, Array]:
        """Posterior positions of both maps' landmarks in frame 1, (n1, 2) and (n2, 2): each map bent onto the other."""
        e1 = (self._shared1 @ self.weights).reshape(-1, 3)
        e2 = (self._shared2 @ self.weights).reshape(-1, 3)
        p2 = se2.transform(self.T12, self.m2.positions - e2[:, :2])
        return self.m1.positions - e1[:, :2], p2

    def predict(self, i: Index, j: Index) -> tuple[Array, Array]:
        """Innovation (k, 3) and its covariance (k, 3, 3) of further pairs, given the pairs so far."""
        k3 = 3 * len(self.i)
        B, S = _turn(self.T0[2]), np.diag(self.prior_sigma**2)
        J = jacobian(self.T0, self.m2.positions[j])
        # cov(new residual, old residuals)
        cross = self._shared1.reshape(-1, 3, k3)[i] - B @ self._shared2.reshape(-1, 3, k3)[j]
        cross = cross + J @ (S @ self.J.T)
        innovation = residuals(self.m1, self.m2, self.T0, self.arms, i, j) - cross @ self.weights
        L = self._factor[0]
        X = solve_triangular(L, cross.reshape(-1, k3).T, lower=True, check_finite=False).T.reshape(cross.shape)
        own1 = self.m1.covariance.reshape(len(self.m1), 3, -1, 3)[i, :, i, :]
        own2 = B @ self.m2.covariance.reshape(len(self.m2), 3, -1, 3)[j, :, j, :] @ B.T
        V = own1 + own2 + _own_noise(self.arms, i, j) + J @ S @ np.swapaxes(J, 1, 2)
        return np.asarray(innovation), np.asarray(V - X @ np.swapaxes(X, 1, 2))

    def quick_innovation(self) -> Array:
        """Innovations in position of all pairs (n1, n2, 2), without their covariances."""
        p1, p2 = self.corrected()
        return p1[:, None, :] - p2[None, :, :]

    def leave_one_out(self) -> tuple[Array, Array]:
        """Innovation (k, 3) and covariance (k, 3, 3) of each pair given all the others."""
        k = len(self.i)
        Q = cho_solve(self._factor, np.eye(3 * k)).reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k), :]
        V = np.linalg.inv(Q)
        return np.asarray((V @ self.weights.reshape(k, 3, 1))[..., 0]), np.asarray(V)

    def sequential(self) -> tuple[Array, Array]:
        """Innovation (k, 3) and covariance (k, 3, 3) of each pair given those before it, T12's prior included."""
        L = np.tril(self._factor[0])
        k = len(self.i)
        z = solve_triangular(L, self.r, lower=True).reshape(k, 3)
        D = L.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k), :]
        return np.asarray((D @ z[..., None])[..., 0]), np.asarray(D @ np.swapaxes(D, 1, 2))
