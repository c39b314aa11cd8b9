"""What a fusion answers: `FusedMap` and its parts, frozen; the names are those of ``mapfuse.fused/1``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri, expit, gammaln

from mapfuse.datasets.maps import JointCovariance, LandmarkMap, Link
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.values import frozen_array, rebuilt, same_fields

if TYPE_CHECKING:
    from .mixture import LandmarkMixture

Array = NDArray[np.float64]
PairDecision = Literal["merged", "ambiguous", "no_overlap"]
Decision = Literal["merged", "partial", "ambiguous", "no_overlap"]

#: A scale is believed to differ from 1 where that leaves the residuals this improbable.
IMPROBABLE = 1e-3
#: Before looking: probability that a map's noise is as stated, and otherwise the scales, all orders of magnitude alike,
#: within this factor of 1, up and down.
AS_STATED, MOST_SCALE = 0.5, 10.0
#: Less redundancy than this says nothing.
LEAST_REDUNDANCY = 1.0


@dataclass(frozen=True, slots=True)
class RankedHypothesis:
    """One possible T12 of a pair: matched landmarks, log evidence ratio against no overlap [nats], probability.

    Known of the placements that are worth telling, else empty: ``correspondences``, the matched landmarks' ids in both
    maps; ``missed``: map name -> ids of landmarks that the other robot passed without recording them; ``evidence``:
    name -> nats, the parts of ``log_evidence`` (`mapfuse.fusion.evidence.Terms`).
    """

    T12: Transform
    count: int
    log_evidence: float
    probability: float
    correspondences: tuple[tuple[str, str], ...] = field(default=(), kw_only=True)
    missed: Mapping[str, tuple[str, ...]] = field(default_factory=dict, hash=False, kw_only=True)
    evidence: Mapping[str, float] = field(default_factory=dict, hash=False, kw_only=True)
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)


@dataclass(frozen=True, eq=False, slots=True)
class PairResult:
    """What is known of two maps' relation: the decision, all hypotheses best first, and why.

    ``probability`` is that of the first hypothesis; with ``no_overlap_probability`` and the other hypotheses' it sums
    to 1. ``T12`` is None where there is no hypothesis; ``mixture_covariance`` (3, 3) includes the spread between modes.
    """

    maps: tuple[str, str]
    decision: PairDecision
    probability: float
    no_overlap_probability: float
    hypotheses: tuple[RankedHypothesis, ...]
    correspondences: tuple[tuple[str, str], ...]
    reason: str
    mixture_covariance: Array | None = None
    overruled_by: tuple[str, ...] | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.mixture_covariance is not None:
            object.__setattr__(self, "mixture_covariance", frozen_array(self.mixture_covariance))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.maps, self.decision, self.probability))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def _repr_html_(self) -> str:
        from .report.notebook import pair_html

        return pair_html(self)

    @property
    def T12(self) -> Transform | None:
        """The first hypothesis' transformation."""
        return self.hypotheses[0].T12 if self.hypotheses else None


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """How the measurements of one map fit the noise that it states.

    ``chi2``: sum of their squared whitened residuals; ``redundancy``: what that sum is expected to be. ``used``: by how
    much the stated sigmas were multiplied before (1: not at all).

    >>> NoiseFit(chi2=120.0, redundancy=30.0).scale
    2.0
    """

    chi2: float
    redundancy: float
    used: float = 1.0

    @property
    def scale(self) -> float:
        """By how much the stated sigmas are too small, as a factor; 1 where nothing can be said."""
        if self.redundancy < LEAST_REDUNDANCY:
            return self.used
        return self.used * float(np.sqrt(self.chi2 / self.redundancy))

    @property
    def interval(self) -> tuple[float, float]:
        """Bounds between which the scale lies with 95 %."""
        if self.redundancy < LEAST_REDUNDANCY:
            return 0.0, float("inf")
        low, high = (float(chdtri(self.redundancy, beyond)) for beyond in (0.025, 0.975))
        return self.used * float(np.sqrt(self.chi2 / low)), self.used * float(np.sqrt(self.chi2 / high))

    @property
    def estimate(self) -> float:
        """The scale to use: the root of the variance to be expected, that of the noise as stated or of any other scale.

        With n redundant readings and c the sum of their squares a scale s has the likelihood ``s^-n exp(-c / 2s^2)``.
        Over all scales, ``ds / s`` each, it integrates to ``Gamma(n/2) (c/2)^(-n/2) / 2``, and the variance to be
        expected is ``c / (n - 2)``: `scale` squared, and as much more as makes up for its being estimated itself
        (Student's t). Few readings that fit what is stated leave the scale there.
        """
        n, c = self.redundancy, self.chi2 * self.used**2
        if n < LEAST_REDUNDANCY or c <= 0:
            return 1.0
        another = float(gammaln(n / 2)) - n / 2 * math.log(c / 2) - math.log(2) - math.log(2 * math.log(MOST_SCALE))
        as_stated = float(expit(math.log(AS_STATED / (1 - AS_STATED)) - c / 2 - another))
        return math.sqrt(as_stated + (1 - as_stated) * c / max(n - 2, n / 2))

    @property
    def can_be_true(self) -> bool:
        """Whether the stated noise can be the true one."""
        if self.redundancy < LEAST_REDUNDANCY:
            return True
        smaller = float(chdtr(self.redundancy, self.chi2 * self.used**2))
        return min(smaller, 1 - smaller) > IMPROBABLE / 2


@dataclass(frozen=True, slots=True)
class Frame:
    """Pose of one map's coordinate system in its group's reference frame (that of the group's first map)."""

    group: int
    T: Transform
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)


@dataclass(frozen=True, eq=False, slots=True)
class FusedLandmark:
    """A landmark of the merged map: once, with all its sources.

    ``covariance``: 3x3 over (x, y, heading) in the group's frame, 2x2 without heading. ``sources``: map name -> ids.
    ``existence``: probability that it is there, from who saw it and who passed without seeing it.
    """

    id: str
    group: int
    type: str
    x: float
    y: float
    heading: float | None
    covariance: Array
    sources: Mapping[str, tuple[str, ...]]
    existence: float
    links: tuple[Link, ...] = ()
    visit_counter: int = 1
    detection_counter: int = 1
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_array(self.covariance))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.id, self.x, self.y))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)


@dataclass(frozen=True, eq=False, slots=True)
class FusedMap:
    """The merged map with its uncertainty, or the reasons why there is none.

    ``maps``: all input names; ``groups``: names sharing a frame, alone ones too; ``frames``: each map's pose in its
    group; ``sources``: the input maps whole, by name (empty when not embedded); ``noise``: how each
    map's measurements fit the noise that it states, by name; ``joint_covariances``: one per group
    over all its landmarks (None where it was not kept, as in a file that was read back).
    """

    decision: Decision
    probability: float
    maps: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    frames: Mapping[str, Frame]
    pairs: tuple[PairResult, ...]
    landmarks: tuple[FusedLandmark, ...]
    provenance: Mapping[str, Any]
    sources: Mapping[str, LandmarkMap] = field(default_factory=dict)
    joint_covariances: tuple[JointCovariance | None, ...] = field(default=(), compare=False)
    noise: Mapping[str, NoiseFit] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.decision, self.probability, self.maps))

    def _repr_html_(self) -> str:
        from .report.notebook import fused_html

        return fused_html(self)

    def to_map(self, group: int = 0, name: str | None = None) -> LandmarkMap:
        """One group's merged map as a recorded map, in the frame of the group's first map, to be fused again.

        It carries the group's joint covariance, each landmark's existence and summed counters, links within the
        group, the walls of all embedded sources, the path of the first one (those of the others under the unknown
        key ``other_paths``), and of each noise figure the sources' worst (`mapfuse.fusion.tomap.combined_noise`). The
        joint covariance has 3 rows per landmark where all have a heading; otherwise 2, and each landmark with heading
        its own 3x3 covariance. Compass readings are left out where several robots' offsets aren't known. The
        ``name`` is the sources' names joined by a plus sign unless given.

        Raises MapfuseError where there is no such group, or where its joint covariance was not kept.
        """
        from .tomap import to_map

        return to_map(self, group, name)

    def landmark_mixture(self, maps: tuple[str, str] | None = None) -> LandmarkMixture:
        """The landmarks of a pair over all its hypotheses, in the frame of the first of ``maps`` (the first pair's).

        As `PairResult.mixture_covariance` for T12: what to use of a landmark where nothing is decided. The graphs of
        the rivals are solved now; `mapfuse.fusion.mixture.landmark_mixture` says how, and what it raises.
        """
        from .mixture import landmark_mixture

        return landmark_mixture(self, maps)
