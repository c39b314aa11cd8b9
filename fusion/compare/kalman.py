"""Kalman-style fusion of matched landmarks: the heuristic's matches as measurements of both maps and T12 at once.

The state is (T12, landmarks of map 1, landmarks of map 2), each map at its own optimum with its own joint covariance,
and T12 where the heuristic has it, hardly known. Of each match, ``p1 - T12 p2 = 0`` is a measurement with the noise of
one place recognised twice; one after the other goes into an extended Kalman filter (filterpy), unless it lies beyond
its chi-square gate. What is linearised once is never looked at again, and neither are the matches: that is the
difference from the optimised merge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.factors.correspondence import SAME_PLACE

from ..config import FuseConfig, chi2_gate
from ..prepared import PreparedMap, prepare
from .heuristic import merge_by_heuristic
from .method import Merge
from .rigid import merged_at

Array = NDArray[np.float64]

#: Standard deviations of the heuristic's T12 before any match is looked at [m, m, rad].
START_SIGMAS = (5.0, 5.0, np.deg2rad(30.0))
#: Landmarks of both maps together: an update costs the third power of their number.
MOST_LANDMARKS = 300


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where what stands in the state: T12 first."""

    n1: int
    n2: int

    @property
    def size(self) -> int:
        return 3 + 2 * (self.n1 + self.n2)

    def of1(self, i: int) -> slice:
        return slice(3 + 2 * i, 5 + 2 * i)

    def of2(self, j: int) -> slice:
        return slice(3 + 2 * (self.n1 + j), 5 + 2 * (self.n1 + j))


def merge_by_kalman(map1: LandmarkMap, map2: LandmarkMap, config: FuseConfig | None = None) -> Merge:
    """The heuristic's merge, refined by a Kalman filter; with a covariance and the chi-square of its innovations.

    Raises `TooLargeError` for more than `MOST_LANDMARKS` landmarks, and as the heuristic does.
    """
    config = config or FuseConfig()
    if len(map1) + len(map2) > MOST_LANDMARKS:
        raise TooLargeError(
            f"the Kalman filter would hold {len(map1) + len(map2)} landmarks, more than {MOST_LANDMARKS}"
        )
    start = merge_by_heuristic(map1, map2, config.matching)
    if start.decision != "merged" or start.T12 is None:
        return start
    m1, m2 = prepare(map1, config.solving), prepare(map2, config.solving)
    layout = _Layout(len(m1), len(m2))
    ekf = _filter(m1, m2, start.T12.array, layout)
    gate = float(chi2_gate(config.solving.gate_probability, 2))
    accepted: list[tuple[str, str]] = []
    chi2 = 0.0
    for a, b in start.correspondences:
        i, j = map1.index_from_id[a], map2.index_from_id[b]
        distance = _update(ekf, layout, i, j, gate)
        if distance <= gate:
            accepted.append((a, b))
            chi2 += distance
    x, P = ekf.x[:, 0], ekf.P
    T12 = Transform.from_array(x[:3], P[:3, :3])
    p1, p2 = x[3 : 3 + 2 * layout.n1].reshape(-1, 2), x[3 + 2 * layout.n1 :].reshape(-1, 2)
    landmarks = merged_at(map1, map2, p1, se2.transform(x[:3], p2), accepted)
    return Merge("merged", T12, tuple(accepted), landmarks, None, chi2, float(max(2 * len(accepted) - 3, 0)))


def _filter(m1: PreparedMap, m2: PreparedMap, T12: Array, layout: _Layout) -> Any:
    from filterpy.kalman import ExtendedKalmanFilter

    ekf = ExtendedKalmanFilter(dim_x=layout.size, dim_z=2)
    ekf.x = np.concatenate([T12, m1.positions.ravel(), m2.positions.ravel()])[:, None]
    P = np.zeros((layout.size, layout.size))
    P[:3, :3] = np.diag(np.square(START_SIGMAS))
    first, second = slice(3, 3 + 2 * layout.n1), slice(3 + 2 * layout.n1, layout.size)
    P[first, first], P[second, second] = _of_positions(m1), _of_positions(m2)
    ekf.P, ekf.R = P, SAME_PLACE**2 * np.eye(2)
    return ekf


def _of_positions(m: PreparedMap) -> Array:
    """Joint covariance (2n, 2n) of a map's positions."""
    rows = (3 * np.arange(len(m))[:, None] + np.arange(2)).ravel()
    return np.asarray(m.covariance[np.ix_(rows, rows)])


def _update(ekf: Any, layout: _Layout, i: int, j: int, gate: float) -> float:
    """Takes in that two landmarks are one, unless it lies beyond the gate; its squared Mahalanobis distance."""

    def jacobian(x: Array) -> Array:
        H = np.zeros((2, layout.size))
        by_T, by_point = se2.transform_jacobians(x[:3, 0], x[layout.of2(j), 0])
        H[:, :3], H[:, layout.of1(i)], H[:, layout.of2(j)] = -by_T, np.eye(2), -by_point
        return H

    def apart(x: Array) -> Array:
        return np.asarray(x[layout.of1(i)] - se2.transform(x[:3, 0], x[layout.of2(j), 0])[:, None])

    H, r = jacobian(ekf.x), -apart(ekf.x)
    distance = float((r.T @ np.linalg.solve(H @ ekf.P @ H.T + ekf.R, r))[0, 0])
    if distance <= gate:
        ekf.update(np.zeros((2, 1)), jacobian, apart)
        ekf.x[2] = se2.wrap(ekf.x[2])
    return distance
