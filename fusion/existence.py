"""Is a landmark really there? From who saw it, and who passed without seeing it (the paper's false alarms)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .prepared import PreparedMap

#: Corridor [m] within which a second robot's false alarm would be taken for the same landmark.
MATCH_LENGTH_M = 1.0


def existence(
    seen: Sequence[tuple[PreparedMap, int]], passed_by: Sequence[PreparedMap], rate: float, against: float = 0.0
) -> float:
    """Probability that a landmark is there.

    ``seen``: the maps it is in, with its place there; ``passed_by``: maps whose robot passed and recorded nothing;
    ``rate`` [1/m]: true landmarks of the kind per metre of corridor; ``against`` [nats]: what its blocked arms say that
    these robots drove through. Bayes, with w = `MATCH_LENGTH_M`: before looking
    the odds of one at a given spot are rate w. A sighting multiplies them by Pd / (density of false alarms w), which
    is (1 - fa) / (fa rate w); a robot that passed without recording it by 1 - Pd. So one sighting alone gives
    the odds (1 - fa) / fa, and the order of the robots does not matter.
    """
    odds = against - (len(seen) - 1) * math.log(min(max(rate * MATCH_LENGTH_M, 1e-6), 1.0))
    for m, k in seen:
        fa = float(m.false[k])
        odds += math.log(1 - fa) - math.log(fa)
    type_ = seen[0][0].map.types[seen[0][1]]
    for m in passed_by:
        odds += math.log(max((1 - m.map.noise.detection(type_)) * m.goes_straight(type_), 1e-9))
    return 1 / (1 + math.exp(-min(max(odds, -700.0), 700.0)))
