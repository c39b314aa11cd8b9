"""`Steel`: how far the iron in a building bends compasses, by place, alike for every robot that passes there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ConfigError
from ..values import frozen_array

Array = NDArray[np.float64]
Correlation = Literal["gaussian", "exponential"]

#: Waves that a field is the sum of: its kurtosis then differs from a normal field's by 1.5 / `WAVES`.
WAVES = 256


@dataclass(frozen=True, eq=False, slots=True)
class Steel:
    """A random field over the plane, the sum of plane waves ``amplitude cos(k . x + phase)``.

    ``wave_vectors`` (m, 2) [rad/m], ``phases`` (m,) [rad], ``amplitude`` [rad]. Over draws its mean is 0 everywhere,
    its standard deviation is sigma and its correlation that asked for in `draw_steel`, by Bochner's theorem (random
    Fourier features: Rahimi and Recht, 2007).
    """

    wave_vectors: Array
    phases: Array
    amplitude: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "wave_vectors", frozen_array(self.wave_vectors))
        object.__setattr__(self, "phases", frozen_array(self.phases))

    def bend(self, points: ArrayLike) -> Array:
        """By how much [rad] a compass reading is off at ``points`` (..., 2) [m, world], as (...)."""
        angles = np.asarray(points, dtype=float) @ self.wave_vectors.T + self.phases
        return np.asarray(self.amplitude * np.cos(angles).sum(axis=-1), dtype=float)


def draw_steel(
    rng: np.random.Generator, sigma: float = 0.15, length: float = 4.0, correlation: Correlation = "gaussian"
) -> Steel:
    """A field with standard deviation ``sigma`` [rad] whose values are alike over ``length`` [m].

    Correlation at distance d: ``exp(-d^2 / (2 length^2))`` (gaussian: smooth), or ``exp(-d / length)`` (exponential:
    rough, as a first-order Gauss-Markov process along a straight way).

    Raises `ConfigError` for a negative sigma, a length that isn't positive, or a correlation that there isn't.

    >>> steel = draw_steel(np.random.default_rng(0))
    >>> steel.bend(np.zeros((5, 3, 2))).shape
    (5, 3)
    """
    if not (sigma >= 0 and np.isfinite(sigma)):
        raise ConfigError(f"sigma of steel must be a finite number of at least 0, not {sigma}")
    if not (length > 0 and np.isfinite(length)):
        raise ConfigError(f"length of steel must be a finite number above 0, not {length}")
    waves = rng.normal(size=(WAVES, 2)) / length
    if correlation == "exponential":
        # a normal vector over the root of an independent chi-square of 1 degree is Cauchy: its transform is exp(-|d|)
        waves /= np.abs(rng.normal(size=(WAVES, 1)))
    elif correlation != "gaussian":
        raise ConfigError(f"correlation of steel must be gaussian or exponential, not {correlation!r}")
    return Steel(waves, rng.uniform(0, 2 * np.pi, WAVES), sigma * float(np.sqrt(2 / WAVES)))
