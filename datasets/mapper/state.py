"""The smoothed estimate as a filter's state: x, covariance, and where each landmark stands in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .joining import copied, direction_of
from .linear import FIRST_NODE
from .memory import Known
from .smooth import Smoothed, arm_starts

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class JointState:
    """Mean ``x`` (n,) and covariance ``P`` (n, n): pose, systematic errors, north, bends, then each landmark's x, y
    and direction. ``landmarks`` are copies that know their rows; ``node_rows``: those of the bends."""

    x: Array
    P: Array
    landmarks: dict[int, Known]
    node_rows: list[int]


def joint_state(smoothed: Smoothed, landmarks: Sequence[Known]) -> JointState:
    """The state that a filter goes on with; a landmark's direction is the mean of what its arms say."""
    e, size = smoothed.estimate, len(smoothed.covariance)
    landmark_at = FIRST_NODE + len(e.bends)
    arm_at = landmark_at + 2 * len(e.landmarks)
    starts = arm_starts(landmarks)
    values = [*e.poses[-1].tolist(), *e.systematic.tolist(), e.north, *e.bends.tolist()]
    rows = [np.eye(size)[:landmark_at]]
    new: dict[int, Known] = {}
    for k, landmark in enumerate(landmarks):
        own = copied(landmark)
        new[own.key] = own
        own.at = len(values)
        values += e.landmarks[k].tolist()
        rows.append(_picked(size, [landmark_at + 2 * k, landmark_at + 2 * k + 1]))
        if own.turn is None:
            continue
        arms = e.arms[starts[k] : starts[k + 1]]
        direction = direction_of(own, arms)
        for arm, towards in zip(own.arms, arms, strict=True):
            arm.off = float(towards - direction)
        own.turn = len(values)
        values.append(direction)
        columns = list(range(arm_at + starts[k], arm_at + starts[k + 1]))
        rows.append(_picked(size, columns).mean(axis=0, keepdims=True))
    J = np.concatenate(rows)
    P = J @ smoothed.covariance @ J.T
    return JointState(np.array(values), (P + P.T) / 2, new, list(range(FIRST_NODE, landmark_at)))


def _picked(size: int, columns: list[int]) -> Array:
    out = np.zeros((len(columns), size))
    out[np.arange(len(columns)), columns] = 1.0
    return out
