"""Problem -> solution: a robust solve, a chi-square gate, a plain refit; covariance is a query of the refit alone."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.sparse import csr_array

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError, TooLargeError, UndeterminedError
from mapfuse.datasets.transform import Transform
from mapfuse.factors import Correspondence, FrameKey, Gauge, LandmarkKey, Problem, Unknown
from mapfuse.factors.axes import pose_rotations, pose_to_axes

from .config import SolvingConfig, chi2_gate

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

#: The joint covariance is kept dense; a problem with more unknown poses than this is refused.
MAX_UNKNOWNS = 5000
#: A solution counts as an optimum when the next Gauss-Newton step moves no unknown by more than this [m, rad].
CONVERGED_STEP = 1e-6
#: A pivot of the information matrix that is less than this share of its diagonal is rounding: nothing is measured.
SINGULAR = 1e-13
MAX_RESTARTS = 10
MAX_POLISHING = 8


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a problem, and its covariance as a query.

    ``poses``: every unknown's (3,) pose in the merged frame.
    ``rejected``: correspondences that the gate took out.
    """

    problem: Problem
    poses: dict[Unknown, Array]
    iterations: int
    rejected: tuple[Correspondence, ...] = ()

    @cached_property
    def chi2(self) -> float:
        """Sum of squared whitened residuals."""
        return float(sum(np.sum(m.residual(self.poses) ** 2) for m in self.problem.measurements))

    @cached_property
    def _order(self) -> dict[Unknown, int]:
        """Column block of each unknown in the Jacobian: GTSAM sorts by key."""
        keys = sorted(self.problem.keys.key(unknown) for unknown in self.problem.keys)
        return {self.problem.keys.unknown(key): k for k, key in enumerate(keys)}

    @cached_property
    def _covariance(self) -> Array:
        """Joint covariance of all unknowns in the axes of the merged frame, (3u, 3u).

        Given the frames that the gauge holds: what keeps the solver from floating is no uncertainty, and over the
        lever from a map's coordinate origin to its landmarks it would grow to one.
        """
        unknowns = len(self._order)
        if unknowns > MAX_UNKNOWNS:
            raise TooLargeError(f"joint covariance of {unknowns} poses; it is kept up to {MAX_UNKNOWNS}")
        linear = self.problem.graph().linearize(self.problem.values(self.poses))
        H = information(linear, 3 * unknowns)
        held = {gauge.of for gauge in self.problem.of_kind(Gauge)}
        free = np.repeat([unknown not in held for unknown in self._order], 3)
        try:
            L = cholesky(H[np.ix_(free, free)], lower=True)
        except LinAlgError:
            raise _undetermined(self.problem, self.poses) from None
        # rounding may leave a pivot where nothing is measured
        if np.min(np.diag(L) ** 2 / np.diag(H)[free], initial=1.0) < SINGULAR:
            raise _undetermined(self.problem, self.poses)
        thetas = np.array([self.poses[unknown][2] for unknown in self._order])
        J = np.zeros((3 * unknowns, 3 * unknowns))
        blocks = np.arange(unknowns)
        J.reshape(unknowns, 3, unknowns, 3)[blocks, :, blocks, :] = pose_rotations(thetas)
        covariance = np.zeros_like(H)
        covariance[np.ix_(free, free)] = J[np.ix_(free, free)] @ cho_solve((L, True), J[np.ix_(free, free)].T)
        return (covariance + covariance.T) / 2

    def joint_covariance(self, unknowns: Sequence[Unknown]) -> Array:
        """Joint covariance (3k, 3k) of k unknowns over (x, y, theta) each, axes of the merged frame.

        Raises `UndeterminedError` naming the landmarks that the measurements leave open.
        """
        columns = np.array([3 * self._order[u] + row for u in unknowns for row in range(3)], dtype=np.intp)
        return self._covariance[np.ix_(columns, columns)]

    def covariance(self, a: Unknown, b: Unknown | None = None) -> Array:
        """Covariance (3, 3) of an unknown, or cross covariance of two; axes of the merged frame."""
        row = 3 * self._order[a]
        column = row if b is None else 3 * self._order[b]
        return self._covariance[row : row + 3, column : column + 3]

    def transform(self, r: int) -> Transform:
        """Pose of map r's frame in the merged frame with its covariance: T12 for the second of two maps."""
        return Transform.from_array(self.poses[FrameKey(r)], self.covariance(FrameKey(r)))

    def frame(self, r: int) -> Array:
        """Pose (3,) of map r's frame in the merged frame."""
        return np.asarray(self.poses[FrameKey(r)])

    def landmark_keys(self, r: int) -> tuple[LandmarkKey, ...]:
        """Keys of map r's landmarks, in the map's order."""
        return tuple(LandmarkKey(r, identifier) for identifier in self.problem.maps[r].ids)

    def landmark_poses(self, r: int) -> Array:
        """Poses (n, 3) of map r's landmarks in the merged frame, in the map's order."""
        return np.array([self.poses[key] for key in self.landmark_keys(r)]).reshape(-1, 3)

    def landmark_covariance(self, r: int) -> Array:
        """Joint covariance (3n, 3n) of map r's landmarks, in the map's order, axes of the merged frame."""
        return self.joint_covariance(self.landmark_keys(r))


def information(linear: Any, size: int) -> Array:
    """Information matrix J'J (size, size) of a linearised graph, unknowns sorted by key."""
    rows, columns, values = np.asarray(linear.sparseJacobian_())
    rows, columns = rows.astype(np.intp) - 1, columns.astype(np.intp) - 1
    kept = columns < size  # the last column is the right-hand side
    J = csr_array((values[kept], (rows[kept], columns[kept])), shape=(int(rows.max()) + 1, size))
    dense: Array = (J.T @ J).toarray()
    return dense


def _optimise(problem: Problem, exact: bool = True) -> tuple[dict[Unknown, Array], int]:
    """Levenberg-Marquardt, then, where ``exact``, Gauss-Newton steps to the very optimum.

    LM may report success after a small decrease far from the optimum, and covariances there are worth nothing.
    """
    graph, values = problem.graph(), problem.values()
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(1e-10)
    params.setAbsoluteErrorTol(1e-10)
    iterations, largest = 0, np.inf
    try:
        for _ in range(MAX_RESTARTS):
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
            values = optimizer.optimize()
            iterations += optimizer.iterations()
            if not exact:
                break
            for _ in range(MAX_POLISHING):
                step = graph.linearize(values).optimize()
                largest = max(float(np.abs(step.at(unknown)).max()) for unknown in values.keys())  # noqa: SIM118
                further = values.retract(step)
                if largest > 1.0 or graph.error(further) > graph.error(values) + 1e-6:
                    break
                values, iterations = further, iterations + 1
                if largest < CONVERGED_STEP:
                    break
            if largest < CONVERGED_STEP:
                break
        else:
            log.warning("optimum not reached: the last step was still %.2g", largest)
    except RuntimeError as error:
        raise _undetermined(problem, problem.initial, str(error)) from None
    poses = problem.poses(values)
    if not all(np.isfinite(pose).all() for pose in poses.values()):
        raise MapfuseError("the solver left finite numbers; the maps' noise or positions are out of proportion")
    return poses, iterations


def _undetermined(problem: Problem, poses: Mapping[Unknown, Array], message: str = "") -> UndeterminedError:
    """Names the landmarks that move along directions which nothing measures; failing that, those in GTSAM's message."""
    found = [unknown for unknown in _open(problem, poses) if isinstance(unknown, LandmarkKey)]
    if found:
        reason = "the measurements leave open where these are"
    else:
        found = [unknown for unknown in problem.keys.mentioned(message) if isinstance(unknown, LandmarkKey)]
        reason = "the measurements leave something open" + (" near these" if found else "")
    return UndeterminedError(reason, tuple((problem.maps[u.map].name, u.id) for u in found))


def _open(problem: Problem, poses: Mapping[Unknown, Array]) -> list[Unknown]:
    """The unknowns that may move at no cost: where the null vectors of the information matrix, scaled to a diagonal
    of ones, are not zero."""
    order = sorted(problem.keys, key=problem.keys.key)
    if len(order) > MAX_UNKNOWNS:
        return []
    H = information(problem.graph().linearize(problem.values(poses)), 3 * len(order))
    scale = 1 / np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    loose = (vectors[:, values < SINGULAR] * scale[:, None]).reshape(len(order), -1)
    moved = np.linalg.norm(loose, axis=1)
    return [unknown for unknown, by in zip(order, moved, strict=True) if by > 0.01 * moved.max(initial=0.0)]


def _solved(problem: Problem) -> Solution:
    poses, iterations = _optimise(problem)
    return Solution(problem, poses, iterations)


def left_out(solution: Solution, match: Correspondence) -> float:
    """Squared Mahalanobis distance of a correspondence from what all other measurements predict.

    With r its residual at the optimum, R its noise and S the posterior covariance of what it measures, that is
    ``r' (R - S)^-1 r``: the residual of a tight measurement says little by itself, since it pulls the optimum along.
    """
    a, b = match.unknowns
    moved = solution.covariance(a) + solution.covariance(b) - solution.covariance(a, b) - solution.covariance(b, a)
    T_a, T_b = solution.poses[a], solution.poses[b]
    r = np.append(T_b[:2] - T_a[:2], se2.wrap(T_b[2] - T_a[2] - match.measured[2]))
    rows = slice(0, match.dof)
    n = match.noise
    square_root = np.array([[n.xx, n.xy, 0], [0, n.yy, 0], [0, 0, n.tt or 1.0]])
    R = pose_to_axes(T_b[2], np.linalg.inv(square_root.T @ square_root))
    free = (R - moved)[rows, rows]
    return float(r[rows] @ np.linalg.solve(free, r[rows]))


def solve(problem: Problem, config: SolvingConfig) -> Solution:
    """Solve a problem; correspondences under a robust loss are gated, and the accepted ones solved as plain Gaussian.

    The robust optimum is the starting point. Then, one by one, the correspondence that disagrees most with all
    the rest is taken out, while it lies beyond the chi-square gate, and the rest is solved again.

    Raises `UndeterminedError` naming the landmarks concerned where the measurements leave something open.
    """
    rejected: list[Correspondence] = []
    if any(m.loss is not None for m in problem.of_kind(Correspondence)):
        poses, _ = _optimise(problem, exact=False)
        problem = problem.starting_at(poses).with_correspondences(m.pair for m in problem.of_kind(Correspondence))
    solution = _solved(problem)
    while matches := problem.of_kind(Correspondence):
        excess = [left_out(solution, m) / chi2_gate(config.gate_probability, m.dof) for m in matches]
        worst = int(np.argmax(excess))
        if excess[worst] <= 1 or len(matches) < 3:
            break
        rejected.append(matches[worst])
        kept = [m for m in problem.measurements if m is not matches[worst]]
        problem = problem.starting_at(solution.poses).with_measurements(kept)
        solution = _solved(problem)
    return replace(solution, rejected=tuple(rejected))
