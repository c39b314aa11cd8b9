"""Three ways from the noise of the readings to the uncertainty of an estimate: `linearised`, `sigma_points`,
`monte_carlo`.

The first takes the solve for linear, as reported covariances do. The second sends chosen noise through the whole solve
and weighs what comes out: right to third order of the mean and to second of the covariance (Julier and Uhlmann,
*Unscented Filtering and Nonlinear Estimation* (2004); points after van der Merwe, as filterpy has them). The third
draws the noise, and is exact but for the number of draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from numpy.typing import NDArray

from mapfuse.datasets.errors import ConfigError
from mapfuse.factors import Unknown

from ..solve import Solution
from .perturbed import Perturbed

Array = NDArray[np.float64]

#: Sigma points stand so many standard deviations out: for a Gaussian the fourth moments along each axis are then right.
REACH = float(np.sqrt(3.0))


@dataclass(frozen=True, eq=False, slots=True)
class Spread:
    """How k unknowns of a solution err, over (x, y, theta) each, axes of the merged frame.

    ``mean`` (3k,): the mean error, which is 0 where all is linear; ``covariance`` (3k, 3k) about that mean.
    ``solves``: how many graphs were solved for it. ``errors`` (n, 3k): what was drawn, None where nothing was.
    """

    mean: Array
    covariance: Array
    solves: int
    errors: Array | None = None

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3k,)."""
        return np.sqrt(np.diag(self.covariance))


def linearised(solution: Solution, of: Sequence[Unknown]) -> Spread:
    """By the inverse of the information at the optimum: what results report."""
    covariance = solution.joint_covariance(list(of))
    return Spread(np.zeros(len(covariance)), covariance, 1)


def sigma_points(solution: Solution, of: Sequence[Unknown]) -> Spread:
    """By the unscented transform of the noise of all readings, through one solve for each of its 2 n + 1 points.

    >>> from mapfuse.datasets import read_map, recordings
    >>> from mapfuse.factors import LandmarkKey, single_map_problem
    >>> from mapfuse.fusion.config import SolvingConfig
    >>> from mapfuse.fusion.solve import solve
    >>> recorded = read_map(recordings.path("ground-floor-milka"))
    >>> solution = solve(single_map_problem(recorded), SolvingConfig())
    >>> unknowns = [LandmarkKey(0, recorded.ids[0])]
    >>> spread, linear = sigma_points(solution, unknowns), linearised(solution, unknowns)
    >>> bool(np.allclose(spread.sigmas, linear.sigmas, rtol=0.02))
    True
    """
    perturbed = Perturbed(solution, of)
    n = perturbed.rows
    points = MerweScaledSigmaPoints(n, alpha=REACH / np.sqrt(n), beta=2.0, kappa=0.0)
    noise = points.sigma_points(np.zeros(n), np.eye(n))
    moved = np.array([perturbed.moved(e).reshape(-1) for e in noise])
    mean, covariance = unscented_transform(moved, points.Wm, points.Wc)
    return Spread(np.asarray(mean), np.asarray(covariance), len(noise))


def monte_carlo(solution: Solution, of: Sequence[Unknown], draws: int, rng: np.random.Generator) -> Spread:
    """By ``draws`` of the noise of all readings; a standard deviation is then known to one part in sqrt(2 draws).

    Raises ConfigError for fewer than two draws.
    """
    if draws < 2:
        raise ConfigError(f"a spread needs two draws or more, not {draws}")
    perturbed = Perturbed(solution, of)
    errors = np.array([perturbed.moved(rng.normal(size=perturbed.rows)).reshape(-1) for _ in range(draws)])
    return Spread(errors.mean(axis=0), np.cov(errors.T), draws, errors)
