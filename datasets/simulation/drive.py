"""`drive`: the true path of a robot along a walk: the middle of the corridors, round corners, on the spot at dead ends.

Nothing here is measured: what the robot's sensors make of the path is in `sensing` and `detecting`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..values import frozen_array
from .explore import START_DISTANCE
from .floors import Floor, bearing
from .robots import Driving

Array = NDArray[np.float64]

#: The way of a robot is made of points this far apart [m].
_GRAIN = 0.02
#: Sharper turns [rad] are made standing on the spot.
_ON_THE_SPOT = np.deg2rad(135.0)
#: An arc takes up at most this share of the straight stretches before and after it.
_ROOM = 0.45
#: Over these metres from where it stands still the robot begins to wander; it never wanders further from the middle
#: than this share of the corridor's width.
_SETTLING, _WANDER_LIMIT = 1.0, 0.125
_WAVES = 12


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """A true path (k, 4): time [s], x, y [m, world], theta [rad, not wrapped]; ``way`` (k,) [m] until then."""

    path: Array
    way: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", frozen_array(self.path))
        object.__setattr__(self, "way", frozen_array(self.way))

    @property
    def t(self) -> Array:
        """Times (k,) [s]."""
        return self.path[:, 0]

    @property
    def poses(self) -> Array:
        """Poses (k, 3)."""
        return self.path[:, 1:]

    def until(self, time: float = np.inf, distance: float = np.inf) -> Drive:
        """The beginning of it, to the last pose no later than ``time`` [s] and no further than ``distance`` [m]."""
        # both grow; the first pose is always left, so that there is a path
        count = max(1, int(np.count_nonzero((self.t <= time) & (self.way <= distance))))
        return Drive(self.path[:count], self.way[:count])

    def steps(self) -> Array:
        """The motion from each pose to the next (k - 1, 3): forward, left [m] seen from half way, and turn [rad]."""
        moved, turn = np.diff(self.poses[:, :2], axis=0), np.diff(self.poses[:, 2])
        half = se2.rotation(self.poses[:-1, 2] + turn / 2)
        return np.column_stack([np.einsum("kij,ki->kj", half, moved), turn])


@dataclass(frozen=True, eq=False, slots=True)
class _Motion:
    """One movement without a stop: poses (n, 3) at ``at`` (n,) of its extent, which is metres or radians."""

    at: Array
    poses: Array
    speed: float
    acceleration: float

    @property
    def extent(self) -> float:
        return float(self.at[-1])

    @property
    def ramp(self) -> float:
        """Time [s] until full speed, or half of the whole where that is never reached."""
        return float(min(self.speed / self.acceleration, np.sqrt(self.extent / self.acceleration)))

    @property
    def duration(self) -> float:
        """Time [s] of it all: speeding up, full speed, slowing down as fast."""
        ramp = self.ramp
        top = self.acceleration * ramp
        return 2 * ramp + (self.extent - top * ramp) / top if top else 0.0

    def at_times(self, t: Array) -> Array:
        """Poses (k, 3) at times (k,) [s] since its beginning."""
        ramp, top, left = self.ramp, self.acceleration * self.ramp, np.maximum(0.0, self.duration - t)
        gone = np.where(t < ramp, self.acceleration * t**2 / 2, top * (t - ramp / 2))
        gone = np.where(left < ramp, self.extent - self.acceleration * left**2 / 2, gone)
        return np.column_stack([np.interp(gone, self.at, column) for column in self.poses.T])


def drive(floor: Floor, places: Sequence[str], driving: Driving, rng: np.random.Generator) -> Drive:
    """The path along a walk of ``places``, from close by the first one, where the robot looks anywhere, to the last.

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> floor = floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (1, 2)])
    >>> driven = drive(floor, ["p0", "p1", "p2"], Driving(), np.random.default_rng(0))
    >>> driven.path[-1, 1:3].round(2).tolist(), bool(13 < driven.way[-1] < 15)
    ([8.0, 6.0], True)
    """
    start = _start(floor, places, rng)
    points = _corners(np.array([start[:2], *(floor.place_from_id[i].xy for i in places)]))
    motions, pose = [], start
    for leg in _legs(points, driving.turn_radius):
        motion = _along(leg, floor.width, driving, rng)
        motions += [_turn(pose, motion.poses[0, 2], driving), motion]
        pose = motion.poses[-1]
    return _sampled(motions, driving.rate)


def _start(floor: Floor, places: Sequence[str], rng: np.random.Generator) -> Array:
    """Pose (3,) beside the first place, on a corridor that the walk doesn't begin with, where there is one."""
    first = floor.place_from_id[places[0]]
    arms = [there for there in floor.neighbours[first.id] if there not in places[1:2]] or list(places[1:2])
    there = floor.place_from_id[str(rng.choice(arms))]
    distance = min(float(rng.uniform(*START_DISTANCE)), floor.distance(first.id, there.id) / 2)
    direction = bearing(first.xy, there.xy)
    away = distance * np.array([np.cos(direction), np.sin(direction)])
    return np.array([*(first.xy + away), rng.uniform(-np.pi, np.pi)])


def _corners(points: Array) -> Array:
    """Of the points (n, 2) of a way those at which it turns, and its ends."""
    turns = _turns(np.diff(points, axis=0)) > 1e-6
    return np.asarray(points[np.concatenate([[True], turns, [True]])], dtype=float)


def _turns(ways: Array) -> Array:
    """By how much [rad, at least 0] it turns from each of the ``ways`` (n, 2) to the next, as (n - 1,)."""
    return np.asarray(np.abs(se2.wrap(np.diff(np.arctan2(ways[:, 1], ways[:, 0])))), dtype=float)


def _legs(points: Array, radius: float) -> list[Array]:
    """The way (n, 2) in parts, between the points where the robot turns on the spot.

    That is where it goes back, and where the next turn is too close for an arc of half the ``radius`` [m].
    """
    ways = np.diff(points, axis=0)
    turns, lengths = _turns(ways), np.hypot(*ways.T)
    room = _ROOM * np.minimum(lengths[:-1], lengths[1:])
    on_the_spot = (turns > _ON_THE_SPOT) | (room < radius / 2 * np.tan(turns / 2))
    cuts = [0, *(1 + np.flatnonzero(on_the_spot)), len(points) - 1]
    return [points[a : b + 1] for a, b in pairwise(cuts)]


def _turn(pose: Array, to: float, driving: Driving) -> _Motion:
    """On the spot, the shorter way round."""
    turn = float(se2.wrap(to - pose[2]))
    poses = np.array([pose, [pose[0], pose[1], pose[2] + turn]])
    return _Motion(np.array([0.0, abs(turn)]), poses, driving.turn_rate, driving.turn_acceleration)


def _along(points: Array, width: float, driving: Driving, rng: np.random.Generator) -> _Motion:
    """Along the way (n, 2) without a stop, wandering to the left and right of it."""
    middle = _rounded(points, driving.turn_radius)
    way = _lengths(middle)
    tangent = np.gradient(middle, way, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    line = middle + _wander(way, width, driving, rng)[:, None] * normal
    at = _lengths(line)
    ahead = np.gradient(line, at, axis=0)
    # at the ends it doesn't wander, and looks exactly along the corridor
    ahead[0], ahead[-1] = points[1] - points[0], points[-1] - points[-2]
    theta = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return _Motion(at, np.column_stack([line, theta]), driving.speed, driving.acceleration)


def _rounded(points: Array, radius: float) -> Array:
    """The way (n, 2) with an arc at each inner point, as points `_GRAIN` apart at most."""
    pieces, last = [], points[0]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        arc = _arc(before, corner, after, radius)
        pieces += [_line(last, arc[0]), arc[1:-1]]
        last = arc[-1]
    return np.vstack([*pieces, _line(last, points[-1]), points[-1:]])


def _line(a: Array, b: Array) -> Array:
    """Points from a to b, without b."""
    count = max(1, int(np.ceil(np.hypot(*(b - a)) / _GRAIN)))
    return np.asarray(a + (b - a) * (np.arange(count) / count)[:, None], dtype=float)


def _arc(before: Array, corner: Array, after: Array, radius: float) -> Array:
    """Points of the arc round a corner; smaller where the ways to the next corners leave no room for ``radius``."""
    a, b = before - corner, after - corner
    reach_a, reach_b = float(np.hypot(*a)), float(np.hypot(*b))
    a, b = a / reach_a, b / reach_b
    turn = float(se2.wrap(bearing((0, 0), b) - bearing(a, (0, 0))))
    half = np.tan(abs(turn) / 2)
    cut = min(radius * half, _ROOM * reach_a, _ROOM * reach_b)
    radius = cut / half
    centre = corner + (a + b) / np.hypot(*(a + b)) * np.hypot(cut, radius)
    count = max(2, int(np.ceil(radius * abs(turn) / _GRAIN)))
    angles = bearing(centre, corner + cut * a) + turn * np.linspace(0, 1, count + 1)
    return np.asarray(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]), dtype=float)


def _lengths(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _wander(way: Array, width: float, driving: Driving, rng: np.random.Generator) -> Array:
    """Distance (n,) [m] to the left of the middle at ``way`` (n,) [m]: a sum of waves, 0 at both ends."""
    waves = rng.normal(size=_WAVES) / driving.wander_length
    phases = rng.uniform(0, 2 * np.pi, _WAVES)
    off = driving.wander * np.sqrt(2 / _WAVES) * np.cos(way[:, None] * waves + phases).sum(axis=1)
    limit = _WANDER_LIMIT * width
    from_end = np.clip(np.minimum(way, way[-1] - way) / _SETTLING, 0, 1)
    return np.asarray(limit * np.tanh(off / limit) * from_end**2 * (3 - 2 * from_end), dtype=float)


def _sampled(motions: Sequence[_Motion], rate: float) -> Drive:
    """All motions one after the other, as poses at a constant rate [Hz] from time 0 to the end."""
    ends = np.cumsum([motion.duration for motion in motions])
    t = np.arange(int(np.ceil(ends[-1] * rate)) + 1) / rate
    which = np.minimum(np.searchsorted(ends, t, side="right"), len(motions) - 1)
    poses = np.empty((len(t), 3))
    turned, theta = 0.0, motions[0].poses[0, 2]
    for k, (motion, end) in enumerate(zip(motions, ends, strict=True)):
        rows = which == k
        # a motion's own angles may begin a whole turn off from where the one before ended
        turned += 2 * np.pi * round((theta - motion.poses[0, 2] - turned) / (2 * np.pi))
        poses[rows] = motion.at_times(t[rows] - (end - motion.duration))
        poses[rows, 2] += turned
        theta = motion.poses[-1, 2] + turned
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    return Drive(np.column_stack([t, poses]), way)
