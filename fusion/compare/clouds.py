"""Open3D's registrations of point clouds, which know nothing of landmarks: each is a point with a descriptor of ours.

Landmarks become points in a plane, and a descriptor says who stands around each. RANSAC looks for a motion on
which most descriptors agree; ICP then lays the points on each other. Needs the extra ``mapfuse[open3d]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import matched_under

from ..show.viewer import open3d
from .method import Merge
from .rigid import rigid_merge

Array = NDArray[np.float64]

RINGS, SECTORS = 8, 8
#: Neighbours looked at, and labels that the descriptor tells apart.
NEIGHBOURS, LABELS = 24, 6
RANSAC_TRIALS, RANSAC_CONFIDENCE = 100_000, 0.999
ICP_ROUNDS = 200
#: Of Open3D's draws. It draws in several threads, so that a close call may still come out otherwise.
SEED = 0


def missing_open3d() -> str:
    """Why Open3D's methods can't run here, or an empty string; Open3D isn't loaded for it."""
    if find_spec("open3d") is None:
        return "Open3D isn't installed; it comes with mapfuse[open3d]"
    return ""


def merge_by_ransac(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None) -> Merge:
    """RANSAC on descriptors, then the rigid merge. Raises MapfuseError where Open3D can't be loaded."""
    config = config or MatchingConfig()
    return _merge(map1, map2, ransac(map1, map2, config.tolerance_m), config)


def merge_by_icp(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None) -> Merge:
    """RANSAC, its T12 refined by point-to-point ICP where that finds one, then the rigid merge.

    Raises as `merge_by_ransac`.
    """
    config = config or MatchingConfig()
    T12 = ransac(map1, map2, config.tolerance_m)
    refined = None if T12 is None else icp(map1, map2, T12, config.tolerance_m)
    return _merge(map1, map2, T12 if refined is None else refined, config)


def _merge(map1: LandmarkMap, map2: LandmarkMap, T12: Array | None, config: MatchingConfig) -> Merge:
    if T12 is None:
        return Merge("no_overlap", None)
    found = Transform.from_array(T12)
    return rigid_merge(map1, map2, found, matched_under(map1, map2, found, config))


def ransac(
    map1: LandmarkMap, map2: LandmarkMap, tolerance_m: float, described: tuple[Array, Array] | None = None
) -> Array | None:
    """T12 (3,) by RANSAC on descriptors; None where there are fewer than three points, or the plane is turned over.

    ``described``: of both maps (n, d), by default `descriptors`.
    """
    o3d = open3d()
    if min(len(map1), len(map2)) < 3:
        return None
    registration: Any = o3d.pipelines.registration
    features = []
    for of_map in reversed(described or descriptors(map1, map2)):
        feature = registration.Feature()
        feature.data = of_map.T
        features.append(feature)
    o3d.utility.random.seed(SEED)
    with _quiet(o3d):
        found = registration.registration_ransac_based_on_feature_matching(
            _cloud(o3d, map2),
            _cloud(o3d, map1),
            *features,
            False,
            tolerance_m,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(tolerance_m),
            ],
            registration.RANSACConvergenceCriteria(RANSAC_TRIALS, RANSAC_CONFIDENCE),
        )
    return _in_plane(np.asarray(found.transformation))


def icp(map1: LandmarkMap, map2: LandmarkMap, T12: Array, tolerance_m: float) -> Array | None:
    """T12 (3,) by point-to-point ICP from a start (3,); partners are within ``tolerance_m``, whatever they are."""
    o3d = open3d()
    registration: Any = o3d.pipelines.registration
    start = np.eye(4)
    start[:2, :2], start[:2, 3] = se2.rotation(T12[2]), T12[:2]
    with _quiet(o3d):
        found = registration.registration_icp(
            _cloud(o3d, map2),
            _cloud(o3d, map1),
            tolerance_m,
            start,
            registration.TransformationEstimationPointToPoint(False),
            registration.ICPConvergenceCriteria(1e-9, 1e-9, ICP_ROUNDS),
        )
    return _in_plane(np.asarray(found.transformation))


def _quiet(o3d: Any) -> Any:
    """Open3D warns on standard output of what is an answer here."""
    return o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)


def _cloud(o3d: Any, recorded: LandmarkMap) -> Any:
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(np.column_stack([recorded.positions, np.zeros(len(recorded))]))
    return cloud


def _in_plane(motion: Array) -> Array | None:
    """A motion (4, 4) in space as T12 (3,); None where it turns the plane over, or is none."""
    R = motion[:3, :3]
    if not np.isfinite(motion).all() or R[2, 2] < 0:
        return None
    theta = np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    return np.array([motion[0, 3], motion[1, 3], float(se2.wrap(theta))])


def descriptor(recorded: LandmarkMap, labels: Sequence[str], ring_m: float) -> Array:
    """Who is around each landmark, (n, d): neighbours by label, distance, and direction from its heading.

    Without heading, directions are left out. ``labels``: of both maps together; ``ring_m`` [m]: width of a ring.
    Smoothed over neighbouring rings and sectors, so that noise changes it little.
    """
    xy, n = recorded.positions, len(recorded)
    code = {label: k % LABELS for k, label in enumerate(labels)}
    label = np.array([code[t] for t in recorded.types])
    headings = [heading_of(landmark) for landmark in recorded.landmarks]
    heading = np.array([np.nan if h is None else h for h in headings])
    found = KDTree(xy).query(xy, k=list(range(2, min(NEIGHBOURS + 1, n) + 1)))
    length, near = np.asarray(found[0]), np.asarray(found[1])
    offset = xy[near] - xy[:, None]
    direction = np.arctan2(offset[..., 1], offset[..., 0]) - np.nan_to_num(heading)[:, None]
    rings = np.exp(-0.5 * (length[..., None] / ring_m - np.arange(RINGS) - 0.5) ** 2)
    sectors = np.exp(2 * (np.cos(direction[..., None] - np.arange(SECTORS) * (2 * np.pi / SECTORS)) - 1))
    sectors[np.isnan(heading)] = 1 / SECTORS
    kinds = np.eye(LABELS)[label[near]]
    around = np.einsum("nkr,nks,nkl->nrsl", rings, sectors, kinds).reshape(n, -1)
    around = np.sqrt(around / np.maximum(around.sum(axis=1, keepdims=True), 1e-9))
    return np.ascontiguousarray(np.hstack([around, 2.0 * np.eye(LABELS)[label]]))


def descriptors(map1: LandmarkMap, map2: LandmarkMap) -> tuple[Array, Array]:
    """The descriptors of two maps' landmarks, with labels and rings of both."""
    labels = sorted({*map1.types, *map2.types})
    nearest = np.asarray(KDTree(map1.positions).query(map1.positions, k=[min(7, len(map1))])[0])
    ring = max(float(np.median(nearest)) / 2, 1e-6)
    return descriptor(map1, labels, ring), descriptor(map2, labels, ring)
