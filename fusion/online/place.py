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

#: Landmarks by which a pose is corrected: the nearest ones.
MOST_NEAR = 12


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
    (Gaussian conditioning). Where the robot tells no covariance with landmarks, they don't move its pose.
    """
    said = segment.placed
    assert said is not None
    name = segment.name
    group = next(group for group in smoother.groups if name in group)
    recorded = segment.map()
    known = smoother.landmarks(name)
    order = [k for k, i in enumerate(said.order) if i in known and i in recorded.index_from_id]
    at = {k: recorded[said.order[k]] for k in order}
    order.sort(key=lambda k: (float(np.hypot(at[k].x - said.pose[0], at[k].y - said.pose[1])), said.order[k]))
    order = order[:MOST_NEAR]
    ids = [said.order[k] for k in order]
    T = smoother.frame(name).array
    own = _own_covariance(segment, ids) if ids else None
    if own is None:
        C = smoother.joint_covariance(name, ())[0]
        pose = np.asarray(se2.compose(T, said.pose))
        C = se2.compose_covariance(T, C, said.pose, said.covariance)
        return Place(segment.robot, group[0], Transform.from_array(pose, C), said.t)
    n = len(ids)
    cross = np.concatenate([said.cross[:, 2 * k : 2 * k + 2] for k in order], axis=1)
    G = np.linalg.solve(own, cross.T).T
    _, C = smoother.joint_covariance(name, ids)
    rows = np.array([0, 1, 2, *(3 + 3 * k + c for k in range(n) for c in range(2))])
    C = C[np.ix_(rows, rows)]
    shared = np.array([known[i][:2] for i in ids])
    seen = np.asarray(se2.transform(se2.inverse(T), shared))
    before = np.array([(at[k].x, at[k].y) for k in order])
    pose_own = said.pose + G @ (seen - before).reshape(-1)
    rest = said.covariance - G @ cross.T
    # l = R' (p - t): by t, theta and p
    R = se2.rotation(T[2])
    J = np.zeros((2 * n, 3 + 2 * n))
    for k in range(n):
        J[2 * k : 2 * k + 2, :2] = -R.T
        J[2 * k : 2 * k + 2, 2] = (seen[k, 1], -seen[k, 0])
        J[2 * k : 2 * k + 2, 3 + 2 * k : 5 + 2 * k] = R.T
    by_T, by_own = se2.compose_jacobians(T, pose_own)
    whole = np.zeros((3, 3 + 2 * n))
    whole[:, :3] = by_T
    whole += by_own @ G @ J
    C = whole @ C @ whole.T + by_own @ rest @ by_own.T
    pose = np.asarray(se2.compose(T, pose_own))
    return Place(segment.robot, group[0], Transform.from_array(pose, (C + C.T) / 2), said.t)


def _own_covariance(segment: Segment, ids: list[str]) -> Array | None:
    """Covariance (2n, 2n) of these landmarks as the robot itself has it; None where it doesn't say."""
    joint = segment.map().joint_covariance
    if joint is None or not set(ids) <= set(joint.order):
        return None
    place = {name: k for k, name in enumerate(joint.order)}
    rows = np.array([joint.rows * place[i] + c for i in ids for c in range(2)], dtype=np.intp)
    return joint.matrix[np.ix_(rows, rows)] + 1e-9 * np.eye(len(rows))
