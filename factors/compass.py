"""Compass: absolute directions of arms, one north for all maps, one offset per robot (measurement model, row 9).

A reading is the true direction of an arm, minus north, minus the instrument's offset. With ``c_r`` = north plus offset
(in the merged frame) and the arm at ``theta_i + alpha`` there, ``reading = theta_i + alpha - c_r``; the arm's own
error, which is no part of its landmark's rotation (row 2), adds to the reading's. Steel bends some readings, so their
loss is robust in every solve, the last one too. Their information in marginals is then that of the weighted readings:
about an eighth less than of Gaussian ones where no steel is near, so it is never overstated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap

from .axes import wrapped
from .heading import arms_variance, headings_of, signatures_of
from .keys import CompassKey, NorthKey, Unknown, map_keys
from .measurement import Array, Between, Poses, Prior
from .noise import LOOSE_ROTATION, STEEL, PoseNoise

#: North and compasses are directions; this [m] only keeps their meaningless positions from floating.
PINNED_POSITION = 1.0


@dataclass(frozen=True, slots=True)
class CompassReading(Between):
    """A landmark's direction seen from its robot's compass, by one arm's reading; robust."""


@dataclass(frozen=True, slots=True)
class NorthOffset(Between):
    """The offset of one robot's compass, seen from the north that all maps share."""


@dataclass(frozen=True, slots=True)
class NorthPrior(Prior):
    """Where north is in the merged frame: unknown, so around its starting value and wide."""


def compass_readings(recorded: LandmarkMap, r: int) -> Iterator[CompassReading]:
    """All compass readings of arms whose heading is known, by landmark id.

    A joint covariance with headings is of all that the robot knew, its compass included: the readings of its landmarks
    say nothing more of how these lie to each other, and together they count as one, which ties the map to north.
    """
    keys, headings = map_keys(recorded, r), headings_of(recorded)
    if keys.compass is None:
        return
    joint = recorded.joint_covariance
    known = frozenset(joint.order if joint is not None and joint.rows == 3 else ())
    seen = {identifier: _seen(recorded[identifier], headings[identifier] or 0.0) for identifier in keys.landmarks}
    of_known = sum(len(seen[identifier]) for identifier in keys.landmarks if identifier in known)
    for identifier, key in keys.landmarks.items():
        sigma = _reading_sigma(recorded, recorded[identifier])
        if identifier in known:
            sigma *= float(np.sqrt(max(of_known, 1)))
        noise = PoseNoise.from_sigmas(np.inf, np.inf, sigma)
        for theta in seen[identifier]:
            yield CompassReading(keys.compass, key, (0.0, 0.0, theta), noise, STEEL)


def _seen(landmark: Landmark, heading: float) -> list[float]:
    """Compass readings of a landmark's arms, less how these stand to its heading [rad], in order."""
    return sorted(
        wrapped(link.compass - (link.heading - heading))
        for link in landmark.links
        if link.compass is not None and link.heading is not None
    )


def _reading_sigma(recorded: LandmarkMap, landmark: Landmark) -> float:
    """Standard deviation [rad] of a landmark's direction by one reading: the compass' own and the arm's own error.

    An arm of which it isn't known whether a corridor goes on takes no part in its landmark's heading. Where there are
    only such arms, both halves of their error count.
    """
    noise = recorded.noise
    own = (
        arms_variance(recorded, landmark, 1)
        if signatures_of(recorded)[landmark.id].headings
        else noise.heading_sigma**2
    )
    return float(np.sqrt(noise.compass_sigma**2 + own))


def robust_direction(angles: ArrayLike, sigmas: ArrayLike) -> float:
    """The direction [rad] that most of ``angles`` (n,) agree on, outliers or not.

    Of them (100 to 200 of many) the one with the least sum of robust losses, then a weighted circular mean.
    """
    angles = se2.wrap(angles)
    sigmas = np.broadcast_to(np.asarray(sigmas, dtype=float), angles.shape)
    order = np.lexsort((sigmas, angles))
    angles, sigmas = angles[order], sigmas[order]
    candidates = angles[:: max(1, len(angles) // 100)]
    k = STEEL.constant

    def weights(direction: Array | float) -> Array:
        return np.asarray(1 + (se2.wrap(angles - direction) / sigmas / k) ** 2)

    best = float(candidates[np.argmin(np.log(weights(candidates[:, None])).sum(axis=1))])
    for _ in range(10):
        w = 1 / weights(best) / sigmas**2
        best += float(w @ se2.wrap(angles - best) / w.sum())
    return float(se2.wrap(best))


def north_measurements(
    maps: Sequence[LandmarkMap], readings: Sequence[CompassReading], poses: Poses
) -> tuple[tuple[NorthOffset | NorthPrior, ...], Mapping[Unknown, Array]]:
    """North and offsets of all maps with readings, and starting values of their unknowns.

    A wide prior pulls towards its mean, however little: those here stand at the starting values, which follow from
    the landmarks' ``poses`` alone, so that they pull nowhere.
    """
    implied: dict[Unknown, list[tuple[float, float]]] = {}
    for reading in readings:
        direction = poses[reading.b][2] - reading.measured[2]
        implied.setdefault(reading.a, []).append((float(direction), 1 / reading.noise.tt))
    if not implied:
        return (), {}
    start = {compass: robust_direction(*np.array(seen).T) for compass, seen in implied.items()}
    offset_sigmas = {CompassKey(r): recorded.noise.compass_offset_sigma for r, recorded in enumerate(maps)}
    known = {c: sigma for c, sigma in offset_sigmas.items() if c in start and sigma is not None}
    if known:
        north = robust_direction([start[c] for c in known], [max(sigma, 0.01) for sigma in known.values()])
    else:
        north = next(iter(start.values()))
    found: list[NorthOffset | NorthPrior] = [NorthPrior(NorthKey(), (0.0, 0.0, north), _direction_noise(None))]
    for compass, theta in start.items():
        sigma = known.get(compass) if isinstance(compass, CompassKey) else None
        offset = 0.0 if sigma is not None else float(se2.wrap(theta - north))
        found.append(NorthOffset(NorthKey(), compass, (0.0, 0.0, offset), _direction_noise(sigma)))
    directions: dict[Unknown, float] = {NorthKey(): north, **start}
    return tuple(found), {unknown: np.array([0.0, 0.0, theta]) for unknown, theta in directions.items()}


def _direction_noise(sigma: float | None) -> PoseNoise:
    return PoseNoise.from_sigmas(PINNED_POSITION, PINNED_POSITION, LOOSE_ROTATION if sigma is None else sigma)
