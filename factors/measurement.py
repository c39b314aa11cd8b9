"""What all measurements have in common: unknowns, a residual in numpy, and a GTSAM factor of the same error.

`Between` says where one pose lies seen from another, `Prior` where one lies in the merged frame; the kinds of
measurement derive from them and differ in where their numbers come from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError

from .keys import KeyBook, Unknown
from .noise import Loss, PoseNoise, pose_model

Array = NDArray[np.float64]
Poses = Mapping[Unknown, Array]
Triple = tuple[float, float, float]


class Measurement(Protocol):
    """One error term. ``poses`` gives each unknown's (3,) pose in the merged frame [m, m, rad]."""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """What it measures, in the order of the factor's keys."""
        ...

    @property
    def rows(self) -> int:
        """How many numbers its residual has."""
        ...

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor, over the measured rows [nats]."""
        ...

    def residual(self, poses: Poses) -> Array:
        """The whitened residual, of unit covariance at the truth."""
        ...

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2``, or the robust loss in its place [nats]; equal to GTSAM's error."""
        ...

    def factor(self, keys: KeyBook) -> Any:
        """The GTSAM factor of this measurement."""
        ...


def checked_pose(pose: Triple, of: object, *unknowns: Unknown) -> Triple:
    """A pose of finite numbers as plain floats; raises `MapfuseError` otherwise (GTSAM takes NaN in silence)."""
    x, y, theta = pose
    x, y, theta = float(x), float(y), float(theta)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(theta)):
        what = f"{type(of).__name__} of {' and '.join(map(str, unknowns))}"
        raise MapfuseError(f"{what} has a measured pose that is not finite: {(x, y, theta)}")
    return x, y, theta


@dataclass(frozen=True, slots=True)
class Between:
    """Pose ``b`` seen from pose ``a`` is ``measured`` (x, y [m], theta [rad]).

    The error is ``log(measured^-1 a^-1 b)``: in the axes of the measured pose, with the full logarithm as in
    GTSAM 4.3. ``loss``: robust where given.
    """

    a: Unknown
    b: Unknown
    measured: Triple
    noise: PoseNoise
    loss: Loss | None = None

    rows: ClassVar[int] = 3

    def __post_init__(self) -> None:
        object.__setattr__(self, "measured", checked_pose(self.measured, self, self.a, self.b))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """``a`` and ``b``."""
        return self.a, self.b

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor, over the measured rows [nats]."""
        return self.noise.log_normaliser

    def residual(self, poses: Poses) -> Array:
        """The whitened residual (3,)."""
        seen = se2.between(poses[self.a], poses[self.b])
        return self.noise.whiten(se2.log(se2.between(np.asarray(self.measured), seen)))

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2``, or the robust loss in its place [nats]."""
        return squared_error(self.residual(poses), self.loss)

    def factor(self, keys: KeyBook) -> Any:
        """A ``BetweenFactorPose2``."""
        model = pose_model(self.noise, self.loss)
        return gtsam.BetweenFactorPose2(keys.key(self.a), keys.key(self.b), gtsam.Pose2(*self.measured), model)


@dataclass(frozen=True, slots=True)
class Prior:
    """Pose ``of`` in the merged frame is ``measured`` (x, y [m], theta [rad]); error ``log(measured^-1 of)``."""

    of: Unknown
    measured: Triple
    noise: PoseNoise

    rows: ClassVar[int] = 3

    def __post_init__(self) -> None:
        object.__setattr__(self, "measured", checked_pose(self.measured, self, self.of))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """``of`` alone."""
        return (self.of,)

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor, over the measured rows [nats]."""
        return self.noise.log_normaliser

    def residual(self, poses: Poses) -> Array:
        """The whitened residual (3,)."""
        return self.noise.whiten(se2.log(se2.between(np.asarray(self.measured), poses[self.of])))

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2`` [nats]."""
        return squared_error(self.residual(poses), None)

    def factor(self, keys: KeyBook) -> Any:
        """A ``PriorFactorPose2``."""
        return gtsam.PriorFactorPose2(keys.key(self.of), gtsam.Pose2(*self.measured), pose_model(self.noise))


def squared_error(residual: Array, loss: Loss | None) -> float:
    """``|r|^2 / 2``, or what a robust loss makes of it [nats]."""
    squared = float(residual @ residual)
    return squared / 2 if loss is None else loss.rho(float(np.sqrt(squared)))
