"""When it is worth weighing: how much is new since the last time, and whether anything stands out."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING

from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap
from .config import OnlineConfig
from .segment import Segment

if TYPE_CHECKING:
    from .rivals import Rivals


class Due:
    """What is new since maps were weighed last.

    ``weighed``: the maps as they were then, by name; ``new``: how many landmarks of each are other ones since.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.weighed: dict[str, LandmarkMap] = {}
        self.new: dict[str, int] = {}

    def changed(self, name: str, new: int) -> None:
        """A map has so many landmarks that are new, gone or otherwise there by now."""
        self.new[name] = new

    def settle(self, segments: Mapping[str, Segment]) -> None:
        """All of this has been weighed."""
        for name, segment in segments.items():
            self.weighed[name] = segment.map()
            segment.changed.clear()
        self.new.clear()

    def unsettle(self, before: Mapping[str, LandmarkMap | None], segments: Mapping[str, Segment]) -> None:
        """Maps of ``before``, as they had been weighed before (None: not at all), have not been weighed after all."""
        for name, recorded in before.items():
            self.weighed.pop(name, None)
            if recorded is not None:
                self.weighed[name] = recorded
            self.new[name] = max(self.new.get(name, 0), segments[name].size)

    def now(self, segments: Mapping[str, Segment], fused: FusedMap | None, rivals: Rivals) -> bool:
        """Whether to weigh now.

        A merge must be doubted as eagerly as it was made, so that what is merged is weighed as what is not, but for
        `OnlineConfig.settled_factor` where it is beyond doubt.
        """
        new = sum(self.new.values())
        if not new:
            return False
        step = max(self.config.weigh_every, self.config.weigh_share * sum(s.size for s in segments.values()))
        if fused is not None and len(fused.groups) == 1 and len(fused.maps) == len(segments):
            settled = 1 - fused.probability < self.config.doubt
            return new >= step * (self.config.settled_factor if settled else 1.0)
        if new >= max(self.config.patience, step):
            return True
        return new >= step and any(
            rivals.votes(a, b) >= self.config.least_votes for a, b in combinations(sorted(segments), 2)
        )
