"""Where a map's frame is: anchors of landmarks in it, priors on it, and the gauge (measurement model, rows 6 and 7)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import Landmark, LandmarkMap

from .axes import point_to_body, wrapped
from .heading import headings_of
from .keys import FrameKey, map_keys
from .link import travelled_links
from .measurement import Between, Prior, Triple
from .noise import LOOSE_POSITION, LOOSE_ROTATION, TIGHT, PoseNoise


@dataclass(frozen=True, slots=True)
class FrameAnchor(Between):
    """A landmark's recorded position seen from its map's frame; its rotation says nothing (`HeadingPrior` does)."""

    readings: ClassVar[float] = 2.0


@dataclass(frozen=True, slots=True)
class TransformPrior(Prior):
    """A weak prior on ``T_r``, so that no graph floats."""

    @classmethod
    def weak(cls, r: int, T: ArrayLike, centre: ArrayLike = (0.0, 0.0)) -> TransformPrior:
        """Around the hypothesis ``T`` (3,), with `LOOSE_POSITION` and `LOOSE_ROTATION`: it doesn't pull.

        The position is that of ``centre`` (2,), a point of the map [m, map frame], not of its coordinates' origin,
        which may be anywhere: so the prior is the same whatever coordinates the map has. A tangent (v, omega) of
        ``T_r`` moves the centre by ``v + omega (-c_y, c_x)``.
        """
        x, y = np.asarray(centre, dtype=float).tolist()
        w = 1 / LOOSE_POSITION
        return cls(FrameKey(r), pose_triple(T), PoseNoise(w, 0.0, w, 1 / LOOSE_ROTATION, -y * w, x * w))


@dataclass(frozen=True, slots=True)
class Gauge(Prior):
    """The reference map's frame, held where it is: the merged frame is that map's frame."""

    @classmethod
    def held(cls, r: int, T: ArrayLike) -> Gauge:
        """At ``T`` (3,), with `TIGHT` in all rows."""
        return cls(FrameKey(r), pose_triple(T), PoseNoise.from_sigmas(TIGHT, TIGHT, TIGHT))


def pose_triple(T: ArrayLike) -> Triple:
    """A pose (3,) as plain floats; raises `MapfuseError` for another shape."""
    pose = np.asarray(T, dtype=float)
    if pose.shape != (3,):
        raise MapfuseError(f"a transformation needs x, y and theta, not an array of shape {pose.shape}")
    return float(pose[0]), float(pose[1]), float(pose[2])


def centre_of(recorded: LandmarkMap) -> tuple[float, float]:
    """Mean position [m, map frame] of the landmarks, to the last bit the same in any order; the origin without any."""
    n = max(1, len(recorded))
    return math.fsum(l.x for l in recorded.landmarks) / n, math.fsum(l.y for l in recorded.landmarks) / n


def components(recorded: LandmarkMap) -> tuple[tuple[str, ...], ...]:
    """Ids of the landmarks whose relative positions the links determine, each group and all of them by id.

    Two landmarks are linked where either recorded the distance and the direction to the other; a landmark without
    such a link is a group of its own.
    """
    parent = {name: name for name in recorded.ids}

    def root(name: str) -> str:
        while parent[name] != name:
            parent[name] = parent[parent[name]]
            name = parent[name]
        return name

    for landmark in recorded.landmarks:
        for link, far in travelled_links(recorded, landmark):
            if link.heading is not None:
                parent[root(far.id)] = root(landmark.id)
    groups: dict[str, list[str]] = {}
    for name in sorted(recorded.ids):
        groups.setdefault(root(name), []).append(name)
    return tuple(sorted(tuple(group) for group in groups.values()))


def nearest_to_start(recorded: LandmarkMap, ids: Iterable[str]) -> Landmark:
    """Of these landmarks the one recorded nearest to the robot's start, whatever their order.

    Of several at the same distance (to a micrometre) the one seen most often, with most links, first
    counter-clockwise from the start's heading, and only then the first by id.
    """
    ids = tuple(ids)
    if len(ids) == 1:
        return recorded[ids[0]]
    x, y, theta = recorded.start.tolist()

    def rank(landmark: Landmark) -> tuple[float, int, int, float, str]:
        dx, dy = landmark.x - x, landmark.y - y
        bearing = (math.atan2(dy, dx) - theta + 1e-6) % (2 * math.pi)
        distance = round(math.hypot(dx, dy), 6)
        return distance, -landmark.visit_counter, -len(landmark.links), round(bearing, 6), landmark.id

    return min((recorded[name] for name in ids), key=rank)


def anchor(recorded: LandmarkMap, r: int, landmark: Landmark) -> FrameAnchor:
    """The recorded position of a landmark, with its own covariance where it has one, else ``position_sigma``."""
    h = headings_of(recorded)[landmark.id] or 0.0
    sigma, keys = recorded.noise.position_sigma, map_keys(recorded, r)
    if landmark.covariance is None:
        noise = PoseNoise.from_sigmas(sigma, sigma, LOOSE_ROTATION)
    else:
        noise = PoseNoise.from_covariance(point_to_body(h, landmark.covariance[:2, :2]), LOOSE_ROTATION)
    return FrameAnchor(keys.frame, keys.landmarks[landmark.id], (landmark.x, landmark.y, wrapped(h)), noise)


def frame_anchors(recorded: LandmarkMap, r: int, explained: frozenset[str] = frozenset()) -> Iterator[FrameAnchor]:
    """One anchor for each group of linked landmarks, that is also for each landmark which no link explains.

    ``explained``: landmarks whose positions are known otherwise (by a joint covariance); a group with one of them
    needs no anchor.
    """
    for group in components(recorded):
        if explained.isdisjoint(group):
            yield anchor(recorded, r, nearest_to_start(recorded, group))
