"""Where a robot is in the frame that the maps share: its pose in its own map, given what the merge says of that map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import UndeterminedError
from mapfuse.datasets.transform import Transform

from .segment import Segment
from .smoother import Smoother

Array = NDArray[np.float64]

#: Added to all variances [m^2, rad^2], so that two landmarks which are as one, or a start that is known, can be told.
FLOOR = 1e-9
#: Eigenvalues of the correlations are taken to be this at least: less is rounding.
LEAST = 1e-13
#: A pose is found when a step is this small [m, rad]; two or three do.
SMALL, STEPS = 1e-9, 20


@dataclass(frozen=True, slots=True)
class Place:
    """A robot's pose with covariance in the frame of the map ``frame_of``, as of time ``t`` [s]."""

    robot: str
    frame_of: str
    pose: Transform
    t: float


def placed_in(segment: Segment, smoother: Smoother) -> Place:
    """Its last pose in the frame of its group.

    With x the pose and l the landmarks in the robot's own frame, the robot says how x and l go together; the joint
    solution says where l are. The pose is the likeliest x given these l, and what is uncertain of it, given l, stays
    so (Gaussian conditioning). Where the robot names no landmarks, they don't move its pose.

    What the robot said is Gaussian as the robot sees its surroundings (`_Sight`), not in the axes of its start: far
    from there its heading may be off by a tenth of a radian, and a turn of the landmarks about it by that is no sum
    of shifts to the centimetre that the sight of them is good for.
    """
    said = segment.placed
    assert said is not None
    name = segment.name
    known = smoother.local_landmarks(name)
    kept = [k for k, identifier in enumerate(said.order) if identifier in known]
    ids = [said.order[k] for k in kept]
    n = len(ids)
    T = smoother.local_frame(name).array
    C = smoother.local_covariance(name, ids)
    rows = np.array([0, 1, 2, *(3 + 3 * k + c for k in range(n) for c in range(2))], dtype=np.intp)
    C = C[np.ix_(rows, rows)]
    shared = np.array([known[i][:2] for i in ids]).reshape(-1, 2)
    seen = np.asarray(se2.transform(se2.inverse(T), shared)).reshape(-1, 2)
    x = said.pose - np.array([*segment.origin, 0.0])
    sight = _Sight.of(x, said.positions[kept] - segment.origin, said.covariance[np.ix_(_rows(kept), _rows(kept))])
    pose, rest, G = sight.pose_given(seen)
    by_T, by_pose = se2.compose_jacobians(T, pose)
    by_frame, by_landmarks = _seen_by(T, shared)
    whole = by_pose @ G @ np.concatenate([by_frame, by_landmarks], axis=1)
    whole[:, :3] += by_T
    C = whole @ C @ whole.T + by_pose @ rest @ by_pose.T
    there = se2.compose(T, pose) + np.array([*smoother.origin_of_group(name), 0.0])
    return Place(segment.robot, smoother.first_of_group(name), Transform.from_array(there, (C + C.T) / 2), said.t)


@dataclass(frozen=True, eq=False, slots=True)
class _Sight:
    """What a robot knows, as seen from where it stands: ``origin`` (3,), its start, and ``landmarks`` (n, 2), with the
    ``whitening`` (3 + 2n, 3 + 2n) of these together: what makes their errors independent, of variance 1. ``pose`` (3,)
    is what it takes for its own, in the frame of its start.

    With a root of the information instead of it all stays well-conditioned where the start is kilometres away, or
    known a million times worse than the landmarks.
    """

    pose: Array
    origin: Array
    landmarks: Array
    whitening: Array

    @classmethod
    def of(cls, pose: Array, positions: Array, covariance: Array) -> _Sight:
        """From the pose and the landmarks (n, 2) in the frame of the start, and their covariance (3 + 2n, 3 + 2n)."""
        J = np.concatenate(_sight_by(pose, positions), axis=1)
        covariance = covariance + FLOOR * np.eye(len(covariance))
        sigmas = np.sqrt(np.diagonal(covariance))
        values, vectors = np.linalg.eigh(covariance / sigmas[:, None] / sigmas)
        root = (vectors / np.sqrt(np.maximum(values, LEAST))).T / sigmas
        return cls(pose, se2.inverse(pose), _seen(pose, positions), root @ np.linalg.inv(J))

    def pose_given(self, positions: Array) -> tuple[Array, Array, Array]:
        """The likeliest pose (3,) where the landmarks are truly at ``positions`` (n, 2), its covariance (3, 3) given
        these, and its derivative (3, 2n) by them. All in the frame of the start."""
        x = self._as_a_whole(positions)
        for _ in range(STEPS):
            by_pose, by_landmarks = _sight_by(x, positions)
            start = se2.inverse(x) - self.origin
            start[2] = se2.wrap(start[2])
            residual = np.concatenate([start, (_seen(x, positions) - self.landmarks).ravel()])
            Q, R = np.linalg.qr(self.whitening @ by_pose)
            H = np.linalg.solve(R, Q.T @ self.whitening)
            step = H @ residual
            x = x - step
            if np.abs(step).max() < SMALL:
                break
        x[2] = se2.wrap(x[2])
        root = np.linalg.inv(R)
        return x, np.asarray(root @ root.T), np.asarray(-H @ by_landmarks)

    def _as_a_whole(self, positions: Array) -> Array:
        """The pose moved rigidly with its landmarks; as it is where these don't say how."""
        try:
            moved = se2.align(positions, se2.transform(self.pose, self.landmarks)).T12
        except UndeterminedError:
            return self.pose
        return se2.compose(moved, self.pose)


def _seen(pose: Array, positions: Array) -> Array:
    """Points (n, 2) as seen from a pose."""
    return np.asarray(se2.transform(se2.inverse(pose), positions)).reshape(-1, 2)


def _seen_by(pose: Array, positions: Array) -> tuple[Array, Array]:
    """Derivatives (2n, 3), (2n, 2n) of points as seen from a pose, by the pose and by the points."""
    by_inverse, by_point = se2.transform_jacobians(se2.inverse(pose), positions)
    n = len(positions)
    by_points = np.zeros((n, 2, n, 2))
    by_points[np.arange(n), :, np.arange(n)] = by_point
    return (by_inverse @ se2.inverse_jacobian(pose)).reshape(2 * n, 3), by_points.reshape(2 * n, 2 * n)


def _sight_by(pose: Array, positions: Array) -> tuple[Array, Array]:
    """Derivatives (3 + 2n, 3), (3 + 2n, 2n) of the start and the points as seen from a pose, likewise."""
    by_pose, by_points = _seen_by(pose, positions)
    start = se2.inverse_jacobian(pose)
    return np.concatenate([start, by_pose]), np.concatenate([np.zeros((3, by_points.shape[1])), by_points])


def _rows(kept: list[int]) -> list[int]:
    """Rows of the pose and of these landmarks in what the robot said."""
    return [0, 1, 2, *(3 + 2 * k + c for k in kept for c in range(2))]
