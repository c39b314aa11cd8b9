"""One robot's drive to a landmark map: 2-D landmark SLAM with known associations, by Levenberg-Marquardt.

Unknowns: the poses of the drive (the first one is the gauge, fixed at the origin) and the landmarks' positions, all in
the frame of the first pose. Measurements: the motion from each pose to the next, and sightings of landmarks in the
robot's frame. The normal equations are sparse and are factorised as such; the landmarks' block of their inverse at the
optimum is the joint covariance of all landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from . import se2
from .errors import MapfuseError, UndeterminedError
from .values import frozen_array

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Step length in standard deviations (root of the Newton decrement) below which a solution counts as an optimum.
CONVERGED = 1e-5
#: Relative difference of the error below which two solutions count as the same optimum.
SAME_ERROR = 1e-7
#: Poses that are added at a time while a long drive is solved.
STRETCH = 250
#: Step length [standard deviations] that ends the descent of a stretch which more poses will follow.
ROUGHLY = 0.3
_MAX_ITERATIONS = 100
_LEAST_DAMPING = 1e-6
_ROUNDING = 1e-12
_SINGULAR = 1e-13


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """What one robot measured along n poses, k landmarks being seen m times.

    ``motions`` (n - 1, 3): pose i + 1 seen from pose i [m, m, rad]; ``motion_sigmas`` (n - 1, 3): standard deviations.
    ``seen_from`` (m,), ``seen`` (m,): index of the pose and of the landmark of each sighting; ``sightings`` (m, 2):
    the landmark in the robot's frame [m]; ``sighting_sigmas`` (m, 2): standard deviations [m].
    """

    motions: Array
    motion_sigmas: Array
    seen_from: Indices
    seen: Indices
    sightings: Array
    sighting_sigmas: Array

    @property
    def pose_count(self) -> int:
        """Number of poses n, the first one included."""
        return len(self.motions) + 1

    @property
    def landmark_count(self) -> int:
        """Number of landmarks k."""
        return int(self.seen.max()) + 1 if len(self.seen) else 0


@dataclass(frozen=True, eq=False, slots=True)
class SlamSolution:
    """An optimum: ``poses`` (n, 3) and ``landmarks`` (k, 2) in the frame of the first pose [m, rad].

    ``error``: half of the sum of squared residuals in standard deviations. ``decrement``: length [standard
    deviations] of the Newton step that was left. ``covariance`` (2k, 2k): of all landmarks together [m^2].
    """

    poses: Array
    landmarks: Array
    error: float
    decrement: float
    covariance: Array

    def __post_init__(self) -> None:
        for name in ("poses", "landmarks", "covariance"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def dead_reckoning(motions: Array) -> Array:
    """Poses (n, 3) of a drive in the frame of its first pose, from its motions (n - 1, 3) alone.

    >>> dead_reckoning(np.array([[1.0, 0.0, np.pi / 2], [1.0, 0.0, 0.0]])).round(9)[-1, :2].tolist()
    [1.0, 1.0]
    """
    theta = np.concatenate([[0.0], np.cumsum(motions[:, 2])])
    steps = np.einsum("kij,kj->ki", se2.rotation(theta[:-1]), motions[:, :2])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, se2.wrap(theta)])


def solve_drive(
    drive: Drive, rng: np.random.Generator, restarts: int = 1, start: tuple[Array, Array] | None = None
) -> SlamSolution:
    """The optimum of a drive, solved as it grew, then bent at random and solved again ``restarts`` times.

    ``start``: poses (n, 3), the first one at the origin, and landmarks (k, 2) to begin with instead.

    Dead reckoning of a long drive is far outside of what Gauss-Newton mends, so that stretches of `STRETCH` poses are
    added one by one. A covariance is worth something at the optimum only: a restart that finds a lower error replaces
    the solution, and the checks begin anew.

    Raises `UndeterminedError` where a landmark was never seen or the measurements leave a direction open, and
    `MapfuseError` where the steps don't come to rest.

    >>> drive = Drive(np.array([[2.0, 0.0, 0.0]]), np.full((1, 3), 0.1), np.array([0, 1]), np.array([0, 0]),
    ...               np.array([[3.0, 1.0], [1.0, 1.0]]), np.full((2, 2), 0.1))
    >>> solve_drive(drive, np.random.default_rng(0)).landmarks.round(6).tolist()
    [[3.0, 1.0]]
    """
    if set(drive.seen.tolist()) != set(range(drive.landmark_count)):
        raise UndeterminedError("a landmark of the drive was never seen")
    best = _descend(drive, *(_grown(drive) if start is None else start), CONVERGED)
    confirmed = 0
    while confirmed < restarts:
        other = _descend(drive, *_bent(drive, best, rng), CONVERGED)
        if other.error < best.error * (1 - SAME_ERROR):
            best, confirmed = other, 0
        else:
            confirmed += 1
    if best.decrement > CONVERGED:
        raise MapfuseError(f"the drive's solution still moved by {best.decrement:.2g} sigma in its last step")
    covariance = _landmark_covariance(drive, best)
    return SlamSolution(best.poses, best.landmarks, best.error, best.decrement, covariance)


@dataclass(frozen=True, eq=False, slots=True)
class _State:
    """Poses and landmarks where a descent stopped."""

    poses: Array
    landmarks: Array
    error: float
    decrement: float


def _first_poses(drive: Drive, count: int) -> tuple[Drive, Indices]:
    """The drive up to its pose ``count``, with the landmarks seen until then only, and which these are."""
    kept = drive.seen_from < count
    known, seen = np.unique(drive.seen[kept], return_inverse=True)
    return Drive(
        drive.motions[: count - 1],
        drive.motion_sigmas[: count - 1],
        drive.seen_from[kept],
        seen,
        drive.sightings[kept],
        drive.sighting_sigmas[kept],
    ), known


def _grown(drive: Drive) -> tuple[Array, Array]:
    """Poses and landmarks near the optimum: each new stretch is dead-reckoned from the solution so far, then solved."""
    poses, landmarks = np.zeros((0, 3)), np.full((drive.landmark_count, 2), np.nan)
    while (done := len(poses)) < drive.pose_count:
        count = min(done + STRETCH, drive.pose_count)
        stretch = dead_reckoning(drive.motions[max(0, done - 1) : count - 1])
        poses = np.concatenate([poses[:-1], se2.compose(poses[-1], stretch)]) if done else stretch
        part, known = _first_poses(drive, count)
        fresh = np.isnan(landmarks[known, 0])
        start = np.where(fresh[:, None], _mean_landmarks(part, poses), landmarks[known])
        state = _descend(part, poses, start, ROUGHLY)
        poses, landmarks[known] = state.poses, state.landmarks
    return poses, landmarks


def _mean_landmarks(drive: Drive, poses: Array) -> Array:
    """Landmarks (k, 2) at the mean of their sightings from the given poses."""
    points = se2.transform(poses[drive.seen_from], drive.sightings)
    counts = np.bincount(drive.seen, minlength=drive.landmark_count)
    sums = np.stack([np.bincount(drive.seen, points[:, a], minlength=len(counts)) for a in (0, 1)], axis=1)
    return np.asarray(sums / counts[:, None], dtype=float)


def _bent(drive: Drive, state: _State, rng: np.random.Generator) -> tuple[Array, Array]:
    """A start elsewhere: the solution with a random drift of heading (0.1 rad in all) and of scale (3 %)."""
    motions = se2.between(state.poses[:-1], state.poses[1:])
    motions[:, 2] += rng.normal(0, 0.1 / np.sqrt(max(1, len(motions))), len(motions))
    motions[:, :2] *= 1 + 0.03 * rng.normal()
    poses = dead_reckoning(motions)
    return poses, _mean_landmarks(drive, poses)


def _descend(drive: Drive, poses: Array, landmarks: Array, until: float) -> _State:
    """Gauss-Newton, damped (Levenberg-Marquardt) while a step raises the error, to steps below ``until`` sigma."""
    residuals, jacobian = _linearise(drive, poses, landmarks)
    error, damping, decrement = float(residuals @ residuals) / 2, 0.0, np.inf
    for _ in range(_MAX_ITERATIONS):
        gradient = jacobian.T @ residuals
        step = -factorised(jacobian, damping).solve(gradient)
        if damping == 0:
            decrement = float(np.sqrt(max(0.0, -step @ gradient)))
            if decrement < until:
                break
        split = 3 * (len(poses) - 1)
        new_poses, new_landmarks = poses.copy(), landmarks + step[split:].reshape(-1, 2)
        new_poses[1:] += step[:split].reshape(-1, 3)
        new_residuals, new_jacobian = _linearise(drive, new_poses, new_landmarks)
        new_error = float(new_residuals @ new_residuals) / 2
        if new_error <= error * (1 + _ROUNDING):
            poses, landmarks, error = new_poses, new_landmarks, new_error
            residuals, jacobian = new_residuals, new_jacobian
            damping = damping / 10 if damping > _LEAST_DAMPING else 0.0
        else:
            damping = max(damping * 10, _LEAST_DAMPING)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return _State(poses, landmarks, error, decrement)


def _linearise(drive: Drive, poses: Array, landmarks: Array) -> tuple[Array, csr_array]:
    """Residuals in standard deviations (3(n - 1) of motions, 2m of sightings), and their Jacobian.

    Its columns: x, y, theta of all poses but the first one, then x, y of all landmarks.
    """
    moved = se2.between(poses[:-1], poses[1:])
    motion = (moved - drive.motions) / drive.motion_sigmas
    motion[:, 2] = se2.wrap(moved[:, 2] - drive.motions[:, 2]) / drive.motion_sigmas[:, 2]
    seen = se2.transform(se2.inverse(poses[drive.seen_from]), landmarks[drive.seen])
    sighting = (seen - drive.sightings) / drive.sighting_sigmas

    n, k, m = drive.pose_count, drive.landmark_count, len(drive.seen)
    here, there = np.zeros((n - 1, 3, 3)), np.zeros((n - 1, 3, 3))
    here[:, :2], there[:, :2, :2] = displacement_jacobians(poses[:-1, 2], moved[:, :2], drive.motion_sigmas[:, :2])
    there[:, 2, 2] = 1 / drive.motion_sigmas[:, 2]
    here[:, 2, 2] = -there[:, 2, 2]
    by_pose, by_landmark = displacement_jacobians(poses[drive.seen_from, 2], seen, drive.sighting_sigmas)
    of_motions, of_sightings = 3 * np.arange(n - 1), 3 * (n - 1) + 2 * np.arange(m)
    blocks = (
        (of_motions, 3 * np.arange(n - 1), here),
        (of_motions, 3 * np.arange(1, n), there),
        (of_sightings, 3 * drive.seen_from, by_pose),
        (of_sightings, 3 * n + 2 * drive.seen, by_landmark),
    )
    jacobian = assemble(blocks, (3 * (n - 1) + 2 * m, 3 * n + 2 * k))
    return np.concatenate([motion.ravel(), sighting.ravel()]), jacobian[:, 3:]


def displacement_jacobians(theta: Array, displacement: Array, sigmas: Array) -> tuple[Array, Array]:
    """Of ``displacement / sigma``, displacement = R(theta)' (q - t): by (t, theta) (m, 2, 3), by q (m, 2, 2)."""
    by_q = np.swapaxes(se2.rotation(theta), -1, -2) / sigmas[:, :, None]
    by_theta = np.stack([displacement[:, 1], -displacement[:, 0]], axis=1) / sigmas
    return np.concatenate([-by_q, by_theta[:, :, None]], axis=2), by_q


def assemble(blocks: tuple[tuple[Indices, Indices, Array], ...], shape: tuple[int, int]) -> csr_array:
    """A sparse matrix of small dense blocks (b, r, c), each with the row and column of its first entry."""
    rows, columns, values = [], [], []
    for row, column, block in blocks:
        r = row[:, None, None] + np.arange(block.shape[1])[:, None]
        c = column[:, None, None] + np.arange(block.shape[2])
        r, c = np.broadcast_arrays(r, c)
        rows.append(r.ravel())
        columns.append(c.ravel())
        values.append(block.ravel())
    triples = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return coo_array(triples, shape=shape).tocsr()


def factorised(jacobian: csr_array, damping: float) -> SuperLU:
    """Factors of ``J'J`` with its diagonal enlarged by ``damping``.

    Without pivoting and with a symmetric order the pivots are those of Cholesky: one that isn't positive says that
    the measurements leave something open.
    """
    information = csc_array(jacobian.T @ jacobian)
    diagonal = information.diagonal()
    information = csc_array(information + diags_array(damping * diagonal))
    undetermined = "the drive's measurements don't determine all poses and landmarks"
    try:
        factors = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise UndeterminedError(undetermined) from error
    if not np.all(factors.U.diagonal() > _SINGULAR * diagonal[np.argsort(factors.perm_c)]):
        raise UndeterminedError(undetermined)
    return factors


def _landmark_covariance(drive: Drive, state: _State) -> Array:
    """Joint covariance (2k, 2k) of all landmarks: their block of the inverse of ``J'J``."""
    _, jacobian = _linearise(drive, state.poses, state.landmarks)
    size, poses = 2 * drive.landmark_count, 3 * (drive.pose_count - 1)
    unit = np.zeros((poses + size, size))
    unit[poses:] = np.eye(size)
    covariance = factorised(jacobian, 0.0).solve(unit)[poses:] if size else np.zeros((0, 0))
    return np.asarray((covariance + covariance.T) / 2, dtype=float)
