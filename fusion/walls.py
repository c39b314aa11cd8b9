"""Walls of two maps laid on each other: point-to-line ICP in the plane, and what it knows of T12.

Points are taken along the walls of map 2; each looks for the nearest point of map 1's walls and measures its distance
from that wall's line. Gauss-Newton over (x, y, theta) with new partners at every step ends where nothing moves.

**Noise.** Points of one wall share the wall's own error, so that counting points would promise far too much. A wall is
a line whose two ends are each off sideways by an error of their own (``wall_sigma``), and points scatter about it
(``point_sigma``). Both are estimated from the residuals, and the information is that of least squares with such walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.values import frozen_array

Array = NDArray[np.float64]
Places = NDArray[np.intp]

#: Directions that know less than this share of the best known one are not moved, nor promised to be known.
LEAST_KNOWN = 1e-6
#: Walls run alike where the cosine of their angle is above this; pairs of walls meet on at least this length, and there
#: are so many of them, where they are to say how large their errors are.
ALIKE, LEAST_STRETCH_M, LEAST_PAIRS = 0.9, 0.5, 2


@dataclass(frozen=True, slots=True)
class WallConfig:
    """``spacing_m``: distance of points along walls; ``gate_m``: how far apart partners may be; ``rounds``: at most.

    ``least_m``: less matched wall than this tells nothing. ``sigma_floor_m``: a wall is never known better.
    """

    spacing_m: float = 0.1
    gate_m: float = 0.75
    rounds: int = 50
    least_m: float = 3.0
    sigma_floor_m: float = 0.01


@dataclass(frozen=True, eq=False, slots=True)
class WallPoints:
    """Points (n, 2) [m] along walls with the normals (n, 2) of their lines and the ``wall`` (n,) that each is on.

    A wall is one straight stretch of a polyline.
    """

    points: Array
    normals: Array
    wall: Places

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", frozen_array(self.points))
        object.__setattr__(self, "normals", frozen_array(self.normals))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False, slots=True)
class Alignment:
    """Where walls say that map 2 lies.

    ``T12`` (3,): x, y [m], theta [rad]. ``information`` (3, 3): of errors added to these, in the axes of frame 1; zero
    along what walls can't tell, as along a corridor without ends. ``matched_m``: length of map 2's walls that found
    partners; ``share``: of all of its walls. ``wall_sigma``, ``point_sigma`` [m]: the noise that was found.
    """

    T12: Array
    information: Array
    matched_m: float
    share: float
    wall_sigma: float
    point_sigma: float
    rounds: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "T12", frozen_array(self.T12))
        object.__setattr__(self, "information", frozen_array(self.information))

    @property
    def transform(self) -> Transform:
        """T12 with its covariance, which is None where walls leave a direction open."""
        values, vectors = np.linalg.eigh(self.information)
        if values[0] <= LEAST_KNOWN * max(values[-1], 1e-300):
            return Transform.from_array(self.T12)
        return Transform.from_array(self.T12, (vectors / values) @ vectors.T)


def wall_points(walls: Sequence[ArrayLike], spacing_m: float) -> WallPoints:
    """Points along polylines ``[(k, 2)]`` [m], evenly on each straight stretch, at most so far apart.

    >>> wall_points([[[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]]], 0.5).points.tolist()
    [[0.25, 0.0], [0.75, 0.0], [1.0, 0.25]]
    """
    points: list[Array] = []
    normals: list[Array] = []
    wall: list[Places] = []
    for a, b in segments(walls):
        along = b - a
        length = float(np.hypot(*along))
        n = max(1, int(np.ceil(length / spacing_m - 1e-9)))
        points.append(a + (np.arange(n)[:, None] + 0.5) / n * along)
        normals.append(np.tile(np.array([-along[1], along[0]]) / length, (n, 1)))
        wall.append(np.full(n, len(wall), dtype=np.intp))
    if not points:
        return WallPoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.intp))
    return WallPoints(np.concatenate(points), np.concatenate(normals), np.concatenate(wall))


def segments(walls: Sequence[ArrayLike]) -> Array:
    """The straight stretches (n, 2, 2) [m] of polylines, those without length left out."""
    lines = [np.asarray(wall, dtype=float).reshape(-1, 2) for wall in walls]
    found = [np.stack([line[:-1], line[1:]], axis=1) for line in lines if len(line) > 1]
    every = np.concatenate(found) if found else np.zeros((0, 2, 2))
    return np.asarray(every[np.hypot(*(every[:, 1] - every[:, 0]).T) > 1e-9])


def align(
    walls1: Sequence[ArrayLike], walls2: Sequence[ArrayLike], T12: ArrayLike, config: WallConfig | None = None
) -> Alignment | None:
    """Lays the walls of map 2 on those of map 1, beginning at ``T12`` (3,); None where too little of them meets.

    Both maps are taken to be rigid: of maps that drift has bent by more than their walls are off, the pose is a
    compromise, and the information promises too much.

    >>> room = [[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [0.0, 0.0]]]
    >>> bool(np.abs(align(room, room, [0.1, -0.1, 0.02]).T12).max() < 1e-9)
    True
    """
    config = config or WallConfig()
    p1, p2 = wall_points(walls1, config.spacing_m), wall_points(walls2, config.spacing_m)
    if not len(p1) or not len(p2):
        return None
    tree = cKDTree(p1.points)
    T = np.array(T12, dtype=float)
    lever = max(float(np.ptp(p2.points, axis=0).max()), 1.0)
    rounds, met = 0, _partners(tree, p2, T, config.gate_m)
    for _ in range(config.rounds):
        rounds += 1
        if not _enough(met, config):
            return None
        r, J = _residuals(p1, p2, T, met)
        step = _step(J.T @ J, J.T @ r, lever)
        T = np.array([*(T[:2] - step[:2]), float(se2.wrap(T[2] - step[2]))])
        before, met = met, _partners(tree, p2, T, config.gate_m)
        if np.abs(step * [1.0, 1.0, lever]).max() < 1e-9 and np.array_equal(before, met):
            break
    if not _enough(met, config):
        return None
    return _judged(p1, p2, T, met, rounds, config, lever)


def align_open3d(
    walls1: Sequence[ArrayLike], walls2: Sequence[ArrayLike], T12: ArrayLike, config: WallConfig | None = None
) -> Array | None:
    """The pose (3,) of `align` by Open3D's point-to-plane ICP, as an independent check; None where `align` gives none.

    Open3D works in space: walls are given two heights, and copies far below with upright normals hold height and tilt,
    on which walls say nothing.

    Raises MapfuseError where Open3D can't be loaded.
    """
    from .show.viewer import open3d

    config = config or WallConfig()
    p1, p2 = wall_points(walls1, config.spacing_m), wall_points(walls2, config.spacing_m)
    start = np.array(T12, dtype=float)
    if not len(p1) or not len(p2) or not _enough(_partners(cKDTree(p1.points), p2, start, config.gate_m), config):
        return None
    o3d = open3d()
    target, source = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    target.points = o3d.utility.Vector3dVector(_upright(p1.points))
    target.normals = o3d.utility.Vector3dVector(_normals(p1.normals))
    source.points = o3d.utility.Vector3dVector(_upright(p2.points))
    registration = o3d.pipelines.registration
    found = registration.registration_icp(
        source, target, config.gate_m, _matrix(start), registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(1e-12, 1e-12, 10 * config.rounds),
    ).transformation  # fmt: skip
    return np.array([found[0, 3], found[1, 3], np.arctan2(found[1, 0], found[0, 0])])


def _upright(points: Array) -> Array:
    """Points in the plane at three heights (3n, 3): two of a wall, and one far below, where no wall finds it."""
    return np.concatenate([np.column_stack([points, np.full(len(points), z)]) for z in (0.0, 10.0, -100.0)])


def _normals(normals: Array) -> Array:
    level = np.column_stack([normals, np.zeros(len(normals))])
    return np.concatenate([level, level, np.tile([0.0, 0.0, 1.0], (len(normals), 1))])


def _matrix(T: Array) -> Array:
    M = np.eye(4)
    M[:2, :2], M[:2, 3] = se2.rotation(T[2]), T[:2]
    return M


def _partners(tree: cKDTree, p2: WallPoints, T: Array, gate_m: float) -> Places:
    """Of each point of map 2 the nearest one of map 1, -1 where none is within the gate."""
    distance, nearest = tree.query(se2.transform(T, p2.points), distance_upper_bound=gate_m)
    return np.where(np.isfinite(distance), nearest, -1).astype(np.intp)


def _enough(met: Places, config: WallConfig) -> bool:
    return bool((met >= 0).sum() * config.spacing_m >= config.least_m)


def _residuals(p1: WallPoints, p2: WallPoints, T: Array, met: Places) -> tuple[Array, Array]:
    """Distances (m,) [m] of matched points from their partners' lines, and their derivatives (m, 3) by x, y, theta."""
    found = met >= 0
    moved = se2.transform(T, p2.points[found])
    normal = p1.normals[met[found]]
    r = np.einsum("ij,ij->i", normal, moved - p1.points[met[found]])
    lever = moved - T[:2]
    turn = np.einsum("ij,ij->i", normal, np.column_stack([-lever[:, 1], lever[:, 0]]))
    return r, np.column_stack([normal, turn])


def _step(H: Array, g: Array, lever: float) -> Array:
    """The Gauss-Newton step (3,), nothing along directions that walls don't know."""
    scale = np.array([1.0, 1.0, lever])
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale)
    known = values > LEAST_KNOWN * values[-1]
    inverse = np.where(known, 1 / np.where(known, values, 1.0), 0.0)
    return np.asarray(vectors @ (inverse * (vectors.T @ (g / scale))) / scale)


def _judged(
    p1: WallPoints, p2: WallPoints, T: Array, met: Places, rounds: int, config: WallConfig, lever: float
) -> Alignment | None:
    """The pose with what is known of it: the covariance of least squares under the errors that walls really have."""
    matched = float((met >= 0).sum())
    met = _side_by_side(p1, p2, T, met, config)
    group = _pairs_of_walls(p1, p2, met)
    if not len(group) or int(group.max()) + 1 < LEAST_PAIRS:
        return None
    r, J = _residuals(p1, p2, T, met)
    scale = np.array([1.0, 1.0, lever])
    J = J / scale
    values, vectors = np.linalg.eigh(J.T @ J)
    known = values > LEAST_KNOWN * values[-1]
    V, H = vectors[:, known], values[known]
    Z = _ends(p1, p2, T, met, group)
    of_ends, of_points = _variances(r, J @ V, H, Z, group, config.sigma_floor_m)
    S = _sums(Z, J @ V, group)
    C = np.diag(of_points / H) + of_ends * np.einsum("gai,gaj->ij", S, S) / H[:, None] / H
    # J was taken by (x, y, lever theta)
    information = (V @ np.linalg.inv(C) @ V.T) * np.outer(scale, scale)
    return Alignment(
        T12=T,
        information=(information + information.T) / 2,
        matched_m=matched * config.spacing_m,
        share=matched / len(p2),
        wall_sigma=float(np.sqrt(of_ends)),
        point_sigma=float(np.sqrt(of_points)),
        rounds=rounds,
    )


def _side_by_side(p1: WallPoints, p2: WallPoints, T: Array, met: Places, config: WallConfig) -> Places:
    """Partners on walls that run alike for some length: the others, around corners, say nothing of the noise."""
    turned = p2.normals @ se2.rotation(T[2]).T
    alike = (met >= 0) & (np.abs(np.einsum("ij,ij->i", turned, p1.normals[met])) > ALIKE)
    met = np.where(alike, met, -1)
    group = _pairs_of_walls(p1, p2, met)
    long = np.bincount(group)[group] * config.spacing_m >= LEAST_STRETCH_M
    kept = met.copy()
    kept[np.flatnonzero(met >= 0)[~long]] = -1
    return kept


def _pairs_of_walls(p1: WallPoints, p2: WallPoints, met: Places) -> Places:
    """Of each matched point (m,) the number of its pair of walls, counted from 0."""
    pairs = np.column_stack([p1.wall[met[met >= 0]], p2.wall[met >= 0]])
    return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1).astype(np.intp)


def _ends(p1: WallPoints, p2: WallPoints, T: Array, met: Places, group: Places) -> Array:
    """How much each matched point (m, 2) takes from the errors of both ends of its pair of walls."""
    moved = se2.transform(T, p2.points[met >= 0])
    normal = p1.normals[met[met >= 0]]
    along = np.einsum("ij,ij->i", moved, np.column_stack([normal[:, 1], -normal[:, 0]]))
    n = int(group.max()) + 1
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, group, along)
    np.maximum.at(high, group, along)
    t = (along - low[group]) / np.maximum(high - low, 1e-9)[group]
    return np.column_stack([1 - t, t])


def _sums(Z: Array, X: Array, group: Places) -> Array:
    """Per group (n, 2, k) the sum of Z' X over its points."""
    found = np.zeros((int(group.max()) + 1, Z.shape[1], X.shape[1]))
    np.add.at(found, group, Z[:, :, None] * X[:, None, :])
    return found


def _variances(r: Array, J: Array, H: Array, Z: Array, group: Places, floor: float) -> tuple[float, float]:
    """Variances [m^2] of the ends of walls and of single points about their walls, from the residuals (m,).

    Of every pair of walls the line through its residuals gives the errors of its two ends, as far as the pose, fitted
    by least squares with derivatives ``J`` (m, k) and J'J = diag(``H``), has not taken them up: residual ends are
    M e with M = I - E inv(H) E' Z'Z, E being J at the ends, so that their sum of squares is the variance times the
    trace of M'M. A variance that is itself estimated makes a t distribution of the pose, whose covariance is larger by
    dof / (dof - 2).
    """
    ZZ = _sums(Z, Z, group)
    inverse = np.linalg.pinv(ZZ, rcond=1e-9, hermitian=True)
    ends = np.einsum("gab,gb->ga", inverse, _sums(Z, r[:, None], group)[:, :, 0])
    alone = float(((r - np.einsum("ma,ma->m", Z, ends[group])) ** 2).sum() / max(len(r) - ends.size, 1))
    alone = max(alone, floor**2)
    S = _sums(Z, J, group)
    E = np.einsum("gab,gbk->gak", inverse, S).reshape(ends.size, -1)
    M = np.eye(ends.size) - (E / H) @ S.reshape(ends.size, -1).T
    dof = ends.size - len(H)
    of_points = alone * float(np.trace(inverse, axis1=1, axis2=2).sum())
    found = (float((ends**2).sum()) - of_points) / max(float((M**2).sum()), 1.0)
    return max(found * dof / max(dof - 2, 0.5), floor**2), alone
