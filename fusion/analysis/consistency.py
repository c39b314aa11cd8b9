"""Do covariances hold? NEES with chi-square bands, and how often ellipses hold what they say.

The normalised estimation error squared, ``e' C^-1 e`` of an error e and the covariance C that was stated for it, is
chi-square distributed with as many degrees of freedom as e has, where C is right (Bar-Shalom, Li and Kirubarajan,
*Estimation with Applications to Tracking and Navigation* (2001), section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv, chdtri

from mapfuse.datasets.errors import MapfuseError

Array = NDArray[np.float64]


def squared_distances(errors: ArrayLike, covariances: ArrayLike) -> Array:
    """NEES (n,) of errors (n, d), each with its covariance (n, d, d), or all with one (d, d).

    >>> squared_distances([[1.0, 0.0], [0.0, 2.0]], [[1.0, 0.0], [0.0, 4.0]]).tolist()
    [1.0, 1.0]
    """
    e, C = np.asarray(errors, dtype=float), np.asarray(covariances, dtype=float)
    weighed = np.linalg.solve(np.broadcast_to(C, (*e.shape, e.shape[1])), e[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", e, weighed))


def mean_band(dof: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Bounds between which the mean of ``count`` independent NEES lies with this probability.

    >>> [round(bound, 2) for bound in mean_band(3, 50)]
    [2.36, 3.72]
    """
    tail = (1 - probability) / 2
    low, high = (float(chdtri(dof * count, beyond)) / count for beyond in (1 - tail, tail))
    return low, high


def share_band(held: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Bounds of the true share, ``held`` of ``count`` independent trials having held (Clopper and Pearson 1934).

    >>> [round(bound, 3) for bound in share_band(95, 100)]
    [0.887, 0.984]
    """
    tail = (1 - probability) / 2
    low = float(betaincinv(held, count - held + 1, tail)) if held else 0.0
    high = float(betaincinv(held + 1, count - held, 1 - tail)) if held < count else 1.0
    return low, high


@dataclass(frozen=True, eq=False, slots=True)
class Consistency:
    """The NEES ``nees`` (n,) of n independent estimates of ``dof`` numbers each.

    ``mean`` should lie in ``band`` (95 %), ``held``, the share of 95 % ellipsoids that hold the truth, near 0.95, and
    ``held_band`` are the 95 % bounds of what that share is of.
    """

    nees: Array
    dof: int

    @property
    def mean(self) -> float:
        """Mean NEES; ``dof`` where the covariances are right."""
        return float(self.nees.mean())

    @property
    def band(self) -> tuple[float, float]:
        """Where ``mean`` lies with 95 %, the covariances being right."""
        return mean_band(self.dof, len(self.nees))

    @property
    def scale(self) -> float:
        """By how much the stated standard deviations are too small, as a factor, by the mean NEES."""
        return float(np.sqrt(self.mean / self.dof))

    @property
    def held(self) -> float:
        """Share of 95 % ellipsoids that hold the truth."""
        return float(np.mean(self.nees < chdtri(self.dof, 0.05)))

    @property
    def held_band(self) -> tuple[float, float]:
        """95 % bounds of the share that ``held`` estimates."""
        return share_band(int(np.sum(self.nees < chdtri(self.dof, 0.05))), len(self.nees))


def consistency(errors: ArrayLike, covariances: ArrayLike) -> Consistency:
    """Of independent errors (n, d) with their covariances (n, d, d) or (d, d).

    Raises `MapfuseError` where there are none.

    >>> rng = np.random.default_rng(1)
    >>> stated = np.diag([1.0, 4.0, 0.01])
    >>> drawn = rng.normal(size=(400, 3)) * np.sqrt(np.diag(stated))
    >>> right, half = consistency(drawn, stated), consistency(drawn, stated / 4)
    >>> right.band[0] < right.mean < right.band[1], round(half.scale / right.scale, 6)
    (True, 2.0)
    """
    e = np.asarray(errors, dtype=float)
    if e.ndim != 2 or not len(e):
        raise MapfuseError("there are no errors to judge covariances by")
    return Consistency(squared_distances(e, covariances), e.shape[1])
