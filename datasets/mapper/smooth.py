"""The map from all that is remembered at once: Gauss-Newton over keyframes, systematic errors, bends and landmarks.

The filter takes each measurement once, at the estimate of that moment. Before a loop is closed that estimate may be
off by metres and tenths of a radian, and a covariance that is derived there is too small. Here every measurement is
taken at the final estimate. The covariance of the border (`linear`) is the inverse of its Schur complement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from .linear import FIRST_NODE, NORTH, SYSTEMATIC, Drive, Estimate, System, linearise
from .memory import Known, Memory

Array = NDArray[np.float64]

_CHUNK = 64
_ITERATIONS = 40
#: Step length [standard deviations] at which a descent ends, and at which its first, trusting part does.
CONVERGED, _ROUGHLY = 1e-3, 0.5
_LEAST_DAMPING, _MOST_DAMPING = 1e-5, 1e6


@dataclass(frozen=True, eq=False, slots=True)
class Smoothed:
    """An optimum: the estimate, ``error`` [nats], the ``covariance`` of the border, weights of the sightings."""

    estimate: Estimate
    error: float
    covariance: Array
    weights: Array
    squared: Array
    converged: bool
    _eliminated: _Schur

    @property
    def landmark_rows(self) -> int:
        """Row of the covariance at which the landmarks begin: x, y of each, then the arms' directions."""
        return FIRST_NODE + len(self.estimate.bends)

    @property
    def line_rows(self) -> int:
        """Row at which the lines of walls begin: direction and offset of each."""
        return len(self.covariance) - 2 * len(self.estimate.lines)

    def keyframe_covariance(self, which: Array) -> tuple[Array, Array]:
        """Joint covariance (3k, 3k) of some keyframes' poses, and theirs with the border (3k, size)."""
        return self._eliminated.poses(which, self.covariance)


def drive_of(
    memory: Memory,
    landmarks: Sequence[Known],
    systematic_sigma: Array,
    arm_sigma: float,
    bend: tuple[float, float],
) -> Drive:
    """The memory as arrays, landmarks in this order, arms one landmark after the other."""
    index = {landmark.key: k for k, landmark in enumerate(landmarks)}
    first_arm = arm_starts(landmarks)
    frames = memory.keyframes[1:]
    covariance = _array([f.motion.covariance for f in frames], 6)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]))
    kept = [s for s in memory.sightings if s.landmark in index]
    noise = _array([(s.uu, s.uv, s.uv, s.vv) for s in kept], 4).reshape(-1, 2, 2)
    arms = [(s.keyframe, first_arm[index[s.landmark]] + m, b) for s in kept for m, b in s.arms]
    return Drive(
        _array([f.motion.pose for f in frames], 3),
        _array([f.motion.at for f in frames], 4),
        np.array([f.motion.by_systematic() for f in frames]).reshape(-1, 3, 4),
        whiten,
        np.array([s.keyframe for s in kept], dtype=np.intp),
        np.array([index[s.landmark] for s in kept], dtype=np.intp),
        _array([(s.u, s.v) for s in kept], 2),
        np.linalg.inv(np.linalg.cholesky(noise)),
        np.array([a[0] for a in arms], dtype=np.intp),
        np.array([a[1] for a in arms], dtype=np.intp),
        np.array([a[2] for a in arms], dtype=float),
        arm_sigma,
        np.array([s.keyframe for s in memory.stations], dtype=np.intp),
        np.array([s.node for s in memory.stations], dtype=np.intp),
        np.array([s.heading for s in memory.stations], dtype=float),
        np.sqrt([s.variance for s in memory.stations]),
        systematic_sigma,
        *bend,
        len(landmarks),
        sum(len(landmark.arms) for landmark in landmarks),
    )


def _array(rows: Sequence[Sequence[float]], width: int) -> Array:
    return np.array(rows, dtype=float).reshape(-1, width)


def arm_starts(landmarks: Sequence[Known]) -> list[int]:
    """Number of the first arm of each landmark, and at the end the number of all."""
    return list(accumulate((len(landmark.arms) for landmark in landmarks), initial=0))


def smooth(drive: Drive, start: Estimate, robust_gate: float) -> Smoothed:
    """The optimum of a drive from a start near it.

    First without doubt in any sighting, so that a loop that was just closed can pull; then with a loss that grows as
    the logarithm beyond ``robust_gate`` (squared residual in sigmas). The bend's covariance is that of the places
    that the estimate puts its nodes at.
    """
    rough, _ = _descend(drive, start, np.inf, _ROUGHLY, 12)
    estimate, converged = _descend(drive, rough, robust_gate, CONVERGED, _ITERATIONS)
    system = linearise(drive, estimate, robust_gate)
    schur = _Schur(system, 0.0)
    return Smoothed(estimate, system.error, schur.covariance(), system.weights, system.squared, converged, schur)


def _descend(drive: Drive, start: Estimate, gate: float, until: float, iterations: int) -> tuple[Estimate, bool]:
    estimate, damping = start, 0.0
    system = linearise(drive, estimate, gate)
    for _ in range(iterations):
        try:
            step_poses, step_border, decrement = _Schur(system, damping).step()
        except LinAlgError:
            # numbers of very different size: a smaller step is what is left
            damping = max(damping * 10, _LEAST_DAMPING)
            if damping > _MOST_DAMPING:
                return estimate, False
            continue
        if damping == 0 and decrement < until:
            return estimate, True
        tried = _moved(estimate, step_poses, step_border)
        if not np.isfinite(gate) and len(drive.walls):
            tried = replace(tried, lines=drive.walls.through(tried.poses, tried.lines))
        new = linearise(drive, tried, gate, nodes=system.node_information)
        if new.error <= system.error * (1 + 1e-12) + 1e-9:
            estimate, damping = tried, damping / 10 if damping > _LEAST_DAMPING else 0.0
            # the bends' places moved with the poses
            system = linearise(drive, estimate, gate) if len(estimate.bends) else new
        else:
            damping = max(damping * 10, _LEAST_DAMPING)
            if damping > _MOST_DAMPING:
                return estimate, False
    return estimate, False


def _moved(e: Estimate, poses: Array, border: Array) -> Estimate:
    n, m = len(e.bends), len(e.landmarks)
    all_poses = e.poses + np.concatenate([poses, border[:3]]).reshape(-1, 3)
    at = FIRST_NODE + n
    arms_end = at + 2 * m + len(e.arms)
    return replace(
        e,
        poses=all_poses,
        systematic=e.systematic + border[SYSTEMATIC],
        north=e.north + float(border[NORTH]),
        bends=e.bends + border[FIRST_NODE:at],
        landmarks=e.landmarks + border[at : at + 2 * m].reshape(-1, 2),
        arms=e.arms + border[at + 2 * m : arms_end],
        lines=e.lines + border[arms_end:].reshape(-1, 2),
    )


def _root(value: float) -> float:
    return float(np.sqrt(max(0.0, value)))


class _Schur:
    """The band is eliminated; what is left is the border's own system."""

    def __init__(self, system: System, damping: float) -> None:
        self.system = system
        band = system.band.copy()
        band[5] *= 1 + damping
        border = system.border.copy()
        border[np.diag_indices(len(border))] *= 1 + damping
        # directions that nothing measures (a sighting that lost all weight) keep where they are
        border[np.diag_indices(len(border))] += 1e-9
        self.factor = cholesky_banded(band) if band.shape[1] else None
        C = system.coupling
        for at in range(0, len(border), _CHUNK):
            part = slice(at, at + _CHUNK)
            if self.factor is not None:
                border[:, part] -= C.T @ cho_solve_banded((self.factor, False), C[:, part].toarray())
        self.border = cho_factor((border + border.T) / 2, lower=True)

    def step(self) -> tuple[Array, Array, float]:
        """Newton step of poses and border, and its length in standard deviations."""
        g, h, C = self.system.gradient_poses, self.system.gradient_border, self.system.coupling
        if self.factor is None:
            border = -cho_solve(self.border, h)
            return np.zeros(0), border, _root(-float(border @ h))
        border = -cho_solve(self.border, h - C.T @ cho_solve_banded((self.factor, False), g))
        poses = -cho_solve_banded((self.factor, False), g + C @ border)
        return poses, border, _root(-float(poses @ g + border @ h))

    def covariance(self) -> Array:
        """Covariance of the border's entries."""
        out = cho_solve(self.border, np.eye(len(self.system.border)))
        return np.asarray((out + out.T) / 2, dtype=float)

    def poses(self, which: Array, covariance: Array) -> tuple[Array, Array]:
        """Covariance (3k, 3k) of keyframes' poses, and theirs with the border (3k, size) of that ``covariance``.

        With B the band, C the coupling and S the border's covariance: poses given the border are off by
        -inv(B) C times what the border is off by, and by errors of covariance inv(B) of their own.
        """
        banded = self.system.band.shape[1]
        rows = (3 * np.asarray(which)[:, None] + np.arange(3)).ravel()
        inside = np.flatnonzero(rows < banded)
        own = np.zeros((len(rows), len(rows)))
        by_border = np.zeros((len(rows), len(covariance)))
        if self.factor is not None:
            unit = np.zeros((banded, len(inside)))
            unit[rows[inside], np.arange(len(inside))] = 1.0
            X = cho_solve_banded((self.factor, False), unit)
            own[np.ix_(inside, inside)] = X[rows[inside]]
            by_border[inside] = -(self.system.coupling.T @ X).T
        last = np.flatnonzero(rows >= banded)
        by_border[last, rows[last] - banded] = 1.0
        cross = by_border @ covariance
        C = own + cross @ by_border.T
        return (C + C.T) / 2, cross
