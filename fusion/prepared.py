"""What is worked out once per map before any two are compared: `PreparedMap`.

A recorded map is straightened first: its own measurements alone are solved, so that positions, headings and their
joint covariance are those of the least-squares optimum instead of whatever order the robot walked in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import atan2, hypot, isnan

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.arms import wrap as turned
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import CORNER, Landmark, LandmarkMap, Link
from mapfuse.factors import is_bent, single_map_problem
from mapfuse.factors.axes import wrapped
from mapfuse.factors.heading import heading_is_joint, headings_of, signatures_of

from .config import SolvingConfig
from .credibility import false_by_own_map, stated_false, straight_on
from .noisefit import noise_fits, scaled
from .result import NoiseFit
from .solve import Solution, solve

Array = NDArray[np.float64]

#: Dense joint covariances are kept up to this many landmarks per map (3n x 3n doubles).
MAX_LANDMARKS = 1000

ARMS = 4

#: Among up to so many points all distances are worked out sooner than a tree is built.
FEW = 100


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """A map at its own optimum, with everything that comparing it needs.

    ``positions`` (n, 2) [m] and ``headings`` (n,) [rad, NaN without] in the map's frame; ``solution``: that optimum,
    for covariances (None of an empty map). ``arm_headings`` (n, 4) [rad, NaN padded], ``arm_passable`` and
    ``arm_travelled`` (n, 4). ``corridors`` (m, 2): places in `map.landmarks` that a straight, travelled link joins.
    """

    map: LandmarkMap
    positions: Array
    headings: Array
    solution: Solution | None
    arm_headings: Array
    arm_passable: NDArray[np.bool_]
    arm_travelled: NDArray[np.bool_]
    corridors: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def poses(self) -> Array:
        """Positions and headings (n, 3) in the map's frame, 0 for the heading of a landmark without one."""
        return np.column_stack([self.positions, np.where(self.headed, self.headings, 0.0)])

    @cached_property
    def covariance(self) -> Array:
        """Joint covariance (3n, 3n) over (x, y, heading) of every landmark in order, map axes.

        Raises `TooLargeError` above `MAX_LANDMARKS`: those of a few come from ``solution.covariances``, at any size.
        """
        if len(self) > MAX_LANDMARKS:
            raise TooLargeError(_too_large(self.map))
        return np.zeros((0, 0)) if self.solution is None else self.solution.landmark_covariance(0)

    @cached_property
    def noise_scale(self) -> float:
        """By how much, 1 or more, the stated sigmas are too small, where this map's own residuals refute them.

        Maps are compared with it; what is reported stays as stated (docs/evidence.md, "Wrong noise").
        """
        fit = self.noise_fit
        return 1.0 if fit.can_be_true else max(fit.estimate, 1.0)

    @cached_property
    def noise_fit(self) -> NoiseFit:
        """How the map's own measurements fit the noise that it states; an empty map has none."""
        return NoiseFit(0.0, 0.0) if self.solution is None else noise_fits(self.solution)[0]

    @cached_property
    def straightened(self) -> LandmarkMap:
        """The recorded map at its own optimum, positions and arm headings, with believable noise; for the matcher."""
        of = headings_of(self.map)
        moved = zip(self.map.landmarks, self.positions.tolist(), self.headings.tolist(), strict=True)
        landmarks = (
            _moved(landmark, x, y, 0.0 if isnan(heading) else heading - (of[landmark.id] or 0.0))
            for landmark, (x, y), heading in moved
        )
        return scaled(self.map.replace(landmarks=tuple(landmarks)), self.noise_scale)

    @cached_property
    def headed(self) -> NDArray[np.bool_]:
        """Which landmarks have a heading (n,)."""
        return ~np.isnan(self.headings)

    @cached_property
    def has_arms(self) -> NDArray[np.bool_]:
        """Which landmarks have arms whose direction is known (n,)."""
        return np.asarray(~np.isnan(self.arm_headings).all(axis=1))

    @property
    def false(self) -> Array:
        """Probability that each recorded landmark isn't there, by this map alone (n,).

        Where the map states the existence of one, that is it.
        """
        return self._believed[0]

    def goes_straight(self, kind: str) -> float:
        """Share of the landmarks of a kind, of those its robot passes, that it drives straight through.

        1 for corners: driving straight across one contradicts its arms, which is counted where these are.
        """
        return 1.0 if kind == CORNER else self._believed[1].get(kind, 1.0)

    @cached_property
    def _believed(self) -> tuple[Array, dict[str, float]]:
        stated = np.array([stated_false(self.map, k) for k in range(len(self))], dtype=float)
        settled = np.array([landmark.existence is not None for landmark in self.map.landmarks], dtype=bool)
        ways = straight_on(self.arm_headings, self.arm_passable, self.arm_travelled)
        visits = np.array([max(landmark.visit_counter, 1) for landmark in self.map.landmarks], dtype=float)
        false, shares = false_by_own_map(stated, self.map.types, settled, *ways, visits)
        armed = {self.map.types[k] for k in np.flatnonzero(self.has_arms)}
        return false, {kind: share for kind, share in shares.items() if kind in armed}

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
            distance = _to_nearest(self.positions[of_label], k)
            density[of_label] = k / np.maximum(np.pi * distance**2, k * 0.05)
        return np.maximum(density, 1 / widest)

    @cached_property
    def north(self) -> tuple[float, float] | None:
        """Direction of compass north in the map's frame [rad] and its standard deviation, or None.

        The circular median over all readings, so that steel near one of them does not turn the map.
        """
        off, noise, of = [], self.map.noise, headings_of(self.map)
        for k, landmark in enumerate(self.map.landmarks):
            shift = self.headings[k] - (of[landmark.id] or 0.0) if self.headed[k] else 0.0
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


def _to_nearest(points: Array, k: int) -> Array:
    """Distance [m] of each point (n, 2) to its k-th nearest other one (n,)."""
    if len(points) > FEW:
        return np.asarray(cKDTree(points).query(points, k=[k + 1])[0])[:, 0]
    apart = points[:, None] - points
    return np.asarray(np.sqrt(np.partition((apart**2).sum(axis=2), k, axis=1)[:, k]))


def _moved(landmark: Landmark, x: float, y: float, turn: float) -> Landmark:
    """The landmark at another place, it and its arms turned [rad]."""
    links = tuple(
        link
        if link.heading is None
        else Link(
            link.type,
            turned(link.heading + turn),
            link.compass,
            link.connected_to_id,
            link.distance,
            link.travel_counter,
            link.extra,
        )
        for link in landmark.links
    )
    heading = None if landmark.heading is None else turned(landmark.heading + turn)
    return replace(landmark, x=x, y=y, links=links, heading=heading)


def _arms(map_: LandmarkMap, headings: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Directions of all arms, whether a corridor goes on there, and whether the robot travelled it."""
    recorded = np.full((len(map_), ARMS), np.nan)
    passable = np.zeros((len(map_), ARMS), dtype=bool)
    travelled = np.zeros((len(map_), ARMS), dtype=bool)
    own = np.zeros(len(map_))
    of, signatures = headings_of(map_), signatures_of(map_)
    for k, landmark in enumerate(map_.landmarks):
        arms = signatures[landmark.id]
        if arms.headings:
            n, own[k] = len(arms.headings), of[landmark.id]
            recorded[k, :n], passable[k, :n] = arms.headings, arms.passable
            links = [landmark.links[place] for place in arms.links]
            travelled[k, :n] = [l.connected_to_id is not None and l.distance is not None for l in links]
    return np.asarray(se2.wrap(recorded + headings[:, None] - own[:, None])), passable, travelled


def straight_corridors(map_: LandmarkMap, positions: Array, headings: Array, angle: float) -> NDArray[np.intp]:
    """Pairs of landmarks joined by a link that goes straight: along an arm at every end that has one."""
    found: set[tuple[int, int]] = set()
    bent: set[tuple[int, int]] = set()
    of, xy = headings_of(map_), positions.tolist()
    for k, (landmark, heading) in enumerate(zip(map_.landmarks, headings.tolist(), strict=True)):
        shift = heading - (of[landmark.id] or 0.0)
        for link in landmark.links:
            other = map_.index_from_id.get(link.connected_to_id or "")
            if other is None or other == k or link.heading is None:
                continue
            dx, dy = xy[other][0] - xy[k][0], xy[other][1] - xy[k][1]
            off = wrapped(atan2(dy, dx) - link.heading - shift)
            straight = (abs(off) < angle or hypot(dx, dy) < 1.0) and not is_bent(map_, landmark, link)
            (found if straight else bent).add((min(k, other), max(k, other)))
    return np.array(sorted(found - bent), dtype=np.intp).reshape(-1, 2)


def _too_large(map_: LandmarkMap) -> str:
    return (
        f"map {map_.name!r} has {len(map_)} landmarks; joint covariances are kept up to {MAX_LANDMARKS}: "
        "split the map, or fuse parts of it"
    )


def prepare(
    map_: LandmarkMap,
    config: SolvingConfig,
    corridor_angle: float = np.deg2rad(20.0),
    *,
    max_landmarks: int = MAX_LANDMARKS,
) -> PreparedMap:
    """Straighten a map and work out what comparing it needs.

    Raises `TooLargeError` above ``max_landmarks``, `UndeterminedError` where its measurements leave a landmark open.
    """
    if len(map_) > max_landmarks:
        raise TooLargeError(_too_large(map_))
    of = headings_of(map_)
    headed = np.array([of[name] is not None for name in map_.ids], dtype=bool)
    solution = solve(single_map_problem(map_), config) if len(map_) else None
    poses = np.zeros((0, 3)) if solution is None else solution.landmark_poses(0)
    if solution is not None:
        solution.check_determined()
    headings = np.where(headed, poses[:, 2], np.nan)
    directions, passable, travelled = _arms(map_, poses[:, 2])
    # of one memory layout for any number of landmarks, which is part of a compiled loop's types
    positions = np.ascontiguousarray(poses[:, :2])
    corridors = straight_corridors(map_, positions, headings, corridor_angle)
    return PreparedMap(map_, positions, headings, solution, directions, passable, travelled, corridors)
