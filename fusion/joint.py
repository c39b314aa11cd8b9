"""One graph for all maps of a group: every landmark of every map, what is the same held together, solved robustly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.factors import LandmarkKey, Problem, build_problem
from mapfuse.factors.noise import DOUBT, Loss

from .config import SolvingConfig, WallsConfig
from .prepared import PreparedMap
from .solve import Solution, solve
from .wallfit import with_walls

Array = NDArray[np.float64]
#: The landmarks that are one place, as (map, place in its landmarks).
Members = tuple[tuple[int, int], ...]

#: How often a graph is built again after the gate took a landmark out of a place that more than two maps have.
MAX_REGROUPINGS = 10


@dataclass(frozen=True, eq=False)
class Joint:
    """The solved graph of a group, in the frame of map ``reference``; ``shared``: places that several maps have.

    ``walled``: the pairs of maps whose walls are in it, and how; None where walls aren't used.
    """

    maps: tuple[PreparedMap, ...]
    solution: Solution
    shared: tuple[Members, ...]
    reference: int
    walled: Walled | None = None


@dataclass(frozen=True, slots=True)
class Walled:
    """Walls in a group's graph: the pairs of maps ``between`` which they are laid on each other."""

    between: tuple[tuple[int, int], ...]
    config: WallsConfig

    def added(self, solution: Solution) -> Solution:
        """The solution with walls in it; the same where they say nothing."""
        fit = with_walls(solution, self.config, self.between)
        return solution if fit is None else fit.solution


def solve_group(
    maps: Sequence[PreparedMap],
    frames: Sequence[Array],
    shared: Sequence[Members],
    config: SolvingConfig,
    walled: Walled | None = None,
) -> Joint:
    """Solve all maps of a group at once, in the frame of the first.

    ``frames``: pose (3,) of each map to start from; ``shared``: which landmarks are the same, each map's at most once
    in a place. A landmark that the gate takes out is a place of its own afterwards. ``walled``: whose walls come in
    then.
    """
    maps, shared = tuple(maps), tuple(shared)
    poses = [m.poses for m in maps]
    scale = _noise_scale(maps)
    solution = solve(_problem(maps, frames, shared, poses, DOUBT), config, scale)
    for _ in range(MAX_REGROUPINGS):
        kept = _without(maps, shared, solution)
        if kept == shared:
            break
        regrouped = any(len(members) > 2 for members in kept) or len(kept) > len(shared)
        shared = kept
        if not regrouped:
            break
        frames, poses = _solved(maps, solution)
        solution = solve(_problem(maps, frames, shared, poses, None), config, scale)
    return Joint(maps, solution if walled is None else walled.added(solution), shared, 0, walled)


def referred_to(joint: Joint, reference: int, config: SolvingConfig) -> Joint:
    """The same places solved in the frame of another map."""
    if reference == joint.reference:
        return joint
    frames, poses = _solved(joint.maps, joint.solution)
    frames = [np.asarray(se2.between(frames[reference], T)) for T in frames]
    problem = _problem(joint.maps, frames, joint.shared, poses, None, reference)
    solution = solve(problem, config, _noise_scale(joint.maps))
    walled = joint.walled
    return Joint(joint.maps, solution if walled is None else walled.added(solution), joint.shared, reference, walled)


def _noise_scale(maps: Sequence[PreparedMap]) -> float:
    """By how much the sigmas of the worst stated map are too small."""
    return max(m.noise_scale for m in maps)


def _problem(
    maps: Sequence[PreparedMap],
    frames: Sequence[Array],
    shared: Sequence[Members],
    poses: Sequence[Array],
    loss: Loss | None,
    reference: int = 0,
) -> Problem:
    keys = [[LandmarkKey(r, maps[r].map.ids[k]) for r, k in members] for members in shared]
    matches = [pair for members in keys for pair in combinations(members, 2)]
    return build_problem([m.map for m in maps], frames, matches, loss=loss, starts=poses, reference=reference)


def _solved(maps: Sequence[PreparedMap], solution: Solution) -> tuple[list[Array], list[Array]]:
    """Frames (3,) and each map's landmark poses (n, 3) in its own frame, at the optimum."""
    frames = [solution.frame(r) for r in range(len(maps))]
    return frames, [np.asarray(se2.between(T, solution.landmark_poses(r))) for r, T in enumerate(frames)]


def _without(maps: Sequence[PreparedMap], shared: Sequence[Members], solution: Solution) -> tuple[Members, ...]:
    """The places that are left when what the gate rejected is cut: what still hangs together."""
    rejected = {match.pair for match in solution.rejected}
    kept: list[Members] = []
    for members in shared:
        key = {member: LandmarkKey(member[0], maps[member[0]].map.ids[member[1]]) for member in members}
        parts: list[set[tuple[int, int]]] = []
        for member in members:
            tied = [part for part in parts if any((key[other], key[member]) not in rejected for other in part)]
            parts = [part for part in parts if part not in tied] + [{member}.union(*tied)]
        kept += [tuple(sorted(part)) for part in parts if len(part) > 1]
    return tuple(kept)
