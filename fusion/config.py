"""Parameters of the estimator, one frozen model per component, given only to that component."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mapfuse.datasets.errors import ConfigError
from mapfuse.matching.config import MatchingConfig


def chi2_gate(probability: float, dof: int | NDArray[np.intp]) -> NDArray[np.float64]:
    """Squared Mahalanobis distance that a right match stays below with this probability.

    >>> float(chi2_gate(0.999, 3).round(2))
    16.27
    """
    return np.asarray(chdtri(np.asarray(dof, dtype=float), 1 - probability))


def _check(section: str, values: object, bounds: dict[str, tuple[float, float]]) -> None:
    for name, (low, high) in bounds.items():
        value = getattr(values, name)
        if not low <= value <= high:
            raise ConfigError(f"{section}.{name} is {value!r}; it must lie between {low!r} and {high!r}")


@dataclass(frozen=True, slots=True)
class SolvingConfig:
    """How a hypothesis grows into matched landmarks, and how its graph is solved.

    ``gate_probability``: share of right matches that the chi-square gate keeps.
    ``match_odds`` [nats]: a match is accepted when its density beats the local density of landmarks by this.
    ``max_rounds``: rounds of re-association before a growing match must stand still.
    ``shortlist``: how many of the best hypotheses get a full graph.
    ``estimate_noise``: whether each map's stated sigmas are multiplied by what its own residuals say of them.
    """

    gate_probability: float = 0.999
    match_odds: float = 0.0
    max_rounds: int = 12
    shortlist: int = 4
    estimate_noise: bool = False

    def __post_init__(self) -> None:
        _check(
            "solving",
            self,
            {
                "gate_probability": (0.5, 0.999999),
                "match_odds": (-50, 50),
                "max_rounds": (1, 1000),
                "shortlist": (1, 1000),
            },
        )


@dataclass(frozen=True, slots=True)
class EvidenceConfig:
    """What speaks for and against a hypothesis; the derivation is in docs/evidence.md.

    ``corridor_width_m`` [m]: a landmark that far from a travelled link, or less, was passed.
    ``corridor_angle_deg`` [degrees]: a link that strays further from its arm is no travelled corridor.
    ``arm_error_rate``: probability that a sensed arm is wrong about being passable.
    ``look_elsewhere`` [nats]: taken off for each hypothesis, since many are tried; down to half of it where the maps
    show that the building isn't regular.
    ``repetition_rate``: probability that a building repeats itself in a way that two hypotheses fit.
    ``repetition_odds`` [nats]: log odds that a wrong hypothesis may reach by chance where nothing repeats.
    ``alike_rate``: probability that maps which share nothing show two floors of one plan, alike but for some landmarks.
    """

    corridor_width_m: float = 1.0
    corridor_angle_deg: float = 20.0
    arm_error_rate: float = 0.05
    look_elsewhere: float = 3.0
    repetition_rate: float = 0.05
    repetition_odds: float = 3.0
    alike_rate: float = 0.001

    def __post_init__(self) -> None:
        _check(
            "evidence",
            self,
            {
                "corridor_width_m": (0.01, 100),
                "corridor_angle_deg": (1, 90),
                "arm_error_rate": (1e-6, 0.5),
                "look_elsewhere": (-50, 100),
                "repetition_rate": (0, 1),
                "repetition_odds": (-50, 50),
                "alike_rate": (0, 1),
            },
        )


@dataclass(frozen=True, slots=True)
class DecisionConfig:
    """When two maps are merged.

    ``accept``: the best hypothesis' probability from which two maps are merged; also the probability of no overlap
    from which they are called so. ``overlap_prior``: probability, before looking, that two maps overlap.
    """

    accept: float = 0.99
    overlap_prior: float = 0.5

    def __post_init__(self) -> None:
        _check("decision", self, {"accept": (0.5, 1.0), "overlap_prior": (1e-9, 1 - 1e-9)})


@dataclass(frozen=True, slots=True)
class WallsConfig:
    """Whether and how walls speak, where both maps carry walls and a path; docs/walls.md.

    ``use``: whether they do.
    ``gate_m`` [m]: walls of two maps that lie further apart than this are not the same.
    ``gate_sigma``: nor are those further apart than so many standard deviations.
    ``margin_m`` [m]: a wall counts as crossed, or as seen through, only where it is by more than this.
    ``reach_m`` [m]: how far from its way a robot sees walls.
    ``crossing_nats`` [nats]: what a wall that the other robot's way leads through takes off.
    ``through_nats`` [nats]: what each metre of wall that was seen through another one takes off.
    ``most_nats`` [nats]: what walls take off at most: whatever they have in common may be wrong.
    """

    use: bool = False
    gate_m: float = 0.75
    gate_sigma: float = 4.0
    margin_m: float = 0.5
    reach_m: float = 5.0
    crossing_nats: float = 3.0
    through_nats: float = 1.5
    most_nats: float = 10.0

    def __post_init__(self) -> None:
        _check(
            "walls",
            self,
            {
                "gate_m": (0.01, 10),
                "gate_sigma": (1, 100),
                "margin_m": (0.01, 10),
                "reach_m": (0.1, 100),
                "crossing_nats": (0, 100),
                "through_nats": (0, 100),
                "most_nats": (0, 1000),
            },
        )


@dataclass(frozen=True, slots=True)
class FuseConfig:
    """All parameters of `fuse`."""

    matching: MatchingConfig = field(default_factory=MatchingConfig)
    solving: SolvingConfig = field(default_factory=SolvingConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)
    walls: WallsConfig = field(default_factory=WallsConfig)

    @classmethod
    def from_dict(cls, values: Mapping[str, Mapping[str, Any]]) -> FuseConfig:
        """Of what `dataclasses.asdict` gives; a section that is left out is as by default.

        >>> FuseConfig.from_dict({"decision": {"accept": 0.9}}).decision.accept
        0.9
        """
        sections = {f.name: f.default_factory for f in fields(cls)}
        return cls(**{name: sections[name](**given) for name, given in values.items()})  # type: ignore[operator]
