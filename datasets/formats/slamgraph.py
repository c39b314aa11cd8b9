"""Pose graphs with landmarks, as SLAM programs exchange them, solved: the map of their landmarks and its covariance.

A file holds measurements (motions between any two poses, sightings of landmarks) and, often, vertices: where a program
thinks that everything is. The map is the optimum of the measurements, which is found from the vertices or, without
them, from the motions one after the other; its joint covariance says how sure the measurements are of it. The first
pose stays where its vertex is, at the origin without one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .. import se2
from ..errors import MapfuseError, TooLargeError, UndeterminedError
from ..landmark_slam import STRETCH, assemble, displacement_jacobians, factorised
from ..maps import JointCovariance, Landmark, LandmarkMap
from .reading import Reading, counted, remark

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Poses of a graph, at most.
MAX_POSES = 50_000
#: Joint covariances are worked out up to so many landmarks.
MAX_JOINT = 2000
#: Step length [standard deviations] that ends the descent; that of a stretch which more poses will follow.
CONVERGED, ROUGHLY = 1e-5, 0.3
_ITERATIONS = 1000


@dataclass(frozen=True, eq=False, slots=True)
class Measurements:
    """What a file says, by its own numbers of poses and landmarks.

    ``motions``: (from, to) -> rows of x, y, theta [m, rad] and the 3x3 information matrix; ``sightings``: (pose,
    landmark) -> x, y [m] in the pose's frame and the 2x2 information. ``poses``, ``landmarks``: vertices.
    """

    motions: tuple[tuple[int, int, Array, Array], ...]
    sightings: tuple[tuple[int, int, Array, Array], ...]
    poses: Mapping[int, Array]
    landmarks: Mapping[int, Array]


@dataclass(frozen=True, eq=False, slots=True)
class _Graph:
    """The part that hangs together, by index; the roots R of information matrices are such that R'R is one."""

    origin: Indices
    goal: Indices
    motions: Array
    motion_roots: Array
    seen_from: Indices
    seen: Indices
    sightings: Array
    sighting_roots: Array

    def within(self, poses: int) -> tuple[_Graph, Indices]:
        """The graph of the first poses, and which landmarks are seen from them."""
        m = (self.origin < poses) & (self.goal < poses)
        s = self.seen_from < poses
        known, seen = np.unique(self.seen[s], return_inverse=True)
        return _Graph(
            self.origin[m], self.goal[m], self.motions[m], self.motion_roots[m],
            self.seen_from[s], seen.astype(np.intp), self.sightings[s], self.sighting_roots[s],
        ), known  # fmt: skip


def solved_map(name: str, found: Measurements, type_: str, ids: Mapping[int, str], types: Mapping[int, str]) -> Reading:
    """The map of a graph: landmarks of ``type_`` and named by their numbers, unless ``types`` and ``ids`` say more.

    Poses that no chain of motions joins to the first one are left out, and so is what only they saw. Raises
    `TooLargeError`, and `MapfuseError` where the measurements don't come to rest.
    """
    numbers = sorted(
        {*found.poses, *(n for a, b, *_ in found.motions for n in (a, b)), *(p for p, *_ in found.sightings)}
    )
    if len(numbers) > MAX_POSES:
        raise TooLargeError(f"the graph {name!r} has {len(numbers):,} poses; at most {MAX_POSES:,} are solved")
    order = _joined(numbers, found)
    reached = set(order)
    lost_poses = sorted(set(numbers) - reached) if found.motions else []
    sightings = [s for s in found.sightings if s[0] in reached]
    seen = sorted({s[1] for s in sightings})
    poses = np.array([found.poses.get(n, np.zeros(3)) for n in order]).reshape(-1, 3)
    xy, covariance = np.zeros((0, 2)), None
    if sightings:
        poses, xy, covariance = _solved(found, order, sightings, seen)
    unseen = sorted(set(found.landmarks) - set(seen))
    never = sorted({s[1] for s in found.sightings} - set(seen) - set(unseen))
    at = {**{n: found.landmarks[n] for n in unseen}, **dict(zip(seen, xy, strict=True))}
    remarks = (
        *remark(lost_poses, "poses that nothing joins to the first one", "left out"),
        *remark(never, "landmarks seen from such poses only", "left out"),
        *remark(unseen, "landmarks that no edge leads to", "taken from their vertices, without covariance"),
        *counted(
            {"landmarks": len(seen) if sightings and covariance is None else 0}, "too many for a joint covariance"
        ),
    )
    landmarks = tuple(Landmark(ids.get(n, str(n)), types.get(n, type_), *at[n].tolist()) for n in sorted(at))
    kept = _path(poses, order) if found.poses or found.motions else None
    map_ = LandmarkMap(name, landmarks, path=kept)
    return Reading((_with(map_, covariance, [ids.get(n, str(n)) for n in seen]),), remarks)


def _path(poses: Array, order: list[int]) -> Array | None:
    by_number = np.argsort(order, kind="stable")
    path = np.column_stack([np.array(order, dtype=float)[by_number], poses[by_number]])
    path[:, 3] = se2.wrap(path[:, 3])
    return path


def _with(map_: LandmarkMap, covariance: Array | None, ids: list[str]) -> LandmarkMap:
    """With the joint covariance, or where nothing correlates with that of each landmark."""
    if covariance is None:
        return map_
    blocks = covariance.reshape(len(ids), 2, len(ids), 2)
    own = blocks[np.arange(len(ids)), :, np.arange(len(ids))]
    others = covariance.copy().reshape(blocks.shape)
    others[np.arange(len(ids)), :, np.arange(len(ids))] = 0
    if np.any(np.abs(others) > 1e-9 * np.abs(own).max()):
        return map_.replace(joint_covariance=JointCovariance(tuple(ids), 2, covariance))
    from dataclasses import replace

    each = dict(zip(ids, own, strict=True))
    return map_.replace(landmarks=tuple(replace(l, covariance=each.get(l.id)) for l in map_.landmarks))


def _joined(numbers: list[int], found: Measurements) -> list[int]:
    """Poses that motions join to the first one, each after one that it is joined to, otherwise by number."""
    import heapq

    if not numbers:
        return []
    near: dict[int, list[int]] = {}
    for a, b, *_ in found.motions:
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    order, queue, known = [], [numbers[0]], {numbers[0]}
    while queue:
        number = heapq.heappop(queue)
        order.append(number)
        for other in near.get(number, ()):
            if other not in known:
                known.add(other)
                heapq.heappush(queue, other)
    if not found.motions:  # vertices alone: a path, of which nothing is known but where it is
        order += [n for n in numbers[1:] if n in found.poses]
    return order


def _solved(
    found: Measurements, order: list[int], sightings: list[tuple[int, int, Array, Array]], seen: list[int]
) -> tuple[Array, Array, Array | None]:
    """Optimum of poses (n, 3) and landmarks (k, 2), and the landmarks' joint covariance (None: too many)."""
    place = {n: k for k, n in enumerate(order)}
    number = {n: k for k, n in enumerate(seen)}
    motions = [m for m in found.motions if m[0] in place and m[1] in place]
    graph = _Graph(
        np.array([place[m[0]] for m in motions], dtype=np.intp),
        np.array([place[m[1]] for m in motions], dtype=np.intp),
        np.array([m[2] for m in motions]).reshape(-1, 3),
        _roots(np.array([m[3] for m in motions]).reshape(-1, 3, 3)),
        np.array([place[s[0]] for s in sightings], dtype=np.intp),
        np.array([number[s[1]] for s in sightings], dtype=np.intp),
        np.array([s[2] for s in sightings]).reshape(-1, 2),
        _roots(np.array([s[3] for s in sightings]).reshape(-1, 2, 2)),
    )
    free = np.unique(np.concatenate([graph.origin, graph.goal, [0]])).astype(np.intp)
    first = found.poses.get(order[0], np.zeros(3))
    if len(free) < len(order):  # vertices that no motion joins stand where they stand
        poses = np.array([found.poses[n] for n in order])
        return poses, *_seen_from_known(graph, poses, len(seen))
    if all(n in found.poses for n in order) and all(n in found.landmarks for n in seen):
        poses, xy = np.array([found.poses[n] for n in order]), np.array([found.landmarks[n] for n in seen])
    else:
        poses, xy = _grown(graph, len(order), len(seen), first)
    poses, xy, decrement = _descend(graph, poses, xy, CONVERGED)
    if decrement > CONVERGED:
        raise MapfuseError(f"the graph's solution still moved by {decrement:.2g} sigma in its last step")
    return poses, xy, _covariance(graph, poses, xy) if len(seen) <= MAX_JOINT else None


def _roots(information: Array) -> Array:
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2) if len(information) else information
    except np.linalg.LinAlgError:
        raise MapfuseError("an information matrix in the graph isn't positive definite") from None


def _seen_from_known(graph: _Graph, poses: Array, count: int) -> tuple[Array, Array | None]:
    """Landmarks (k, 2) seen from poses that are taken as known, and their joint covariance."""
    turned = graph.sighting_roots @ np.swapaxes(se2.rotation(poses[graph.seen_from, 2]), 1, 2)
    points = se2.transform(poses[graph.seen_from], graph.sightings)
    information = np.zeros((count, 2, 2))
    np.add.at(information, graph.seen, np.swapaxes(turned, 1, 2) @ turned)
    weighed = np.zeros((count, 2))
    np.add.at(weighed, graph.seen, np.einsum("kji,kjl,kl->ki", turned, turned, points))
    own = np.linalg.inv(information)
    joint = np.zeros((count, 2, count, 2))
    joint[np.arange(count), :, np.arange(count)] = (own + np.swapaxes(own, 1, 2)) / 2
    xy = np.einsum("kij,kj->ki", own, weighed)
    return xy, joint.reshape(2 * count, 2 * count) if count <= MAX_JOINT else None


def _grown(graph: _Graph, poses: int, landmarks: int, first: Array) -> tuple[Array, Array]:
    """Poses and landmarks near the optimum: stretch after stretch, each by its motions, then solved with all so far."""
    at, xy = np.zeros((poses, 3)), np.full((landmarks, 2), np.nan)
    at[0] = first
    leads = _leads(graph, poses)
    done = 1
    while True:
        part, known = graph.within(done)
        seen_at = se2.transform(at[part.seen_from], part.sightings)
        fresh = np.isnan(xy[known, 0])
        counts = np.maximum(np.bincount(part.seen, minlength=len(known)), 1)
        means = np.stack([np.bincount(part.seen, seen_at[:, a], minlength=len(known)) / counts for a in (0, 1)], axis=1)
        start = np.where(fresh[:, None], means, xy[known])
        at[:done], xy[known], _ = _descend(part, at[:done], start, ROUGHLY)
        if done == poses:
            return at, xy
        new = min(done + STRETCH, poses)
        for k in range(done, new):
            before, motion = leads[k]
            at[k] = se2.compose(at[before], motion)
        done = new


def _leads(graph: _Graph, poses: int) -> list[tuple[int, Array]]:
    """Of each pose one before it in order, and the motion from there."""
    leads: list[tuple[int, Array]] = [(-1, np.zeros(3))] * poses
    for a, b, motion in zip(graph.origin.tolist(), graph.goal.tolist(), graph.motions, strict=True):
        low, high = min(a, b), max(a, b)
        if low < high and low > leads[high][0]:
            leads[high] = (low, motion if a < b else se2.inverse(motion))
    return leads


def _descend(graph: _Graph, poses: Array, xy: Array, until: float) -> tuple[Array, Array, float]:
    """Levenberg-Marquardt to steps below ``until`` sigma; the first pose stays. Returns the last step's length too."""
    residuals, jacobian = _linearise(graph, poses, xy)
    error, damping, decrement = float(residuals @ residuals), 0.0, np.inf
    for _ in range(_ITERATIONS):
        if jacobian.shape[1] == 0:
            return poses, xy, 0.0
        gradient = jacobian.T @ residuals
        step = -factorised(jacobian, damping).solve(gradient)
        if damping == 0:
            decrement = float(np.sqrt(max(0.0, -step @ gradient)))
            if decrement < until:
                break
        split = 3 * (len(poses) - 1)
        moved = poses.copy()
        moved[1:] += step[:split].reshape(-1, 3)
        moved_xy = xy + step[split:].reshape(-1, 2)
        new_residuals, new_jacobian = _linearise(graph, moved, moved_xy)
        new_error = float(new_residuals @ new_residuals)
        if new_error <= error * (1 + 1e-12):
            poses, xy, error, residuals, jacobian = moved, moved_xy, new_error, new_residuals, new_jacobian
            damping = damping / 10 if damping > 1e-6 else 0.0
        else:
            damping = max(damping * 10, 1e-6)
    return poses, xy, decrement


def _linearise(graph: _Graph, poses: Array, xy: Array) -> tuple[Array, csr_array]:
    """Residuals in standard deviations and their Jacobian by all poses but the first, then all landmarks."""
    a, b, s = graph.origin, graph.goal, graph.seen_from
    moved = se2.between(poses[a], poses[b])
    motion = moved - graph.motions
    motion[:, 2] = se2.wrap(motion[:, 2])
    sighting = se2.transform(se2.inverse(poses[s]), xy[graph.seen])
    m, k, n = len(a), len(s), len(poses)
    here, there = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
    here[:, :2], there[:, :2, :2] = displacement_jacobians(poses[a, 2], moved[:, :2], np.ones((m, 2)))
    there[:, 2, 2], here[:, 2, 2] = 1, -1
    by_pose, by_landmark = displacement_jacobians(poses[s, 2], sighting, np.ones((k, 2)))
    of_motions, of_sightings = 3 * np.arange(m), 3 * m + 2 * np.arange(k)
    blocks = (
        (of_motions, 3 * a, graph.motion_roots @ here),
        (of_motions, 3 * b, graph.motion_roots @ there),
        (of_sightings, 3 * s, graph.sighting_roots @ by_pose),
        (of_sightings, 3 * n + 2 * graph.seen, graph.sighting_roots @ by_landmark),
    )
    jacobian = assemble(blocks, (3 * m + 2 * k, 3 * n + 2 * len(xy)))
    whitened = (
        np.einsum("kij,kj->ki", graph.motion_roots, motion).ravel(),
        np.einsum("kij,kj->ki", graph.sighting_roots, sighting - graph.sightings).ravel(),
    )
    return np.concatenate(whitened), jacobian[:, 3:]


def _covariance(graph: _Graph, poses: Array, xy: Array) -> Array:
    """Joint covariance (2k, 2k) of the landmarks: their block of the inverse of the information."""
    _, jacobian = _linearise(graph, poses, xy)
    split, size = 3 * (len(poses) - 1), 2 * len(xy)
    unit = np.zeros((split + size, size))
    unit[split:] = np.eye(size)
    try:
        covariance = factorised(jacobian, 0.0).solve(unit)[split:]
    except UndeterminedError as error:
        raise UndeterminedError("the graph's measurements don't determine all poses and landmarks") from error
    return np.asarray((covariance + covariance.T) / 2, dtype=float)
