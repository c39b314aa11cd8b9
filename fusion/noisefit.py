"""Is the noise that a map states its true noise? Its residuals at the optimum say so: `noise_fits`.

Variance components (Helmert 1907; Foerstner 1979): if its sigmas are true, the squared whitened residuals of one map's
measurements add up to their redundancy, the number of measured values less what the solution fits of them; to s^2
times that, if all are s times larger. The redundancy of a measurement is the number of its independent readings less
the trace of ``J Sigma J'``, its whitened Jacobian around the covariance of the solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap
from mapfuse.factors import (
    FrameAnchor,
    HeadingPrior,
    JointMeasurement,
    LandmarkKey,
    LinkMeasurement,
    Measurement,
    RangeMeasurement,
)
from mapfuse.factors.axes import pose_rotations

from .result import NoiseFit
from .solve import Solution

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_OF_ONE_MAP = (LinkMeasurement, RangeMeasurement, FrameAnchor, HeadingPrior, JointMeasurement)


def noise_fits(solution: Solution, used: Sequence[float] | None = None) -> tuple[NoiseFit, ...]:
    """How each map of a solved problem fits its stated noise, in the order of the problem's maps.

    ``used``: by how much the maps' stated sigmas were multiplied before.

    Of distances, headings, positions and joint covariances; compass readings, of which steel makes any, are left out.
    """
    problem, held = solution.problem, solution.linearised
    assert held.residuals is not None
    measurements = problem.measurements
    of_row = np.repeat(np.arange(len(measurements)), [m.rows for m in measurements])
    # rows of zeros at the end of a graph leave no entry
    squares = np.bincount(of_row[: len(held.residuals)], held.residuals**2, minlength=len(measurements))
    of_one = [(k, _map_of(m), m.readings) for k, m in enumerate(measurements) if isinstance(m, _OF_ONE_MAP)]
    which, of_map = (np.array([one[column] for one in of_one], dtype=np.intp) for column in (0, 1))
    asked = np.zeros(len(measurements), dtype=bool)
    asked[which] = True
    inside = asked[of_row[held.rows]]
    fitted = _fitted(solution, of_row, held.rows[inside], held.columns[inside], held.values[inside])
    left = np.array([readings for _, _, readings in of_one]) - fitted[which]
    chi2, redundancy = (np.bincount(of_map, x, minlength=len(problem.maps)) for x in (squares[which], left))
    used = used or [1.0] * len(problem.maps)
    return tuple(NoiseFit(float(c), float(max(n, 0.0)), u) for c, n, u in zip(chi2, redundancy, used, strict=True))


def _map_of(measurement: Measurement) -> int:
    """The map that a measurement is of."""
    last = measurement.unknowns[-1]
    assert isinstance(last, LandmarkKey)
    return last.map


def _fitted(solution: Solution, of_row: Index, rows: Index, columns: Index, values: Array) -> Array:
    """Trace of ``J Sigma J'`` of each measurement (m,), from the entries of their whitened Jacobian.

    ``of_row``: the measurement of each row. Sigma is needed only between the unknowns that a measurement has.
    """
    n, which, unknown = len(solution.problem.measurements), of_row[rows], columns // 3
    first, last = np.full(n, len(solution.poses)), np.zeros(n, dtype=np.intp)
    np.minimum.at(first, which, unknown)
    np.maximum.at(last, which, unknown)
    first = np.minimum(first, last)  # of those that aren't asked any will do: their rows are zero
    is_last = unknown == last[which]
    wide = np.unique(which[~is_last & (unknown != first[which])])  # of more than two unknowns
    of_two = np.where(np.isin(which, wide), 0.0, values) if len(wide) else values
    J = np.zeros((len(of_row), 2, 3))
    J[rows, is_last.astype(np.intp), columns % 3] = of_two
    # body tangents to axes, once for each row
    rotations = pose_rotations(solution.linearised.thetas)
    J = np.einsum("rsb,rsab->rsa", J, rotations[np.column_stack([first, last])[of_row]])
    blocks = solution.marginals.blocks(np.concatenate([first, last, first]), np.concatenate([first, last, last]))
    S = blocks.reshape(3, n, 3, 3)[:, of_row]
    one, other = (J[:, ends].swapaxes(0, 1) for ends in ((0, 1, 0), (0, 1, 1)))
    traces = np.array([1.0, 1.0, 2.0]) @ np.einsum("kra,krab,krb->kr", one, S, other)
    fitted = np.asarray(np.bincount(of_row, traces, minlength=n), dtype=np.float64)
    for k in wide.tolist():
        own = which == k
        fitted[k] = _fitted_jointly(solution, rotations, rows[own], columns[own], values[own])
    return fitted


def _fitted_jointly(solution: Solution, rotations: Array, rows: Index, columns: Index, values: Array) -> float:
    """The same of one measurement of any number of unknowns."""
    row = np.unique(rows, return_inverse=True)[1]
    touched, of_unknown = np.unique(columns // 3, return_inverse=True)
    J = np.zeros((int(row.max()) + 1, len(touched), 3))
    J[row, of_unknown, columns % 3] = values
    J = np.einsum("rsb,sab->rsa", J, rotations[touched]).reshape(len(J), -1)
    S = solution.marginals.joint(touched)
    return float(np.einsum("ra,ra->", J @ S, J))


def scaled(recorded: LandmarkMap, scale: float) -> LandmarkMap:
    """The map with all its standard deviations of distances, headings and positions multiplied by ``scale``."""
    if scale == 1.0:
        return recorded
    names = ("distance_sigma_per_metre", "distance_sigma_floor", "heading_sigma", "position_sigma")
    noise = replace(recorded.noise, **{name: scale * getattr(recorded.noise, name) for name in names})
    joint = recorded.joint_covariance
    if joint is not None:
        keyframes = None if joint.keyframes is None else joint.keyframes.scaled(scale)
        joint = JointCovariance(joint.order, joint.rows, joint.matrix * scale**2, joint.extra, keyframes)
    landmarks: Sequence[Landmark] = [
        landmark if landmark.covariance is None else replace(landmark, covariance=landmark.covariance * scale**2)
        for landmark in recorded.landmarks
    ]
    return recorded.replace(noise=noise, joint_covariance=joint, landmarks=tuple(landmarks))
