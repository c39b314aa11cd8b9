"""Joint covariance: one Gaussian over all landmarks of a map that carries one (measurement model, row 8).

The residual is in the map's own axes, ``T_r^-1`` applied to each landmark less its recorded pose, so it is exact under
any rotation of ``T_r``; a turn that all landmarks have in common is told as a turn (`turning`). It has no native
factor: a ``gtsam.CustomFactor`` with analytic Jacobians, one Python call per iteration. GTSAM crashes where such a
factor leaves its Jacobians unfilled and takes wrong shapes in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.maps import JointCovariance, LandmarkMap
from mapfuse.datasets.values import frozen_array, rebuilt, same_fields

from .heading import headings_of
from .keys import FrameKey, KeyBook, LandmarkKey, Unknown
from .measurement import Array, Poses, squared_error
from .noise import floored_eigen
from .turning import derivatives, errors, pivot, seen_jacobians


@dataclass(frozen=True, eq=False, slots=True)
class JointMeasurement:
    """Landmarks' poses (n, 3) seen from their map's ``frame``, with a joint square root information.

    ``recorded`` (n, 3): x, y [m], theta [rad]. ``places`` (m,): which of the 3n numbers, landmark by landmark, are
    measured. ``sqrt_information`` (m, m): W with ``W' W = C^-1``. ``pivot`` (2,) [m]: about which they turn.
    """

    frame: FrameKey
    landmarks: tuple[LandmarkKey, ...]
    recorded: Array
    places: tuple[int, ...]
    sqrt_information: Array
    pivot: Array

    def __post_init__(self) -> None:
        for name in ("recorded", "sqrt_information", "pivot"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        n, m = len(self.landmarks), len(self.places)
        if self.recorded.shape != (n, 3) or self.sqrt_information.shape != (m, m):
            raise MapfuseError(f"a joint measurement of {n} landmarks and {m} numbers has arrays of other shapes")
        if not (np.isfinite(self.recorded).all() and np.isfinite(self.sqrt_information).all()):
            raise MapfuseError("a joint measurement has numbers that are not finite")

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.frame, self.landmarks, self.places))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The frame, then the landmarks."""
        return self.frame, *self.landmarks

    @property
    def rows(self) -> int:
        """How many numbers its residual has."""
        return len(self.places)

    @property
    def readings(self) -> float:
        """How many independent numbers it stands for."""
        return float(len(self.places))

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor [nats]."""
        log_det = float(np.linalg.slogdet(self.sqrt_information)[1])
        return log_det - len(self.places) / 2 * float(np.log(2 * np.pi))

    def residual(self, poses: Poses) -> Array:
        """The whitened residual (m,)."""
        return self._whitened(poses[self.frame], np.array([poses[key] for key in self.landmarks]))

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2`` [nats]."""
        return squared_error(self.residual(poses), None)

    def _whitened(self, T: Array, landmarks: Array) -> Array:
        off = errors(self.recorded, self.pivot, np.asarray(se2.between(T, landmarks)))
        return np.asarray(self.sqrt_information @ off.reshape(-1)[list(self.places)])

    def jacobians(self, T: Array, landmarks: Array) -> tuple[Array, Array]:
        """Of the residual by the body tangents of the frame (m, 3) and of each landmark (n, m, 3)."""
        n, places = len(landmarks), list(self.places)
        seen = np.asarray(se2.between(T, landmarks))
        R, lever, gradient = derivatives(self.recorded, self.pivot, seen)
        by_frame, by_landmark = seen_jacobians(seen)
        # the turn, which depends on all of them
        levers = np.zeros((n, 3))
        levers[:, :2] = lever
        turned = self.sqrt_information @ levers.reshape(-1)[places]
        turn_by_frame = np.einsum("ni,nij->j", gradient, by_frame[:, :2])
        turn_by_landmark = np.einsum("ni,nij->nj", gradient, by_landmark[:, :2])
        by_frame[:, :2], by_landmark[:, :2] = R @ by_frame[:, :2], R @ by_landmark[:, :2]
        whole = turned[None, :, None] * turn_by_landmark[:, None, :]
        columns: list[list[int]] = [[] for _ in range(n)]
        for column, place in enumerate(places):
            columns[place // 3].append(column)
        for i, own in enumerate(columns):
            rows = [places[column] % 3 for column in own]
            whole[i] += self.sqrt_information[:, own] @ by_landmark[i][rows]
        frame = self.sqrt_information @ by_frame.reshape(-1, 3)[places] + np.outer(turned, turn_by_frame)
        return frame, whole

    def factor(self, keys: KeyBook) -> Any:
        """A ``CustomFactor`` on the frame and the landmarks."""
        frame, *landmarks = keys.keys(self.unknowns)

        def residual(_: Any, values: Any, jacobians: Any) -> Array:
            T = _pose(values, frame)
            poses = np.array([_pose(values, key) for key in landmarks])
            if jacobians is not None:
                by_frame, by_landmark = self.jacobians(T, poses)
                jacobians[0] = np.asfortranarray(by_frame)
                for k, block in enumerate(by_landmark, start=1):
                    jacobians[k] = np.asfortranarray(block)
            return self._whitened(T, poses)

        model = gtsam.noiseModel.Unit.Create(len(self.places))
        return gtsam.CustomFactor(model, [frame, *landmarks], residual)


def _pose(values: Any, key: int) -> Array:
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def joint_measurement(recorded: LandmarkMap, r: int) -> JointMeasurement | None:
    """The joint covariance of map ``r`` as a measurement; None where it has none or that of no landmark.

    A singular covariance is allowed (a merged map's own frame is known exactly): eigenvalues are raised to
    `noise.TIGHT` squared. Of a landmark without heading the third row is left out.

    Raises `MapError` where ``order`` names a landmark that the map doesn't have, or one twice, or the matrix isn't
    a covariance of that size.
    """
    joint = recorded.joint_covariance
    if joint is None or not joint.order:
        return None
    _check(recorded, joint.order, joint.rows, joint.matrix.shape)
    landmarks = [recorded[name] for name in joint.order]
    headings = [headings_of(recorded)[name] for name in joint.order]
    poses = np.array([(l.x, l.y, h or 0.0) for l, h in zip(landmarks, headings, strict=True)])
    kept = [(i, row) for i, h in enumerate(headings) for row in range(joint.rows) if row < 2 or h is not None]
    rows = [i * joint.rows + row for i, row in kept]
    try:
        values, vectors = floored_eigen(joint.matrix[np.ix_(rows, rows)])
    except MapfuseError as error:
        raise MapError(recorded.name, (Problem("joint_covariance.matrix", str(error)),)) from error
    W = (vectors / np.sqrt(values)).T
    keys = tuple(LandmarkKey(r, name) for name in joint.order)
    about = pivot_of(recorded, joint)
    return JointMeasurement(FrameKey(r), keys, poses, tuple(3 * i + row for i, row in kept), W, about)


def pivot_of(recorded: LandmarkMap, joint: JointCovariance) -> Array:
    """The point (2,) [m, map frame] about which the landmarks of a map's joint covariance turn (`turning.pivot`)."""
    positions = [(recorded[name].x, recorded[name].y) for name in joint.order]
    rows = (joint.rows * np.arange(len(joint.order))[:, None] + np.arange(2)).ravel()
    return pivot(positions, joint.matrix[np.ix_(rows, rows)])


def _check(recorded: LandmarkMap, order: Sequence[str], rows: int, shape: tuple[int, ...]) -> None:
    strangers = [name for name in order if name not in recorded.index_from_id]
    reasons = []
    if strangers:
        reasons.append(Problem("joint_covariance.order", f"names {strangers[0]!r}, which is not in the map"))
    if len(set(order)) < len(order):
        reasons.append(Problem("joint_covariance.order", "names a landmark twice"))
    if rows not in (2, 3) or shape != (rows * len(order), rows * len(order)):
        reasons.append(Problem("joint_covariance.matrix", f"is {shape}, not {rows} rows for each landmark"))
    if reasons:
        raise MapError(recorded.name, tuple(reasons))
