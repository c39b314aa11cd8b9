"""Walls in the graph: maps' walls laid on each other piece by piece, two maps at a time, as both are bent.

Rounds of ICP, point to line: walls are placed where the solved graph has them, those that face each other are found,
their noise is estimated, and the graph is solved with their offsets as one measurement (`mapfuse.factors.walls`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.factors import Unknown
from mapfuse.factors.axes import pose_rotations
from mapfuse.factors.walls import (
    Facing,
    Hanging,
    WallMeasurement,
    hanging,
    keyframe_jacobians,
    keyframes_of,
    offset_jacobian,
    offsets,
)

from .config import WallsConfig
from .evidence import Weighed
from .facing import Pieces, faced, pieces_of
from .solve import Solution, optimum
from .wallspace import WallEvidence, against, credible, wall_evidence, way_of

Array = NDArray[np.float64]

#: Standard deviations [m] among which that of an offset between two walls is looked for.
SIGMAS = np.geomspace(0.03, 0.3, 25)
#: Fewer places where walls face each other tell nothing; so many rounds of looking for them at most.
LEAST, ROUNDS = 12, 6
#: What lies further off than the gate, and than this share of the worst, is taken out first.
WORST = 0.7
#: Rounds end where no map moves by more than this [m, rad].
STILL = 1e-4


@dataclass(frozen=True, eq=False, slots=True)
class WallFit:
    """A solution with walls in it: ``count`` offsets between walls, each with a standard deviation ``sigma`` [m]; of
    several pairs of maps the largest."""

    solution: Solution
    count: int
    sigma: float


def with_walls(
    solution: Solution, config: WallsConfig | None = None, between: Sequence[tuple[int, int]] = ((0, 1),)
) -> WallFit | None:
    """The graph of a group solved again with its maps' walls in it; None where these say nothing.

    ``between``: the pairs of maps whose walls are laid on each other. A wall that n maps have is measured by up to
    n (n - 1) / 2 offsets, which know n walls' errors only: each counts 2 / n, as differences of landmarks do.
    """
    config = config or WallsConfig()
    maps = solution.problem.maps
    sides = {
        r: side for r in sorted({r for pair in between for r in pair}) if (side := hanging(maps[r], r)) is not None
    }
    facing = [(r, s) for r, s in between if r in sides and s in sides]
    pieces = {r: pieces_of(keyframes_of(maps[r])) for r in sides}
    priors = {(r, s): _Prior(solution, sides[r], sides[s]) for r, s in facing}
    share = 2 / max(len({r for pair in facing for r in pair}), 2)
    now, fit = solution, None
    for _ in range(ROUNDS):
        found = []
        for r, s in facing:
            placed = _placed(now, sides[r], sides[s], pieces[r], pieces[s], config.gate_m)
            measured = priors[r, s].measurement(placed, now.poses, config)
            if measured is not None:
                measurement, sigma = measured
                W = np.sqrt(share) * measurement.sqrt_information
                found.append((replace(measurement, sqrt_information=W), sigma))
        if not found:
            return fit
        before = now
        bare = solution.problem.starting_at(now.poses)
        now = optimum(bare.with_measurements((*bare.measurements, *(m for m, _ in found))), solution.rejected)
        fit = WallFit(now, sum(len(m.facing) for m, _ in found), max(sigma for _, sigma in found))
        moved = np.array([now.frame(r) - before.frame(r) for r in range(len(maps))])
        moved[:, 2] = se2.wrap(moved[:, 2])
        if np.abs(moved).max() < STILL:
            break
    return fit


def _placed(now: Solution, side1: Hanging, side2: Hanging, pieces1: Pieces, pieces2: Pieces, gate_m: float) -> Facing:
    T12 = se2.between(now.poses[side1.frame], now.poses[side2.frame])
    placed1 = side1.moved(now.poses)
    placed2 = np.asarray(se2.compose(T12, side2.moved(now.poses)))
    return faced(pieces1, pieces2, placed1, placed2, gate_m)


def weighed_by_walls(w: Weighed, solution: Solution, config: WallsConfig) -> tuple[Weighed, Solution]:
    """A solved hypothesis with what walls say for its placement and against it; unchanged where they say nothing."""
    fit = with_walls(solution, config)
    solution = solution if fit is None else fit.solution
    return _told(w, evidence_of_walls(solution, config)), solution


def weighed_by_conflicts(w: Weighed, config: WallsConfig) -> Weighed:
    """A hypothesis with what walls say against it, both maps bent onto each other by its matches: without a graph."""
    joined = w.growth.joined
    return _told(w, wall_evidence(joined.m1.map, joined.m2.map, joined.T12, config, placed=joined.corrected()))


def _told(w: Weighed, found: WallEvidence | None) -> Weighed:
    if found is None:
        return w
    # an image of the right place has the same corridors, not the same walls
    return replace(w, terms=replace(w.terms, walls=found.nats), apart=w.apart + found.nats)


def evidence_of_walls(solution: Solution, config: WallsConfig) -> WallEvidence | None:
    """What walls and ways of two maps say against the solved hypothesis, each map bent as the solution bends it.

    None where a map has no walls or no way.
    """
    map1, map2 = solution.problem.maps
    bent1, bent2 = (_bent(solution, r, config) for r in range(2))
    if bent1 is not None and bent2 is not None:
        return against(bent1, bent2, config)
    T12 = se2.between(solution.frame(0), solution.frame(1))
    inverse = se2.inverse(solution.frame(0))
    at1, at2 = (se2.transform(inverse, solution.landmark_poses(r)[:, :2]) for r in range(2))
    return wall_evidence(map1, map2, T12, config, placed=(at1, at2))


def _bent(solution: Solution, r: int, config: WallsConfig) -> tuple[list[Array], Array] | None:
    """A map's walls as its keyframes saw them and its way, as the solution places them, in the merged frame."""
    map_ = solution.problem.maps[r]
    side, way = hanging(map_, r), way_of(map_)
    if side is None or len(way) < 2:
        return None
    placed = np.asarray(se2.compose(solution.frame(r), side.moved(solution.poses)))
    at = np.asarray(cKDTree(side.keyframes[:, :2]).query(way)[1])
    way = se2.transform(placed[at], se2.transform(se2.inverse(side.keyframes[at]), way))
    pieces = pieces_of(keyframes_of(map_))
    lines = se2.transform(placed[pieces.at][:, None], pieces.ends)
    return credible(list(lines), way, config.margin_m), way


class _Prior:
    """What is known without walls: the joint covariance of the unknowns, at the solution without them."""

    def __init__(self, solution: Solution, side1: Hanging, side2: Hanging) -> None:
        self.sides = side1, side2
        self.poses = solution.poses
        self.unknowns: tuple[Unknown, ...] = (side1.frame, side2.frame, *side1.landmarks, *side2.landmarks)
        self.C = solution.joint_covariance(self.unknowns)

    def measurement(
        self, found: Facing, poses: Mapping[Unknown, Array], config: WallsConfig
    ) -> tuple[WallMeasurement, float] | None:
        """The offsets at ``poses`` as a measurement, and their sigma [m]; without those that disagree with all others.

        None where too few are left.
        """
        while len(found) >= LEAST:
            r, by_landmarks, own = self._expected(found, poses)
            sigma = _sigma(r, by_landmarks + own)
            R = own + sigma**2 * np.eye(len(r))
            information = np.linalg.inv(by_landmarks + R)
            # in standard deviations, what each is off by from what all others predict
            off = np.abs(information @ r) / np.sqrt(np.diag(information))
            if off.max() <= config.gate_sigma:
                L = np.linalg.cholesky(R)
                return WallMeasurement(*self.sides, found, solve_triangular(L, np.eye(len(L)), lower=True)), sigma
            # a few at a time: what is wrong makes others look wrong
            found = found.only(off <= max(config.gate_sigma, WORST * off.max()))
        return None

    def _expected(self, found: Facing, poses: Mapping[Unknown, Array]) -> tuple[Array, Array, Array]:
        """Offsets (k,) as they were at the solution without walls; their covariance by landmarks, by keyframes (k, k).

        Linearised at ``poses``.
        """
        side1, side2 = self.sides
        axes = pose_rotations(np.array([-poses[u][2] for u in self.unknowns]))
        J = offset_jacobian(side1, side2, found, poses).reshape(len(found), -1, 3)
        J = np.einsum("kui,uij->kuj", J, axes).reshape(len(found), -1)
        came = np.array([poses[u] - self.poses[u] for u in self.unknowns])
        came[:, 2] = se2.wrap(came[:, 2])
        r = offsets(side1, side2, found, poses) - J @ came.ravel()
        by1, by2 = keyframe_jacobians(side1, side2, found, poses)
        return r, J @ self.C @ J.T, by1 @ side1.alone @ by1.T + by2 @ side2.alone @ by2.T


def _sigma(r: Array, S0: Array) -> float:
    """The most probable standard deviation [m] of an offset between walls; offsets (k,) have covariance S0 besides."""
    values, vectors = np.linalg.eigh((S0 + S0.T) / 2)
    squared = (vectors.T @ r) ** 2
    variances = np.maximum(values, 0.0) + SIGMAS[:, None] ** 2
    return float(SIGMAS[np.argmin((squared / variances + np.log(variances)).sum(axis=1))])
