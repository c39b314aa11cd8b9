"""The smoother's normal equations: everything measured, linearised at an estimate.

The poses of the keyframes form a chain, whose normal equations are a band; everything else (the last pose, systematic
errors, north, bends, landmarks, arms, lines of walls) is the border of the band.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .. import se2
from .compass import JITTER, bend_covariance
from .walllines import WallPoints, no_walls

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: The border begins with the last pose (3), the systematic errors (4) and north (1).
SYSTEMATIC, NORTH, FIRST_NODE = slice(3, 7), 7, 8
#: Squared residual in sigmas beyond which the reading of an arm loses weight.
_ARM_GATE = 10.8
#: The same of a point of a wall.
WALL_GATE = 9.0
_START_SIGMA = 1e-5
_NORTH_INFORMATION = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """Everything measured, as arrays; indices of landmarks, arms and nodes count from 0.

    ``motions`` (K - 1, 3) were integrated with systematic errors ``at`` (K - 1, 4), derivatives ``by`` (K - 1, 3, 4),
    root of the information ``whiten`` (K - 1, 3, 3). Sightings: ``seen_from``, ``seen`` (m,), ``points`` (m, 2),
    ``point_whiten`` (m, 2, 2). Arms: ``arm_from``, ``arm``, ``arm_bearing`` (a,). Stations: ``station``, ``node``,
    ``heading``, ``heading_sigma`` (s,). ``systematic_sigma`` (4,). ``walls``: points of walls that lie on lines.
    """

    motions: Array
    at: Array
    by: Array
    whiten: Array
    seen_from: Indices
    seen: Indices
    points: Array
    point_whiten: Array
    arm_from: Indices
    arm: Indices
    arm_bearing: Array
    arm_sigma: float
    station: Indices
    node: Indices
    heading: Array
    heading_sigma: Array
    systematic_sigma: Array
    bend_sigma: float
    bend_length: float
    landmark_count: int
    arm_count: int
    walls: WallPoints = field(default_factory=no_walls)


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """Where everything is: ``poses`` (K, 3), ``systematic`` (4,), ``north``, ``bends``, ``landmarks``, ``arms``.

    ``lines`` (w, 2): of walls, as `WallPoints` has them.
    """

    poses: Array
    systematic: Array
    north: float
    bends: Array
    landmarks: Array
    arms: Array
    lines: Array = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, eq=False, slots=True)
class System:
    """Normal equations: band (K - 1 poses), coupling, border; gradient; error; weights of the sightings."""

    band: Array
    coupling: csr_array
    border: Array
    gradient_poses: Array
    gradient_border: Array
    error: float
    weights: Array
    squared: Array
    node_information: Array


def node_places(drive: Drive, poses: Array, count: int) -> Array:
    """Where the nodes of the bend are (n, 2) [m]: at the keyframe of each one's first station."""
    nodes, first = np.unique(drive.node, return_index=True)
    places = np.zeros((count, 2))
    places[nodes] = poses[drive.station[first], :2]
    return places


def _node_information(drive: Drive, poses: Array, count: int) -> Array:
    if not count:
        return np.zeros((0, 0))
    places = node_places(drive, poses, count)
    covariance = bend_covariance(places, places, drive.bend_sigma, drive.bend_length)
    covariance[np.diag_indices(count)] += JITTER * drive.bend_sigma**2
    return np.asarray(np.linalg.inv(covariance), dtype=float)


class _Assembly:
    """Normal equations as they grow, term by term."""

    def __init__(self, drive: Drive, e: Estimate, gate: float) -> None:
        self.drive, self.e, self.gate = drive, e, gate
        self.K, n, self.m = len(e.poses), len(e.bends), len(e.landmarks)
        self.nodes = slice(FIRST_NODE, FIRST_NODE + n)
        self.landmark_at = FIRST_NODE + n
        self.arm_at = self.landmark_at + 2 * self.m
        self.line_at = self.arm_at + drive.arm_count
        self.size = self.line_at + 2 * len(e.lines)
        self.diagonal, self.off = np.zeros((self.K, 3, 3)), np.zeros((max(0, self.K - 1), 3, 3))
        self.border = np.zeros((self.size, self.size))
        self.g_poses, self.g_border = np.zeros((self.K, 3)), np.zeros(self.size)
        self.rows: list[Indices] = [np.zeros(0, dtype=np.intp)]
        self.columns: list[Indices] = [np.zeros(0, dtype=np.intp)]
        self.values: list[Array] = [np.zeros(0)]
        self.error = 0.0

    def couple(self, pose: Indices, column: Indices, block: Array) -> None:
        """Blocks (k, 3, c) between poses and border entries that begin at ``column``."""
        r = 3 * pose[:, None, None] + np.arange(3)[:, None] + np.zeros(block.shape[2], dtype=np.intp)
        c = column[:, None, None] + np.zeros((3, 1), dtype=np.intp) + np.arange(block.shape[2])
        self.rows.append(r.ravel())
        self.columns.append(c.ravel())
        self.values.append(block.ravel())

    def priors(self) -> None:
        """The start is where the map's frame is; systematic errors have priors, north next to none."""
        e, sigma = self.e, self.drive.systematic_sigma
        start, scaled = e.poses[0] / _START_SIGMA, e.systematic / sigma
        self.diagonal[0] += np.eye(3) / _START_SIGMA**2
        self.g_poses[0] += start / _START_SIGMA
        self.border[SYSTEMATIC, SYSTEMATIC] += np.diag(sigma**-2.0)
        self.g_border[SYSTEMATIC] += scaled / sigma
        self.border[NORTH, NORTH] += _NORTH_INFORMATION
        self.error += float(start @ start + scaled @ scaled) / 2

    def bends(self, information: Array) -> None:
        """The bend of compasses as a field."""
        bends = self.e.bends
        self.border[self.nodes, self.nodes] += information
        self.g_border[self.nodes] += information @ bends
        self.error += float(bends @ information @ bends) / 2

    def motions(self) -> None:
        """From each keyframe to the next."""
        K = self.K
        if K < 2:
            return
        r, previous, following, by = _motions(self.drive, self.e)
        self.error += float(np.sum(r * r)) / 2
        before, after = np.swapaxes(previous, 1, 2), np.swapaxes(following, 1, 2)
        self.diagonal[:-1] += before @ previous
        self.diagonal[1:] += after @ following
        self.off += before @ following
        self.g_poses[:-1] += np.einsum("kij,ki->kj", previous, r)
        self.g_poses[1:] += np.einsum("kij,ki->kj", following, r)
        at = np.full(K - 1, SYSTEMATIC.start, dtype=np.intp)
        self.couple(np.arange(K - 1), at, before @ by)
        self.couple(np.arange(1, K), at, after @ by)
        self.border[SYSTEMATIC, SYSTEMATIC] += np.einsum("kij,kil->jl", by, by)
        self.g_border[SYSTEMATIC] += np.einsum("kij,ki->j", by, r)

    def sightings(self) -> tuple[Array, Array]:
        """Landmarks seen; the weights (m,) that they have, and their squared residuals."""
        drive = self.drive
        r, by_pose, by_landmark = _sightings(drive, self.e)
        squared = np.sum(r * r, axis=1)
        weights, losses = _robust(squared, self.gate)
        self.error += float(np.sum(losses)) / 2
        root = np.sqrt(weights)
        r, by_pose, by_landmark = r * root[:, None], by_pose * root[:, None, None], by_landmark * root[:, None, None]
        np.add.at(self.diagonal, drive.seen_from, np.swapaxes(by_pose, 1, 2) @ by_pose)
        np.add.at(self.g_poses, drive.seen_from, np.einsum("kij,ki->kj", by_pose, r))
        own, g_own = np.zeros((self.m, 2, 2)), np.zeros((self.m, 2))
        np.add.at(own, drive.seen, np.swapaxes(by_landmark, 1, 2) @ by_landmark)
        np.add.at(g_own, drive.seen, np.einsum("kij,ki->kj", by_landmark, r))
        at = self.landmark_at + 2 * np.arange(self.m)
        for i in range(2):
            for j in range(2):
                self.border[at + i, at + j] += own[:, i, j]
        self.g_border[self.landmark_at : self.arm_at] += g_own.ravel()
        self.couple(drive.seen_from, self.landmark_at + 2 * drive.seen, np.swapaxes(by_pose, 1, 2) @ by_landmark)
        return weights, squared

    def arms(self) -> None:
        """Directions of arms: direction less theta less bearing."""
        drive = self.drive
        if not len(drive.arm):
            return
        information = drive.arm_sigma**-2.0
        r = se2.wrap(self.e.arms[drive.arm] - self.e.poses[drive.arm_from, 2] - drive.arm_bearing)
        weights, losses = _robust(r * r * information, _ARM_GATE if np.isfinite(self.gate) else np.inf)
        self.error += float(np.sum(losses)) / 2
        w = weights * information
        at = self.arm_at + drive.arm
        np.add.at(self.diagonal[:, 2, 2], drive.arm_from, w)
        np.add.at(self.g_poses[:, 2], drive.arm_from, -r * w)
        np.add.at(self.border, (at, at), w)
        np.add.at(self.g_border, at, r * w)
        self.couple(drive.arm_from, at, _turning(-w))

    def stations(self) -> None:
        """Compass readings: theta less north less bend less reading."""
        drive = self.drive
        if not len(drive.station):
            return
        w = drive.heading_sigma**-2.0
        r = se2.wrap(self.e.poses[drive.station, 2] - self.e.north - self.e.bends[drive.node] - drive.heading)
        self.error += float(np.sum(r * r * w)) / 2
        np.add.at(self.diagonal[:, 2, 2], drive.station, w)
        np.add.at(self.g_poses[:, 2], drive.station, r * w)
        north, node = np.full(len(r), NORTH, dtype=np.intp), FIRST_NODE + drive.node
        for a in (north, node):
            for b in (north, node):
                np.add.at(self.border, (a, b), w)
            np.add.at(self.g_border, a, -r * w)
            self.couple(drive.station, a, _turning(-w))

    def walls(self) -> None:
        """Points of walls, each on its line."""
        walls = self.drive.walls
        if not len(walls):
            return
        r, by_pose, by_line = walls.residuals(self.e.poses, self.e.lines)
        weights, losses = _robust(r * r, WALL_GATE if np.isfinite(self.gate) else np.inf)
        self.error += float(np.sum(losses)) / 2
        weighted = by_pose * weights[:, None]
        np.add.at(self.diagonal, walls.keyframe, weighted[:, :, None] * by_pose[:, None, :])
        np.add.at(self.g_poses, walls.keyframe, weighted * r[:, None])
        at = self.line_at + 2 * walls.line
        for i in range(2):
            for j in range(2):
                np.add.at(self.border, (at + i, at + j), weights * by_line[:, i] * by_line[:, j])
            np.add.at(self.g_border, at + i, weights * by_line[:, i] * r)
        self.couple(walls.keyframe, at, weighted[:, :, None] * by_line[:, None, :])

    def system(self, weights: Array, squared: Array, information: Array) -> System:
        """All terms together; the last pose belongs to the border."""
        K, size = self.K, self.size
        entries = np.concatenate(self.values)
        places = (np.concatenate(self.rows), np.concatenate(self.columns))
        coupling = csr_array((entries, places), shape=(3 * K, size))
        last = coupling[3 * (K - 1) :].toarray()
        self.border[:3] += last
        self.border[:, :3] += last.T
        self.border[:3, :3] += self.diagonal[-1]
        self.g_border[:3] += self.g_poses[-1]
        coupling = csr_array(coupling[: 3 * (K - 1)])
        if K > 1:
            rows, columns = np.repeat(3 * (K - 2) + np.arange(3), 3), np.tile(np.arange(3), 3)
            to_last = csr_array((self.off[-1].ravel(), (rows, columns)), shape=(3 * (K - 1), size))
            coupling = csr_array(coupling + to_last)
        band = _band(self.diagonal[:-1], self.off[:-1])
        gradient = self.g_poses[:-1].ravel()
        return System(band, coupling, self.border, gradient, self.g_border, self.error, weights, squared, information)


def linearise(drive: Drive, e: Estimate, gate: float, nodes: Array | None = None) -> System:
    """The normal equations at an estimate; sightings whose squared residual is beyond ``gate`` lose weight.

    ``nodes``: information of the bends at their nodes, where it is known already.
    """
    information = _node_information(drive, e.poses, len(e.bends)) if nodes is None else nodes
    assembly = _Assembly(drive, e, gate)
    assembly.priors()
    assembly.bends(information)
    assembly.motions()
    weights, squared = assembly.sightings()
    assembly.arms()
    assembly.stations()
    assembly.walls()
    return assembly.system(weights, squared, information)


def _robust(squared: Array, gate: float) -> tuple[Array, Array]:
    """Weights and losses of squared residuals: as they are up to ``gate``, growing with the logarithm beyond."""
    if not np.isfinite(gate):
        return np.ones(len(squared)), squared
    beyond = np.maximum(squared / gate, 1.0)
    return 1 / beyond, np.where(squared > gate, gate * (1 + np.log(beyond)), squared)


def _turning(values: Array) -> Array:
    """Blocks (k, 3, 1) that couple the heading of poses."""
    block = np.zeros((len(values), 3, 1))
    block[:, 2, 0] = values
    return block


def _motions(drive: Drive, e: Estimate) -> tuple[Array, Array, Array, Array]:
    """Whitened residuals (K - 1, 3) of the motions and their derivatives by both poses and the systematic errors."""
    first, second = e.poses[:-1], e.poses[1:]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    gx, gy = second[:, 0] - first[:, 0], second[:, 1] - first[:, 1]
    mx, my = c * gx + s * gy, c * gy - s * gx
    wanted = drive.motions + np.einsum("kij,kj->ki", drive.by, e.systematic - drive.at)
    r = np.column_stack([mx, my, second[:, 2] - first[:, 2]]) - wanted
    # poses are never wrapped inside, and a motion may hold more than one turn
    r[:, 2] = se2.wrap(r[:, 2])
    previous, following = np.zeros((len(first), 3, 3)), np.zeros((len(first), 3, 3))
    following[:, 0, 0] = following[:, 1, 1] = c
    following[:, 0, 1], following[:, 1, 0] = s, -s
    following[:, 2, 2] = 1
    previous[:] = -following
    previous[:, 0, 2], previous[:, 1, 2] = my, -mx
    W = drive.whiten
    return np.einsum("kij,kj->ki", W, r), W @ previous, W @ following, -(W @ drive.by)


def _sightings(drive: Drive, e: Estimate) -> tuple[Array, Array, Array]:
    """Whitened residuals (m, 2) of the sightings and their derivatives by pose and landmark."""
    pose, point = e.poses[drive.seen_from], e.landmarks[drive.seen]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    gx, gy = point[:, 0] - pose[:, 0], point[:, 1] - pose[:, 1]
    u, v = c * gx + s * gy, c * gy - s * gx
    by_landmark = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
    by_pose = np.concatenate([-by_landmark, np.stack([v, -u], axis=1)[:, :, None]], axis=2)
    W = drive.point_whiten
    r = np.einsum("kij,kj->ki", W, np.column_stack([u, v]) - drive.points)
    return r, W @ by_pose, W @ by_landmark


def _band(diagonal: Array, off: Array) -> Array:
    """Block-tridiagonal matrix as LAPACK's upper band (6, 3 n): entry (i, j) stands at [5 + i - j, j]."""
    n = len(diagonal)
    band = np.zeros((6, 3 * n))
    for i in range(3):
        for j in range(i, 3):
            band[5 + i - j, j::3] = diagonal[:, i, j]
        for j in range(3):
            band[5 + i - j - 3, 3 + j :: 3] = off[: n - 1, i, j] if n else 0
    return band
