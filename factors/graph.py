"""Maps and a hypothesis -> `Problem`: measurements, unknowns and starting values, to be edited or solved.

A `Problem` is a value without a solver: `Problem.graph` and `Problem.values` hand it to GTSAM, everything else about
it is numpy. Maps can be any number; the merged frame is the frame of the reference map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets import errors, se2
from mapfuse.datasets.arms import wrap
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform

from .compass import CompassReading, compass_readings, north_measurements
from .correspondence import Correspondence, correspondence
from .frame import Gauge, TransformPrior, centre_of, frame_anchors, pose_triple
from .heading import heading_measurements, headings_of
from .joint import JointMeasurement, joint_measurement
from .keys import ByIdentity, FrameKey, KeyBook, LandmarkKey, Unknown, map_keys
from .link import RangeMeasurement, link_measurements
from .measurement import Between, Measurement, Poses
from .noise import DOUBT, Loss, floored_eigen

Array = NDArray[np.float64]
Match = tuple[LandmarkKey, LandmarkKey]
#: What one map says of its own landmarks and frame.
MapMeasurement = Between | RangeMeasurement | JointMeasurement
Kind = TypeVar("Kind")


@dataclass(frozen=True, eq=False, slots=True)
class Problem:
    """What is measured of which unknowns, and where a solver starts.

    ``initial``: pose (3,) of every unknown in the merged frame [m, m, rad]; that frame is map ``reference``'s.

    >>> from mapfuse.datasets.maps import Landmark
    >>> problem = single_map_problem(LandmarkMap("D7", (Landmark("t1", "tree", 1.0, 2.0),)))
    >>> [type(measurement).__name__ for measurement in problem.measurements]
    ['Gauge', 'FrameAnchor', 'RotationPin']
    >>> problem.graph().error(problem.values())
    0.0
    """

    maps: tuple[LandmarkMap, ...]
    keys: KeyBook
    measurements: tuple[Measurement, ...]
    initial: Mapping[Unknown, Array]
    reference: int = 0

    def graph(self) -> Any:
        """All measurements as a ``gtsam.NonlinearFactorGraph``, in their order.

        Raises `UndeterminedError` naming the landmarks that no measurement mentions: GTSAM would leave them where
        they are in silence.
        """
        graph, kept = gtsam.NonlinearFactorGraph(), [_map_terms(recorded, r) for r, recorded in enumerate(self.maps)]
        made = {number: factor for terms in kept for number, factor in terms.factors.items()}
        for measurement in self.measurements:
            graph.add(made.get(id(measurement)) or measurement.factor(self.keys))
        mentioned = set(graph.keyVector())
        if len(mentioned) < len(self.keys):
            silent = [unknown for unknown in self.keys if self.keys.key(unknown) not in mentioned]
            landmarks = tuple((self.maps[u.map].name, u.id) for u in silent if isinstance(u, LandmarkKey))
            names = "" if landmarks else f" ({', '.join(self.keys.name(self.keys.key(u)) for u in silent)})"
            raise errors.UndeterminedError(f"no measurement says anything of these{names}", landmarks)
        return graph

    def values(self, poses: Poses | None = None) -> Any:
        """Starting values, or other ``poses``, as ``gtsam.Values``.

        Raises `MapfuseError` for a pose that is not finite; KeyError where one is missing.
        """
        poses = self.initial if poses is None else poses
        unknowns = self.keys.in_order
        rows = np.array([poses[unknown] for unknown in unknowns])
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            name = self.keys.name(self.keys.key(unknowns[int(np.argmin(finite))]))
            raise errors.MapfuseError(f"the starting value of {name} is not finite")
        values = gtsam.Values()
        for key, (x, y, theta) in zip(self.keys.keys(unknowns), rows.tolist(), strict=True):
            values.insert(key, gtsam.Pose2(x, y, theta))
        return values

    def poses(self, values: Any) -> dict[Unknown, Array]:
        """Poses (3,) of all unknowns out of ``gtsam.Values``, as a solver returns them."""
        return dict(zip(self.keys.in_order, gtsam.utilities.extractPose2(values), strict=True))

    def error(self, poses: Poses | None = None) -> float:
        """Sum of all errors in numpy [nats]; equals ``graph().error(values(poses))``."""
        poses = self.initial if poses is None else poses
        return float(sum(measurement.error(poses) for measurement in self.measurements))

    def of_kind(self, kind: type[Kind]) -> tuple[Kind, ...]:
        """The measurements of one class, in their order."""
        return tuple(measurement for measurement in self.measurements if isinstance(measurement, kind))

    def starting_at(self, poses: Poses) -> Problem:
        """The same problem with other starting values for some or all unknowns."""
        return replace(self, initial={**self.initial, **poses})

    def with_measurements(self, measurements: Iterable[Measurement]) -> Problem:
        """The same unknowns with other measurements."""
        return replace(self, measurements=tuple(measurements))

    def with_correspondences(self, matches: Iterable[Match], loss: Loss | None = None) -> Problem:
        """The same problem with these correspondences instead of its own; plain Gaussian without a ``loss``.

        Turns between the headings of matched landmarks follow from the frames' starting values.
        """
        kept = [m for m in self.measurements if not isinstance(m, Correspondence)]
        return replace(self, measurements=(*kept, *_correspondences(self.maps, self.initial, matches, loss)))


def build_problem(
    maps: Sequence[LandmarkMap],
    transforms: Sequence[Transform | ArrayLike],
    matches: Iterable[Match] = (),
    *,
    loss: Loss | None = None,
    starts: Sequence[ArrayLike | None] | None = None,
    reference: int = 0,
) -> Problem:
    """The problem of several maps under a hypothesis of how their frames lie and which landmarks are one.

    ``transforms``: for each map ``T_r`` (3,), into the merged frame; that of map ``reference`` is held there.
    ``matches``: pairs of `LandmarkKey` of different maps; of a landmark that n maps have, all n (n-1) / 2 of them
    (`correspondence` says why). ``loss``: robust loss of the correspondences (None: plain).
    ``starts``: for each map None (recorded positions) or better starting positions, (n, 2) [m] or poses (n, 3), in its
    own frame and the order of its landmarks; starting values only.

    Raises `MapError` for a map that no graph can be built of, `MapfuseError` for transforms, matches or starts that
    make no sense.
    """
    maps = tuple(maps)
    if not maps or len(transforms) != len(maps) or not 0 <= reference < len(maps):
        raise errors.MapfuseError(f"{len(maps)} maps need as many transformations, and one of them as reference")
    frames = [_pose(T, r) for r, T in enumerate(transforms)]
    given = [None] * len(maps) if starts is None else starts
    initial: dict[Unknown, Array] = {FrameKey(r): T for r, T in enumerate(frames)}
    measurements: list[Measurement] = []
    for r, (recorded, T, start) in enumerate(zip(maps, frames, given, strict=True)):
        own = map_measurements(recorded, r)
        measurements += [Gauge.held(r, T) if r == reference else TransformPrior.weak(r, T, centre_of(recorded)), *own]
        placed = se2.compose(T, _starting_poses(recorded, start))
        keys = map_keys(recorded, r).landmarks
        initial |= {keys[name]: pose for name, pose in zip(recorded.ids, placed, strict=True)}
    readings = [m for m in measurements if isinstance(m, CompassReading)]
    north, directions = north_measurements(maps, readings, initial)
    measurements += [*north, *_correspondences(maps, initial, matches, loss)]
    return Problem(maps, KeyBook(maps), tuple(measurements), {**initial, **directions}, reference)


def single_map_problem(recorded: LandmarkMap, start: ArrayLike | None = None) -> Problem:
    """One map alone, in its own frame."""
    return build_problem([recorded], [np.zeros(3)], starts=[start])


def pair_problem(
    map1: LandmarkMap,
    map2: LandmarkMap,
    T12: Transform | ArrayLike,
    correspondences: Iterable[tuple[str, str]],
    robust: bool = True,
    starts: tuple[ArrayLike | None, ArrayLike | None] = (None, None),
) -> Problem:
    """Two maps under a hypothesis: the merged frame is that of map 1, correspondences are (id in 1, id in 2).

    ``robust``: correspondences under the loss `noise.DOUBT`, for a first solve; False: plain, for the refit.
    """
    matches = [(LandmarkKey(0, a), LandmarkKey(1, b)) for a, b in correspondences]
    return build_problem([map1, map2], [np.zeros(3), T12], matches, loss=DOUBT if robust else None, starts=starts)


def map_measurements(recorded: LandmarkMap, r: int) -> tuple[Measurement, ...]:
    """All that map ``r`` says of its own landmarks and frame (links, anchors, headings, compass, joint covariance).

    Kept for the maps used last, since it is the same under every hypothesis. Raises `MapError` for numbers that are
    not finite, duplicate ids, links to landmarks that the map doesn't have, and covariances that are none.
    """
    return _map_terms(recorded, r).measurements


class _MapTerms:
    """What a map measures, and the GTSAM factor of each measurement by its identity: these live as long as this."""

    def __init__(self, recorded: LandmarkMap, r: int) -> None:
        # all but the names of the unknowns is the same whatever the map's place
        self.measurements = _placed(recorded, r) if r else _measured(recorded, 0)
        self._maps = r * [LandmarkMap("")] + [recorded]

    @cached_property
    def factors(self) -> Mapping[int, Any]:
        keys = KeyBook(self._maps)
        return {id(measurement): measurement.factor(keys) for measurement in self.measurements}


def _map_terms(recorded: LandmarkMap, r: int) -> _MapTerms:
    return _kept_terms(ByIdentity(recorded), r)


@lru_cache(maxsize=64)
def _kept_terms(cached: ByIdentity, r: int) -> _MapTerms:
    return _MapTerms(cached.recorded, r)


def _placed(recorded: LandmarkMap, r: int) -> tuple[MapMeasurement, ...]:
    """What the map measures as the first one of a problem, of its unknowns as map ``r``."""
    here, there = map_keys(recorded, 0), map_keys(recorded, r)
    of: dict[Unknown, Any] = {here.frame: there.frame}
    of |= zip(here.landmarks.values(), there.landmarks.values(), strict=True)
    if here.compass is not None:
        of[here.compass] = there.compass
    return tuple(
        replace(m, frame=of[m.frame], landmarks=tuple(of[key] for key in m.landmarks))
        if isinstance(m, JointMeasurement)
        else replace(m, a=of[m.a], b=of[m.b])
        for m in _map_terms(recorded, 0).measurements
    )


def _measured(recorded: LandmarkMap, r: int) -> tuple[MapMeasurement, ...]:
    _check_map(recorded)
    joint = joint_measurement(recorded, r)
    placed = frozenset(recorded.joint_covariance.order if recorded.joint_covariance else ())
    turned = placed if recorded.joint_covariance and recorded.joint_covariance.rows == 3 else frozenset()
    links = list(link_measurements(recorded, r))
    if placed:
        joined = {LandmarkKey(r, name) for name in placed}
        links = [m for m in links if not joined.issuperset(m.unknowns)]
    return (
        *frame_anchors(recorded, r, explained=placed),
        *heading_measurements(recorded, r, known=turned),
        *links,
        *([joint] if joint is not None else []),
        *compass_readings(recorded, r),
    )


_SIGMAS = ("distance_sigma_per_metre", "distance_sigma_floor", "heading_sigma", "position_sigma", "compass_sigma")


def _check_map(recorded: LandmarkMap) -> None:
    """Raise `MapError` with all places where GTSAM would take a broken number in silence."""
    broken: list[errors.Problem] = []
    if len(set(recorded.ids)) < len(recorded):
        broken.append(errors.Problem("landmarks", "two landmarks have the same id"))
    for k, landmark in enumerate(recorded.landmarks):
        if _is_finite(landmark):
            continue
        numbers = {"x": landmark.x, "y": landmark.y, "heading": landmark.heading}
        for j, link in enumerate(landmark.links):
            at = f"links[{j}]."
            numbers |= {f"{at}heading": link.heading, f"{at}compass": link.compass, f"{at}distance": link.distance}
            if link.distance is not None and link.distance < 0:
                broken.append(errors.Problem(f"landmarks[{k}].{at}distance", "is negative"))
        bad = [name for name, number in numbers.items() if number is not None and not np.isfinite(number)]
        broken += [errors.Problem(f"landmarks[{k}].{name}", "is not a finite number") for name in bad]
        broken += _covariance_problems(f"landmarks[{k}].covariance", landmark.covariance)
    n = recorded.noise
    for name in _SIGMAS:
        if not 0 <= getattr(n, name) < np.inf:
            broken.append(errors.Problem(f"noise.{name}", "must be a finite number, not negative"))
    if n.compass_offset_sigma is not None and not 0 <= n.compass_offset_sigma < np.inf:
        broken.append(errors.Problem("noise.compass_offset_sigma", "must be a finite number, not negative, or null"))
    if broken:
        raise errors.MapError(recorded.name, tuple(broken))


def _is_finite(landmark: Landmark) -> bool:
    """Whether all numbers are finite and distances not negative: most are, and listing them all takes long."""
    if landmark.covariance is not None:
        return False
    total = landmark.x + landmark.y + (landmark.heading or 0.0)
    for link in landmark.links:
        total += (link.heading or 0.0) + (link.compass or 0.0)
        if link.distance is not None:
            if link.distance < 0:
                return False
            total += link.distance
    return math.isfinite(total)


def _covariance_problems(place: str, covariance: Array | None) -> list[errors.Problem]:
    if covariance is None:
        return []
    if np.shape(covariance) not in {(2, 2), (3, 3)}:
        return [errors.Problem(place, f"must be 2x2 or 3x3, not {np.shape(covariance)}")]
    try:
        floored_eigen(covariance)
    except errors.MapfuseError as error:
        return [errors.Problem(place, str(error))]
    return []


def _pose(T: Transform | ArrayLike, r: int) -> Array:
    pose = np.array(pose_triple(T.array if isinstance(T, Transform) else T))
    if not np.isfinite(pose).all():
        raise errors.MapfuseError(f"the transformation of map {r} is not finite: {pose.tolist()}")
    return pose


def _starting_poses(recorded: LandmarkMap, start: ArrayLike | None) -> Array:
    """Poses (n, 3) of all landmarks in their map's frame; theta 0 for landmarks without heading."""
    n = len(recorded)
    of = headings_of(recorded)
    headings = [of[name] for name in recorded.ids]
    thetas = np.array([0.0 if h is None else h for h in headings], dtype=float)
    positions = recorded.positions
    if start is not None:
        given = np.asarray(start, dtype=float)
        if given.shape not in ((n, 2), (n, 3)) or not np.isfinite(given).all():
            raise errors.MapfuseError(f"starting poses of map {recorded.name!r} must be finite, ({n}, 2) or ({n}, 3)")
        positions = given[:, :2]
        if given.shape[-1] > 2:
            thetas = np.where([h is None for h in headings], 0.0, given[:, 2])
    return np.column_stack([positions, thetas]).reshape(n, 3)


def _correspondences(
    maps: Sequence[LandmarkMap], initial: Poses, matches: Iterable[Match], loss: Loss | None
) -> list[Correspondence]:
    found: list[Correspondence] = []
    matches = list(dict.fromkeys(matches))
    robots = _robots(matches)
    for a, b in matches:
        for key in (a, b):
            if not (0 <= key.map < len(maps) and key.id in maps[key.map].index_from_id):
                reason = f"a correspondence names landmark {key.id!r}, which map {key.map} doesn't have"
                raise errors.MapfuseError(reason)
        if a.map == b.map:
            raise errors.MapfuseError(f"a correspondence joins {a.id!r} and {b.id!r} of one map")
        rotation = wrap(float(initial[FrameKey(b.map)][2] - initial[FrameKey(a.map)][2]))
        found.append(correspondence(maps[a.map], a, maps[b.map], b, rotation, loss, robots[a]))
    return found


def _robots(matches: Iterable[Match]) -> dict[LandmarkKey, int]:
    """How many recorded landmarks are one place with each matched one, itself counted."""
    place: dict[LandmarkKey, set[LandmarkKey]] = {}
    for a, b in matches:
        joined = place.get(a, {a}) | place.get(b, {b})
        place |= dict.fromkeys(joined, joined)
    return {key: len(members) for key, members in place.items()}
