"""`PoseGraph`: poses of a few frames from relative poses between them, with their joint covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.transform import Transform

Array = NDArray[np.float64]

_ROUNDS, _CONVERGED = 30, 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class Edge:
    """``T`` (3,) takes frame ``b`` into frame ``a``; ``covariance`` (3, 3) in the axes of ``a``."""

    a: str
    b: str
    T: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Frames ``names`` tied by edges, solved by Gauss-Newton with the first one held at the origin.

    Small and dense: it holds the frames of one group of maps, not their landmarks. The edges count as independent,
    which they are not quite (two edges of one map share its drift): it gates cycles and gives starting values, and
    what is reported comes from the graph of landmarks.

    >>> step = Edge("a", "b", np.array([1.0, 0.0, 0.0]), np.eye(3))
    >>> graph = PoseGraph(("a", "b", "c"), (step, Edge("b", "c", np.array([1.0, 0.0, 0.0]), np.eye(3))))
    >>> graph.pose("c").tolist(), np.diag(graph.between("a", "c")[1]).tolist()
    ([2.0, 0.0, 0.0], [2.0, 3.0, 2.0])
    """

    names: tuple[str, ...]
    edges: Sequence[Edge] = ()

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    @cached_property
    def _solved(self) -> tuple[Array, Array]:
        """Poses (n, 3) and their joint covariance (3n, 3n), the first frame's being zero."""
        n = len(self.names)
        poses, information = self._start(), np.zeros((3 * n, 3 * n))
        for _ in range(_ROUNDS):
            information[:] = 0
            gradient = np.zeros(3 * n)
            for edge in self.edges:
                a, b = self._index[edge.a], self._index[edge.b]
                back = se2.inverse(poses[a])
                by_back, by_b = se2.compose_jacobians(back, poses[b])
                J = np.zeros((3, 3 * n))
                J[:, 3 * a : 3 * a + 3] = by_back @ se2.inverse_jacobian(poses[a])
                J[:, 3 * b : 3 * b + 3] = by_b
                off = se2.compose(back, poses[b]) - edge.T
                off[2] = se2.wrap(off[2])
                weighted = np.linalg.solve(edge.covariance, np.column_stack([J, off]))
                information += J.T @ weighted[:, :-1]
                gradient += J.T @ weighted[:, -1]
            if n < 2:
                break
            step = -np.linalg.solve(information[3:, 3:], gradient[3:])
            poses[1:] += step.reshape(-1, 3)
            poses[:, 2] = se2.wrap(poses[:, 2])
            if np.abs(step).max() < _CONVERGED:
                break
        covariance = np.zeros_like(information)
        if n > 1:
            covariance[3:, 3:] = np.linalg.inv(information[3:, 3:])
        return poses, covariance

    def _start(self) -> Array:
        """Every frame by the first edges that reach it; raises `MapfuseError` where none do."""
        poses = np.full((len(self.names), 3), np.nan)
        poses[0] = 0.0
        while np.isnan(poses).any():
            placed = 0
            for edge in self.edges:
                a, b = self._index[edge.a], self._index[edge.b]
                if np.isnan(poses[b, 0]) and not np.isnan(poses[a, 0]):
                    poses[b], placed = se2.compose(poses[a], edge.T), placed + 1
                elif np.isnan(poses[a, 0]) and not np.isnan(poses[b, 0]):
                    poses[a], placed = se2.compose(poses[b], se2.inverse(edge.T)), placed + 1
            if not placed:
                raise MapfuseError("the edges of a pose graph don't reach all its frames")
        return poses

    def pose(self, name: str) -> Array:
        """Pose (3,) of a frame in the first one."""
        return np.asarray(self._solved[0][self._index[name]])

    def transform(self, name: str) -> Transform:
        """Pose of a frame in the first one with its covariance."""
        rows = slice(3 * self._index[name], 3 * self._index[name] + 3)
        return Transform.from_array(self.pose(name), self._solved[1][rows, rows])

    def between(self, a: str, b: str) -> tuple[Array, Array]:
        """Pose (3,) of frame ``b`` in frame ``a``, and its covariance (3, 3)."""
        T_a, T_b = self.pose(a), self.pose(b)
        if a == b:
            return np.zeros(3), np.zeros((3, 3))
        back = se2.inverse(T_a)
        by_back, by_b = se2.compose_jacobians(back, T_b)
        J = np.zeros((3, len(self._solved[1])))
        k, m = 3 * self._index[a], 3 * self._index[b]
        J[:, k : k + 3] = by_back @ se2.inverse_jacobian(T_a)
        J[:, m : m + 3] = by_b
        return np.asarray(se2.compose(back, T_b)), se2.propagate(J, self._solved[1])
