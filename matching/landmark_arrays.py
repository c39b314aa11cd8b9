"""What the matcher needs of one map, as arrays: worked out once per map and kept as long as the map lives."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapfuse.datasets import se2
from mapfuse.datasets.arms import ARM_TOLERANCE, signature
from mapfuse.datasets.maps import LandmarkMap, Noise

from .travelled import Travelled, travelled

Array = NDArray[np.float64]
Codes = NDArray[np.int32]
Kept = TypeVar("Kept")

#: Standard deviation per axis [m] below which positions aren't believed.
LEAST_SIGMA = 0.035
#: The largest variances decide how far everything is searched; one that is hardly known must not blow that up.
MOST_VARIANCE = 4.0
#: Arms are told apart in so many directions.
SECTORS = 64
#: How finely arm patterns are told apart [rad]: the first of these with a bounded number of patterns.
_PATTERN_STEPS = np.deg2rad([15.0, 30.0, 45.0, 90.0, 360.0])
_MOST_PATTERNS = 256


@dataclass(frozen=True, eq=False)
class LandmarkArrays:
    """One map's n landmarks, in the map's order and frame; every array is read-only.

    ``xy`` (n, 2) [m]; ``variance`` (n,) [m^2]: of a position, per axis; ``labels``: the types in the map, sorted, and
    ``label`` (n,) the place of each landmark's own among them. ``heading`` (n,) [rad], NaN where there is none.
    ``arm_heading`` (n, k) [rad] NaN padded and ``arm_open`` (n, k): 1 passable, 0 blocked, -1 no arm.
    ``detected`` (n,): probability that a place of this type is in the map if the robot passed it; ``true`` (n,): that
    the recorded landmark is there. ``noise``: the robot's. ``north`` [rad] and ``north_sigma``: where the compass
    points in the map's frame; NaN without one, or where its offset is unknown.
    ``links`` (m, 2): places of the landmarks that a straight travelled way joins; ``bend`` [m^2 per m]: how much the
    variance of a displacement grows with its length.
    """

    xy: Array
    variance: Array
    labels: tuple[str, ...]
    label: Codes
    heading: Array
    arm_heading: Array
    arm_open: NDArray[np.int8]
    detected: Array
    true: Array
    noise: Noise
    north: float
    north_sigma: float
    links: Codes
    bend: float

    def __len__(self) -> int:
        return len(self.xy)

    @cached_property
    def headed(self) -> NDArray[np.bool_]:
        """Which landmarks have a heading (n,)."""
        return frozen(~np.isnan(self.heading))

    @property
    def recorded(self) -> Array:
        """Probability (n,) that a place of this type is in the map and that a landmark of it is there."""
        return self.detected * self.true

    @cached_property
    def armed(self) -> NDArray[np.bool_]:
        """Which landmarks have arms (n,)."""
        return frozen(self.arm_open[:, 0] >= 0)

    @cached_property
    def log_true(self) -> Array:
        """Logarithm of the probability that a recorded landmark is there (n,)."""
        return frozen(np.log(self.true))

    @cached_property
    def middle(self) -> Array:
        """Mean position (2,) [m]."""
        return frozen(self.xy.mean(axis=0))

    @cached_property
    def spread(self) -> float:
        """Mean squared distance from the middle [m^2]."""
        return float(np.mean(np.sum((self.xy - self.middle) ** 2, axis=1)))

    @cached_property
    def largest_variance(self) -> float:
        """Of all positions, per axis [m^2]."""
        return float(self.variance.max())

    @cached_property
    def rates(self) -> tuple[Array, Array]:
        """True landmarks of each label per square metre, and, of those with arms, per metre of corridor instead."""
        n = len(self.labels)
        count = np.bincount(self.label, weights=self.true / self.detected, minlength=n)
        armed = np.bincount(self.label, weights=self.armed, minlength=n) > 0
        box = float(np.prod(np.ptp(self.xy, axis=0) + 2.0))
        way = self.travelled
        # closer than the noise landmarks can't be told apart, however many there are
        most = 0.25 / (np.sqrt(2 * np.pi) * np.sqrt(2 * float(np.median(self.variance))))
        within = np.minimum(count / max(box if way.has_links else way.length, 1.0), 4 * most**2)
        along = np.minimum(count / max(way.length, 1.0), most)
        return frozen(within), frozen(np.where(armed, along, within))

    @cached_property
    def travelled(self) -> Travelled:
        """Where the robot has been, and so what it should have seen."""
        return travelled(self.xy, self.links, self.variance)

    @cached_property
    def nearest(self) -> Array:
        """Distance [m] of each landmark to the nearest other one (n,); the same in whatever frame and order."""
        if len(self) < 2:
            return np.zeros(len(self))
        return frozen(np.asarray(KDTree(self.xy).query(self.xy, k=[2])[0])[:, 0])

    @cached_property
    def by_isolation(self) -> NDArray[np.intp]:
        """Places in the map, the loneliest landmarks first: an order that neither frame nor file has a say in (n,)."""
        if not len(self):
            return np.zeros(0, dtype=np.intp)
        off_centre = np.hypot(*(self.xy - self.xy.mean(axis=0)).T)
        return frozen(np.lexsort((off_centre.round(6), -self.nearest.round(6))))

    @cached_property
    def isolation_rank(self) -> NDArray[np.intp]:
        """The place of each landmark in `by_isolation` (n,)."""
        rank = np.empty(len(self), dtype=np.intp)
        rank[self.by_isolation] = np.arange(len(self))
        return frozen(rank)

    @cached_property
    def by_place(self) -> NDArray[np.intp]:
        """Places in the map in an order in which neighbours in space come close to each other (n,)."""
        if not len(self):
            return np.zeros(0, dtype=np.intp)
        size = max(4 * float(np.median(self.nearest)), 1e-3)
        column = np.floor((self.xy[:, 0] - self.xy[:, 0].min()) / size)
        return frozen(np.lexsort((self.xy[:, 0], self.xy[:, 1], column)))

    @cached_property
    def isolation_by_place(self) -> NDArray[np.intp]:
        """`by_isolation`, as places in the order `by_place` (n,)."""
        now_at = np.empty(len(self), dtype=np.intp)
        now_at[self.by_place] = np.arange(len(self))
        return frozen(now_at[self.by_isolation])

    @cached_property
    def _kept(self) -> dict[tuple[Any, ...], Any]:
        return {}

    def kept(self, key: tuple[Any, ...] | None, make: Callable[[], Kept]) -> Kept:
        """What ``make`` gives, kept with the map under ``key``, unless that is None; the last few are kept."""
        if key is None:
            return make()
        found: Kept | None = self._kept.get(key)
        if found is None:
            if len(self._kept) > 15:
                self._kept.clear()
            found = self._kept[key] = make()
        return found

    def facing(self, seen_by_other: tuple[float, ...], linear: bool, by_place: bool) -> Facing:
        """The arrays as a pair's kernels take them; the last few are kept, since many robots are alike.

        ``seen_by_other``: the other robot's detection rate of each of ``labels``; ``linear``: whether both maps' ways
        are known; ``by_place``: in that order, else the map's.
        """
        key = seen_by_other, linear, by_place
        return self.kept(("facing", *key), lambda: _faced(self, *key))

    @cached_property
    def patterns(self) -> ArmPatterns:
        """Landmarks by what their arms look like."""
        return _patterns(self)

    @cached_property
    def open_sectors(self) -> NDArray[np.uint64]:
        """The directions of each landmark's passable arms as bits (n,)."""
        return _sectors(self.arm_heading, self.arm_open == 1)

    @cached_property
    def blocked_sectors(self) -> NDArray[np.uint64]:
        """The directions of each landmark's blocked arms as bits (n,)."""
        return _sectors(self.arm_heading, self.arm_open == 0)

    @cached_property
    def near_open(self) -> NDArray[np.uint64]:
        """Directions within 30 degrees of a passable arm (n,)."""
        return _widened(self.open_sectors)

    @cached_property
    def near_blocked(self) -> NDArray[np.uint64]:
        """Directions within 30 degrees of a blocked arm (n,)."""
        return _widened(self.blocked_sectors)


@dataclass(frozen=True, eq=False)
class ArmPatterns:
    """Landmarks with heading, by pattern: those of one label whose arms point alike, seen from their own heading.

    ``members`` (h,): places in the map, by pattern, then by heading; ``start`` (p + 1,): where each pattern's begin;
    ``heading`` (h,): of each member [rad]. Of each pattern: ``label`` (p,), its mean ``arms`` (p, k) [rad from the
    heading, NaN padded] and ``open`` (p, k).
    """

    members: Codes
    start: Codes
    heading: Array
    label: Codes
    arms: Array
    open: NDArray[np.int8]
    pattern: Codes


@dataclass(frozen=True, eq=False, slots=True)
class Facing:
    """One map's landmarks beside another robot's map, in the order of the map or by place.

    ``values`` (n, 6): x, y [m], variance [m^2], heading [rad], and what a match is worth but for its residual and what
    it costs to have none where the other robot passed [nats]; ``arms`` (n, 4): sectors with an open and a blocked arm,
    and those near them; ``linear`` (n,): 1 where the landmark counts per metre of corridor.
    """

    values: Array
    arms: NDArray[np.uint64]
    linear: NDArray[np.uint8]


def _faced(own: LandmarkArrays, seen_by_other: tuple[float, ...], linear: bool, by_place: bool) -> Facing:
    on_ways = own.armed if linear else np.zeros(len(own), dtype=bool)
    seen = np.clip(np.array(seen_by_other), 0.01, 0.99)[own.label]
    # off the corridors nobody knows where the other robot looked
    miss = np.where(on_ways | (not linear), np.log(1 - own.true * seen), 0.0)
    worth = own.log_true - (np.log(own.rates[linear]) / 2)[own.label]
    columns = (
        np.column_stack([own.xy, own.variance, own.heading, worth, miss]),
        np.column_stack([own.open_sectors, own.blocked_sectors, own.near_open, own.near_blocked]),
        on_ways.astype(np.uint8),
    )
    return Facing(*(frozen(column[own.by_place] if by_place else column) for column in columns))


_kept: dict[int, tuple[weakref.ref[LandmarkMap], LandmarkArrays]] = {}


def landmark_arrays(recorded: LandmarkMap) -> LandmarkArrays:
    """The arrays of a map, worked out at the first call and kept until the map is gone.

    >>> from mapfuse.datasets.maps import Landmark
    >>> m = LandmarkMap("m", (Landmark("a", "tree", 1.0, 2.0), Landmark("b", "door", 3.0, 4.0, heading=0.5)))
    >>> arrays = landmark_arrays(m)
    >>> arrays.labels, arrays.label.tolist(), arrays.headed.tolist(), landmark_arrays(m) is arrays
    (('door', 'tree'), [1, 0], [False, True], True)
    """
    key = id(recorded)
    found = _kept.get(key)
    if found is not None and found[0]() is recorded:
        return found[1]
    arrays = _read(recorded)
    _kept[key] = weakref.ref(recorded, lambda _: _kept.pop(key, None)), arrays
    return arrays


def shared_labels(one: LandmarkArrays, two: LandmarkArrays) -> tuple[Codes, Codes, int]:
    """Label codes of two maps' landmarks, equal where the labels are, and how many there are."""
    if one.labels == two.labels:
        return one.label, two.label, len(one.labels)
    code = {label: k for k, label in enumerate(sorted({*one.labels, *two.labels}))}
    label1, label2 = (
        np.array([code[label] for label in side.labels], dtype=np.int32)[side.label]
        if len(side)
        else np.zeros(0, dtype=np.int32)
        for side in (one, two)
    )
    return label1, label2, len(code)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """The array, contiguous and read-only: to a kernel that is a type of its own, so that all must be."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def _read(recorded: LandmarkMap) -> LandmarkArrays:
    noise, n = recorded.noise, len(recorded)
    signatures = [signature(landmark) for landmark in recorded.landmarks]
    most = max(4, max((len(s.headings) for s in signatures), default=0))
    arm_heading, arm_open = np.full((n, most), np.nan), np.full((n, most), -1, dtype=np.int8)
    heading = np.full(n, np.nan)
    for k, (arms, landmark) in enumerate(zip(signatures, recorded.landmarks, strict=True)):
        whole = arms.heading
        if whole is None:
            whole = landmark.heading
        if whole is not None:
            heading[k] = whole
        if arms.headings:
            arm_heading[k, : len(arms.headings)] = arms.headings
            arm_open[k, : len(arms.headings)] = arms.passable
    labels = tuple(sorted(set(recorded.types)))
    place = {label: k for k, label in enumerate(labels)}
    label = np.array([place[t] for t in recorded.types], dtype=np.int32)
    detected = np.array([noise.detection(t) for t in labels]).reshape(-1)[label]
    true = np.array([1 - noise.false_alarm(t) for t in labels]).reshape(-1)[label]
    links = _links(recorded)
    north, north_sigma = _north(recorded)
    return LandmarkArrays(
        frozen(recorded.positions),
        frozen(_variance(recorded)),
        labels,
        frozen(label),
        frozen(heading),
        frozen(arm_heading),
        frozen(arm_open),
        frozen(np.clip(detected, 0.01, 0.99)),
        frozen(np.clip(true, 0.01, 0.99)),
        noise,
        north,
        north_sigma,
        frozen(links),
        _bend(recorded, links),
    )


def _variance(recorded: LandmarkMap) -> Array:
    """Variance per axis [m^2] of each position, bounded to four times the median one."""
    variance = np.full(len(recorded), recorded.noise.position_sigma**2)
    joint = recorded.joint_covariance
    if joint is not None:
        diagonal = np.diag(joint.matrix).reshape(-1, joint.rows)
        for identifier, of_axes in zip(joint.order, diagonal, strict=True):
            variance[recorded.index_from_id[identifier]] = of_axes[:2].mean()
    for k, landmark in enumerate(recorded.landmarks):
        if landmark.covariance is not None:
            variance[k] = np.trace(landmark.covariance[:2, :2]) / 2
    middle = float(np.median(variance)) if len(variance) else 0.0
    return np.asarray(np.clip(variance, LEAST_SIGMA**2, max(MOST_VARIANCE * middle, LEAST_SIGMA**2)))


def _links(recorded: LandmarkMap) -> Codes:
    """Pairs of landmarks that a travelled way joins along its arms at both ends, each once; (m, 2).

    A way that strays from its arm by more than 20 degrees went round a corner and is no straight one.
    """
    straight, bent = set[tuple[int, int]](), set[tuple[int, int]]()
    xy, place, least = recorded.positions.tolist(), recorded.index_from_id, math.cos(math.radians(20.0))
    for k, landmark in enumerate(recorded.landmarks):
        for link in landmark.links:
            if link.connected_to_id is None or link.heading is None:
                continue
            other = place.get(link.connected_to_id)
            if other is None or other == k:
                continue
            dx, dy = xy[other][0] - xy[k][0], xy[other][1] - xy[k][1]
            length = math.hypot(dx, dy)
            along = (dx * math.cos(link.heading) + dy * math.sin(link.heading)) / max(length, 1e-9)
            pair = (min(k, other), max(k, other))
            (straight if length < 1.0 or along > least else bent).add(pair)
    return np.array(sorted(straight - bent), dtype=np.int32).reshape(-1, 2)


def _bend(recorded: LandmarkMap, links: Codes) -> float:
    """How the variance of a displacement grows [m^2 per m], from the noise of a link of median length."""
    noise, xy = recorded.noise, recorded.positions
    if not len(links):
        return 0.0
    length = max(float(np.median(np.hypot(*(xy[links[:, 1]] - xy[links[:, 0]]).T))), 1.0)
    per_axis = (noise.distance_sigma(length) ** 2 + (noise.heading_sigma * length) ** 2) / 2
    return per_axis / length


def _north(recorded: LandmarkMap) -> tuple[float, float]:
    """Direction of compass north in the map's frame [rad] and its standard deviation; NaN where it isn't known."""
    noise = recorded.noise
    off = np.array(
        [
            link.heading - link.compass
            for landmark in recorded.landmarks
            for link in landmark.links
            if link.compass is not None and link.heading is not None
        ]
    )
    if not len(off) or noise.compass_offset_sigma is None:
        return np.nan, np.nan
    centre = float(np.angle(np.exp(1j * off).sum()))
    sigma = max(noise.compass_sigma, 1e-3)
    weight = np.ones(len(off))
    for _ in range(5):  # a reading bent by steel turns nothing
        residual = se2.wrap(off - centre)
        weight = 1 / (1 + (residual / sigma) ** 2)
        centre = float(se2.wrap(centre + (weight @ residual) / weight.sum()))
    return centre, float(np.hypot(noise.compass_offset_sigma, sigma / np.sqrt(weight.sum())))


def _sectors(headings: Array, which: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Directions as bits: bit s is set where an arm points into sector s; (n,)."""
    sector = np.floor(np.where(np.isnan(headings), 0.0, headings) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    bits = np.where(which, np.left_shift(np.uint64(1), sector.astype(np.uint64)), np.uint64(0))
    return frozen(np.bitwise_or.reduce(bits, axis=1) if len(bits) else np.zeros(0, dtype=np.uint64))


def _widened(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    one, last = np.uint64(1), np.uint64(SECTORS - 1)
    for _ in range(round(ARM_TOLERANCE / (2 * np.pi) * SECTORS)):
        bits = bits | (bits << one) | (bits >> last) | (bits >> one) | (bits << last)
    return frozen(bits)


def _patterns(arrays: LandmarkArrays) -> ArmPatterns:
    members = np.flatnonzero(arrays.headed).astype(np.int32)
    own = arrays.heading[members]
    relative = se2.wrap(arrays.arm_heading[members] - own[:, None])
    arm_open = arrays.arm_open[members]
    pattern = np.zeros(len(members), dtype=np.intp)
    for step in _PATTERN_STEPS:
        sector = np.round(np.where(np.isnan(relative), 0.0, relative) / step).astype(np.int64) % round(2 * np.pi / step)
        code = np.where(arm_open >= 0, 1 + 2 * sector + arm_open, 0)
        order = np.argsort(code, axis=1, kind="stable")
        code = np.take_along_axis(code, order, axis=1)
        keys, pattern = np.unique(np.column_stack([arrays.label[members], code]), axis=0, return_inverse=True)
        pattern = pattern.reshape(-1)
        if len(keys) <= _MOST_PATTERNS:
            break
    relative, arm_open = np.take_along_axis(relative, order, axis=1), np.take_along_axis(arm_open, order, axis=1)
    n = int(pattern.max(initial=-1)) + 1
    sorted_by = np.lexsort((arrays.xy[members, 1], arrays.xy[members, 0], own, pattern))
    start = np.searchsorted(pattern[sorted_by], np.arange(n + 1)).astype(np.int32)
    first = sorted_by[start[:-1]]
    shift = se2.wrap(relative - relative[first[pattern]])
    known, arm = ~np.isnan(shift), np.arange(relative.shape[1])
    place = (pattern[:, None] * len(arm) + arm)[known]
    shape = (n, len(arm))
    total = np.bincount(place, shift[known], n * len(arm)).reshape(shape)
    count = np.bincount(place, minlength=n * len(arm)).reshape(shape)
    arms = np.where(count > 0, relative[first] + total / np.maximum(count, 1), np.nan)
    of_landmark = np.full(len(arrays), -1, dtype=np.int32)
    of_landmark[members] = pattern
    return ArmPatterns(
        frozen(members[sorted_by]),
        frozen(start),
        frozen(own[sorted_by]),
        frozen(arrays.label[members][first]),
        frozen(arms),
        frozen(arm_open[first]),
        frozen(of_landmark),
    )
