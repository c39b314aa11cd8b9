"""Walls of two maps that face each other (measurement model, row 12): what one wall's offset from the other measures.

A wall hangs on a keyframe of the drive that saw it. Where landmarks lie says where that keyframe lies, up to errors of
its own, both by the map's joint covariance: with D a map's landmarks less what it recorded of them, in its own frame,
the keyframe is off by ``G D`` and by an error of covariance Q, ``G = C_kl C_ll^-1``, ``Q = C_kk - G C_lk``. Both are
errors beside the turn that all have in common (`turning`). Keyframes so need no unknowns of their own: walls measure
landmarks. All offsets of two maps are one measurement, since they share the errors of keyframes and of walls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import Keyframes, LandmarkMap
from mapfuse.datasets.values import frozen_array, rebuilt, same_fields

from .heading import headings_of
from .joint import pivot_of
from .keys import FrameKey, KeyBook, LandmarkKey, Unknown, map_keys
from .measurement import Array, Poses, squared_error
from .noise import floored_eigen
from .turning import QUARTER, derivatives, errors, placed, seen_jacobians, turn


@dataclass(frozen=True, eq=False, slots=True)
class Hanging:
    """How one map's keyframes hang on its landmarks.

    ``landmarks``: those of the joint covariance, in its order; ``recorded`` (n, 3): where it has them. ``places`` (m,):
    which of the 3n numbers have rows in it. ``keyframes`` (k, 3): recorded poses [m, m, rad]; ``by_landmarks``
    (3k, m): G; ``alone`` (3k, 3k): Q. ``pivot`` (2,): about which all turn.
    """

    frame: FrameKey
    landmarks: tuple[LandmarkKey, ...]
    recorded: Array
    places: tuple[int, ...]
    keyframes: Array
    by_landmarks: Array
    alone: Array
    pivot: Array

    def __post_init__(self) -> None:
        for name in ("recorded", "keyframes", "by_landmarks", "alone", "pivot"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.frame, self.landmarks))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def _seen(self, poses: Poses) -> Array:
        return np.asarray(se2.between(poses[self.frame], np.array([poses[key] for key in self.landmarks])))

    def moved(self, poses: Poses) -> Array:
        """Where the landmarks put the keyframes, in the map's frame (k, 3)."""
        seen = self._seen(poses)
        off = self.by_landmarks @ errors(self.recorded, self.pivot, seen).reshape(-1)[list(self.places)]
        return placed(self.keyframes, self.pivot, off.reshape(-1, 3), turn(self.recorded[:, :2], seen[:, :2])[0])

    def jacobians(self, poses: Poses) -> tuple[Array, Array]:
        """Of `moved` by the body tangents of the frame (3k, 3) and of each landmark (3k, 3n)."""
        seen = self._seen(poses)
        n, k = len(seen), len(self.keyframes)
        by_frame, by_landmark = seen_jacobians(seen)
        of_each = np.zeros((n, 3, n, 3))
        of_each[range(n), :, range(n)] = by_landmark
        both = np.concatenate([by_frame, of_each.reshape(n, 3, 3 * n)], axis=2)
        # of the errors by the tangents, then of the keyframes by the errors and the turn
        R, lever, gradient = derivatives(self.recorded, self.pivot, seen)
        by_turn = np.einsum("ni,nij->j", gradient, both[:, :2])
        both[:, :2] = R @ both[:, :2] + lever[:, :, None] * by_turn
        off = self.by_landmarks @ errors(self.recorded, self.pivot, seen).reshape(-1)[list(self.places)]
        moved = (self.by_landmarks @ both.reshape(3 * n, -1)[list(self.places)]).reshape(k, 3, -1)
        f = turn(self.recorded[:, :2], seen[:, :2])[0]
        straight = off.reshape(-1, 3)[:, :2] - f * (self.keyframes[:, :2] - self.pivot) @ QUARTER.T
        moved[:, :2] = R.T @ moved[:, :2] + (straight @ (R @ QUARTER.T))[:, :, None] * by_turn
        whole = moved.reshape(3 * k, -1)
        return whole[:, :3], whole[:, 3:]


def keyframes_of(recorded: LandmarkMap) -> Keyframes:
    """The keyframes in a map's joint covariance; none, where it has none."""
    joint = recorded.joint_covariance
    if joint is None or joint.keyframes is None:
        return Keyframes(np.zeros((0, 3)), np.zeros((0, 5)), np.zeros((0, 0)), np.zeros((0, 0)))
    return joint.keyframes


def hanging(recorded: LandmarkMap, r: int) -> Hanging | None:
    """How map ``r``'s keyframes hang on its landmarks; None where its joint covariance has none.

    A singular covariance is allowed: eigenvalues are raised as those of the joint measurement are.
    """
    joint, keyframes = recorded.joint_covariance, keyframes_of(recorded)
    if joint is None or not len(keyframes.poses) or not joint.order:
        return None
    keys, of = map_keys(recorded, r), headings_of(recorded)
    poses = np.array([(recorded[name].x, recorded[name].y, of[name] or 0.0) for name in joint.order])
    kept = [
        (i, row) for i, name in enumerate(joint.order) for row in range(joint.rows) if row < 2 or of[name] is not None
    ]
    rows = [i * joint.rows + row for i, row in kept]
    values, vectors = floored_eigen(joint.matrix[np.ix_(rows, rows)])
    cross = keyframes.with_landmarks[:, rows]
    by_landmarks = (cross @ vectors) / values @ vectors.T
    alone = keyframes.matrix - by_landmarks @ cross.T
    values, vectors = np.linalg.eigh((alone + alone.T) / 2)
    alone = (vectors * np.maximum(values, 0.0)) @ vectors.T
    landmarks = tuple(keys.landmarks[name] for name in joint.order)
    places = tuple(3 * i + row for i, row in kept)
    about = pivot_of(recorded, joint)
    return Hanging(keys.frame, landmarks, poses, places, keyframes.poses, by_landmarks, alone, about)


@dataclass(frozen=True, eq=False, slots=True)
class Facing:
    """Places where a wall of map 1 faces one of map 2; arrays over k places.

    ``points1``, ``points2`` (k, 2) [m]: on the one and on the other, each in the frame of its keyframe; ``at1``,
    ``at2`` (k,): that keyframe. ``normals`` (k, 2): of the wall of map 1, in the frame of its keyframe.
    """

    points1: Array
    points2: Array
    at1: Any
    at2: Any
    normals: Array

    def __post_init__(self) -> None:
        for name in ("points1", "points2", "normals"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash(len(self.points1))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def __len__(self) -> int:
        return len(self.points1)

    def only(self, kept: Any) -> Facing:
        """Some of the places."""
        return Facing(self.points1[kept], self.points2[kept], self.at1[kept], self.at2[kept], self.normals[kept])


@dataclass(frozen=True, eq=False, slots=True)
class WallMeasurement:
    """How far walls of map 2 lie off walls of map 1 along these walls' normals: 0, up to their errors.

    ``sqrt_information`` (k, k): W with ``W' W`` the inverse of the offsets' covariance beyond the landmarks' own.
    """

    side1: Hanging
    side2: Hanging
    facing: Facing
    sqrt_information: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "sqrt_information", frozen_array(self.sqrt_information))
        k = len(self.facing)
        if self.sqrt_information.shape != (k, k) or not np.isfinite(self.sqrt_information).all():
            raise MapfuseError(f"a measurement by {k} places of walls needs a finite square root of as many rows")

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.side1, self.side2, self.facing))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Both frames, then the landmarks of map 1, then those of map 2."""
        return self.side1.frame, self.side2.frame, *self.side1.landmarks, *self.side2.landmarks

    @property
    def rows(self) -> int:
        """How many numbers its residual has."""
        return len(self.facing)

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor [nats]."""
        return float(np.linalg.slogdet(self.sqrt_information)[1]) - len(self.facing) / 2 * float(np.log(2 * np.pi))

    def residual(self, poses: Poses) -> Array:
        """The whitened offsets (k,)."""
        return np.asarray(self.sqrt_information @ offsets(self.side1, self.side2, self.facing, poses))

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2`` [nats]."""
        return squared_error(self.residual(poses), None)

    def factor(self, keys: KeyBook) -> Any:
        """A ``CustomFactor`` on both frames and all landmarks."""
        unknowns = self.unknowns
        numbers = keys.keys(unknowns)

        def residual(_: Any, values: Any, jacobians: Any) -> Array:
            poses = {unknown: _pose(values, key) for unknown, key in zip(unknowns, numbers, strict=True)}
            if jacobians is not None:
                J = self.sqrt_information @ offset_jacobian(self.side1, self.side2, self.facing, poses)
                for place in range(len(unknowns)):
                    jacobians[place] = np.asfortranarray(J[:, 3 * place : 3 * place + 3])
            return self.residual(poses)

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(self.facing)), numbers, residual)


def _pose(values: Any, key: int) -> Array:
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def offsets(side1: Hanging, side2: Hanging, facing: Facing, poses: Poses) -> Array:
    """Offsets (k,) [m] of map 2's walls from map 1's along the normals, under ``poses``."""
    n, difference = _placed(side1, side2, facing, poses)[:2]
    return np.asarray(np.einsum("ki,ki->k", n, difference))


def _placed(side1: Hanging, side2: Hanging, facing: Facing, poses: Poses) -> tuple[Array, Array, Array, Array]:
    """Normals, differences (k, 2), and the keyframes of map 1, of map 2 (k, 3), all in the frame of map 1."""
    T12 = se2.between(poses[side1.frame], poses[side2.frame])
    k1 = side1.moved(poses)[facing.at1]
    k2 = np.asarray(se2.compose(T12, side2.moved(poses)))[facing.at2]
    p1, p2 = se2.transform(k1, facing.points1), se2.transform(k2, facing.points2)
    n = np.einsum("kij,kj->ki", se2.rotation(k1[:, 2]), facing.normals)
    return n, p2 - p1, k1, k2


def keyframe_jacobians(side1: Hanging, side2: Hanging, facing: Facing, poses: Poses) -> tuple[Array, Array]:
    """Of the offsets by what map 1's (k, 3 k1) and map 2's (k, 3 k2) keyframes are off by in their maps' frames."""
    n, difference, k1, k2 = _placed(side1, side2, facing, poses)
    T12 = se2.between(poses[side1.frame], poses[side2.frame])
    k, rows = len(facing), np.arange(len(facing))
    J1, J2 = np.zeros((k, len(side1.keyframes), 3)), np.zeros((k, len(side2.keyframes), 3))
    p1, p2 = se2.transform(k1, facing.points1), se2.transform(k2, facing.points2)
    # n turns with the keyframe of map 1, as does p1 about it
    J1[rows, facing.at1, :2] = -n
    J1[rows, facing.at1, 2] = _cross(n, difference) - _cross_lever(n, p1 - k1[:, :2])
    J2[rows, facing.at2, :2] = n @ se2.rotation(float(T12[2]))
    J2[rows, facing.at2, 2] = _cross_lever(n, p2 - k2[:, :2])
    return J1.reshape(k, -1), J2.reshape(k, -1)


def _cross(n: Array, d: Array) -> Array:
    """d/da of (R(a) n) . d at a = 0."""
    return np.asarray(n[:, 0] * d[:, 1] - n[:, 1] * d[:, 0])


def _cross_lever(n: Array, lever: Array) -> Array:
    """d/da of n . (R(a) lever) at a = 0."""
    return np.asarray(n[:, 1] * lever[:, 0] - n[:, 0] * lever[:, 1])


def offset_jacobian(side1: Hanging, side2: Hanging, facing: Facing, poses: Poses) -> Array:
    """Of the offsets by the body tangents of a `WallMeasurement`'s unknowns, in their order (k, 3 unknowns)."""
    by1, by2 = keyframe_jacobians(side1, side2, facing, poses)
    n, _, _, k2 = _placed(side1, side2, facing, poses)
    T12 = se2.between(poses[side1.frame], poses[side2.frame])
    p2 = se2.transform(k2, facing.points2)
    (frame1, landmarks1), (frame2, landmarks2) = side1.jacobians(poses), side2.jacobians(poses)
    # T12 = inv(T1) T2 by the tangents: of map 2 as it stands, of map 1 against it
    by_T2 = np.column_stack([n @ se2.rotation(float(T12[2])), _cross_lever(n, p2 - T12[:2])])
    by_T1 = np.column_stack([-n, -_cross_lever(n, p2)])
    return np.column_stack([by_T1 + by1 @ frame1, by_T2 + by2 @ frame2, by1 @ landmarks1, by2 @ landmarks2])
