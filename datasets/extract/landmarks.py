"""Landmarks out of an occupancy grid, and how well each of them is known.

What such an extraction is known to be was measured where nothing judges it: Willow Garage's grid against itself turned
by random angles, and two grids of one care home made in different years (STRANDS), of which no test knows. The command
for it is ``benchmarks/extraction.py repeatability``, and docs/extraction.md has the table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..arms import wrap
from ..maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from .config import ExtractConfig
from .consensus import Agreed, agreed
from .grid import Grid
from .places import SAME_ARM
from .walls import walls_of

Array = NDArray[np.float64]

#: Detection is that between sessions; of one grid more is found again, and existence says of each landmark how much.
NOISE = Noise(
    distance_sigma_per_metre=0.005,
    distance_sigma_floor=0.08,
    heading_sigma=0.08,
    position_sigma=0.08,
    detection_rate=0.75,
    false_alarm_rate=0.2,
    door_detection_rate=0.75,
    door_false_alarm_rate=0.2,
)
#: A place on which all looks agree is there with this probability: another session may have found the door shut.
_SURE = 0.95
#: The grid is bent smoothly: a distance d in it is wrong by this share of d, up to about this length [m].
_BEND, _BEND_LENGTH = 0.005, 30.0


def extract_landmarks(grid: Grid, config: ExtractConfig | None = None) -> LandmarkMap:
    """Corners, junctions, ends and doors of a grid with their arms and links, its walls, and how sure all that is.

    Positions are in the grid's map frame [m]; their joint covariance holds what looks at the grid from several sides
    differ by, and a smooth bend of the grid as a whole. ``existence`` of each landmark is the share of looks that found
    it. A grid without corridors gives a map without landmarks.

    >>> cells = np.full((60, 200), -1, dtype=np.int8)
    >>> cells[18:42, 8:192], cells[20:40, 10:190] = 100, 0
    >>> map_ = extract_landmarks(Grid("corridor", cells, 0.1, [0, 0, 0]))
    >>> sorted((landmark.type, round(landmark.x), round(landmark.y)) for landmark in map_.landmarks)
    [('corner', 2, 3), ('corner', 18, 3)]
    """
    config = config or ExtractConfig()
    found = agreed(grid, config)
    ids = [f"{one.place.type[0]}{k}" for k, one in enumerate(found, start=1)]
    landmarks = tuple(_landmark(k, found, ids) for k in range(len(found)))
    joint = JointCovariance(tuple(ids), 2, _joint(found)) if found else None
    return LandmarkMap(grid.name, landmarks, noise=NOISE, joint_covariance=joint, walls=walls_of(grid, config))


def _landmark(k: int, found: Sequence[Agreed], ids: Sequence[str]) -> Landmark:
    one = found[k]
    links = []
    for arm in one.place.arms:
        step = None if arm.to is None else found[arm.to].place.xy - one.place.xy
        bearing = None if step is None else float(np.arctan2(step[1], step[0]))
        if (
            arm.to is not None
            and step is not None
            and bearing is not None
            and abs(wrap(bearing - arm.direction)) < SAME_ARM
        ):
            links.append(Link("open", bearing, None, ids[arm.to], float(np.hypot(*step)), 1))
        else:
            links.append(Link("open" if arm.passable else "blocked", arm.direction))
    x, y = one.place.xy.tolist()
    return Landmark(ids[k], one.place.type, x, y, links=tuple(links), existence=_SURE * one.share)


def _joint(found: Sequence[Agreed]) -> Array:
    """Covariance (2n, 2n) [m^2] of all positions, with the bend's mean taken out: the frame is where the grid is."""
    n = len(found)
    at = np.array([one.place.xy for one in found])
    apart2 = ((at[:, None] - at[None]) ** 2).sum(axis=-1)
    bend = (_BEND * _BEND_LENGTH) ** 2 * np.exp(-apart2 / (2 * _BEND_LENGTH**2))
    centred = np.eye(n) - 1 / n
    covariance = np.kron(centred @ bend @ centred, np.eye(2))
    for k, one in enumerate(found):
        place = slice(2 * k, 2 * k + 2)
        covariance[place, place] += one.covariance + NOISE.position_sigma**2 * np.eye(2)
    return np.asarray((covariance + covariance.T) / 2)
