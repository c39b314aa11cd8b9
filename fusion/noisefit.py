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
    problem = solution.problem
    graph = problem.graph()
    linear = graph.linearize(problem.values(solution.poses))
    rows, columns, values = np.asarray(linear.sparseJacobian_())
    rows, columns = rows.astype(np.intp) - 1, columns.astype(np.intp) - 1
    heights = [graph.at(k).dim() for k in range(graph.size())]
    asked = [isinstance(m, _OF_ONE_MAP) for m in problem.measurements]
    size = 3 * len(problem.keys.in_order)
    residual = columns == size
    squares = np.zeros(len(heights))
    of_row = np.repeat(np.arange(len(heights)), heights)
    np.add.at(squares, of_row[rows[residual]], values[residual] ** 2)
    inside = ~residual & np.array(asked, dtype=bool)[of_row[rows]]
    fitted = _fitted(solution, of_row, rows[inside], columns[inside], values[inside])
    chi2, redundancy = np.zeros(len(problem.maps)), np.zeros(len(problem.maps))
    terms = zip(problem.measurements, squares.tolist(), fitted.tolist(), strict=True)
    for measurement, square, fit in terms:
        if isinstance(measurement, _OF_ONE_MAP):
            r = _map_of(measurement)
            chi2[r] += square
            redundancy[r] += measurement.readings - fit
    used = used or [1.0] * len(problem.maps)
    return tuple(NoiseFit(float(c), float(max(n, 0.0)), u) for c, n, u in zip(chi2, redundancy, used, strict=True))


def _map_of(measurement: Measurement) -> int:
    """The map that a measurement is of."""
    return next(unknown.map for unknown in measurement.unknowns if isinstance(unknown, LandmarkKey))


def _fitted(solution: Solution, of_row: Index, rows: Index, columns: Index, values: Array) -> Array:
    """Trace of ``J Sigma J'`` of each measurement (m,), from the entries of their whitened Jacobian.

    ``of_row``: the measurement of each row. Sigma is needed only between the unknowns that a measurement has.
    """
    measurements, unknowns = solution.problem.measurements, solution.problem.keys.in_order
    place = {unknown: k for k, unknown in enumerate(unknowns)}
    rotations = pose_rotations(np.array([solution.poses[unknown][2] for unknown in unknowns]))
    out = np.zeros(len(measurements))
    asked = np.unique(of_row[rows])
    two = np.array([k for k in asked if len(measurements[k].unknowns) == 2], dtype=np.intp)
    ends = np.zeros((len(measurements), 2), dtype=np.intp)
    ends[two] = np.array([[place[u] for u in measurements[k].unknowns] for k in two]).reshape(-1, 2)
    on = np.isin(of_row[rows], two)
    row, column, which = rows[on], columns[on], of_row[rows[on]]
    J = np.zeros((len(of_row), 2, 3))
    J[row, (column // 3 == ends[which, 1]).astype(np.intp), column % 3] = values[on]
    # body tangents to axes, once for each row
    J = np.einsum("rsb,rsab->rsa", J, rotations[ends[of_row]])
    for one, other, times in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, 2.0)):
        S = np.zeros((len(measurements), 3, 3))
        if len(two):
            S[two] = solution.covariances(*([unknowns[k] for k in ends[two, end]] for end in (one, other)))
        of_rows = np.einsum("ra,rab,rb->r", J[:, one], S[of_row], J[:, other])
        out += times * np.bincount(of_row, of_rows, minlength=len(out))
    for k in set(asked.tolist()) - set(two.tolist()):
        out[k] = _fitted_jointly(solution, rotations, *(part[of_row[rows] == k] for part in (rows, columns, values)))
    return out


def _fitted_jointly(solution: Solution, rotations: Array, rows: Index, columns: Index, values: Array) -> float:
    """The same of one measurement of any number of unknowns."""
    row = np.unique(rows, return_inverse=True)[1]
    touched, of_unknown = np.unique(columns // 3, return_inverse=True)
    J = np.zeros((int(row.max()) + 1, len(touched), 3))
    J[row, of_unknown, columns % 3] = values
    J = np.einsum("rsb,sab->rsa", J, rotations[touched]).reshape(len(J), -1)
    S = solution.joint_covariance([solution.problem.keys.in_order[k] for k in touched])
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
