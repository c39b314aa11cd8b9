"""Maps with keyframes and walls whose errors are drawn from the joint covariance that they state.

A robot drives once round a polygon and a little on, with errors of odometry, and sees landmarks and walls from its
keyframes. Everything is linear and Gaussian, so that the joint covariance is exact: what fuses such maps must be
consistent. Cheap, too: no log is made and no mapper runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..maps import JointCovariance, Keyframes, Landmark, LandmarkMap

Array = NDArray[np.float64]

#: Keyframes are this far [m] from each other, and see walls within that.
STEP_M, REACH_M = 3.0, 4.0


def driven(corners: Array, start: int, turns: float = 1.1, back: bool = False) -> Array:
    """Poses (k, 3) every few metres along a closed polygon (n, 2), from one of its corners on."""
    corners = np.roll(corners, -start, axis=0)
    corners = corners[[0, *range(len(corners) - 1, 0, -1)]] if back else corners
    closed = np.concatenate([corners, corners[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.arange(0.0, turns * way[-1], STEP_M)
    xy = np.column_stack([np.interp(at % way[-1], way, column) for column in closed.T])
    side = np.minimum(np.searchsorted(way, at % way[-1], side="right") - 1, len(corners) - 1)
    heading = np.arctan2(*np.diff(closed, axis=0).T[::-1])
    return np.column_stack([xy, heading[side]])


def posterior(keyframes: Array, landmarks: Array, sigmas: Sequence[float], sight_sigma: float) -> Array:
    """Covariance (3k + 2n square) of keyframes, the first one held, and landmarks, in the axes of the first one's map.

    ``sigmas``: of a step along, across [m] and in turning [rad].
    """
    k, n = len(keyframes), len(landmarks)
    H = np.zeros((3 * k + 2 * n, 3 * k + 2 * n))
    H[:3, :3] = np.eye(3) * 1e8
    for a, (p, q) in enumerate(pairwise(keyframes)):
        R = se2.rotation(p[2])
        J = np.zeros((3, H.shape[0]))
        lever = q[:2] - p[:2]
        J[:2, 3 * a + 3 : 3 * a + 5], J[:2, 3 * a : 3 * a + 2] = R.T, -R.T
        J[:2, 3 * a + 2] = -R.T @ [-lever[1], lever[0]]
        J[2, 3 * a + 5], J[2, 3 * a + 2] = 1, -1
        H += J.T @ np.diag(np.array(sigmas) ** -2.0) @ J
    for i, xy in enumerate(landmarks):
        for a in np.flatnonzero(np.hypot(*(keyframes[:, :2] - xy).T) < REACH_M).tolist():
            J = np.zeros((2, H.shape[0]))
            lever = xy - keyframes[a, :2]
            J[:, 3 * k + 2 * i : 3 * k + 2 * i + 2] = np.eye(2)
            J[:, 3 * a : 3 * a + 2] = -np.eye(2)
            J[:, 3 * a + 2] = [lever[1], -lever[0]]
            H += J.T @ J / sight_sigma**2
    C = np.linalg.inv(H)
    return (C + C.T) / 2


def drifted(
    name: str,
    walls: Sequence[Array],
    keyframes: Array,
    landmarks: Array,
    rng: np.random.Generator,
    sigmas: Sequence[float] = (0.05, 0.01, 0.005),
    sight_sigma: float = 0.25,
    wall_sigma: float = 0.03,
) -> LandmarkMap:
    """A map in the frame of its first keyframe, landmarks ("tree") without headings.

    ``walls``: polylines (n, 2) [m], ``keyframes`` (k, 3) and ``landmarks`` (n, 2) [m] of the world. ``sigmas``: of the
    odometry of a step, along, across [m] and in turning [rad]; ``sight_sigma`` [m]: of a landmark seen from a keyframe,
    per axis; ``wall_sigma`` [m]: by how much each end of a piece of wall is off sideways.

    >>> square = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]])
    >>> made = drifted("A", [square + 1.0], driven(square, 0), square, np.random.default_rng(0))
    >>> made.joint_covariance.keyframes.poses.shape
    (14, 3)
    """
    T = keyframes[0]
    frames = np.asarray(se2.between(T, keyframes))
    places = se2.transform(se2.inverse(T), landmarks)
    C = posterior(frames, places, sigmas, sight_sigma)
    k, n = len(frames), len(places)
    error = np.linalg.cholesky(C + 1e-12 * np.eye(len(C))) @ rng.normal(size=len(C))
    seen, marks = frames + error[: 3 * k].reshape(-1, 3), places + error[3 * k :].reshape(-1, 2)
    ids = tuple(f"m{i}" for i in range(n))
    pieces = _seen(walls, keyframes, wall_sigma, rng)
    joint = JointCovariance(
        ids, 2, C[3 * k :, 3 * k :], {}, Keyframes(seen, pieces, C[: 3 * k, 3 * k :], C[: 3 * k, : 3 * k])
    )
    return LandmarkMap(
        name,
        tuple(Landmark(identifier, "tree", *xy) for identifier, xy in zip(ids, marks.tolist(), strict=True)),
        joint_covariance=joint,
        walls=tuple(se2.transform(seen[int(k)], np.array(ends).reshape(2, 2)) for k, *ends in pieces),
        path=np.column_stack([np.arange(k), seen[:, :2], se2.wrap(seen[:, 2])]),
    )


def _seen(walls: Sequence[Array], keyframes: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Pieces (p, 5) of walls as keyframes (k, 3) see them, each end off sideways by an error of its own."""
    found = []
    lines = [(a, b) for wall in walls for a, b in pairwise(wall)]
    for k, pose in enumerate(keyframes):
        for a, b in lines:
            length = float(np.hypot(*(b - a)))
            u = (b - a) / length
            near = float((pose[:2] - a) @ u)
            off = float(np.hypot(*(a + near * u - pose[:2])))
            if off >= REACH_M:
                continue
            half = np.sqrt(REACH_M**2 - off**2)
            low, high = max(0.0, near - half), min(length, near + half)
            if high - low > 0.5:
                ends = a + np.array([[low], [high]]) * u + rng.normal(0, sigma, (2, 1)) * [-u[1], u[0]]
                found.append([k, *se2.transform(se2.inverse(pose), ends).ravel()])
    return np.array(found).reshape(-1, 5)
