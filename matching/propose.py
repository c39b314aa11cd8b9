"""`propose`: two maps to ranked hypotheses of T12."""

from __future__ import annotations

from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import LandmarkMap

from .config import MatchingConfig
from .exhaustive import match_exhaustively
from .hypothesis import Hypothesis
from .landmark_arrays import landmark_arrays
from .point_pairs import match_point_pairs
from .voting import propose_by_votes


def propose(
    map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None, *, explain: bool = False
) -> list[Hypothesis]:
    """Hypotheses of the transformation of map 2 into map 1, best first; empty where no landmarks can correspond.

    Paper mode is the exact, exhaustive matcher. In the default mode landmarks with headings vote for T12 one pair at a
    time, and those without propose two pairs at a time; what both find is refined and ranked together by all landmarks.
    Compasses, bent by steel indoors, say something about the order and exclude nothing.

    With ``explain`` each hypothesis carries the sentence that says why it was proposed; `mapfuse.matching.explain` also
    says why some other T12, or a pair of landmarks, was not.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> arms = (Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14), Link("open", -1.57))
    >>> one = LandmarkMap("one", (Landmark("c", "corner", 1.0, 2.0, links=arms),))
    >>> two = LandmarkMap("two", (Landmark("e", "corner", 0.0, 0.0, links=arms),))
    >>> [(h.T12.x, h.T12.y, h.count) for h in propose(one, two)]
    [(1.0, 2.0, 1)]
    """
    config = config or MatchingConfig()
    if explain:
        from .explain import explained

        return explained(map1, map2, propose(map1, map2, config), config)
    if config.mode == "paper":
        return list(match_exhaustively(map1, map2, config).hypotheses)
    headed1, headed2 = landmark_arrays(map1).headed, landmark_arrays(map2).headed
    if not headed1.any() or not headed2.any():
        return match_point_pairs(_without_heading(map1), _without_heading(map2), config)
    points: list[Hypothesis] = []
    if not headed1.all() and not headed2.all():
        points = match_point_pairs(_without_heading(map1), _without_heading(map2), config)
    return propose_by_votes(map1, map2, config, also=[hypothesis.T12 for hypothesis in points])


def _without_heading(recorded: LandmarkMap) -> LandmarkMap:
    """The map's landmarks that propose only in pairs."""
    bare = tuple(landmark for landmark in recorded.landmarks if heading_of(landmark) is None)
    if len(bare) == len(recorded):
        return recorded
    return recorded.replace(landmarks=bare, joint_covariance=None, same_as={})
