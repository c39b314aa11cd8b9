"""`Transform`: a rigid motion between two frames with its covariance, as it stands in files and results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import se2
from .values import frozen_array, rebuilt, same_fields

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Transform:
    """``T12``: coordinates of map 2 into map 1; x, y [m], theta [rad] in (-pi, pi].

    ``covariance`` is 3x3 over (x, y, theta) in the axes of frame 1, or None where it was not estimated.

    >>> Transform(1.0, 2.0, 0.0).apply([[1.0, 1.0]]).tolist()
    [[2.0, 3.0]]
    """

    x: float
    y: float
    theta: float
    covariance: Array | None = None

    def __post_init__(self) -> None:
        if not -np.pi < self.theta <= np.pi:  # most are in range, and arrays are slow for one number
            object.__setattr__(self, "theta", float(se2.wrap(self.theta)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", frozen_array(self.covariance))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.x, self.y, self.theta))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    @classmethod
    def from_array(cls, pose: ArrayLike, covariance: ArrayLike | None = None) -> Transform:
        """From a pose array (3,) and, if known, its covariance (3, 3)."""
        x, y, theta = np.asarray(pose, dtype=float).tolist()
        return cls(x, y, theta, None if covariance is None else np.asarray(covariance, dtype=float))

    @property
    def array(self) -> Array:
        """(x, y, theta) as an array (3,)."""
        return np.array([self.x, self.y, self.theta])

    def apply(self, points: ArrayLike) -> Array:
        """Points ``(..., 2)`` of frame 2 in frame 1."""
        return se2.transform(self.array, points)

    def inverse(self) -> Transform:
        """``T21`` with its covariance."""
        covariance = None if self.covariance is None else se2.inverse_covariance(self.array, self.covariance)
        return Transform.from_array(se2.inverse(self.array), covariance)
