"""What the page of a result holds, as plain values: maps, merged groups, pairs with their rivals, uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap, PairResult, RankedHypothesis
from ..show.scene import COMMON_OWNER, scene_of_group
from ..show.words import percent, transform_text
from .joint import coupling
from .plain import (
    correlations,
    map_plain,
    number,
    origin_of,
    places,
    pose_between,
    scene_plain,
    shades,
    sigmas,
    text,
)
from .terms import evidence_rows
from .verdict import answer, facts

Array = NDArray[np.float64]

#: So many rivals of a pair are on the page, the best ones; the sum of the others is told.
MOST_RIVALS = 24
#: Pairs beyond these are told without their rivals.
MOST_PAIRS = 60


def fused_data(fused: FusedMap) -> dict[str, Any]:
    """All that the page of a result shows."""
    index = {name: k for k, name in enumerate(fused.maps)}
    shown = [_map(name, fused.sources.get(name), k) for name, k in index.items()]
    origins = {
        name: np.array(plain["scene"]["origin"]) if plain["scene"] else np.zeros(2)
        for name, plain in zip(fused.maps, shown, strict=True)
    }
    detailed = sorted(fused.pairs, key=lambda pair: pair.decision == "no_overlap")[:MOST_PAIRS]
    kept = {id(pair) for pair in detailed}
    return {
        "kind": "fused",
        "decision": fused.decision,
        "answer": answer(fused),
        "facts": facts(fused),
        "maps": shown,
        "groups": [_group(fused, k, index) for k in range(len(fused.groups))],
        "frames": [
            {
                "map": index[name],
                "group": frame.group,
                "text": transform_text(frame.T),
            }
            for name, frame in fused.frames.items()
        ],
        "pairs": [_pair(pair, index, fused.sources, origins, detailed=id(pair) in kept) for pair in fused.pairs],
        "made_by": f"mapfuse {text(str(fused.provenance.get('mapfuse', '')))}".strip(),
    }


def _map(name: str, map_: LandmarkMap | None, k: int) -> dict[str, Any]:
    """Name, origin and scene of a recorded map; a map that isn't embedded has no scene."""
    extra: Mapping[str, Any] = {} if map_ is None else map_.extra
    return {
        "name": text(name),
        "robot": text(map_.robot) if map_ is not None and map_.robot else None,
        "simulated": bool(extra.get("simulated")),
        "scene": None if map_ is None else map_plain(map_, k),
    }


def _group(fused: FusedMap, k: int, index: Mapping[str, int]) -> dict[str, Any]:
    """A merged group, or a map alone: its scene, and of each landmark what is known of it."""
    members = [l for l in fused.landmarks if l.group == k]
    scene = scene_of_group(fused, k)
    plain = scene_plain(scene, origin_of(scene.positions))
    plain["existence"] = [round(l.existence, 4) for l in members]
    plain["counters"] = [[l.visit_counter, l.detection_counter] for l in members]
    plain["sources"] = [
        [[index[name], _place(fused.sources.get(name), i), text(i)] for name, ids in l.sources.items() for i in ids]
        for l in members
    ]
    joint = fused.joint_covariances[k] if k < len(fused.joint_covariances) else None
    if joint is not None and len(joint.order) == len(members):
        place = {identifier: n for n, identifier in enumerate(joint.order)}
        order = sorted(range(len(members)), key=lambda n: (_rank(int(scene.owners[n])), n))
        rows = [place[members[n].id] for n in order]
        plain["joint"] = {"order": order, **shades(coupling(joint)[np.ix_(rows, rows)])}
    return {"maps": [index[name] for name in fused.groups[k]], "scene": plain}


def _rank(owner: int) -> int:
    """Maps in their order, what several recorded at the end."""
    return 10**6 if owner == COMMON_OWNER else owner


def _place(map_: LandmarkMap | None, identifier: str) -> int | None:
    return None if map_ is None else map_.index_from_id.get(identifier)


def _pair(
    pair: PairResult,
    index: Mapping[str, int],
    sources: Mapping[str, LandmarkMap],
    origins: Mapping[str, Array],
    *,
    detailed: bool,
) -> dict[str, Any]:
    first, second = pair.maps
    shown = pair.hypotheses[: MOST_RIVALS if detailed else 0]
    return {
        "maps": [index[first], index[second]],
        "decision": pair.decision,
        "probability": number(pair.probability, 6),
        "none": number(pair.no_overlap_probability, 6),
        "likelihood": percent(pair.probability),
        "none_text": percent(pair.no_overlap_probability),
        "reason": text_of_reason(pair.reason),
        "overruled": None if pair.overruled_by is None else [index[n] for n in pair.overruled_by if n in index],
        "count": len(pair.correspondences),
        "T12": None if pair.T12 is None else transform_text(pair.T12),
        "mixture": sigmas(pair.mixture_covariance),
        "rivals": [_rival(pair, k, sources, (origins[first], origins[second])) for k in range(len(shown))],
        "left_out": len(pair.hypotheses) - len(shown),
        "left_out_text": percent(sum(h.probability for h in pair.hypotheses[len(shown) :])),
    }


def text_of_reason(reason: str) -> str:
    """The reason without control characters; it may name many landmarks, and is long then."""
    words = [word if len(word) <= 200 else text(word) for word in reason.split(" ")]
    return " ".join("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in word) for word in words)


def _rival(
    pair: PairResult, k: int, sources: Mapping[str, LandmarkMap], origins: tuple[Array, Array]
) -> dict[str, Any]:
    hypothesis = pair.hypotheses[k]
    T12 = hypothesis.T12
    return {
        "pose": pose_between(T12.array, *origins),
        "text": transform_text(T12),
        "sigmas": sigmas(T12.covariance),
        "correlations": correlations(T12.covariance),
        "count": hypothesis.count,
        "nats": round(hypothesis.log_evidence, 2),
        "probability": number(hypothesis.probability, 6),
        "likelihood": percent(hypothesis.probability),
        "evidence": evidence_rows(hypothesis.evidence),
        **_named(pair.maps, hypothesis, pair.correspondences if k == 0 else (), sources),
    }


def _named(
    maps: tuple[str, str],
    hypothesis: RankedHypothesis,
    otherwise: Sequence[tuple[str, str]],
    sources: Mapping[str, LandmarkMap],
) -> dict[str, Any]:
    """Matched and missed landmarks as their places in both maps; empty where the maps aren't embedded."""
    first, second = (sources.get(name) for name in maps)
    if first is None or second is None:
        return {"matches": [], "missed": [[], []], "distances": []}
    pairs = [
        (first.index_from_id[a], second.index_from_id[b])
        for a, b in hypothesis.correspondences or otherwise
        if a in first.index_from_id and b in second.index_from_id
    ]
    i, j = (np.array(side, dtype=np.intp) for side in zip(*pairs, strict=True)) if pairs else (np.zeros(0, int),) * 2
    apart = first.positions[i] - hypothesis.T12.apply(second.positions[j])
    return {
        "matches": [list(pair) for pair in pairs],
        "apart": [[round(x, 3), round(y, 3)] for x, y in apart.tolist()],
        "missed": [
            places(hypothesis.missed.get(name, ()), map_.index_from_id)
            for name, map_ in zip(maps, (first, second), strict=True)
        ],
    }
