"""Landmarks out of an occupancy grid, and how well each of them is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from .config import ExtractConfig
from .consensus import Agreed, agreed
from .grid import Grid
from .places import SAME_ARM

Array = NDArray[np.float64]

NOISE = Noise(
    distance_sigma_per_metre=0.005,
    distance_sigma_floor=0.1,
    heading_sigma=0.06,
    position_sigma=0.1,
    detection_rate=0.8,
    false_alarm_rate=0.15,
    door_detection_rate=0.8,
    door_false_alarm_rate=0.15,
)
#: Drift
_DRIFT, _DRIFT_LENGTH = 0.005, 30.0
_FLOOR = 0.07


def extract_landmarks(grid: Grid, config: ExtractConfig | None = None) -> LandmarkMap:
    found = agreed(grid, config or ExtractConfig())
    ids = [f"{one.place.type[0]}{k}" for k, one in enumerate(found, start=1)]
    landmarks = tuple(_landmark(k, found, ids) for k in range(len(found)))
    joint = JointCovariance(tuple(ids), 2, _joint(found)) if found else None
    return LandmarkMap(grid.name, landmarks, noise=NOISE, joint_covariance=joint)


def _landmark(k: int, found: Sequence[Agreed], ids: Sequence[str]) -> Landmark:
    one = found[k]
    links = []
    for arm in one.place.arms:
        heading, to = arm.direction, arm.to
        if to is not None:
            step = found[to].place.xy - one.place.xy
            bearing = float(np.arctan2(step[1], step[0]))
            if abs(float(se2.wrap(bearing - heading))) < SAME_ARM:
                links.append(Link("open", bearing, None, ids[to], float(np.hypot(*step)), 1))
                continue
        links.append(Link("open" if arm.passable else "blocked", heading))
    x, y = one.place.xy.tolist()
    return Landmark(ids[k], one.place.type, x, y, links=tuple(links), existence=float(np.clip(one.share, 0.0, 0.98)),
                    extra={"clearance": one.place.clearance, "degree": 3, "short": 2, "turn": 90})


def _joint(found: Sequence[Agreed]) -> Array:
    n = len(found)
    at = np.array([one.place.xy for one in found])
    apart2 = ((at[:, None] - at[None]) ** 2).sum(axis=-1)
    bend = (_DRIFT * _DRIFT_LENGTH) ** 2 * np.exp(-apart2 / (2 * _DRIFT_LENGTH**2))
    centred = np.eye(n) - 1 / n
    C = np.kron(centred @ bend @ centred, np.eye(2))
    for k, one in enumerate(found):
        C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += one.covariance + _FLOOR**2 * np.eye(2)
    return (C + C.T) / 2
