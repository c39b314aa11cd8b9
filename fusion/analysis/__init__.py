"""Covariance studied: how far linearised uncertainty can be believed, and whether it holds.

Three ways from the measurements' noise to that of an estimate (`propagate`), the same drives recorded again and again
(`rerecord`), and what the errors that are then seen say of the covariances that were stated (`consistency`, `trials`).
"""

from .consistency import Consistency, consistency, mean_band, share_band, squared_distances
from .perturbed import Perturbed
from .propagate import Spread, linearised, monte_carlo, sigma_points
from .rerecord import Drives
from .trials import Trial, Trials, run_trials

__all__ = [
    "Consistency",
    "Drives",
    "Perturbed",
    "Spread",
    "Trial",
    "Trials",
    "consistency",
    "linearised",
    "mean_band",
    "monte_carlo",
    "run_trials",
    "share_band",
    "sigma_points",
    "squared_distances",
]
