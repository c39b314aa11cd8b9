"""A map's joint covariance in the datum of its own landmarks, instead of that of where its robot started.

A robot's map is exact where it started, and all that lies far from there shares an error of direction. Two maps are
laid on each other by a transformation that is free anyway, so that this shared error says nothing of how they fit; but
where it is large (0.1 rad and more) a Gaussian over coordinates takes it wrong: along the tangent a turn by delta
stretches the map by 1 / cos(delta), so that maps whose scales differ seem to be turned. Baarda's S-transformation
(1973) takes the rigid motion out: with P the projector on what no rigid motion of all landmarks makes, the covariance
becomes P C P'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .maps import JointCovariance, LandmarkMap

Array = NDArray[np.float64]


def in_own_datum(map_: LandmarkMap) -> LandmarkMap:
    """The map with the joint covariance of its landmarks among each other; as it is where it has none.

    What is lost is how well the robot's start is known in the map: fuse such maps for their landmarks, not for T12.
    Positions stay; covariances of single landmarks, which the joint one overrules, too.

    >>> from mapfuse.datasets.maps import Landmark
    >>> landmarks = tuple(Landmark(f"p{k}", "tree", float(k), 0.0) for k in (1, 2, 3))
    >>> turn = np.array([0.0, 1.0, 0.0, 2.0, 0.0, 3.0])  # each is off sideways by its distance from the start
    >>> joint = JointCovariance(("p1", "p2", "p3"), 2, 0.01 * np.outer(turn, turn))
    >>> among = in_own_datum(LandmarkMap("m", landmarks, joint_covariance=joint)).joint_covariance
    >>> bool(np.abs(among.matrix).max() < 1e-12)  # a turn is all it was
    True
    """
    joint = map_.joint_covariance
    if joint is None or len(joint.order) < 2:
        return map_
    P = _projector(map_, joint)
    C = P @ joint.matrix @ P.T
    return map_.replace(joint_covariance=JointCovariance(joint.order, joint.rows, (C + C.T) / 2, joint.extra))


def _projector(map_: LandmarkMap, joint: JointCovariance) -> Array:
    """What takes the best rigid motion, by positions, out of an error of the joint covariance's numbers."""
    n, rows = len(joint.order), joint.rows
    p = map_.positions[[map_.index_from_id[i] for i in joint.order]]
    p = p - p.mean(axis=0)
    G = np.zeros((n, rows, 3))
    G[:, 0, 0] = G[:, 1, 1] = 1
    G[:, 0, 2], G[:, 1, 2] = -p[:, 1], p[:, 0]
    if rows == 3:
        G[:, 2, 2] = 1
    seen = G.copy()
    seen[:, 2:] = 0  # headings follow the motion, but don't say which it is
    fitted = np.linalg.lstsq(seen.reshape(-1, 3), np.eye(n * rows), rcond=None)[0]
    return np.eye(n * rows) - G.reshape(-1, 3) @ fitted
