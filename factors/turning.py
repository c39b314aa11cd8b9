"""What the landmarks of one map are off by, beyond a turn that they have in common.

A joint covariance is that of small errors. But a robot's error of heading, made where it set out, turns its whole map:
at 25 m a turn of 0.1 rad moves landmarks along an arc that leaves its tangent by 0.12 m, while neighbours there are
known to each other within centimetres. Were errors straight, such a turn would look like a stretch of the map, which
the covariance excludes, and T12 would come out too sure of itself. So errors are told in exponential coordinates, as
those of one pose are (Long, Wolfe, Mashner and Chirikjian, "The banana distribution is Gaussian", RSS 2012): the turn
is taken out as a turn, and what it would be to first order is added again. Small errors are what they were.

The turn is that of the rigid motion that lays the recorded landmarks on where they are; it goes about the pivot, the
point that moves least as the landmarks turn, by the covariance itself: where the robot set out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mapfuse.datasets import se2

from .measurement import Array

#: Turns a vector by a quarter turn, counter-clockwise.
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
#: Landmarks nearer to each other than this [m, root mean square from their middle] show no turn.
_SPREAD = 1e-6
#: Rounds of looking for what was recorded, at most, and what [m, rad] is near enough.
_INVERTING, _INVERTED = 200, 1e-12


def pivot(positions: ArrayLike, covariance: ArrayLike) -> Array:
    """The point (2,) about which landmarks at ``positions`` (n, 2) turn, by their joint ``covariance`` (2n, 2n).

    With t the mean of the errors, f the turn of their best rigid motion and m the middle of the landmarks,
    ``m + J cov(t, f) / var(f)``: there a rigid motion's shift does not depend on its turn. It moves with the map.

    >>> away = np.array([[10.0, 0.0], [10.0, 4.0], [14.0, 0.0]])
    >>> lever = (away @ QUARTER.T).ravel()
    >>> pivot(away, 0.01 * np.outer(lever, lever) + 1e-9 * np.eye(6)).round(4).tolist()  # all turn about the origin
    [0.0, 0.0]
    """
    at, C = np.asarray(positions, dtype=float).reshape(-1, 2), np.asarray(covariance, dtype=float)
    middle = at.mean(axis=0)
    away = at - middle
    if np.sum(away**2) <= len(at) * _SPREAD**2:
        return np.asarray(middle)
    gradient = (away @ QUARTER.T).ravel() / np.sum(away**2)
    by_turn = C @ gradient
    variance = float(gradient @ by_turn)
    if variance <= 0.0:
        return np.asarray(middle)
    return np.asarray(middle + QUARTER @ by_turn.reshape(-1, 2).mean(axis=0) / variance)


def turn(recorded: Array, seen: Array) -> tuple[float, Array]:
    """The turn [rad] of the rigid motion that lays ``recorded`` (n, 2) on ``seen`` (n, 2) best, and its gradient
    (n, 2) by the latter; 0 where all are at one place."""
    away = recorded - recorded.mean(axis=0)
    if np.sum(away**2) <= len(away) * _SPREAD**2:
        return 0.0, np.zeros_like(away)
    across = away @ QUARTER.T
    sine, cosine = float(np.sum(across * seen)), float(np.sum(away * seen))
    square = sine**2 + cosine**2
    if square == 0.0:
        return 0.0, np.zeros_like(away)
    return float(np.arctan2(sine, cosine)), (cosine * across - sine * away) / square


def errors(recorded: Array, about: Array, seen: Array) -> Array:
    """What landmarks ``seen`` (n, 3) are off ``recorded`` (n, 3) by (n, 3) [m, m, rad], in exponential coordinates.

    With q, p a landmark's position seen and recorded, c the point ``about`` which they turn, f the turn:
    ``R(-f) (q - c) - (p - c) + f J (p - c)``. Headings: the difference, wrapped.

    >>> recorded = np.array([[10.0, 0.0, 0.0], [10.0, 5.0, 0.0]])
    >>> seen = np.asarray(se2.compose([0.0, 0.0, 0.1], recorded))  # turned about the origin
    >>> errors(recorded, np.zeros(2), seen).round(6).tolist()
    [[0.0, 1.0, 0.1], [-0.5, 1.0, 0.1]]
    """
    f, _ = turn(recorded[:, :2], seen[:, :2])
    off = np.empty_like(seen)
    off[:, :2] = _shape(recorded, about, seen, f) + f * (recorded[:, :2] - about) @ QUARTER.T
    off[:, 2] = se2.wrap(seen[:, 2] - recorded[:, 2])
    return off


def _shape(recorded: Array, about: Array, seen: Array, f: float) -> Array:
    """What is left of the errors of positions (n, 2) without the turn."""
    return np.asarray((seen[:, :2] - about) @ se2.rotation(f) - (recorded[:, :2] - about))


def placed(recorded: Array, about: Array, off: Array, f: float) -> Array:
    """Where what was ``recorded`` (k, 3) lies if it is ``off`` (k, 3) by `errors` and all of it is turned by ``f``.

    >>> recorded = np.array([[10.0, 0.0, 0.0], [10.0, 5.0, 0.0], [3.0, 1.0, 0.0]])
    >>> seen = recorded + np.array([[0.0, 1.0, 0.1], [0.0, 0.9, 0.2], [0.3, 0.0, 0.1]])
    >>> off = errors(recorded, np.zeros(2), seen)
    >>> bool(np.allclose(placed(recorded, np.zeros(2), off, turn(recorded[:, :2], seen[:, :2])[0]), seen))
    True
    """
    away = recorded[:, :2] - about
    seen = recorded + off
    seen[:, :2] = about + (away + off[:, :2] - f * away @ QUARTER.T) @ se2.rotation(-f)
    return seen


def recorded_for(seen: Array, about: Array, off: Array) -> Array:
    """What has to be recorded (n, 3) of landmarks ``seen`` (n, 3), so that their `errors` are ``off`` (n, 3).

    >>> seen, off = np.array([[10.0, 0.0, 0.0], [10.0, 5.0, 1.0]]), np.array([[0.0, 1.0, 0.1], [-0.5, 0.8, 0.2]])
    >>> bool(np.allclose(errors(recorded_for(seen, np.zeros(2), off), np.zeros(2), seen), off))
    True
    """
    recorded = seen - off
    for _ in range(_INVERTING):
        wrong = errors(recorded, about, seen) - off
        recorded = recorded + wrong
        if np.abs(wrong).max(initial=0.0) < _INVERTED:
            break
    return recorded


def derivatives(recorded: Array, about: Array, seen: Array) -> tuple[Array, Array, Array]:
    """R(-f) (2, 2), a (n, 2) and g (n, 2) of the derivatives of `errors` by the positions seen:
    ``de_i = R(-f) dq_i + a_i sum_j g_j . dq_j``.

    With u what is left without the turn: ``a = -J u``. Of headings the derivative is 1.
    """
    f, gradient = turn(recorded[:, :2], seen[:, :2])
    return se2.rotation(-f), -_shape(recorded, about, seen, f) @ QUARTER.T, gradient


def seen_jacobians(seen: Array) -> tuple[Array, Array]:
    """Derivatives of landmarks' poses ``seen`` (n, 3) from a frame by the body tangents of that frame (n, 3, 3) and of
    each landmark itself (n, 3, 3).

    With p the landmark in the frame, v a body velocity and w a turn: ``dp = R_T' R_i v_i - v_T - w_T (-p_y, p_x)``.

    >>> by_frame, by_landmark = seen_jacobians(np.array([[4.0, 3.0, 0.0]]))
    >>> by_frame[0, :, 2].tolist(), by_landmark[0].tolist() == np.eye(3).tolist()
    ([3.0, -4.0, -1.0], True)
    """
    by_frame = np.tile(-np.eye(3), (len(seen), 1, 1))
    by_frame[:, 0, 2], by_frame[:, 1, 2] = seen[:, 1], -seen[:, 0]
    by_landmark = np.zeros((len(seen), 3, 3))
    by_landmark[:, :2, :2] = se2.rotation(seen[:, 2])
    by_landmark[:, 2, 2] = 1
    return by_frame, by_landmark
