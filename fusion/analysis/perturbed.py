"""`Perturbed`: an estimate as a function of its measurements' noise, through the whole nonlinear solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.factors import (
    Between,
    Gauge,
    JointMeasurement,
    Measurement,
    NorthOffset,
    NorthPrior,
    PoseNoise,
    Prior,
    Problem,
    RangeMeasurement,
    RotationPin,
    TransformPrior,
    Unknown,
)
from mapfuse.factors.measurement import Poses
from mapfuse.factors.noise import LOOSE_ROTATION
from mapfuse.factors.turning import recorded_for

from ..solve import Solution, optimum

Array = NDArray[np.float64]

#: What holds a frame or a meaningless rotation and is no reading of anything.
_HELD = (Gauge, TransformPrior, RotationPin, NorthPrior)


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The unknowns ``of`` of a solved problem as a function of e, the whitened noise (rows,) of all its readings.

    The solution is taken for the truth, and every reading for what it would be there, plus its noise: e = 0 gives the
    solution back, and e drawn from N(0, 1) is what the measurement model says of a recording of the same landmarks.
    Priors that keep the solver from floating have no noise. Which landmarks match is given, and no gate is applied.
    Compass readings that a joint covariance knows already count as one together, each with a sigma of that many times
    its own (row 9 of the measurement model): a direction with noise of radians is no more than roughly what is meant.

    >>> from mapfuse.datasets import read_map, recordings
    >>> from mapfuse.factors import LandmarkKey, single_map_problem
    >>> from mapfuse.fusion.config import SolvingConfig
    >>> from mapfuse.fusion.solve import solve
    >>> recorded = read_map(recordings.path("ground-floor-milka"))
    >>> solution = solve(single_map_problem(recorded), SolvingConfig())
    >>> landmark = Perturbed(solution, [LandmarkKey(0, recorded.ids[0])])
    >>> bool(np.abs(landmark.moved(np.zeros(landmark.rows))).max() < 1e-6)
    True
    """

    solution: Solution
    of: Sequence[Unknown]

    @property
    def rows(self) -> int:
        """How many independent numbers the noise has."""
        return sum(len(rows) for _, rows in self._readings)

    @cached_property
    def _readings(self) -> tuple[tuple[Measurement, NDArray[np.intp]], ...]:
        """Every measurement, and which rows of its residual are noise."""
        return tuple((m, _noisy_rows(m)) for m in self.solution.problem.measurements)

    @cached_property
    def _seen(self) -> tuple[Array, Array]:
        """Each measured pose as seen at the solution (m, 3), and from its noise to its error (m, 3, 3)."""
        poses, of_poses = self.solution.poses, [m for m, _ in self._readings if isinstance(m, Between | Prior)]
        seen = [se2.between(poses[m.a], poses[m.b]) if isinstance(m, Between) else poses[m.of] for m in of_poses]
        return np.array(seen).reshape(-1, 3), np.array([_colouring(m.noise) for m in of_poses]).reshape(-1, 3, 3)

    @cached_property
    def _silent(self) -> tuple[Measurement, ...]:
        """All readings without noise; sigma points change one at a time, and making hundreds anew takes long."""
        seen, poses = iter(self._seen[0].tolist()), self.solution.poses
        return tuple(
            replace(m, measured=tuple(next(seen)))
            if isinstance(m, Between | Prior)
            else _read_at(m, poses, np.zeros(_height(m)))
            for m, _ in self._readings
        )

    def problem(self, e: Array) -> Problem:
        """The problem with readings taken at the solution, their whitened noise being ``e`` (rows,)."""
        noise, at = [], 0
        for measurement, rows in self._readings:
            noise.append(np.zeros(_height(measurement)))
            noise[-1][rows] = e[at : at + len(rows)]
            at += len(rows)
        seen, colouring = self._seen
        of_poses = [own for (m, _), own in zip(self._readings, noise, strict=True) if isinstance(m, Between | Prior)]
        off = se2.exp(np.einsum("kij,kj->ki", colouring, np.array(of_poses).reshape(-1, 3)))
        read = iter(se2.compose(seen, off).tolist())
        measurements: list[Measurement] = []
        for (measurement, _), own, silent in zip(self._readings, noise, self._silent, strict=True):
            measured = next(read) if isinstance(measurement, Between | Prior) else []
            if not own.any():
                measurements.append(silent)
            elif isinstance(measurement, Between | Prior):
                measurements.append(replace(measurement, measured=tuple(measured)))
            else:
                measurements.append(_read_at(measurement, self.solution.poses, own))
        return self.solution.problem.starting_at(self.solution.poses).with_measurements(measurements)

    def moved(self, e: Array) -> Array:
        """How far the noise ``e`` (rows,) moves the unknowns (k, 3) from the solution, theta in (-pi, pi]."""
        poses = optimum(self.problem(np.asarray(e, dtype=float))).poses
        off = np.array([poses[unknown] - self.solution.poses[unknown] for unknown in self.of]).reshape(-1, 3)
        off[:, 2] = se2.wrap(off[:, 2])
        return off


def _height(measurement: Measurement) -> int:
    """Rows of its residual."""
    if isinstance(measurement, JointMeasurement):
        return len(measurement.places)
    return 1 if isinstance(measurement, RangeMeasurement) else 3


def _noisy_rows(measurement: Measurement) -> NDArray[np.intp]:
    if isinstance(measurement, _HELD):
        return np.zeros(0, dtype=np.intp)
    if isinstance(measurement, Between | Prior):
        n = measurement.noise
        placed = not isinstance(measurement, NorthOffset)  # directions have no position
        # a rotation that is free says nothing, though the factor holds it loosely
        return np.flatnonzero([placed and n.xx > 0, placed and n.yy > 0, n.tt > 1.001 / LOOSE_ROTATION])
    return np.arange(_height(measurement))


def _colouring(noise: PoseNoise) -> Array:
    """``R^-1`` (3, 3) of the rows that are measured, 0 for the others."""
    R = np.array([[noise.xx, noise.xy, noise.xt], [0.0, noise.yy, noise.yt], [0.0, 0.0, noise.tt]])
    kept = np.flatnonzero(np.diag(R) > 0)
    out = np.zeros((3, 3))
    out[np.ix_(kept, kept)] = np.linalg.inv(R[np.ix_(kept, kept)])
    return out


def _read_at(measurement: Measurement, poses: Poses, e: Array) -> Measurement:
    """The reading that has the whitened residual ``-e`` at these poses."""
    if isinstance(measurement, RangeMeasurement):
        length = float(np.linalg.norm(poses[measurement.b][:2] - poses[measurement.a][:2]))
        return replace(measurement, distance=max(0.0, length + measurement.sigma * float(e[0])))
    if isinstance(measurement, JointMeasurement):
        seen = np.asarray(
            se2.between(poses[measurement.frame], np.array([poses[key] for key in measurement.landmarks]))
        )
        off = np.zeros(seen.size)
        off[list(measurement.places)] = -np.linalg.solve(measurement.sqrt_information, e)
        return replace(measurement, recorded=recorded_for(seen, measurement.pivot, off.reshape(seen.shape)))
    raise TypeError(f"no noise is known of {type(measurement).__name__}")
