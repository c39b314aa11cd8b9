"""How far a recorded landmark is to be believed: what its own map says of it, before any other robot looks.

A robot takes for a landmark what isn't one while it drives along a corridor, so that a false one lies on a corridor
which goes straight on there. Where the robot turned off, or where no corridor goes on, something is
(docs/evidence.md, "How far a landmark is to be believed").
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.arms import ARM_TOLERANCE
from mapfuse.datasets.maps import CORNER, LandmarkMap
from mapfuse.datasets.se2 import wrap

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Probability that the corridor is taken for one that ends or turns where it goes straight on, or the reverse.
BEND_ERROR_RATE = 0.05
#: As if so many true corners, all of which bend but for `BEND_ERROR_RATE`, had been seen before; and of any other kind
#: two landmarks, one of which bends.
CORNERS_BEFORE, OTHERS_BEFORE = 10.0, 2.0
#: So many times at most that a robot came by again and detected nothing speak against a landmark: what hides it once
#: may hide it for good.
MOST_UNDETECTED = 3
#: Rounds of estimating how many true landmarks of a kind stand where a corridor goes straight on; it converges.
_ROUNDS = 30


def stated_false(map_: LandmarkMap, k: int) -> float:
    """Probability that a recorded landmark isn't there by what the map states: the map's own `existence`, or else the
    robot's rate to the power of the detections, and how often the robot came by again without detecting it.

    Never quite 0 or 1, whatever the map states: no evidence is infinite.

    >>> from mapfuse.datasets import Landmark, LandmarkMap, Noise
    >>> seen = Landmark("a", "corner", 0.0, 0.0), Landmark("b", "corner", 0.0, 0.0, visit_counter=2)
    >>> stated = LandmarkMap("m", seen, noise=Noise(detection_rate=0.84, false_alarm_rate=0.2))
    >>> round(stated_false(stated, 0), 3), round(stated_false(stated, 1), 3)  # odds of 1 : 4; times 0.8 / 0.16
    (0.2, 0.556)
    """
    landmark = map_.landmarks[k]
    if landmark.existence is not None:
        rate = 1 - landmark.existence
    else:
        alarm, detection = map_.noise.false_alarm(landmark.type), map_.noise.detection(landmark.type)
        detections = max(1, landmark.detection_counter)
        undetected = min(max(landmark.visit_counter - detections, 0), MOST_UNDETECTED)
        false = alarm**detections * (1 - alarm) ** undetected
        true = (1 - alarm**detections) * max(1 - detection, 1e-3) ** undetected
        rate = false / (false + true) if false + true > 0 else alarm
    return min(max(rate, 1e-9), 1 - 1e-9)


def straight_on(arm_headings: Array, passable: Flags, travelled: Flags) -> tuple[Flags, Flags]:
    """Of each landmark (n,) whether its robot drove straight through it, and whether it turned or came to an end there.

    Straight through: all arms it travelled lie on one line, open to both sides. Neither, where no arm was travelled,
    or where it isn't known what is opposite the only one that was. Arms as in `mapfuse.fusion.prepared.PreparedMap`.

    >>> heading = np.array([[0.0, np.pi / 2, np.pi, np.nan]])
    >>> on, bends = straight_on(heading, np.array([[True, False, True, False]]), np.array([[True, False, True, False]]))
    >>> bool(on[0]), bool(bends[0])
    (True, False)
    """
    sensed = ~np.isnan(arm_headings)
    ways = travelled & sensed
    apart = np.abs(wrap(arm_headings[:, :, None] - arm_headings[:, None, :]))
    opposite = apart > np.pi - ARM_TOLERANCE  # false for an arm that wasn't sensed
    in_line = opposite | (apart < ARM_TOLERANCE)
    turned = (ways[:, :, None] & ways[:, None, :] & ~in_line).any(axis=(1, 2))
    known = ways[:, :, None] & opposite & sensed[:, None, :]
    ended = (known & ~(passable | travelled)[:, None, :]).any(axis=(1, 2))
    bends = turned | ended
    return np.asarray(known.any(axis=(1, 2)) & ~bends), np.asarray(bends)


def false_by_own_map(
    stated: Array, kinds: tuple[str, ...], settled: Flags, on: Flags, bends: Flags, visits: Array
) -> tuple[Array, dict[str, float]]:
    """Probability (n,) that each landmark isn't there, given how the corridor goes on at it; and of each kind the share
    of visits to true ones that go straight through.

    ``stated`` (n,): before that is looked at; ``settled`` (n,): which are taken as stated, whatever the corridor does;
    ``visits`` (n,): how often the robot came by, each time of which it may have turned off. Bayes for each kind, with
    that share estimated from the map itself, each landmark counting as far as it is believed (expectation and
    maximisation).
    """
    false, shares = stated.copy(), dict[str, float]()
    odds = (stated / (1 - stated)).tolist()
    known = np.flatnonzero(on | bends).tolist()
    for kind in sorted(set(kinds)):
        of = [k for k in known if kinds[k] == kind]
        before, share = (CORNERS_BEFORE, BEND_ERROR_RATE) if kind == CORNER else (OTHERS_BEFORE, 0.5)
        # where a corner is the corridor bends, and one that was taken for going straight stays so
        seen = [_Seen(odds[k], bool(on[k]), 1.0 if kind == CORNER else float(visits[k]), bool(settled[k])) for k in of]
        through_before, alike = share * before, Counter(seen)
        for _ in range(_ROUNDS):
            through, came = through_before, before
            for one, count in alike.items():
                there = count / (1 + one.odds(share))
                through += there * one.straight_visits(share)
                came += there * one.visits
            share, last = through / came, share
            if share == last:  # to the last digit, as all further rounds would be
                break
        told = {one: one.odds(last) for one in alike}
        false[of], shares[kind] = [told[one] / (1 + told[one]) for one in seen], share
    return np.clip(false, 1e-9, 1 - 1e-9), shares


class _Seen(NamedTuple):
    """What is known of one landmark: the ``stated`` odds that it isn't there, whether its robot drove straight through,
    how many ``visits`` it could have turned off at, and whether it is ``settled``, so that this tells nothing."""

    stated: float
    straight: bool
    visits: float
    settled: bool

    def odds(self, share: float) -> float:
        """Odds that it isn't there, where the ``share`` of visits to true ones goes straight through."""
        if self.settled:
            return self.stated
        always = float(share**self.visits)
        return self.stated * ((1 - BEND_ERROR_RATE) / always if self.straight else BEND_ERROR_RATE / (1 - always))

    def straight_visits(self, share: float) -> float:
        """Expected number of its visits that went straight through, if it is there."""
        if self.straight:
            return self.visits
        always = float(share**self.visits)  # not all of them did
        return self.visits * (share - always) / (1 - always)
