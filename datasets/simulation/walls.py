"""Walls of a floor: the boundary of everything that its corridors cover, closed at every junction, corner and end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .floors import Floor, Place, bearing

Array = NDArray[np.float64]

#: An edge is wall where what lies this far [m] beside it, outside its own piece, is in no other piece.
_SKIN = 1e-7
#: Outer corners that reach further than this many half widths from their place are cut off there.
_LONGEST_MITRE = 1.5


@dataclass(frozen=True, eq=False, slots=True)
class _Piece:
    """A convex piece of the covered area: four corners (4, 2) counter-clockwise, and which of its edges may be wall.

    Edge i leads from corner i to the next one.
    """

    corners: Array
    wall_edges: tuple[int, ...]


def floor_walls(floor: Floor) -> Array:
    """Walls (n, 2, 2) [m, world] around the corridors, each ``floor.width`` wide; doors in them are closed.

    Outer corners are mitred (sharp ones cut off), dead ends closed half a width behind their place. Where corridors
    overlap, cross or pass close to each other, whatever lies inside another one is no wall: together the walls are the
    boundary of the union of all corridors, and no ray leads out.

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> floor_walls(floor_from_graph("I", [(0, 0), (8, 0)], [(0, 1)])).round(9).tolist()
    [[[-1.0, -1.0], [9.0, -1.0]], [[9.0, -1.0], [9.0, 1.0]], [[9.0, 1.0], [-1.0, 1.0]], [[-1.0, 1.0], [-1.0, -1.0]]]
    """
    pieces = [*_corridors(floor), *_outer_corners(floor)]
    if not pieces:
        return np.zeros((0, 2, 2))
    corners = np.array([piece.corners for piece in pieces])
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    walls: list[Array] = []
    for k, piece in enumerate(pieces):
        for i in piece.wall_edges:
            outside, within = _shifted(edges[k, i], -_SKIN), _shifted(edges[k, i], _SKIN)
            # where two pieces have the same edge, the first of them builds the wall
            covered = [_covered(outside, edges), _covered(within, edges[:k])]
            walls += _uncovered(edges[k, i], *(np.concatenate(shares) for shares in zip(*covered, strict=True)))
    return np.array(walls).reshape(-1, 2, 2)


def _shifted(edge: Array, by: float) -> Array:
    """The edge (2, 2), so far [m] to its left."""
    along = edge[1] - edge[0]
    return np.asarray(edge + by / np.hypot(*along) * np.array([-along[1], along[0]]), dtype=float)


def _ways(floor: Floor) -> dict[str, list[float]]:
    """Directions [rad] of the corridors that end at each place where one does."""
    ways: dict[str, list[float]] = {}
    for corridor in floor.corridors:
        a, b = (floor.place_from_id[i] for i in (corridor.places[0], corridor.places[-1]))
        ways.setdefault(a.id, []).append(bearing(a.xy, b.xy))
        ways.setdefault(b.id, []).append(bearing(b.xy, a.xy))
    return ways


def _corridors(floor: Floor) -> Iterator[_Piece]:
    """The corridors as rectangles, longer by half a width at dead ends; walls at both sides, and where they end."""
    ways = _ways(floor)
    for corridor in floor.corridors:
        a, b = (floor.place_from_id[i] for i in (corridor.places[0], corridor.places[-1]))
        direction = bearing(a.xy, b.xy)
        dead = [len(ways[end.id]) == 1 for end in (a, b)]
        forward, left = floor.width / 2 * _unit(direction), floor.width / 2 * _unit(direction + np.pi / 2)
        start, end = a.xy - dead[0] * forward, b.xy + dead[1] * forward
        wall_edges = [edge for edge, is_wall in enumerate((True, dead[1], True, dead[0])) if is_wall]
        yield _Piece(np.array([start - left, end - left, end + left, start + left]), tuple(wall_edges))


def _outer_corners(floor: Floor) -> Iterator[_Piece]:
    """What lies outside around a turn of more than half a circle, between the ends of the two corridors' sides."""
    for identifier, ways in _ways(floor).items():
        place, directions = floor.place_from_id[identifier], sorted(np.mod(ways, 2 * np.pi))
        for k, direction in enumerate(directions):
            gap = float(np.mod(directions[(k + 1) % len(directions)] - direction, 2 * np.pi))
            if len(directions) > 1 and gap > np.pi + 1e-9:
                yield from _outer_corner(place, direction, gap, floor.width / 2)


def _outer_corner(place: Place, direction: float, gap: float, half: float) -> Iterator[_Piece]:
    """The pieces between the corridors at ``direction`` and ``direction + gap``."""
    bisector = _unit(direction + gap / 2)
    first = place.xy + half * _unit(direction + np.pi / 2)
    last = place.xy + half * _unit(direction + gap - np.pi / 2)
    mitre = half / np.sin(gap / 2)
    if mitre <= half * _LONGEST_MITRE:
        yield _Piece(np.array([place.xy, first, place.xy + mitre * bisector, last]), (1, 2))
        return
    # both sides go on until they are so far out along the bisector, and there a wall stands square to it
    out = half * _LONGEST_MITRE
    further = (out - half * np.sin(gap / 2)) / -np.cos(gap / 2)
    middle = place.xy + out * bisector
    yield _Piece(np.array([place.xy, first, first - further * _unit(direction), middle]), (1, 2))
    yield _Piece(np.array([place.xy, middle, last - further * _unit(direction + gap), last]), (1, 2))


def _covered(edge: Array, edges: Array) -> tuple[Array, Array]:
    """From where to where (shares of its length) an edge (2, 2) is inside each convex piece of ``edges`` (p, 4, 2, 2).

    Cyrus and Beck's clipping; empty where the first share isn't below the second.
    """
    start, along = edge[0], edge[1] - edge[0]
    sides = edges[:, :, 1] - edges[:, :, 0]
    inward = np.stack([-sides[..., 1], sides[..., 0]], axis=-1)
    inward /= np.hypot(inward[..., 0], inward[..., 1])[..., None]
    depth = np.einsum("pei,pei->pe", inward, start - edges[:, :, 0]) - _SKIN / 10
    gain = inward @ along
    crossing = -depth / np.where(np.abs(gain) < 1e-12, 1.0, gain)
    enters = np.where(gain > 1e-12, crossing, np.where((gain >= -1e-12) & (depth < 0), np.inf, -np.inf))
    leaves = np.where(gain < -1e-12, crossing, np.inf)
    return enters.max(axis=1), leaves.min(axis=1)


def _uncovered(edge: Array, enters: Array, leaves: Array) -> Iterator[Array]:
    """The parts (2, 2) of an edge outside all the pieces that it enters and leaves at those shares."""
    start, along = edge[0], edge[1] - edge[0]
    shortest = 5 * _SKIN / float(np.hypot(*along))
    inside = (enters < leaves) & (leaves > 0) & (enters < 1)
    free_from = 0.0
    for k in [*np.flatnonzero(inside)[np.argsort(enters[inside])], None]:
        until = 1.0 if k is None else float(enters[k])
        if until - free_from > shortest:
            yield np.array([start + free_from * along, start + until * along])
        free_from = free_from if k is None else max(free_from, float(leaves[k]))


def _unit(direction: float) -> Array:
    return np.array([np.cos(direction), np.sin(direction)])
