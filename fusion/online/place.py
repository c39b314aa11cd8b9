"""Where a robot is in the frame that the maps share: its pose in its own map, given what the merge says of that map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform

from .segment import Segment
from .smoother import Smoother

Array = NDArray[np.float64]

#: Added to the landmarks' variances [m^2], so that two which are as one can be told apart.
FLOOR = 1e-9


@dataclass(frozen=True, slots=True)
class Place:
    """A robot's pose with covariance in the frame of the map ``frame_of``, as of time ``t`` [s]."""

    robot: str
    frame_of: str
    pose: Transform
    t: float


def placed_in(segment: Segment, smoother: Smoother) -> Place:
    """Its last pose in the frame of its group.

    With x the pose and l the landmarks in the robot's own frame, G = cov(x, l) cov(l)^-1 from the robot itself: where
    the joint solution has the landmarks elsewhere, the pose follows by G, and what is uncertain of x given l stays so
    (Gaussian conditioning). Where the robot names no landmarks, they don't move its pose.
    """
    said = segment.placed
    assert said is not None
    name = segment.name
    group = next(group for group in smoother.groups if name in group)
    known = smoother.landmarks(name)
    kept = [k for k, identifier in enumerate(said.order) if identifier in known]
    ids = [said.order[k] for k in kept]
    n = len(ids)
    P = said.covariance[np.ix_(_rows(kept), _rows(kept))]
    G = np.linalg.solve(P[3:, 3:] + FLOOR * np.eye(2 * n), P[3:, :3]).T
    rest = P[:3, :3] - G @ P[3:, :3]
    T = smoother.frame(name).array
    C = smoother.joint_covariance(name, ids)[1]
    rows = np.array([0, 1, 2, *(3 + 3 * k + c for k in range(n) for c in range(2))], dtype=np.intp)
    C = C[np.ix_(rows, rows)]
    shared = np.array([known[i][:2] for i in ids]).reshape(-1, 2)
    seen = np.asarray(se2.transform(se2.inverse(T), shared)).reshape(-1, 2)
    pose = said.pose + G @ (seen - said.positions[kept]).reshape(-1)
    # l = R' (p - t): by t, theta and p
    back = se2.rotation(T[2]).T
    J = np.zeros((2 * n, 3 + 2 * n))
    for k in range(n):
        J[2 * k : 2 * k + 2, :2] = -back
        J[2 * k : 2 * k + 2, 2] = (seen[k, 1], -seen[k, 0])
        J[2 * k : 2 * k + 2, 3 + 2 * k : 5 + 2 * k] = back
    by_T, by_pose = se2.compose_jacobians(T, pose)
    whole = by_pose @ G @ J
    whole[:, :3] += by_T
    C = whole @ C @ whole.T + by_pose @ rest @ by_pose.T
    return Place(segment.robot, group[0], Transform.from_array(se2.compose(T, pose), (C + C.T) / 2), said.t)


def _rows(kept: list[int]) -> list[int]:
    """Rows of the pose and of these landmarks in what the robot said."""
    return [0, 1, 2, *(3 + 2 * k + c for k in kept for c in range(2))]
