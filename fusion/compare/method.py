"""What a method is: two recorded maps in, matches, T12 and merged landmarks out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from ..result import PairDecision


@dataclass(frozen=True, slots=True)
class MergedLandmark:
    """A landmark of a merged map [m, frame of map 1], with the ids that it has in both maps.

    ``kept`` False: the method takes it for a false alarm.
    """

    x: float
    y: float
    ids1: tuple[str, ...]
    ids2: tuple[str, ...]
    kept: bool = True


@dataclass(frozen=True, slots=True)
class Merge:
    """What a method says of two maps.

    ``T12``, ``correspondences``: of its best placement of map 2 in map 1 (``p1 = T12 p2``), whatever it decides; T12
    with a covariance where the method has one. ``landmarks``: the merged map, empty where nothing was merged.
    ``probability``: that the best placement is right; ``chi2``, ``dof``: squared whitened residuals and how many are
    expected. Both None of methods that know no noise.
    """

    decision: PairDecision
    T12: Transform | None
    correspondences: tuple[tuple[str, str], ...] = ()
    landmarks: tuple[MergedLandmark, ...] = ()
    probability: float | None = None
    chi2: float | None = None
    dof: float | None = None


@dataclass(frozen=True, slots=True)
class Method:
    """A method by name. ``missing``: why it can't run here, or an empty string.

    ``run`` raises `MapfuseError` for a pair that the method can't do.
    """

    name: str
    title: str
    run: Callable[[LandmarkMap, LandmarkMap], Merge]
    missing: str = ""
