"""The middle lines of free space as a graph: nodes where lines end or meet, ways between them as rows of points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..simulation.corridorgraph import chains
from .cleaning import Space

Array = NDArray[np.float64]


@dataclass(eq=False, slots=True)
class Way:
    """A way from node ``start`` to node ``end``: ``points`` (k, 2), ``clearance`` and ``to_wall`` (k,) [m]."""

    start: int
    end: int
    points: Array
    clearance: Array
    to_wall: Array
    length: float = field(init=False)

    def __post_init__(self) -> None:
        self.measure()

    def measure(self) -> None:
        """Work out the length [m] along the points again, after they have been changed."""
        steps = self.points[1:] - self.points[:-1]
        self.length = float(np.hypot(steps[:, 0], steps[:, 1]).sum())

    def turned(self) -> Way:
        """The same way from its end to its start."""
        return Way(self.end, self.start, self.points[::-1], self.clearance[::-1], self.to_wall[::-1])

    def part(self, first: int, last: int, start: int, end: int) -> Way:
        """The piece from point ``first`` to point ``last``, both in it, between other nodes."""
        cut = slice(first, last + 1)
        return Way(start, end, self.points[cut], self.clearance[cut], self.to_wall[cut])

    def and_then(self, other: Way) -> Way:
        """This way and one that begins where it ends."""
        return Way(
            self.start,
            other.end,
            np.vstack([self.points, other.points[1:]]),
            np.append(self.clearance, other.clearance[1:]),
            np.append(self.to_wall, other.to_wall[1:]),
        )

    def from_node(self, node: int) -> Way:
        """The way seen from one of its ends."""
        return self if node == self.start else self.turned()


@dataclass(eq=False, slots=True)
class WayGraph:
    """Nodes with position and clearance [m], ways between them, and which nodes are doorways."""

    xy: dict[int, Array]
    clearance: dict[int, float]
    ways: list[Way]
    doors: set[int] = field(default_factory=set)

    def at(self, node: int) -> list[Way]:
        """The ways at a node, each from there; one that leads back to it comes twice."""
        return [way.from_node(node) for way in self.ways if node in (way.start, way.end)] + [
            way.turned() for way in self.ways if way.start == way.end == node
        ]

    def degrees(self) -> dict[int, int]:
        """Number of way ends at each node."""
        count = dict.fromkeys(self.xy, 0)
        for way in self.ways:
            count[way.start] += 1
            count[way.end] += 1
        return count


def skeleton_graph(space: Space, resolution: float) -> WayGraph:
    """The skeleton of free space as a graph, in metres from the middle of cell (0, 0) of ``space``; x along columns."""
    from skimage.morphology import medial_axis

    bones = np.argwhere(medial_axis(space.free, rng=0))
    index = np.full(space.free.shape, -1, dtype=np.intp)
    index[tuple(bones.T)] = np.arange(len(bones))
    edges = neighbours(index)
    xy = bones[:, ::-1] * resolution
    clearance, to_wall = space.clearance[tuple(bones.T)], space.to_wall[tuple(bones.T)]
    graph = WayGraph({}, {}, [])
    runs = chains(edges)
    for run in runs:
        graph.ways.append(Way(run[0], run[-1], xy[run].astype(float), clearance[run], to_wall[run]))
        for node in (run[0], run[-1]):
            graph.xy[node], graph.clearance[node] = xy[node].astype(float), float(clearance[node])
    return graph


def neighbours(index: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Pairs of neighbouring skeleton cells; diagonal ones only where no third cell joins them."""
    found = []
    here = np.pad(index, 1, constant_values=-1)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = here[1:-1, 1:-1]
        b = here[1 + down : here.shape[0] - 1 + down, 1 + right : here.shape[1] - 1 + right]
        both = (a >= 0) & (b >= 0)
        if down and right:
            beside = here[1:-1, 1 + right : here.shape[1] - 1 + right]
            below = here[1 + down : here.shape[0] - 1 + down, 1:-1]
            both &= (beside < 0) & (below < 0)
        found.append(np.stack([a[both], b[both]], axis=1))
    return [(int(a), int(b)) for a, b in np.concatenate(found)]
