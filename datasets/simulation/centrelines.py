"""Centre lines of corridors from walls alone, for plans that have no ways drawn in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import TooLargeError
from .corridorgraph import chains, simplified
from .raycast import clear

Array = NDArray[np.float64]

#: Walls are looked at every so many metres, and a robot needs this much room [m] to either side.
SPACING, ROOM = 0.1, 0.3
#: A point is on a centre line where the two walls nearest to it lie further apart than this many times its distance:
#: 2 between parallel walls, 1.41 on the diagonal of a room's corner, which is no way.
_ACROSS = 1.5
#: Doors further than this [m] from a centre line belong to another one.
_DOOR_REACH = 2.5
#: So much [m] of centre line runs straight up to a door that stands across a corridor; walls are so thick at most [m].
_RUN_UP, _THICK = 0.5, 0.3
#: Longer walls [m] are refused.
MAX_WALLS = 30_000.0


def centrelines(walls: Array, doors: Array, leaves: Array, door_of_leaf: NDArray[np.intp]) -> list[Array]:
    """Lines (k, 2) [m] midway between ``walls`` (n, 2, 2), of the one space that most ``doors`` (m, 2, 2) open to.

    Rooms are spaces of their own behind closed doors, and a corridor is the space that most doors open to. A door that
    stands across a corridor, with centre lines running up to it on both sides, is taken as open; of each door the
    ``leaves`` (l, 2, 2), with ``door_of_leaf`` (l,), are wall otherwise. The lines are the medial axis, from the
    Voronoi diagram of points on the walls, without its branches into corners (by the object angle: Attali and
    Montanvert, 1996). Empty where there is none.

    Raises `TooLargeError` above `MAX_WALLS` of walls.
    """
    vertices, ridges = _medial_axis(np.concatenate([walls, leaves]))
    if not len(ridges):
        return []
    bridges = [_bridge(door, vertices, ridges) for door in doors]
    across = np.array([bridge is not None for bridge in bridges], dtype=bool)
    for door, bridge in zip(doors, bridges, strict=True):
        if bridge is not None:
            vertices = np.vstack([vertices, door.mean(axis=0)])
            ridges = np.vstack([ridges, [(end, len(vertices) - 1) for end in bridge]])
    # imported here because scipy takes longer to import than the whole package does
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(ridges)), ridges.T), shape=(len(vertices), len(vertices)))
    part = connected_components(joined, directed=False)[1][ridges[:, 0]]
    closed = np.concatenate([walls, leaves[~across[door_of_leaf]]])
    best = _busiest(vertices[ridges], part, closed, doors[~across].mean(axis=1))
    edges = [(int(a), int(b)) for a, b in ridges[part == best] if a != b]
    return [simplified(vertices[run], SPACING / 2) for run in chains(edges)]


def _medial_axis(walls: Array) -> tuple[Array, NDArray[np.intp]]:
    """Vertices (v, 2) and edges (e, 2) of what lies midway between walls with `ROOM` to either side."""
    from scipy.spatial import QhullError, Voronoi

    points = _along(walls)
    nothing = np.zeros((0, 2)), np.zeros((0, 2), dtype=np.intp)
    if len(points) < 4:
        return nothing
    try:
        diagram = Voronoi(points)
    except QhullError:  # all walls on one line
        return nothing
    ridges, sides = np.asarray(diagram.ridge_vertices, dtype=np.intp), points[diagram.ridge_points]
    finite = (ridges >= 0).all(axis=1)
    ridges, sides = ridges[finite], sides[finite]
    ends = diagram.vertices[ridges]
    apart = np.hypot(*(sides[:, 0] - sides[:, 1]).T)
    clearance = np.hypot(*np.moveaxis(ends - sides[:, :1], -1, 0))
    kept = (clearance >= ROOM).all(axis=1) & (apart >= _ACROSS * clearance.max(axis=1))
    inside = ((ends >= points.min(axis=0)) & (ends <= points.max(axis=0))).all(axis=(1, 2))
    return np.asarray(diagram.vertices, dtype=float), ridges[kept & inside]


def _along(walls: Array) -> Array:
    """Distinct points on all walls, at most `SPACING` apart."""
    lengths = np.hypot(*(walls[:, 1] - walls[:, 0]).T)
    if lengths.sum() > MAX_WALLS:
        raise TooLargeError(f"{lengths.sum():,.0f} m of walls; at most {MAX_WALLS:,.0f} m are read without ways")
    found = [
        start + np.linspace(0, 1, int(np.ceil(length / SPACING)) + 1)[:, None] * (end - start)
        for (start, end), length in zip(walls, lengths, strict=True)
    ]
    return np.unique(np.round(np.vstack(found), 4), axis=0) if found else np.zeros((0, 2))


def _bridge(door: Array, vertices: Array, ridges: NDArray[np.intp]) -> tuple[int, int] | None:
    """The vertices before and behind a door (2, 2) if centre lines run straight up to it from both its sides."""
    middle, along = door.mean(axis=0), door[1] - door[0]
    width = float(np.hypot(*along))
    if width < 1e-6:
        return None
    along = along / width
    normal = np.array([-along[1], along[0]])
    lines = vertices[ridges]
    off, run = lines.mean(axis=1) - middle, lines[:, 1] - lines[:, 0]
    length = np.abs(run @ normal)
    straight = length >= 0.9 * np.hypot(run[:, 0], run[:, 1])
    ahead = straight & (np.abs(off @ along) < 0.7 * max(width, 1.0)) & (np.abs(off @ normal) < _DOOR_REACH)
    found = []
    for side in (-1, 1):
        ours = np.flatnonzero(ahead & (side * (off @ normal) > 0))
        if length[ours].sum() <= _RUN_UP:
            return None
        ends = ridges[ours].ravel()
        found.append(int(ends[np.argmin(np.hypot(*(vertices[ends] - middle).T))]))
    return found[0], found[1]


def _busiest(lines: Array, part: NDArray[np.int32], walls: Array, doors: Array) -> int:
    """The part of the ``lines`` (e, 2, 2) that most doors (m, 2) are seen from; of those, the longest."""
    length = np.bincount(part, weights=np.hypot(*(lines[:, 1] - lines[:, 0]).T))
    count = np.zeros(len(length))
    middles = lines.mean(axis=1)
    for door in doors:
        off = np.hypot(*(middles - door).T)
        for which in np.unique(part[off <= _DOOR_REACH]):
            ours = np.flatnonzero(part == which)
            nearest = ours[np.argmin(off[ours])]
            face = door + (middles[nearest] - door) * min(1.0, _THICK / off[nearest])
            count[which] += bool(clear(middles[nearest], face[None], walls)[0])
    return int(np.lexsort((length, count))[-1])
