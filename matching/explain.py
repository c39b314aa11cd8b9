"""`explain`: why a pair of landmarks, or a T12, was proposed or wasn't, in a sentence with the values behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of, overlay, signature, turns
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import SPATIAL_TYPES, LandmarkMap
from mapfuse.datasets.transform import Transform

from .candidates import compass_readings
from .config import MatchingConfig
from .hypothesis import Hypothesis
from .landmark_arrays import landmark_arrays
from .modes import displacement
from .propose import propose
from .voting import assessed


@dataclass(frozen=True, slots=True)
class Explanation:
    """``proposed``: whether `propose` has it. ``reason``: one sentence. ``step``: what decided: ``type`` (H1), ``kind``
    (H2), ``heading``, ``arms``, ``compass``, ``matches``, ``score``, ``distinct``, or ``listed``. ``values``: the
    figures behind it. ``rank``: place in the list, from 0, of what it is or is too near to."""

    proposed: bool
    reason: str
    step: str
    values: Mapping[str, float] = field(default_factory=dict)
    rank: int | None = None


def explain(
    map1: LandmarkMap,
    map2: LandmarkMap,
    what: Transform | tuple[str, str],
    config: MatchingConfig | None = None,
) -> Explanation:
    """Why a T12, or the pair (id in map 1, id in map 2), is among the hypotheses of `propose`, or isn't.

    A pair is proposed if it is a match of a hypothesis in the list. Raises `ConfigError` for an id that isn't there.

    >>> from mapfuse.datasets.maps import Landmark
    >>> one = LandmarkMap("one", (Landmark("c", "corner", 1.0, 2.0, heading=0.0),))
    >>> two = LandmarkMap("two", (Landmark("d", "door", 0.0, 0.0, heading=0.0),))
    >>> explain(one, two, ("c", "d")).reason
    "c is of type 'corner' and d of type 'door': only landmarks of one type match (H1)"
    """
    config = config or MatchingConfig()
    if isinstance(what, Transform):
        return _of_transform(map1, map2, what, config)
    return _of_pair(map1, map2, what, config)


def explained(
    map1: LandmarkMap, map2: LandmarkMap, found: Sequence[Hypothesis], config: MatchingConfig
) -> list[Hypothesis]:
    """The hypotheses, each with why it was proposed as its ``explanation``."""
    return [replace(h, explanation=_proposed(map1, map2, h, config)) for h in found]


def _proposed(map1: LandmarkMap, map2: LandmarkMap, hypothesis: Hypothesis, config: MatchingConfig) -> str:
    """Which landmarks proposed it by which rule, how many match, and what it is ranked by."""
    named = ", ".join(f"{a}={b}" for a, b in hypothesis.seed)
    types = {map1[a].type for a, _ in hypothesis.seed}
    with_heading = all(heading_of(map1[a]) is not None and heading_of(map2[b]) is not None for a, b in hypothesis.seed)
    rule = "their arms or headings lie on each other" if with_heading else "their distances are the same"
    if config.mode == "paper":
        rule = "of one type (H1), corners or junctions (H2), arms and compass agree"
    text = f"proposed by {named or 'neighbours that agree'}" + (
        f" ({', '.join(sorted(types))}; {rule})" if types else ""
    )
    matches = _number(hypothesis.count, "landmark matches", "landmarks match")
    score = f"{hypothesis.score:.4g}" + ("" if config.mode == "paper" else " nats")
    return f"{text}; {matches} one to one within {config.tolerance_m:g} m or their noise; score {score}"


def _of_pair(map1: LandmarkMap, map2: LandmarkMap, pair: tuple[str, str], config: MatchingConfig) -> Explanation:
    for recorded, identifier in zip((map1, map2), pair, strict=True):
        if identifier not in recorded.index_from_id:
            raise ConfigError(f"map {recorded.name!r} has no landmark {identifier!r}")
    a, b = map1[pair[0]], map2[pair[1]]
    paper = config.mode == "paper"
    if config.use_h1 and a.type != b.type:
        kinds = f"{a.id} is of type {a.type!r} and {b.id} of type {b.type!r}"
        return Explanation(False, f"{kinds}: only landmarks of one type match (H1)", "type")
    found = propose(map1, map2, config)
    listed = [k for k, hypothesis in enumerate(found) if pair in set(hypothesis.correspondences)]
    if listed:
        best = found[listed[0]]
        values = {"score": best.score, "count": float(best.count), "hypotheses": float(len(listed))}
        text = f"{a.id} and {b.id} match in {_number(len(listed), 'hypothesis', 'hypotheses')}, the best of them"
        return Explanation(True, f"{text} number {listed[0] + 1} of {len(found)}", "listed", values, listed[0])
    if paper and config.use_h2 and a.type not in SPATIAL_TYPES:
        return Explanation(False, f"{a.id} is a {a.type}: only corners and junctions propose (H2)", "kind")
    heading1, heading2 = heading_of(a), heading_of(b)
    if heading1 is None or heading2 is None:
        which = a.id if heading1 is None else b.id
        text = f"{which} has no heading, so {a.id} and {b.id} propose only together with other pairs, and none fits"
        return Explanation(False, text, "heading")
    arms1, arms2 = signature(a), signature(b)
    rotations = [turn.rotation for turn in turns(arms1, arms2)]
    if not arms1.headings or not arms2.headings:
        rotations = [float(se2.wrap(heading1 - heading2))]
    if not rotations:
        straight = overlay(arms1, arms2, float(se2.wrap(heading1 - heading2)))
        values = {"coincide": float(straight.coincide), "contradict": float(straight.contradict)}
        text = f"in no turn do the arms of {a.id} and {b.id} coincide without an open one on a blocked one"
        return Explanation(False, text, "arms", values)
    if paper and config.use_compass and not any(_compass_agrees(map1, map2, pair, r, config) for r in rotations):
        gate = f"{config.compass_gate_deg:g} degrees"
        readings = f"the compass readings of {a.id} and {b.id} differ by more than {gate}"
        text = f"in every turn that lays arms on arms {readings}"
        return Explanation(False, text, "compass", {"turns": float(len(rotations))})
    explanations = [_of_transform(map1, map2, _laid_on(map1, map2, pair, r), config, found) for r in rotations]
    best_turn = max(explanations, key=lambda e: e.values.get("score", -np.inf))
    text = f"{a.id} on {b.id} is a T12 of its own, but {best_turn.reason}"
    return Explanation(False, text, best_turn.step, best_turn.values, best_turn.rank)


def _laid_on(map1: LandmarkMap, map2: LandmarkMap, pair: tuple[str, str], rotation: float) -> Transform:
    a, b = map1[pair[0]], map2[pair[1]]
    turned = se2.transform([0.0, 0.0, rotation], [b.x, b.y])
    return Transform(a.x - float(turned[0]), a.y - float(turned[1]), rotation)


def _compass_agrees(
    map1: LandmarkMap, map2: LandmarkMap, pair: tuple[str, str], rotation: float, config: MatchingConfig
) -> bool:
    a, b = map1[pair[0]], map2[pair[1]]
    readings1, readings2 = compass_readings(a), compass_readings(b)
    met = [(readings1[k1], readings2[k2]) for k1, k2 in overlay(signature(a), signature(b), rotation).pairs]
    off = [abs(float(se2.wrap(r1 - r2))) for r1, r2 in met if r1 is not None and r2 is not None]
    beyond = sum(angle > np.deg2rad(config.compass_gate_deg) for angle in off)
    return bool(beyond <= len(off) - beyond)


def _of_transform(
    map1: LandmarkMap,
    map2: LandmarkMap,
    T12: Transform,
    config: MatchingConfig,
    found: list[Hypothesis] | None = None,
) -> Explanation:
    if not len(map1) or not len(map2):
        return Explanation(False, "a map without landmarks gives no hypotheses", "matches")
    found = propose(map1, map2, config) if found is None else found
    off = [float(displacement(T12.array, h.T12.array, map2.positions)) for h in found]
    nearest = int(np.argmin(off)) if off else None
    if nearest is not None and off[nearest] <= config.tolerance_m:
        values = {"score": found[nearest].score, "count": float(found[nearest].count), "off_m": off[nearest]}
        text = f"it is hypothesis number {nearest + 1} of {len(found)}, to {off[nearest]:.2f} m"
        return Explanation(True, text, "listed", values, nearest)
    refined, score, count = assessed(map1, map2, T12, config)
    values = {
        "score": score,
        "count": float(count),
        "moved_m": float(displacement(T12.array, refined.array, map2.positions)),
    }
    if count == 0:
        text = "under it no landmark of map 2 lies on one of its type and arms in map 1"
        return Explanation(False, text, "matches", values)
    near = [float(displacement(refined.array, h.T12.array, map2.positions)) for h in found]
    if near and min(near) <= 2 * config.tolerance_m:
        k = int(np.argmin(near))
        matches = _number(count, "match", "matches")
        text = f"aligned with its {matches} it becomes hypothesis number {k + 1} of {len(found)}"
        return Explanation(True, text, "distinct", values, k)
    last = found[-1].score if found else 0.0
    headed1, headed2 = landmark_arrays(map1).headed, landmark_arrays(map2).headed
    if config.mode == "paper" or not (headed1.any() and headed2.any()):
        return Explanation(False, f"no pair of landmarks proposes it, though {count} would match", "arms", values)
    if len(found) >= config.max_hypotheses and score <= last:
        text = f"its score of {score:.1f} nats is below the {last:.1f} of the last of {len(found)} hypotheses"
        return Explanation(False, f"{text}; {count} landmarks match", "score", values)
    text = f"no vote came out for it: its {_number(count, 'match', 'matches')} give a score of {score:.1f} nats"
    return Explanation(False, text, "score", values)


def _number(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"
