"""`walk`: which way a robot goes at each place: where it has not been, at random or turning always to one side."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import ConfigError
from .explore import Step, step, way_to_unknown
from .floors import Floor, bearing

Array = NDArray[np.float64]

#: ``unexplored``: an unexplored way at random. The others go that way round the loops, unexplored ways first.
Policy = Literal["unexplored", "clockwise", "counter-clockwise"]
POLICIES: tuple[Policy, ...] = get_args(Policy)

_SIDE = {"clockwise": -1, "counter-clockwise": 1}


def walk(
    floor: Floor,
    rng: np.random.Generator,
    start: str,
    policy: Policy = "unexplored",
    *,
    share: float = 1.0,
    beyond: float = 0.0,
) -> tuple[str, ...]:
    """Ids of the places passed from ``start`` until ``share`` of the corridors' length is known.

    Counted are the corridors that can be reached from there. Where there is no unexplored way, the robot goes back the
    shortest way to a place that has one. When all is known it goes straight on for ``beyond`` [m] more along corridors
    that it knows, so that it comes by again where a loop closed. ``clockwise``: of the unexplored ways the first from
    the right with which the next loop that closes is gone round clockwise; where no way does, the first from the right.

    Raises `ConfigError` for a policy or place that there isn't, or a share outside 0 to 1.

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> square = floor_from_graph("O", [(0, 0), (8, 0), (8, 8), (0, 8)], [(0, 1), (1, 2), (2, 3), (3, 0)])
    >>> walk(square, np.random.default_rng(0), "p0", "clockwise")
    ('p0', 'p3', 'p2', 'p1', 'p0')
    """
    if policy not in POLICIES:
        raise ConfigError(f"policy must be one of {', '.join(POLICIES)}, not {policy!r}")
    if start not in floor.place_from_id:
        raise ConfigError(f"{floor.name!r} has no place {start!r} to start at")
    if not 0 <= share <= 1:
        raise ConfigError(f"share must be from 0 to 1, not {share}")
    so_far, known, length = [start], set[Step](), 0.0
    total = _reachable(floor, start)
    while length < share * total - 1e-9:
        leads = _unexplored(floor, so_far[-1], known)
        if not leads:
            way = way_to_unknown(floor, so_far[-1], known)
        elif policy == "unexplored":
            way = [str(rng.choice(leads))]
        else:
            way = [_to_side(floor, so_far, known, leads, _SIDE[policy])]
        for there in way:
            if step(so_far[-1], there) not in known:
                known.add(step(so_far[-1], there))
                length += floor.distance(so_far[-1], there)
            so_far.append(there)
    if length >= total - 1e-9:
        _go_on(floor, so_far, beyond)
    return tuple(so_far)


def _reachable(floor: Floor, start: str) -> float:
    """Length [m] of the corridors that hang together with a place."""
    todo, met, steps = [start], {start}, set[Step]()
    while todo:
        here = todo.pop()
        for there in floor.neighbours[here]:
            steps.add(step(here, there))
            if there not in met:
                met.add(there)
                todo.append(there)
    return sum(floor.distance(a, b) for a, b in sorted(steps))


def _unexplored(floor: Floor, at: str, known: set[Step]) -> list[str]:
    return [there for there in floor.neighbours[at] if step(at, there) not in known]


def _direction(floor: Floor, a: str, b: str) -> float:
    return bearing(floor.place_from_id[a].xy, floor.place_from_id[b].xy)


def _by_side(floor: Floor, so_far: list[str], leads: list[str], side: int) -> list[str]:
    """Ways in order from the right (``side`` -1) or the left (1) of whoever comes along ``so_far``."""
    # at the start there is no direction to come from: any will do, as it only orders the ways
    ahead = _direction(floor, so_far[-2], so_far[-1]) if len(so_far) > 1 else 0.0
    turns = {there: float(se2.wrap(_direction(floor, so_far[-1], there) - ahead)) for there in leads}
    return sorted(leads, key=lambda there: (-side * turns[there], there))


def _to_side(floor: Floor, so_far: list[str], known: set[Step], leads: list[str], side: int) -> str:
    ordered = _by_side(floor, so_far, leads, side)
    if len(ordered) > 1:
        for there in ordered:
            if side * _next_loop(floor, so_far, known, there, side) > 0:
                return there
    return ordered[0]


def _next_loop(floor: Floor, so_far: list[str], known: set[Step], there: str, side: int) -> float:
    """Signed area [m^2] of the loop that closes first if the robot now goes ``there`` and then always to its side.

    Positive counter-clockwise; 0 where it comes to a dead end before any loop closes.
    """
    ahead, been = list(so_far), set(known)
    while True:
        been.add(step(ahead[-1], there))
        ahead.append(there)
        if there in ahead[:-1]:
            last = len(ahead) - 2 - ahead[-2::-1].index(there)
            return _area(floor, ahead[last:])
        leads = _unexplored(floor, there, been)
        if not leads:
            return 0.0
        there = _by_side(floor, ahead, leads, side)[0]


def _area(floor: Floor, loop: list[str]) -> float:
    """Signed area of a closed way (shoelace formula); stretches gone both ways cancel."""
    points = np.array([floor.place_from_id[i].xy for i in loop])
    (x0, y0), (x1, y1) = points[:-1].T, points[1:].T
    return float((x0 * y1 - x1 * y0).sum() / 2)


def _go_on(floor: Floor, so_far: list[str], beyond: float) -> None:
    """Extends the walk straight on, with the least turn at each place, until it is ``beyond`` [m] longer."""
    gone = 0.0
    while gone < beyond and len(so_far) > 1:
        here, before = so_far[-1], so_far[-2]
        ahead = _direction(floor, before, here)
        there = min(
            floor.neighbours[here],
            key=lambda there: (abs(float(se2.wrap(_direction(floor, here, there) - ahead))), there),
        )
        gone += floor.distance(here, there)
        so_far.append(there)
