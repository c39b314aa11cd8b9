"""One sentence that says what decided: what speaks for the best hypothesis, what against, and how near its rival is."""

from __future__ import annotations

import math

from .decide import Verdict
from .evidence import Weighed

#: Landmarks that a reason names before it says "and so many more".
NAMED = 4
#: Probability above which a placement counts as possible.
POSSIBLE = 1e-3


def reason(verdict: Verdict, swapped: bool) -> str:
    """Why a pair of maps was decided as it was; ``swapped``: name map 2's landmarks before map 1's."""
    if not verdict.ranked:
        return (
            "there is nothing to compare: no landmark of one map can be one of the other; nothing speaks for an overlap"
        )
    best = verdict.ranked[0]
    evidence = f"{_matches(best, swapped)}; {_misses(best)}; {best.log_odds:+.1f} nats against no overlap"
    rival = _rival(verdict)
    if verdict.decision == "merged":
        return f"{evidence}{rival}"
    if verdict.decision == "ambiguous":
        return f"not decided: {_open(verdict)}; the best one has {evidence}{rival}"
    if floor := _floor(verdict):
        return f"no overlap{floor}; the best placement has {evidence}"
    return f"no placement stands out; the best one has {evidence}"


def _open(verdict: Verdict) -> str:
    """How many answers are left."""
    possible = int((verdict.probabilities > POSSIBLE).sum())
    placements = f"{possible} placements are possible" if possible != 1 else "one placement is possible"
    if verdict.no_overlap < POSSIBLE:
        return placements
    return f"{placements}, and no overlap has {verdict.no_overlap:.3f}{_floor(verdict)}"


def _floor(verdict: Verdict) -> str:
    """Words for floors that are alike, where these are half of what "no overlap" weighs."""
    return ", as on two floors built to one plan" if verdict.alike > math.log(2) else ""


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _matches(w: Weighed, swapped: bool) -> str:
    ids1, ids2 = w.growth.joined.m1.map.ids, w.growth.joined.m2.map.ids
    pairs = [(ids1[i], ids2[j]) for i, j in zip(w.growth.i, w.growth.j, strict=True)]
    names = sorted(f"{b}={a}" if swapped else f"{a}={b}" for a, b in pairs)
    return f"{len(names)} common landmark{'s' if len(names) != 1 else ''} ({_listed(names)})"


def _misses(w: Weighed) -> str:
    m1, m2 = w.growth.joined.m1.map, w.growth.joined.m2.map
    names = [f"{m1.name}:{m1.ids[k]}" for k in w.missed1] + [f"{m2.name}:{m2.ids[k]}" for k in w.missed2]
    if not names:
        return "none that a robot passed without recording it"
    them = "it" if len(names) == 1 else "them"
    return f"{len(names)} that the other robot passed without recording {them} ({_listed(sorted(names))})"


def _rival(verdict: Verdict) -> str:
    if len(verdict.ranked) < 2:
        return ""
    first, second = (max(float(p), 1e-300) for p in verdict.probabilities[:2])
    count = len(verdict.ranked[1].growth.i)
    landmarks = f"{count} common landmark{'s' if count != 1 else ''}"
    gap = math.log(first / second)
    if gap < 0.05:
        return f"; a rival with {landmarks} is as probable"
    return f"; the nearest rival, with {landmarks}, is {gap:.1f} nats less probable"
