"""Parameters of the online fuser."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapfuse.datasets.errors import ConfigError

from ..config import FuseConfig


@dataclass(frozen=True, slots=True)
class OnlineConfig:
    """When maps that grow are weighed anew, and all parameters of `mapfuse.fusion.fuse`.

    ``weigh_every``, ``weigh_share``: maps are weighed once so many of their landmarks are new or changed: the larger
    one of a number and a share of all of them. ``settled_factor``: times as many while a merge is beyond doubt.
    ``doubt``: a merge is beyond it where it is wrong with a smaller probability.
    ``patience`` [landmarks]: however little the rivals of a pair stand out, it is weighed after so many changes.
    ``least_votes``: a pair is worth weighing where so many landmarks agree on one placement.
    ``delay`` [s]: with a worker process, what was asked at a time counts from so much later, and is waited for;
    None: from whenever it is there, so that nothing ever waits, and two runs may differ.
    """

    fuse: FuseConfig = field(default_factory=FuseConfig)
    weigh_every: int = 2
    weigh_share: float = 0.04
    settled_factor: float = 2.0
    doubt: float = 1e-4
    patience: int = 8
    least_votes: int = 3
    delay: float | None = 2.0

    def __post_init__(self) -> None:
        bounds = {
            "weigh_every": (1, 1000),
            "weigh_share": (0, 1),
            "settled_factor": (1, 1000),
            "doubt": (0, 0.5),
            "patience": (1, 10_000),
            "least_votes": (1, 1000),
            "delay": (0, 1e6),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if name == "delay" and value is None:
                continue
            if not low <= value <= high:
                raise ConfigError(f"online.{name} is {value!r}; it must lie between {low!r} and {high!r}")
