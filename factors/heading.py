"""Headings: which way a landmark faces, seen from its map's frame (measurement model, row 2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mapfuse.datasets import arms
from mapfuse.datasets.maps import Landmark, LandmarkMap

from .keys import ByIdentity, map_keys
from .measurement import Between
from .noise import PINNED_ROTATION, PoseNoise


@dataclass(frozen=True, slots=True)
class HeadingPrior(Between):
    """A landmark's heading seen from its map's frame; its position says nothing."""


@dataclass(frozen=True, slots=True)
class RotationPin(Between):
    """The rotation of a landmark without heading, held to its map's frame, where it means nothing."""


def headings_of(recorded: LandmarkMap) -> Mapping[str, float | None]:
    """Heading [rad, map frame] of each landmark by id, None where it has none; kept for the maps used last."""
    return _directions(ByIdentity(recorded))[0]


def signatures_of(recorded: LandmarkMap) -> Mapping[str, arms.ArmSignature]:
    """Arm signature of each landmark by id; kept for the maps used last."""
    return _directions(ByIdentity(recorded))[1]


@lru_cache(maxsize=256)
def _directions(cached: ByIdentity) -> tuple[Mapping[str, float | None], Mapping[str, arms.ArmSignature]]:
    signatures = {landmark.id: arms.signature(landmark) for landmark in cached.recorded.landmarks}
    headings: dict[str, float | None] = {}
    for landmark in cached.recorded.landmarks:
        of_arms = signatures[landmark.id].heading
        headings[landmark.id] = landmark.heading if of_arms is None else of_arms
    return headings, signatures


def heading_sigma(recorded: LandmarkMap, landmark: Landmark) -> float:
    """Standard deviation [rad] of what all of a landmark's directions are off by: ``heading_sigma / sqrt 2`` (row 1).

    The rotation that is estimated is where the robot stood by its own heading; each arm's own error counts where that
    arm is used, in its link and in correspondences. Without arms: that of its own 3x3 covariance, else
    ``heading_sigma``.
    """
    if signatures_of(recorded)[landmark.id].headings:
        return float(recorded.noise.heading_sigma / np.sqrt(2))
    if landmark.covariance is not None and landmark.covariance.shape == (3, 3):
        return float(np.sqrt(max(0.0, landmark.covariance[2, 2])))
    return float(recorded.noise.heading_sigma)


def heading_is_joint(recorded: LandmarkMap, landmark: Landmark) -> bool:
    """Whether the map's joint covariance gives this landmark's heading, errors of its arms included (row 8)."""
    joint = recorded.joint_covariance
    return joint is not None and joint.rows == 3 and landmark.id in joint.order


def arms_variance(recorded: LandmarkMap, landmark: Landmark, used: int) -> float:
    """Variance [rad^2] of a direction read off ``used`` of a landmark's k arms, beyond that of its rotation (row 2).

    Each arm adds its own error: ``heading_sigma^2 / 2 / used``. Where a joint covariance gives the heading, the mean
    error of all arms is in there already, and only the rest counts: ``heading_sigma^2 / 2 (1 / used - 1 / k)``.
    """
    k = len(signatures_of(recorded)[landmark.id].headings)
    if not used or not k:
        return 0.0
    rest = 1 / k if heading_is_joint(recorded, landmark) else 0.0
    return float(recorded.noise.heading_sigma**2 / 2 * max(0.0, 1 / used - rest))


def heading_measurements(
    recorded: LandmarkMap, r: int, known: frozenset[str] = frozenset()
) -> Iterator[HeadingPrior | RotationPin]:
    """A prior for each landmark with a heading, a pin for each without, by id.

    ``known``: landmarks whose headings a joint covariance gives.
    """
    keys, headings = map_keys(recorded, r), headings_of(recorded)
    for identifier, key in keys.landmarks.items():
        h = headings[identifier]
        if h is None:
            noise = PoseNoise.from_sigmas(np.inf, np.inf, PINNED_ROTATION)
            yield RotationPin(keys.frame, key, (0.0, 0.0, 0.0), noise)
        elif identifier not in known:
            noise = PoseNoise.from_sigmas(np.inf, np.inf, heading_sigma(recorded, recorded[identifier]))
            yield HeadingPrior(keys.frame, key, (0.0, 0.0, h), noise)
