"""Problem -> solution: a robust solve, a chi-square gate, a plain refit; covariance is a query of the refit alone."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError, UndeterminedError
from mapfuse.datasets.transform import Transform
from mapfuse.factors import Correspondence, FrameKey, Gauge, LandmarkKey, Problem, Unknown
from mapfuse.factors.axes import pose_to_axes
from mapfuse.factors.keys import map_keys
from mapfuse.factors.measurement import Poses

from .config import SolvingConfig, chi2_gate
from .covariance import Linearised, Marginals, SingularError

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

#: A solution counts as an optimum when the next Gauss-Newton step moves no unknown by more than this [m, rad].
CONVERGED_STEP = 1e-6
#: Steps that no longer shrink, and change the error by this share of it at most, are rounding: over a long lever the
#: last digits of a rotation move landmarks by more than `CONVERGED_STEP`. So are steps below `ROUNDING_STEP` [m, rad]
#: that raise the error.
ROUNDING, ROUNDING_STEP = 1e-11, 1e-4
#: A Gauss-Newton step may raise the error [nats] by so much, which is rounding.
LEVEL = 1e-6
#: Turns between landmarks' headings follow from how the frames lie; frames that turned more than this [rad] since are
#: looked at again.
TURNED = 1e-3
#: From this share of correspondences beyond the gate on, the optimum of all of them is no place to start from.
MANY = 0.25
#: Steps count as slow that keep more than `SLOW` of their length, and as on a line from this squared cosine on; so many
#: times as long are they made at least and at most.
SLOW, ON_A_LINE, LENGTHS = 0.2, 0.9, (0.1, 10.0)
MAX_RESTARTS = 10
MAX_STEPS = 12


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a problem, and its covariance as a query.

    ``poses``: every unknown's (3,) pose in the merged frame.
    ``rejected``: correspondences that the gate took out.
    """

    problem: Problem
    poses: dict[Unknown, Array]
    iterations: int
    linearised: Linearised
    rejected: tuple[Correspondence, ...] = ()

    @cached_property
    def chi2(self) -> float:
        """Sum of squared whitened residuals."""
        return float(sum(np.sum(m.residual(self.poses) ** 2) for m in self.problem.measurements))

    @cached_property
    def _place(self) -> dict[Unknown, int]:
        """Place of each unknown in the linearised graph: GTSAM sorts by key."""
        return {unknown: k for k, unknown in enumerate(self.problem.keys.in_order)}

    @cached_property
    def marginals(self) -> Marginals:
        """Covariances in the axes of the merged frame, given the frames that the gauge holds: what keeps the solver
        from floating is no uncertainty, and over the lever from a map's coordinate origin to its landmarks it would
        grow to one. Unknowns are in the order of their keys.
        """
        try:
            return Marginals(self.linearised)
        except SingularError as error:
            unknowns = self.problem.keys.in_order
            raise _undetermined(self.problem, [unknowns[k] for k in error.loose]) from None

    def check_determined(self) -> None:
        """Raises `UndeterminedError` naming the landmarks that the measurements leave open."""
        _ = self.marginals

    def joint_covariance(self, unknowns: Sequence[Unknown]) -> Array:
        """Joint covariance (3k, 3k) of k unknowns over (x, y, theta) each, axes of the merged frame.

        Raises `UndeterminedError` naming the landmarks that the measurements leave open, `TooLargeError` for more
        than `covariance.MAX_JOINT` unknowns.
        """
        return self.marginals.joint([self._place[u] for u in unknowns])

    def covariances(self, unknowns: Sequence[Unknown], others: Sequence[Unknown] | None = None) -> Array:
        """Covariance (k, 3, 3) of each of k unknowns, or cross covariance of each with one of ``others``.

        Those of all landmarks at once cost little more than those of one.
        """
        also = None if others is None else [self._place[u] for u in others]
        return self.marginals.blocks([self._place[u] for u in unknowns], also)

    def covariance(self, a: Unknown, b: Unknown | None = None) -> Array:
        """Covariance (3, 3) of an unknown, or cross covariance of two; axes of the merged frame."""
        return np.asarray(self.covariances([a], None if b is None else [b])[0])

    def transform(self, r: int) -> Transform:
        """Pose of map r's frame in the merged frame with its covariance: T12 for the second of two maps."""
        return Transform.from_array(self.poses[FrameKey(r)], self.covariance(FrameKey(r)))

    def frame(self, r: int) -> Array:
        """Pose (3,) of map r's frame in the merged frame."""
        return np.asarray(self.poses[FrameKey(r)])

    def landmark_keys(self, r: int) -> tuple[LandmarkKey, ...]:
        """Keys of map r's landmarks, in the map's order."""
        keys = map_keys(self.problem.maps[r], r).landmarks
        return tuple(keys[identifier] for identifier in self.problem.maps[r].ids)

    def landmark_poses(self, r: int) -> Array:
        """Poses (n, 3) of map r's landmarks in the merged frame, in the map's order."""
        return np.array([self.poses[key] for key in self.landmark_keys(r)]).reshape(-1, 3)

    def landmark_covariance(self, r: int) -> Array:
        """Joint covariance (3n, 3n) of map r's landmarks, in the map's order, axes of the merged frame."""
        return self.joint_covariance(self.landmark_keys(r))


def optimum(problem: Problem, rejected: Sequence[Correspondence] = ()) -> Solution:
    """The optimum nearby of all measurements as they stand, ungated: what `solve` is made of.

    To the last step: Gauss-Newton, and Levenberg-Marquardt where that doesn't descend.

    Levenberg-Marquardt alone may report success after a small decrease far from the optimum, and covariances there
    are worth nothing.
    """
    graph, values = problem.graph(), problem.values()
    order = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    iterations = 0
    try:
        for _ in range(MAX_RESTARTS):
            values, steps, last = _gauss_newton(graph, values, order)
            iterations += steps
            if last is None:
                break
            values, steps = _levenberg_marquardt(graph, values, 1e-10)
            iterations += steps
            if not steps:  # neither finds a way down: what is left is rounding
                break
        else:
            log.warning("optimum not reached: the last step was still %.2g", last)
    except RuntimeError as error:
        raise _indeterminate(problem, graph, order, str(error)) from None
    poses = _finite_poses(problem, values)
    return Solution(problem, poses, iterations, _linearised(problem, graph, values, poses, order), tuple(rejected))


def _gauss_newton(graph: Any, values: Any, order: Any) -> tuple[Any, int, float | None]:
    """Steps while the error doesn't rise; the poses, how many steps, and the last one's size or None at the optimum.

    Where the residuals are bent as much as they are steep, as where a map's heading is hardly known, Gauss-Newton's
    steps shrink slowly or go to and fro. They then are a line's: by how much the last one was right follows from what
    is left of it, and the next is made so much longer or shorter (`_length`).
    """
    error, steps, largest = graph.error(values), 0, np.inf
    past, length = np.zeros(0), 1.0
    for _ in range(MAX_STEPS):
        step = graph.linearize(values).optimize(order)
        whole = step.vector()
        proposed, past = _length(whole, past, length), whole
        for share in (proposed, 1.0, 0.5):
            length, further = share, values.retract(step if share == 1.0 else step.scale(share))
            after = graph.error(further)
            if after <= error + (LEVEL if share == 1.0 else 0.0):
                break
        before, largest = largest, float(np.abs(whole).max(initial=0.0))
        if not after <= error + LEVEL:
            return values, steps, None if largest < ROUNDING_STEP else np.inf
        gain, values, error, steps = abs(error - after), further, after, steps + 1
        if largest < CONVERGED_STEP or (largest > before / 2 and gain <= ROUNDING * (1 + error)):
            return values, steps, None
    return values, steps, largest


def _length(step: Array, past: Array, length: float) -> float:
    """What share of Gauss-Newton's ``step`` to go, after ``length`` times the ``past`` one; 1 unless both are slow and
    on one line (secant method on that line; B. Irons and R. Tuck, Int. J. Numer. Meth. Eng. 1, 1969).

    >>> s = np.array([0.0, 1.0])
    >>> _length(-0.9 * s, s, 1.0), _length(0.75 * s, s, 1.0), _length(0.01 * s, s, 1.0)
    (0.5263157894736842, 4.0, 1.0)
    """
    if len(past) != len(step) or not len(step):
        return 1.0
    along, square = float(step @ past), float(past @ past)
    if along**2 < ON_A_LINE * square * float(step @ step) or abs(along) < SLOW * square:
        return 1.0
    undone = (1.0 - along / square) / length
    return float(np.clip(1.0 / undone, *LENGTHS)) if undone > 0.0 else 1.0


def _levenberg_marquardt(graph: Any, values: Any, tolerance: float) -> tuple[Any, int]:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(200)
    params.setRelativeErrorTol(tolerance)
    params.setAbsoluteErrorTol(tolerance)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    return optimizer.optimize(), optimizer.iterations()


def _robust_optimum(problem: Problem) -> dict[Unknown, Array]:
    """Poses that most of the correspondences agree on: a place to start from, no more."""
    graph = problem.graph()
    try:
        values, _ = _levenberg_marquardt(graph, problem.values(), 1e-4)
    except RuntimeError as error:
        order = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        raise _indeterminate(problem, graph, order, str(error)) from None
    return _finite_poses(problem, values)


def _finite_poses(problem: Problem, values: Any) -> dict[Unknown, Array]:
    poses = problem.poses(values)
    if not np.isfinite(list(poses.values())).all():
        raise MapfuseError("the solver left finite numbers; the maps' noise or positions are out of proportion")
    return poses


def _linearised(problem: Problem, graph: Any, values: Any, poses: Poses, order: Any) -> Linearised:
    unknowns = problem.keys.in_order
    held = {gauge.of for gauge in problem.of_kind(Gauge)}
    free = np.array([unknown not in held for unknown in unknowns], dtype=bool)
    thetas = np.array([poses[unknown][2] for unknown in unknowns])
    return Linearised.of(graph.linearize(values), order, problem.keys.keys(unknowns), free, thetas)


def _indeterminate(problem: Problem, graph: Any, order: Any, message: str) -> UndeterminedError:
    """What GTSAM gave up: names the landmarks that nothing holds, failing that those in its message."""
    held = _linearised(problem, graph, problem.values(), problem.initial, order)
    try:
        Marginals(replace(held, free=np.ones_like(held.free)))
    except SingularError as error:
        unknowns = problem.keys.in_order
        return _undetermined(problem, [unknowns[k] for k in error.loose], message)
    return _undetermined(problem, (), message)


def _undetermined(problem: Problem, loose: Iterable[Unknown], message: str = "") -> UndeterminedError:
    """Names the landmarks that move along directions which nothing measures; failing that, those in GTSAM's message."""
    found = [unknown for unknown in loose if isinstance(unknown, LandmarkKey)]
    if found:
        reason = "the measurements leave open where these are"
    else:
        found = [unknown for unknown in problem.keys.mentioned(message) if isinstance(unknown, LandmarkKey)]
        reason = "the measurements leave something open" + (" near these" if found else "")
    return UndeterminedError(reason, tuple((problem.maps[u.map].name, u.id) for u in found))


def left_out(solution: Solution, match: Correspondence) -> float:
    """`all_left_out` of one correspondence."""
    return float(all_left_out(solution, [match])[0])


def all_left_out(solution: Solution, matches: Sequence[Correspondence]) -> Array:
    """Squared Mahalanobis distance (k,) of each correspondence from what all other measurements predict.

    With r its residual at the optimum, R its noise and S the posterior covariance of what it measures, that is
    ``r' (R - S)^-1 r``: the residual of a tight measurement says little by itself, since it pulls the optimum along.
    """
    a, b = [m.a for m in matches], [m.b for m in matches]
    of_a, of_b, cross = solution.covariances([*a, *b, *a], [*a, *b, *b]).reshape(3, len(a), 3, 3)
    moved = of_a + of_b - cross - np.swapaxes(cross, 1, 2)
    poses_a, poses_b = (np.array([solution.poses[u] for u in side]).reshape(-1, 3) for side in (a, b))
    r = poses_b - poses_a
    r[:, 2] = se2.wrap(r[:, 2] - [m.measured[2] for m in matches])
    square_root = np.array([((n.xx, n.xy, 0), (0, n.yy, 0), (0, 0, n.tt or 1.0)) for n in (m.noise for m in matches)])
    square_root = square_root.reshape(-1, 3, 3)
    R = pose_to_axes(poses_b[:, 2], np.linalg.inv(np.swapaxes(square_root, 1, 2) @ square_root))
    free = R - moved
    without_heading = np.array([m.dof < 3 for m in matches], dtype=bool)
    r[without_heading, 2] = 0
    free[without_heading, 2, :] = free[without_heading, :, 2] = (0, 0, 1)
    return np.asarray(np.einsum("ki,ki->k", r, np.linalg.solve(free, r[:, :, None])[..., 0]))


def solve(problem: Problem, config: SolvingConfig, noise_scale: float = 1.0) -> Solution:
    """Solve a problem; correspondences under a robust loss are gated, and the accepted ones solved as plain Gaussian.

    One by one, the correspondence that disagrees most with all the rest is taken out, while it lies beyond the
    chi-square gate, and the rest is solved again. Where many disagree at first the optimum of all may be far from the
    right one: the robust optimum is then the starting point. ``noise_scale``: by how much the stated sigmas are known
    to be too small (`mapfuse.fusion.prepared.PreparedMap.noise_scale`); the gate is as much wider.

    Raises `UndeterminedError` naming the landmarks concerned where the measurements leave something open.
    """
    doubted = any(m.loss is not None for m in problem.of_kind(Correspondence))
    trusted = _trusted(problem) if doubted else problem
    solution = optimum(trusted)
    if doubted:
        solution = _turned(trusted, solution)
    excess = _excess(solution, config, noise_scale)
    if doubted and len(excess) and np.mean(excess > 1) > MANY:
        # what all measurements determine is determined: where the robust optimum is no place to start from, the first
        # solution is left, and loses its matches one by one
        with suppress(UndeterminedError):
            solution = optimum(_matched_again(problem.starting_at(_robust_optimum(problem))))
            excess = _excess(solution, config, noise_scale)
    rejected: list[Correspondence] = []
    while excess.max(initial=0.0) > 1:
        worst = solution.problem.of_kind(Correspondence)[int(np.argmax(excess))]
        rejected.append(worst)
        kept = [m for m in solution.problem.measurements if m is not worst]
        solution = optimum(solution.problem.starting_at(solution.poses).with_measurements(kept), rejected)
        excess = _excess(solution, config, noise_scale)
    return solution


def _trusted(problem: Problem) -> Problem:
    """The problem with its correspondences plain."""
    plain = [replace(m, loss=None) if isinstance(m, Correspondence) else m for m in problem.measurements]
    return problem.with_measurements(plain)


def _matched_again(problem: Problem) -> Problem:
    """The problem with plain correspondences as they follow from how its frames lie."""
    return problem.with_correspondences(m.pair for m in problem.of_kind(Correspondence))


def _turned(problem: Problem, solution: Solution) -> Solution:
    """Solved again where the frames turned on the way to the optimum, and with them which arms meet."""
    frames = [FrameKey(r) for r in range(len(problem.maps))]
    turns = [abs(se2.wrap(solution.poses[T][2] - problem.initial[T][2])) for T in frames]
    if max(turns) < TURNED:
        return solution
    again = _matched_again(problem.starting_at(solution.poses))
    return solution if again.measurements == problem.measurements else optimum(again)


def _excess(solution: Solution, config: SolvingConfig, noise_scale: float) -> Array:
    """How far each correspondence disagrees with all the rest, by the gate's distance (k,).

    0 of fewer than three: either of two may be the wrong one.
    """
    matches = solution.problem.of_kind(Correspondence)
    if len(matches) < 3:
        return np.zeros(len(matches))
    dof = np.array([m.dof for m in matches])
    return np.asarray(all_left_out(solution, matches) / (chi2_gate(config.gate_probability, dof) * noise_scale**2))
