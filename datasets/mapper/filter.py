"""`JointFilter`: an extended Kalman filter over a state that grows, on filterpy's.

Robot, systematic errors and landmarks are one state with one covariance (EKF-SLAM). filterpy's
`ExtendedKalmanFilter` holds x, P, S, K, the residual and its likelihood; its ``predict`` and ``update`` multiply
matrices of the size of the state, n^3 operations for measurements that concern a handful of numbers of it. They are
overridden by the same equations on the rows that take part, n and n^2 operations. A test compares both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class JointFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """State ``x`` (n,) and covariance ``P`` (n, n); rows come and go."""

    def __init__(self, x: Array, P: Array) -> None:
        # filterpy's constructor makes a dozen matrices of the state's size that these equations don't use
        super().__init__(dim_x=1, dim_z=1)
        self.x: Array = np.array(x, dtype=float)
        self.P: Array = np.array(P, dtype=float)
        self.dim_x = len(self.x)

    def predict_rows(self, rows: Indices, values: Array, F: Array, columns: Indices, Q: Array) -> None:
        """Rows become ``values``, whose derivatives by the entries ``columns`` are ``F``, with noise ``Q`` added.

        filterpy's ``predict`` with a transition that is the identity but for these rows.
        """
        P = self.P
        crossed = F @ P[columns]
        own = crossed[:, columns] @ F.T + Q
        P[rows] = crossed
        P[:, rows] = crossed.T
        P[np.ix_(rows, rows)] = (own + own.T) / 2
        self.x[rows] = values

    def innovation(self, columns: Indices, H: Array, R: Array) -> Array:
        """Covariance S of a residual with derivatives ``H`` by the entries ``columns`` and noise ``R``."""
        out: Array = H @ self.P[np.ix_(columns, columns)] @ H.T + R
        return out

    def update_rows(self, columns: Indices, H: Array, residual: Array, R: Array) -> None:
        """Correct all of the state by a residual that depends on the entries ``columns`` by ``H``.

        filterpy's ``update`` where all other columns of the Jacobian are zero.
        """
        PHt = self.P[:, columns] @ H.T
        self.y = residual
        self.S = H @ PHt[columns] + R
        L = np.linalg.cholesky((self.S + self.S.T) / 2)
        half = np.linalg.solve(L, PHt.T)  # P - K S K' = P - half' half, symmetric to the last bit
        self.x += half.T @ np.linalg.solve(L, residual)
        self.P -= half.T @ half

    def augment(self, values: Array, F: Array, columns: Indices, Q: Array) -> int:
        """New entries at the end, with derivatives ``F`` by the entries ``columns`` and noise ``Q``.

        Returns the row of the first one.
        """
        n, k = len(self.x), len(values)
        crossed = F @ self.P[columns]
        P = np.empty((n + k, n + k))
        P[:n, :n] = self.P
        P[n:, :n] = crossed
        P[:n, n:] = crossed.T
        own = crossed[:, columns] @ F.T + Q
        P[n:, n:] = (own + own.T) / 2
        self.x, self.P = np.concatenate([self.x, values]), P
        self.dim_x = n + k
        return n

    def remove(self, rows: Indices) -> None:
        """Entries leave the state (they are marginalised)."""
        keep = np.setdiff1d(np.arange(len(self.x)), rows)
        self.x, self.P = self.x[keep], np.ascontiguousarray(self.P[np.ix_(keep, keep)])
        self.dim_x = len(keep)

    def copy(self) -> JointFilter:
        """An independent filter with the same state."""
        return JointFilter(self.x, self.P)

    def state(self) -> dict[str, Any]:
        """What there is to save."""
        return {"x": self.x.tolist(), "P": self.P.tolist()}
