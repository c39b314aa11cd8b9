"""Parameters of the matcher, with units and meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mapfuse.datasets.errors import ConfigError


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    """How hypotheses of T12 are proposed.

    ``mode``: ``default``, or ``paper``: the exact, exhaustive matcher of Dedeoglu & Sukhatme (2000).
    ``use_h1``, ``use_h2``, ``use_compass``: the paper's heuristics; switch one off to measure its worth.
    ``compass_gate_deg`` [degrees]: absolute readings must agree within it (paper: 30).
    ``tolerance_m`` [m]: landmarks that far apart or less under T12 count as matching.
    ``max_hypotheses``: how many distinct modes are kept, best first.
    ``bend_sigma_m``, ``bend_length_m`` [m]: smooth bend of two maps of points against each other: its standard
    deviation, and over which distance it keeps its direction. 0: as much as the maps' noise says.
    ``threads``: how many run at once; the result is the same for any number.
    """

    mode: Literal["default", "paper"] = "default"
    use_h1: bool = True
    use_h2: bool = True
    use_compass: bool = True
    compass_gate_deg: float = 30.0
    tolerance_m: float = 1.0
    max_hypotheses: int = 64
    bend_sigma_m: float = 0.0
    bend_length_m: float = 0.0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.mode not in ("default", "paper"):
            raise ConfigError(f"matching.mode is {self.mode!r}; it must be 'default' or 'paper'")
        for name in ("compass_gate_deg", "tolerance_m", "max_hypotheses", "threads"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"matching.{name} is {getattr(self, name)!r}; it must be greater than 0")
        for name in ("bend_sigma_m", "bend_length_m"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"matching.{name} is {getattr(self, name)!r}; it must be 0 or greater")
