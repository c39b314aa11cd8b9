"""The one place that converts between covariances in the axes of a frame (ours) and in GTSAM's body tangent.

Ours: errors added to (x, y, theta) of a pose in the axes of the frame that it is expressed in. GTSAM's: the tangent
of the pose itself, its x along the pose's own heading. They differ by the rotation of the position part,
``C_axes = R(theta) C_body R(theta)'``; theta itself is the same in both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets import se2

Array = NDArray[np.float64]


def wrapped(angle: float) -> float:
    """One angle [rad] in (-pi, pi]: `se2.wrap` without the cost of an array.

    >>> wrapped(-np.pi) == np.pi
    True
    """
    return float(np.pi - (np.pi - angle) % (2 * np.pi))


def pose_rotations(thetas: ArrayLike) -> Array:
    """``d(axes error)/d(body tangent)`` ``(..., 3, 3)`` of poses with these angles [rad]."""
    thetas = np.asarray(thetas, dtype=float)
    J = np.zeros((*thetas.shape, 3, 3))
    J[..., :2, :2] = se2.rotation(thetas)
    J[..., 2, 2] = 1
    return J


def pose_to_axes(theta: ArrayLike, covariance: ArrayLike) -> Array:
    """Covariances ``(..., 3, 3)`` of poses at angles ``theta`` [rad], body tangent -> frame axes.

    >>> pose_to_axes(np.pi / 2, np.diag([4.0, 1.0, 0.1])).round(9).diagonal().tolist()
    [1.0, 4.0, 0.1]
    """
    return se2.propagate(pose_rotations(theta), covariance)


def pose_to_body(theta: ArrayLike, covariance: ArrayLike) -> Array:
    """Covariances ``(..., 3, 3)`` of poses at angles ``theta`` [rad], frame axes -> body tangent."""
    return se2.propagate(pose_rotations(-np.asarray(theta, dtype=float)), covariance)


def point_to_axes(theta: ArrayLike, covariance: ArrayLike) -> Array:
    """Covariances ``(..., 2, 2)`` of positions of poses at angles ``theta`` [rad], body tangent -> frame axes."""
    return se2.propagate(se2.rotation(np.asarray(theta, dtype=float)), covariance)


def point_to_body(theta: ArrayLike, covariance: ArrayLike) -> Array:
    """Covariances ``(..., 2, 2)`` of positions of poses at angles ``theta`` [rad], frame axes -> body tangent."""
    return se2.propagate(se2.rotation(-np.asarray(theta, dtype=float)), covariance)


def cross_to_axes(theta_a: ArrayLike, theta_b: ArrayLike, cross: ArrayLike) -> Array:
    """Cross covariances ``(..., 3, 3)`` of poses a (rows) and b (columns), body tangents -> frame axes."""
    Ja, Jb = pose_rotations(theta_a), pose_rotations(theta_b)
    return np.asarray(Ja @ np.asarray(cross, dtype=float) @ np.swapaxes(Jb, -1, -2))


def joint_to_axes(thetas: ArrayLike, covariance: ArrayLike) -> Array:
    """Joint covariance ``(3n, 3n)`` of n poses at angles ``thetas`` (n,) [rad], body tangents -> frame axes."""
    return _rotate_joint(np.asarray(thetas, dtype=float), covariance)


def joint_to_body(thetas: ArrayLike, covariance: ArrayLike) -> Array:
    """Joint covariance ``(3n, 3n)`` of n poses at angles ``thetas`` (n,) [rad], frame axes -> body tangents."""
    return _rotate_joint(-np.asarray(thetas, dtype=float), covariance)


def _rotate_joint(thetas: Array, covariance: ArrayLike) -> Array:
    n = len(thetas)
    J = pose_rotations(thetas)
    blocks = np.asarray(covariance, dtype=float).reshape(n, 3, n, 3)
    turned = np.einsum("aij,ajbk,blk->aibl", J, blocks, J, optimize=True).reshape(3 * n, 3 * n)
    return np.asarray((turned + turned.T) / 2)
