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
from scipy.sparse import csr_array

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
    unknowns = problem.keys.in_order
    size = 3 * len(unknowns)
    ends = np.cumsum([graph.at(k).dim() for k in range(graph.size())])
    height = int(ends[-1])
    inside = columns < size
    J = csr_array((values[inside], (rows[inside], columns[inside])), shape=(height, size))
    squares = np.zeros(height)
    squares[rows[~inside]] = values[~inside] ** 2
    asked = np.repeat([isinstance(m, _OF_ONE_MAP) for m in problem.measurements], np.diff(ends, prepend=0))
    fitted = np.zeros(height)
    fitted[asked] = _fitted(J[asked], solution, np.array([solution.poses[u][2] for u in unknowns]))
    chi2, redundancy = np.zeros(len(problem.maps)), np.zeros(len(problem.maps))
    for measurement, end, count in zip(problem.measurements, ends, np.diff(ends, prepend=0), strict=True):
        if isinstance(measurement, _OF_ONE_MAP):
            r = _map_of(measurement)
            of_it = slice(end - count, end)
            chi2[r] += squares[of_it].sum()
            redundancy[r] += measurement.readings - fitted[of_it].sum()
    used = used or [1.0] * len(problem.maps)
    return tuple(NoiseFit(float(c), float(max(n, 0.0)), u) for c, n, u in zip(chi2, redundancy, used, strict=True))


def _map_of(measurement: Measurement) -> int:
    """The map that a measurement is of."""
    return next(unknown.map for unknown in measurement.unknowns if isinstance(unknown, LandmarkKey))


def _fitted(J: csr_array, solution: Solution, thetas: Array) -> Array:
    """Diagonal of ``J Sigma J'`` (rows,), Sigma being needed only between unknowns that a row has both."""
    unknowns = solution.problem.keys.in_order
    rotations = pose_rotations(thetas)
    out = np.zeros(J.shape[0])
    blocks = csr_array((np.ones(J.nnz), J.indices // 3, J.indptr.copy()), shape=(J.shape[0], len(unknowns)))
    blocks.sum_duplicates()
    which: dict[tuple[int, int], list[int]] = {}
    for row in range(J.shape[0]):
        touched = blocks.indices[blocks.indptr[row] : blocks.indptr[row + 1]].tolist()
        for a in touched:
            for b in touched:
                which.setdefault((a, b), []).append(row)
    pairs = list(which)
    if not pairs:
        return out
    covariances = solution.covariances([unknowns[a] for a, _ in pairs], [unknowns[b] for _, b in pairs])
    dense = J.toarray()
    for (a, b), S in zip(pairs, covariances, strict=True):
        rows = which[a, b]
        local = rotations[a].T @ S @ rotations[b]
        out[rows] += np.einsum("ra,ab,rb->r", dense[rows, 3 * a : 3 * a + 3], local, dense[rows, 3 * b : 3 * b + 3])
    return out


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
