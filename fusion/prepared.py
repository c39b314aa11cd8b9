"""What is worked out once per map before any two are compared: `PreparedMap`.

A recorded map is straightened first: its own measurements alone are solved, so that positions, headings and their
joint covariance are those of the least-squares optimum instead of whatever order the robot walked in.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of, signature
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.factors import is_bent, single_map_problem
from mapfuse.factors.heading import heading_is_joint

from .config import SolvingConfig
from .solve import solve

Array = NDArray[np.float64]

#: Dense joint covariances are kept up to this many landmarks per map (3n x 3n doubles).
MAX_LANDMARKS = 1000

ARMS = 4


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """A map at its own optimum, with everything that comparing it needs.

    ``positions`` (n, 2) [m] and ``headings`` (n,) [rad, NaN without] in the map's frame; ``covariance`` (3n, 3n) over
    (x, y, heading) of every landmark in order, map axes. ``arm_headings`` (n, 4) [rad, NaN padded], ``arm_passable``
    and ``arm_travelled`` (n, 4). ``corridors`` (m, 2): places in `map.landmarks` that a straight, travelled link joins.
    """

    map: LandmarkMap
    positions: Array
    headings: Array
    covariance: Array
    arm_headings: Array
    arm_passable: NDArray[np.bool_]
    arm_travelled: NDArray[np.bool_]
    corridors: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def headed(self) -> NDArray[np.bool_]:
        """Which landmarks have a heading (n,)."""
        return ~np.isnan(self.headings)

    @cached_property
    def has_arms(self) -> NDArray[np.bool_]:
        """Which landmarks have arms whose direction is known (n,)."""
        return np.asarray(~np.isnan(self.arm_headings).all(axis=1))

    @cached_property
    def arms_in_covariance(self) -> Array:
        """1/k where the covariance of the heading holds the mean error of a landmark's k arms already, else 0; (n,)."""
        inside = np.array([heading_is_joint(self.map, landmark) for landmark in self.map.landmarks], dtype=bool)
        arms = (~np.isnan(self.arm_headings)).sum(axis=1)
        return np.where(inside, 1 / np.maximum(arms, 1), 0.0)

    @cached_property
    def corridor_length(self) -> float:
        """Length [m] of all straight, travelled links."""
        ends = self.positions[self.corridors]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()) if len(ends) else 0.0

    @cached_property
    def local_density(self) -> Array:
        """Landmarks of the same type per square metre around each landmark (n,), from its nearest neighbours."""
        density = np.empty(len(self))
        types = np.array(self.map.types)
        spread = np.ptp(self.positions, axis=0) if len(self) else np.zeros(2)
        widest = np.pi * max(float(np.hypot(*spread)), 10.0) ** 2 / 4
        for label in set(self.map.types):
            of_label = np.flatnonzero(types == label)
            k = min(4, len(of_label) - 1)
            if k < 1:
                density[of_label] = 1 / widest
                continue
            found = cKDTree(self.positions[of_label]).query(self.positions[of_label], k=[k + 1])[0]
            distance = np.asarray(found)[:, 0]
            density[of_label] = k / np.maximum(np.pi * distance**2, k * 0.05)
        return np.maximum(density, 1 / widest)

    @cached_property
    def north(self) -> tuple[float, float] | None:
        """Direction of compass north in the map's frame [rad] and its standard deviation, or None.

        The circular median over all readings, so that steel near one of them does not turn the map.
        """
        off, noise = [], self.map.noise
        for k, landmark in enumerate(self.map.landmarks):
            shift = self.headings[k] - (heading_of(landmark) or 0.0) if self.headed[k] else 0.0
            for link in landmark.links:
                if link.compass is not None and link.heading is not None:
                    off.append(link.heading + shift - link.compass)
        if not off:
            return None
        angles = np.array(off)
        centre = float(np.angle(np.exp(1j * angles).sum()))
        for _ in range(5):
            residual = se2.wrap(angles - centre)
            weight = 1 / (1 + (residual / max(noise.compass_sigma, 1e-3)) ** 2)
            centre = float(se2.wrap(centre + (weight @ residual) / weight.sum()))
        offset = noise.compass_offset_sigma
        if offset is None:
            return None
        sigma = np.hypot(offset, max(noise.compass_sigma, 1e-3) / np.sqrt(weight.sum()))
        return centre, float(np.hypot(sigma, noise.heading_sigma / np.sqrt(len(angles))))


def _arms(map_: LandmarkMap, headings: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Directions of all arms, whether a corridor goes on there, and whether the robot travelled it."""
    directions = np.full((len(map_), ARMS), np.nan)
    passable = np.zeros((len(map_), ARMS), dtype=bool)
    travelled = np.zeros((len(map_), ARMS), dtype=bool)
    for k, landmark in enumerate(map_.landmarks):
        arms = signature(landmark)
        if arms.heading is not None:
            turned = np.array(arms.headings) + headings[k] - arms.heading
            directions[k, : len(turned)] = se2.wrap(turned)
            passable[k, : len(turned)] = arms.passable
            links = [landmark.links[place] for place in arms.links]
            travelled[k, : len(turned)] = [l.connected_to_id is not None and l.distance is not None for l in links]
    return directions, passable, travelled


def _corridors(map_: LandmarkMap, positions: Array, directions: Array, angle: float) -> NDArray[np.intp]:
    """Pairs of landmarks joined by a link that goes straight: along an arm at every end that has one."""
    found: set[tuple[int, int]] = set()
    bent: set[tuple[int, int]] = set()
    for k, landmark in enumerate(map_.landmarks):
        shift = directions[k] - (heading_of(landmark) or 0.0)
        for link in landmark.links:
            other = map_.index_from_id.get(link.connected_to_id or "")
            if other is None or other == k or link.heading is None:
                continue
            pair = (min(k, other), max(k, other))
            step = positions[other] - positions[k]
            off = se2.wrap(np.arctan2(step[1], step[0]) - link.heading - shift)
            straight = not is_bent(map_, landmark, link) and (abs(off) < angle or np.hypot(*step) < 1.0)
            (found if straight else bent).add(pair)
    return np.array(sorted(found - bent), dtype=np.intp).reshape(-1, 2)


def prepare(map_: LandmarkMap, config: SolvingConfig, corridor_angle: float = np.deg2rad(20.0)) -> PreparedMap:
    """Straighten a map and work out what comparing it needs.

    Raises `TooLargeError` above `MAX_LANDMARKS`, `UndeterminedError` where its measurements leave a landmark open.
    """
    if len(map_) > MAX_LANDMARKS:
        raise TooLargeError(
            f"map {map_.name!r} has {len(map_)} landmarks; joint covariances are kept up to {MAX_LANDMARKS}: "
            "split the map, or fuse parts of it"
        )
    headed = np.array([heading_of(landmark) is not None for landmark in map_.landmarks], dtype=bool)
    if len(map_) == 0:
        poses, covariance = np.zeros((0, 3)), np.zeros((0, 0))
    else:
        solution = solve(single_map_problem(map_), config)
        poses, covariance = solution.landmark_poses(0), solution.landmark_covariance(0)
    headings = np.where(headed, poses[:, 2], np.nan)
    directions, passable, travelled = _arms(map_, poses[:, 2])
    corridors = _corridors(map_, poses[:, :2], headings, corridor_angle)
    return PreparedMap(map_, poses[:, :2], headings, covariance, directions, passable, travelled, corridors)
