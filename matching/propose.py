"""`propose`: two maps to ranked hypotheses of T12."""

from __future__ import annotations

from dataclasses import replace

from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import LandmarkMap

from .config import MatchingConfig
from .exhaustive import match_exhaustively
from .hypothesis import Hypothesis
from .modes import distinct_modes
from .point_pairs import match_point_pairs


def propose(
    map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None
) -> list[Hypothesis]:
    """Hypotheses of the transformation of map 2 into map 1, best first; empty where no landmarks can correspond.

    Paper mode is the exact, exhaustive matcher. The default mode lets doors propose as well and leaves the compass
    to the evidence (indoor compasses are bent by steel), adds what landmarks without heading propose in pairs, and
    keeps distinct modes only.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> arms = (Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14), Link("open", -1.57))
    >>> one = LandmarkMap("one", (Landmark("c", "corner", 1.0, 2.0, links=arms),))
    >>> two = LandmarkMap("two", (Landmark("e", "corner", 0.0, 0.0, links=arms),))
    >>> [(h.T12.x, h.T12.y, h.count) for h in propose(one, two)]
    [(1.0, 2.0, 1)]
    """
    config = config or MatchingConfig()
    if config.mode == "paper":
        return list(match_exhaustively(map1, map2, config).hypotheses)
    every_kind = replace(config, use_h2=False, use_compass=False)
    headed = match_exhaustively(map1, map2, every_kind).best(8 * config.max_hypotheses)
    points = match_point_pairs(_without_heading(map1), _without_heading(map2), config)
    ranked = sorted([*headed, *points], key=lambda h: -h.count)
    return distinct_modes(ranked, map2.positions, config.tolerance_m, config.max_hypotheses) if ranked else []


def _without_heading(recorded: LandmarkMap) -> LandmarkMap:
    """The map's landmarks that propose only in pairs."""
    bare = tuple(landmark for landmark in recorded.landmarks if heading_of(landmark) is None)
    return recorded.replace(landmarks=bare, joint_covariance=None, same_as={})
