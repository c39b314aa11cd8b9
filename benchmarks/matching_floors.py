"""Simulated corridor floors of any size, and pairs of maps of them, for the matcher's benchmarks.

Two robots map two windows of one floor; the windows share a part (``overlap``) of their places. A lattice of corridors,
of which a quarter is missing, with doors; *irregular*: gaps of 5 to 14 m; *alike*: one pitch of 10 m, doors at one
place after each node; *oblique*: irregular, corridors crossing at 50 to 70 degrees. 19 % of the places are missed,
20 % of a map's landmarks are false; positions are off by 0.34 m per axis (0.57 m median between two maps), arms by
0.03 rad; frames are random. With ``drift`` nothing is known but the links from one place to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise

Array = NDArray[np.float64]
Kind = Literal["irregular", "alike", "oblique"]

MISSED, FALSE = 0.19, 0.20
POSITION_SIGMA, HEADING_SIGMA = 0.34, 0.03
PITCH = 10.0
NOISE = Noise(
    position_sigma=POSITION_SIGMA,
    heading_sigma=HEADING_SIGMA,
    detection_rate=1 - MISSED,
    false_alarm_rate=FALSE,
    door_detection_rate=1 - MISSED,
    door_false_alarm_rate=FALSE,
)


@dataclass(frozen=True, eq=False)
class Places:
    """What is there: ``xy`` (n, 2) [m], ``type`` (n,), ``direction`` [rad] and ``open`` (n, 4) of their arms.

    ``ways`` (m, 2): neighbours along a corridor.
    """

    xy: Array
    type: NDArray[np.str_]
    direction: Array
    open: NDArray[np.int8]
    ways: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class FloorPair:
    """Two maps, the true T12 and the true pairs (place in map 1, place in map 2)."""

    map1: LandmarkMap
    map2: LandmarkMap
    T12: Array
    pairs: NDArray[np.intp]


def floor(kind: Kind, columns: int, rows: int, rng: np.random.Generator) -> Places:
    """A lattice of corridors with doors."""
    if kind == "alike":
        x, y = PITCH * np.arange(columns), PITCH * np.arange(rows)
    else:
        x, y = (np.cumsum(rng.uniform(5.0, 14.0, n)) for n in (columns, rows))
    along = rng.random((columns - 1, rows)) < 0.75
    across = rng.random((columns, rows - 1)) < 0.75
    east, north = np.zeros((columns, rows), bool), np.zeros((columns, rows), bool)
    east[:-1], north[:, :-1] = along, across
    west, south = np.zeros_like(east), np.zeros_like(north)
    west[1:], south[:, 1:] = along, across
    ways = np.stack([east, north, west, south], axis=-1)
    n_open = ways.sum(axis=-1)
    straight = (n_open == 2) & ((east & west) | (north & south))
    is_place = (n_open > 0) & ~straight
    column, row = np.nonzero(is_place)
    node_xy = np.column_stack([x[column], y[row]])
    node_open = ways[column, row].astype(np.int8)
    quarter = np.array([0.0, 0.5, 1.0, 1.5]) * np.pi
    node_type = np.where(node_open.sum(axis=1) >= 3, "junction", "corner")
    spots, turn, side = [], [], []
    for edges, axis in ((along, 0), (across, 1)):
        c, r = np.nonzero(edges)
        start = np.column_stack([x[c], y[r]])
        gap = (x[c + 1] - x[c]) if axis == 0 else (y[r + 1] - y[r])
        if kind == "alike":
            has, share = rng.random(len(c)) < 0.6, np.full(len(c), 0.35)
            left = np.ones(len(c))
        else:
            has, share = rng.random(len(c)) < 0.7, rng.uniform(0.25, 0.75, len(c))
            left = rng.choice([-1.0, 1.0], len(c))
        unit = np.eye(2)[axis]
        spots.append((start + (share * gap)[:, None] * unit)[has])
        turn.append(np.full(has.sum(), axis * np.pi / 2))
        side.append(left[has])
    door_xy, door_turn, door_side = np.concatenate(spots), np.concatenate(turn), np.concatenate(side)
    lateral = door_turn + door_side * np.pi / 2
    door_direction = np.column_stack([door_turn, door_turn + np.pi, lateral, lateral + np.pi])
    door_open = np.tile(np.array([1, 1, 1, 0], dtype=np.int8), (len(door_xy), 1))
    xy = np.concatenate([node_xy, door_xy])
    direction = np.concatenate([np.tile(quarter, (len(node_xy), 1)), door_direction])
    types = np.concatenate([node_type, np.full(len(door_xy), "door")])
    links = _ways(xy, along, across, x, y)
    if kind == "oblique":
        angle = rng.uniform(np.deg2rad(50), np.deg2rad(70))
        shear = np.array([[1.0, np.cos(angle)], [0.0, np.sin(angle)]])
        xy = xy @ shear.T
        unit = np.stack([np.cos(direction), np.sin(direction)], axis=-1) @ shear.T
        direction = np.arctan2(unit[..., 1], unit[..., 0])
    return Places(xy, types, direction, np.concatenate([node_open, door_open]), links)


def _ways(xy: Array, along: NDArray[np.bool_], across: NDArray[np.bool_], x: Array, y: Array) -> NDArray[np.intp]:
    """Neighbours on one corridor: consecutive along a lattice line with nothing but open corridor between."""
    found = []
    for axis, edges, lines, steps in ((0, along, y, x), (1, across.T, x, y)):
        line = np.searchsorted(lines, xy[:, 1 - axis] - 1e-6)
        on_line = np.abs(lines[np.minimum(line, len(lines) - 1)] - xy[:, 1 - axis]) < 1e-6
        member = np.flatnonzero(on_line)
        order = member[np.lexsort((xy[member, axis], line[member]))]
        a, b = order[:-1], order[1:]
        same = line[a] == line[b]
        a, b = a[same], b[same]
        missing = np.concatenate([np.zeros((1, edges.shape[1])), np.cumsum(~edges, axis=0)])
        first = np.searchsorted(steps, xy[a, axis] + 1e-6) - 1
        last = np.searchsorted(steps, xy[b, axis] - 1e-6) - 1
        open_between = missing[last + 1, line[a]] == missing[first, line[a]]
        found.append(np.column_stack([a, b])[open_between])
    return np.concatenate(found)


def pair_of_maps(
    n: int, kind: Kind, rng: np.random.Generator, *, overlap: float = 0.5, drift: float = 0.0, links: bool = True
) -> FloorPair:
    """Two maps of about ``n`` landmarks each; ``overlap``: which share of the places in a window is in both."""
    n_places = round(n * (1 - FALSE) / (1 - MISSED))
    side = max(3, round(np.sqrt(n_places / 2.2)))
    places = floor(kind, int(side * (2 - overlap) * 1.3) + 3, side + 1, rng)
    while len(places.xy) < (2 - overlap) * n_places + 1:
        places = floor(kind, 2 * side + 6, side + 2, rng)
    by_x = np.lexsort((places.xy[:, 1], places.xy[:, 0]))
    first = round((1 - overlap) * n_places)
    recorded = [
        np.sort(window[rng.random(n_places) >= MISSED]) for window in (by_x[:n_places], by_x[first:][:n_places])
    ]
    maps, frames, seen_as = [], [], []
    for name, seen in zip("AB", recorded, strict=True):
        frame = np.array([*rng.uniform(-50, 50, 2), rng.uniform(-np.pi, np.pi)])
        recorded_map, place_of = _map(name, places, seen, frame, rng, drift, links)
        maps.append(recorded_map)
        frames.append(frame)
        seen_as.append(place_of)
    place1, place2 = seen_as
    known = {p: k for k, p in enumerate(place1.tolist()) if p >= 0}
    pairs = np.array([(known[p], k) for k, p in enumerate(place2.tolist()) if p in known], dtype=np.intp).reshape(-1, 2)
    return FloorPair(maps[0], maps[1], se2.between(frames[0], frames[1]), pairs)


def _map(
    name: str,
    places: Places,
    seen: NDArray[np.intp],
    frame: Array,
    rng: np.random.Generator,
    drift: float,
    with_links: bool,
) -> tuple[LandmarkMap, NDArray[np.intp]]:
    """The map of the places ``seen`` and some false ones in ``frame``; and which place each landmark is, -1 if none."""
    n_false = round(len(seen) * FALSE / (1 - FALSE))
    ways = places.ways[np.isin(places.ways, seen).all(axis=1)]
    near = places.ways[np.isin(places.ways, seen).any(axis=1)]
    way = near[rng.integers(0, len(near), n_false)]
    false_xy = places.xy[way[:, 0]] + rng.random((n_false, 1)) * (places.xy[way[:, 1]] - places.xy[way[:, 0]])
    like = rng.choice(seen, n_false)
    which = np.concatenate([seen, like])
    xy = np.concatenate([places.xy[seen], false_xy])
    turn = np.zeros(len(xy))
    if drift:
        moved, turn[: len(seen)] = _drifted(places, seen, ways, drift, rng)
        offset = np.zeros(len(xy), dtype=np.intp)
        offset[len(seen) :] = np.argmin(np.hypot(*(false_xy[:, None] - places.xy[seen]).transpose(2, 0, 1)), axis=1)
        shift = moved - places.xy[seen]
        xy = np.concatenate([moved, false_xy + shift[offset[len(seen) :]]])
        turn[len(seen) :] = turn[offset[len(seen) :]]
    xy = se2.transform(se2.inverse(frame), xy) + rng.normal(0, POSITION_SIGMA, xy.shape)
    shared = rng.normal(0, HEADING_SIGMA / np.sqrt(2), (len(xy), 1))
    own = rng.normal(0, HEADING_SIGMA / np.sqrt(2), (len(xy), 4))
    direction = se2.wrap(places.direction[which] - frame[2] + turn[:, None] + shared + own)
    place_of = np.concatenate([seen, np.full(n_false, -1)])
    order = rng.permutation(len(xy))
    ids = [f"{name.lower()}{k}" for k in range(len(xy))]
    id_of_place = dict(zip(place_of[order].tolist(), ids, strict=True))
    at_of_place = dict(zip(place_of.tolist(), xy, strict=True))
    neighbours: dict[int, list[tuple[int, float]]] = {}
    if with_links:
        length = np.hypot(*(places.xy[ways[:, 1]] - places.xy[ways[:, 0]]).T)
        measured = length + rng.normal(0, 0.1 + 0.02 * length)
        for (a, b), d in zip(ways.tolist(), measured.tolist(), strict=True):
            neighbours.setdefault(a, []).append((b, d))
            neighbours.setdefault(b, []).append((a, d))
    landmarks = []
    for k, identifier in zip(order.tolist(), ids, strict=True):
        place = int(place_of[k])
        to = {}
        for other, d in neighbours.get(place, ()) if place >= 0 else ():
            dx, dy = at_of_place[other] - xy[k]
            off = np.abs(se2.wrap(direction[k] - np.arctan2(dy, dx)))
            off[places.open[which[k]] != 1] = 9.0
            to[int(np.argmin(off))] = (id_of_place[other], d)
        links = []
        for m, (heading, is_open) in enumerate(zip(direction[k].tolist(), places.open[which[k]].tolist(), strict=True)):
            kind = "open" if is_open else "blocked"
            if m in to:
                links.append(Link(kind, heading, None, to[m][0], max(to[m][1], 0.1), 1))
            else:
                links.append(Link(kind, heading))
        landmarks.append(Landmark(identifier, str(places.type[which[k]]), *xy[k].tolist(), links=tuple(links)))
    return LandmarkMap(name, tuple(landmarks), noise=NOISE), place_of[order]


def _drifted(
    places: Places, seen: NDArray[np.intp], ways: NDArray[np.intp], drift: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Positions (n, 2) and turns (n,) [rad] of the places seen, chained along the shortest ways from one of them.

    Distances are off by one factor (``drift`` is its sigma); the heading walks at random such that it adds as much
    sideways at 100 m. No loop is closed. Where the ways fall apart the robot went straight over.
    """
    n = len(seen)
    number = np.full(len(places.xy), -1)
    number[seen] = np.arange(n)
    a, b = number[ways].T
    xy = places.xy[seen]
    length = np.hypot(*(xy[b] - xy[a]).T)
    # straight over where nothing else joins: long, so that it is never shorter than a way
    from scipy.spatial import KDTree

    near = np.asarray(KDTree(xy).query(xy, k=min(8, n))[1])
    i, j = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()
    detour = 5 * np.hypot(*(xy[i] - xy[j]).T)
    graph = coo_array(
        (np.concatenate([length, detour]), (np.concatenate([a, i]), np.concatenate([b, j]))), shape=(n, n)
    )
    graph = graph.tocsr()
    graph.data = np.maximum(graph.data, 1e-6)
    start = int(rng.integers(n))
    distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    scale = 1 + drift * rng.normal()
    walk = drift * np.sqrt(3.0 / 100.0)
    out, turn = np.zeros((n, 2)), np.zeros(n)
    out[start] = xy[start]
    for k in np.argsort(distance, kind="stable").tolist():
        p = int(before[k])
        if p < 0:
            if k != start:
                out[k] = xy[k]
            continue
        step = xy[k] - xy[p]
        turned = turn[p] + walk * np.sqrt(np.hypot(*step)) * rng.normal()
        turn[k] = turned
        out[k] = out[p] + scale * (se2.rotation(turned) @ step)
    return out, turn
