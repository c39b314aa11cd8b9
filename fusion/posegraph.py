"""`PoseGraph`: poses of a few frames from relative poses between them, with their joint covariance."""

from __future__ import annotations

from collections import deque
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

    Dense: it holds the frames of one group of maps, not their landmarks. The edges count as independent,
    which they are not quite (two edges of one map share its drift): it gates cycles and gives starting values, and
    what is reported comes from the graph of landmarks. ``start`` (n, 3): where to begin, where that is known.

    >>> step = Edge("a", "b", np.array([1.0, 0.0, 0.0]), np.eye(3))
    >>> graph = PoseGraph(("a", "b", "c"), (step, Edge("b", "c", np.array([1.0, 0.0, 0.0]), np.eye(3))))
    >>> graph.pose("c").tolist(), np.diag(graph.between("a", "c")[1]).tolist()
    ([2.0, 0.0, 0.0], [2.0, 3.0, 2.0])
    """

    names: tuple[str, ...]
    edges: Sequence[Edge] = ()
    start: Array | None = None

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    @cached_property
    def solved(self) -> tuple[Array, Array]:
        """Poses (n, 3) and their joint covariance in blocks (n, n, 3, 3), the first frame's being zero."""
        n = len(self.names)
        poses, covariance = self._start() if self.start is None else self.start.copy(), np.zeros((n, n, 3, 3))
        if n < 2:
            return poses, covariance
        a, b = (np.array([self._index[getattr(edge, end)] for edge in self.edges], dtype=np.intp) for end in "ab")
        T, weight = np.array([e.T for e in self.edges]), np.linalg.inv([e.covariance for e in self.edges])
        for _ in range(_ROUNDS):
            back = se2.inverse(poses[a])
            by_back, by_b = se2.compose_jacobians(back, poses[b])
            by_a = by_back @ se2.inverse_jacobian(poses[a])
            off = se2.compose(back, poses[b]) - T
            off[:, 2] = se2.wrap(off[:, 2])
            blocks, gradient = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
            for i, J in ((a, by_a), (b, by_b)):
                weighed = np.swapaxes(J, 1, 2) @ weight
                np.add.at(gradient, i, np.einsum("eij,ej->ei", weighed, off))
                for j, other in ((a, by_a), (b, by_b)):
                    np.add.at(blocks, (i, j), weighed @ other)
            information = blocks.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)[3:, 3:]
            step = -np.linalg.solve(information, gradient[1:].ravel())
            poses[1:] += step.reshape(-1, 3)
            poses[:, 2] = se2.wrap(poses[:, 2])
            if np.abs(step).max() < _CONVERGED:
                break
        dense = np.linalg.inv(information).reshape(n - 1, 3, n - 1, 3)
        covariance[1:, 1:] = dense.transpose(0, 2, 1, 3)
        return poses, covariance

    def _start(self) -> Array:
        """Every frame by the first edges that reach it; raises `MapfuseError` where none do."""
        poses = np.zeros((len(self.names), 3))
        touching: list[list[Edge]] = [[] for _ in self.names]
        for edge in self.edges:
            touching[self._index[edge.a]].append(edge)
            touching[self._index[edge.b]].append(edge)
        reached, todo = {0}, deque([0])
        while todo:
            here = todo.popleft()
            for edge in touching[here]:
                a, b = self._index[edge.a], self._index[edge.b]
                there = b if here == a else a
                if there not in reached:
                    poses[there] = se2.compose(poses[here], edge.T if here == a else se2.inverse(edge.T))
                    reached.add(there)
                    todo.append(there)
        if len(reached) < len(self.names):
            raise MapfuseError("the edges of a pose graph don't reach all its frames")
        return poses

    def pose(self, name: str) -> Array:
        """Pose (3,) of a frame in the first one."""
        return np.asarray(self.solved[0][self._index[name]])

    def transform(self, name: str) -> Transform:
        """Pose of a frame in the first one with its covariance."""
        k = self._index[name]
        return Transform.from_array(self.pose(name), self.solved[1][k, k])

    def between(self, a: str, b: str) -> tuple[Array, Array]:
        """Pose (3,) of frame ``b`` in frame ``a``, and its covariance (3, 3)."""
        poses, blocks = self.solved
        i, j = self._index[a], self._index[b]
        if i == j:
            return np.zeros(3), np.zeros((3, 3))
        back = se2.inverse(poses[i])
        by_back, by_b = se2.compose_jacobians(back, poses[j])
        by_a = by_back @ se2.inverse_jacobian(poses[i])
        cross = by_a @ blocks[i, j] @ by_b.T
        covariance = se2.propagate(by_a, blocks[i, i]) + se2.propagate(by_b, blocks[j, j]) + cross + cross.T
        return np.asarray(se2.compose(back, poses[j])), np.asarray(covariance)
