"""SE(2) on arrays: poses are ``(..., 3)`` arrays of x [m], y [m], theta [rad]; every function broadcasts.

A pose ``T_ab`` takes coordinates of frame b into frame a: ``p_a = transform(T_ab, p_b)``. Covariances of a pose
are 3x3 over (x, y, theta) in the axes of the frame that the pose is expressed in (not the body tangent):
an error (dx, dy, dtheta) is simply added to the pose. The tangent used by `exp`, `log` and `adjoint` is
(v_x, v_y, omega) of the body. Formulas: Sola, Deray and Atchuthan, *A micro Lie theory for state
estimation in robotics* (2018), Appendix on SE(2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import UndeterminedError

Array = NDArray[np.float64]

IDENTITY: Array = np.zeros(3)
IDENTITY.flags.writeable = False


def wrap(angle: ArrayLike) -> Array:
    """Angle [rad] in (-pi, pi].

    >>> float(wrap(3 * np.pi)) == np.pi
    True
    """
    angle = np.asarray(angle, dtype=float)
    inside = (angle > -np.pi) & (angle <= np.pi)
    if inside.all():
        return angle.copy()[()]
    turned = np.pi - np.mod(np.pi - angle, 2 * np.pi)
    # an angle in range keeps every bit, and one just above pi must not round to -pi, which is out of range
    turned = np.where(turned <= -np.pi, np.pi, turned)
    return np.where(inside, angle, turned)[()]


def rotation(theta: ArrayLike) -> Array:
    """Rotation matrices ``(..., 2, 2)`` of angles ``(...)`` [rad]."""
    c, s = np.cos(theta), np.sin(theta)
    R = np.empty((*np.shape(c), 2, 2))
    R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    return R


def transform(T: ArrayLike, points: ArrayLike) -> Array:
    """Points ``(..., 2)`` of the frame b in frame a, ``T`` being ``T_ab``.

    >>> transform([1, 2, np.pi / 2], [3, 0]).round(9).tolist()
    [1.0, 5.0]
    """
    T, points = np.asarray(T, dtype=float), np.asarray(points, dtype=float)
    c, s = np.cos(T[..., 2]), np.sin(T[..., 2])
    x, y = points[..., 0], points[..., 1]
    there = T[..., 0] + c * x - s * y
    moved = np.empty((*there.shape, 2))
    moved[..., 0], moved[..., 1] = there, T[..., 1] + s * x + c * y
    return moved


def compose(T_ab: ArrayLike, T_bc: ArrayLike) -> Array:
    """``T_ac = T_ab T_bc``, theta in (-pi, pi]."""
    T_ab, T_bc = np.asarray(T_ab, dtype=float), np.asarray(T_bc, dtype=float)
    theta = wrap(T_ab[..., 2] + T_bc[..., 2])
    T_ac = np.empty((*np.shape(theta), 3))
    T_ac[..., :2], T_ac[..., 2] = transform(T_ab, T_bc[..., :2]), theta
    return T_ac


def inverse(T_ab: ArrayLike) -> Array:
    """``T_ba``.

    >>> T = np.array([1.0, 2.0, 0.3])
    >>> bool(np.allclose(compose(T, inverse(T)), IDENTITY))
    True
    """
    T = np.asarray(T_ab, dtype=float)
    c, s = np.cos(T[..., 2]), np.sin(T[..., 2])
    x, y = T[..., 0], T[..., 1]
    T_ba = np.empty(T.shape)
    T_ba[..., 0], T_ba[..., 1], T_ba[..., 2] = -c * x - s * y, s * x - c * y, wrap(-T[..., 2])
    return T_ba


def between(T_wa: ArrayLike, T_wb: ArrayLike) -> Array:
    """``T_ab``: pose b seen from pose a."""
    return compose(inverse(T_wa), T_wb)


def _v_matrix(omega: Array) -> Array:
    """V(omega) ``(..., 2, 2)`` of exp: the integral of the rotation along the unit-time motion."""
    small = np.abs(omega) < 1e-5
    safe = np.where(small, 1.0, omega)
    a = np.where(small, 1 - omega**2 / 6, np.sin(safe) / safe)
    b = np.where(small, omega / 2 - omega**3 / 24, 2 * np.sin(safe / 2) ** 2 / safe)  # (1 - cos) / omega
    return np.stack([np.stack([a, -b], axis=-1), np.stack([b, a], axis=-1)], axis=-2)


def exp(tangent: ArrayLike) -> Array:
    """Pose reached by the body velocity (v_x, v_y, omega) after unit time."""
    tangent = np.asarray(tangent, dtype=float)
    xy = np.einsum("...ij,...j->...i", _v_matrix(tangent[..., 2]), tangent[..., :2])
    return np.concatenate([xy, wrap(tangent[..., 2])[..., None]], axis=-1)


def log(T: ArrayLike) -> Array:
    """Tangent (v_x, v_y, omega) with ``exp(log(T)) == T``; omega in (-pi, pi]."""
    T = np.asarray(T, dtype=float)
    omega = wrap(T[..., 2])
    xy = np.linalg.solve(_v_matrix(omega), T[..., :2, None])[..., 0]
    return np.concatenate([xy, omega[..., None]], axis=-1)


def adjoint(T: ArrayLike) -> Array:
    """Adjoint ``(..., 3, 3)``: ``T exp(v) T^-1 == exp(adjoint(T) v)``."""
    T = np.asarray(T, dtype=float)
    out = np.zeros((*T.shape[:-1], 3, 3))
    out[..., :2, :2] = rotation(T[..., 2])
    out[..., 0, 2] = T[..., 1]
    out[..., 1, 2] = -T[..., 0]
    out[..., 2, 2] = 1
    return out


def _turned(v: Array) -> Array:
    """Vectors ``(..., 2)`` turned by a quarter turn counter-clockwise: d(R p)/dtheta is this of R p."""
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def compose_jacobians(T_ab: ArrayLike, T_bc: ArrayLike) -> tuple[Array, Array]:
    """d(T_ac)/d(T_ab) and d(T_ac)/d(T_bc), each ``(..., 3, 3)``, for errors added to (x, y, theta)."""
    T_ab, T_bc = np.asarray(T_ab, dtype=float), np.asarray(T_bc, dtype=float)
    shape = np.broadcast_shapes(T_ab.shape, T_bc.shape)[:-1]
    R = rotation(T_ab[..., 2])
    first = np.zeros((*shape, 3, 3))
    first[...] = np.eye(3)
    first[..., :2, 2] = _turned(np.einsum("...ij,...j->...i", R, T_bc[..., :2]))
    second = np.zeros((*shape, 3, 3))
    second[..., :2, :2] = R
    second[..., 2, 2] = 1
    return first, second


def inverse_jacobian(T_ab: ArrayLike) -> Array:
    """d(T_ba)/d(T_ab) ``(..., 3, 3)``: ``-[[R', R' (t_y, -t_x)'], [0, 1]]``."""
    T = np.asarray(T_ab, dtype=float)
    Rt = np.swapaxes(rotation(T[..., 2]), -1, -2)
    out = np.zeros((*T.shape[:-1], 3, 3))
    out[..., :2, :2] = -Rt
    out[..., :2, 2] = -np.einsum("...ij,...j->...i", Rt, np.stack([T[..., 1], -T[..., 0]], axis=-1))
    out[..., 2, 2] = -1
    return out


def propagate(jacobian: ArrayLike, covariance: ArrayLike) -> Array:
    """``J C J'``, symmetrised."""
    J, C = np.asarray(jacobian, dtype=float), np.asarray(covariance, dtype=float)
    out: Array = J @ C @ np.swapaxes(J, -1, -2)
    return (out + np.swapaxes(out, -1, -2)) / 2


def compose_covariance(T_ab: ArrayLike, cov_ab: ArrayLike, T_bc: ArrayLike, cov_bc: ArrayLike) -> Array:
    """Covariance of ``T_ab T_bc`` for independent factors, first order, our axes."""
    first, second = compose_jacobians(T_ab, T_bc)
    return propagate(first, cov_ab) + propagate(second, cov_bc)


def inverse_covariance(T_ab: ArrayLike, cov_ab: ArrayLike) -> Array:
    """Covariance of ``T_ba``, first order, our axes."""
    return propagate(inverse_jacobian(T_ab), cov_ab)


def transform_jacobians(T: ArrayLike, points: ArrayLike) -> tuple[Array, Array]:
    """d(T p)/dT ``(..., 2, 3)`` and d(T p)/dp ``(..., 2, 2)``."""
    T, points = np.asarray(T, dtype=float), np.asarray(points, dtype=float)
    shape = np.broadcast_shapes(T.shape[:-1], points.shape[:-1])
    R = rotation(T[..., 2])
    by_T = np.zeros((*shape, 2, 3))
    by_T[..., 0, 0] = by_T[..., 1, 1] = 1
    by_T[..., :2, 2] = _turned(np.einsum("...ij,...j->...i", R, points))
    return by_T, np.broadcast_to(R, (*shape, 2, 2))


@dataclass(frozen=True, slots=True)
class Alignment:
    """A weighted rigid alignment: ``T12`` (3,), its covariance (3, 3), and what is left per point."""

    T12: Array
    covariance: Array
    residuals: Array


def align(points1: ArrayLike, points2: ArrayLike, sigma: ArrayLike = 1.0) -> Alignment:
    """Rotation and translation ``T12`` minimising ``sum |p1 - T12 p2|^2 / sigma^2``, in closed form, never mirrored.

    Parameters: ``points1``, ``points2`` (n, 2) in their maps' frames; ``sigma`` (n,) or scalar: standard deviation
    per axis [m] of each residual. Source: Horn (1987) in the plane, whose optimal angle is that of
    ``sum w (q2 x q1) , sum w (q2 . q1)`` over the centred points q. The covariance is the inverse of
    ``sum J' J / sigma^2`` with J = d(T12 p2)/dT12.

    Raises `UndeterminedError` for fewer than two distinct points, and where every rotation fits alike (a square
    against its mirror image).

    >>> p2 = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> align(transform([1.0, 2.0, 0.5], p2), p2).T12.round(9).tolist()
    [1.0, 2.0, 0.5]
    """
    p1, p2 = np.asarray(points1, dtype=float), np.asarray(points2, dtype=float)
    w = np.broadcast_to(1 / np.square(np.asarray(sigma, dtype=float)), p1.shape[:1])
    if len(p1) < 2:
        raise UndeterminedError("an alignment needs two points or more")
    m1, m2 = w @ p1 / w.sum(), w @ p2 / w.sum()
    q1, q2 = p1 - m1, p2 - m2
    if not (np.abs(q1).max() > 1e-9 and np.abs(q2).max() > 1e-9):
        raise UndeterminedError("an alignment needs two distinct points or more")
    cross = w @ (q2[:, 0] * q1[:, 1] - q2[:, 1] * q1[:, 0])
    dot = w @ (q1 * q2).sum(axis=1)
    if not np.hypot(cross, dot) > 1e-12 * (w @ (np.hypot(*q1.T) * np.hypot(*q2.T))):
        raise UndeterminedError("an alignment of points that every rotation fits alike has no answer")
    theta = np.arctan2(cross, dot)
    T12 = np.array([*(m1 - rotation(theta) @ m2), theta])
    J, _ = transform_jacobians(T12, p2)
    information = np.einsum("k,kij,kil->jl", w, J, J)
    return Alignment(T12, np.linalg.inv(information), p1 - transform(T12, p2))
