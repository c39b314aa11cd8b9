"""A map that the mapper made, against the truth of its log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from ..logs import LogTruth
from ..maps import LandmarkMap
from ..truth import Truth


def truth_of_map(map_: LandmarkMap, sources: Mapping[str, Sequence[int]], truth: LogTruth) -> Truth:
    """What is really so of a map: each landmark is the place that most of its detections were of, or a false alarm.

    ``sources``: of each landmark its detections (`Mapper.sources`). The map's frame is the first pose of the path.
    """
    places: dict[str, str | None] = {}
    for landmark in map_.landmarks:
        votes = Counter(truth.detections[k] for k in sources[landmark.id] if k < len(truth.detections))
        # of as many votes for two, the first in the alphabet; a false alarm last
        ranked = sorted(votes, key=lambda place: (-votes[place], place is None, place or ""))
        places[landmark.id] = ranked[0] if ranked else None
    frame = np.asarray(truth.path[0, 1:4], dtype=float)
    return Truth({map_.name: frame}, {map_.name: places}, truth.places)
