"""The answer in a sentence, and the facts that a reader asks for next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedLandmark, FusedMap
from ..show.words import percent, transform_text
from .plain import number, text


def answer(fused: FusedMap) -> dict[str, str]:
    """``word``: the decision; ``sentence``: what it means; ``detail``: how sure it is.

    >>> from mapfuse.fusion.result import PairResult
    >>> pair = PairResult(("A", "B"), "no_overlap", 0.0, 1.0, (), (), "no kinds in common")
    >>> fused = FusedMap("no_overlap", 1.0, ("A", "B"), (("A",), ("B",)), {}, (pair,), (), {})
    >>> answer(fused)["sentence"]
    'These maps show different places. Nothing was merged.'
    """
    word = fused.decision.replace("_", " ")
    if len(fused.maps) < 2:
        return {"word": "one map", "sentence": "There was nothing to merge it with.", "detail": ""}
    sentence, detail = _several(fused) if len(fused.maps) > 2 else _two(fused)
    return {"word": word, "sentence": sentence, "detail": detail}


def _two(fused: FusedMap) -> tuple[str, str]:
    pair = fused.pairs[0] if fused.pairs else None
    if fused.decision == "merged":
        return "These two maps overlap, and were merged.", f"{percent(fused.probability)} sure that this is right"
    if pair is None:
        return "Nothing was merged.", ""
    if fused.decision == "no_overlap":
        sure = f"{percent(pair.no_overlap_probability)} sure that they share nothing"
        return "These maps show different places. Nothing was merged.", sure
    possible = sum(h.probability >= 1e-3 for h in pair.hypotheses)
    ways = f"{possible} placements are possible" if possible != 1 else "one placement is possible"
    sentence = f"It can't be decided where these maps lie to each other: {ways}. Nothing was merged."
    rest = f"no overlap has {percent(pair.no_overlap_probability)}"
    return sentence, f"the likeliest placement has {percent(pair.probability)}, {rest}"


def stand_alone(count: int) -> str:
    """How many maps were merged with none.

    >>> stand_alone(1), stand_alone(0)
    ('1 stands alone', 'none stands alone')
    """
    return f"{count or 'none'} stand{'' if count > 1 else 's'} alone"


def _several(fused: FusedMap) -> tuple[str, str]:
    n, sure = len(fused.maps), f"{percent(fused.probability)} sure that all merges are right"
    if fused.decision == "merged":
        return f"All {n} maps share one frame, and were merged.", sure
    if fused.decision == "partial":
        merged = [names for names in fused.groups if len(names) > 1]
        alone = n - sum(map(len, merged))
        groups = "one group" if len(merged) == 1 else f"{len(merged)} groups"
        return f"{n - alone} of {n} maps were merged into {groups}; {stand_alone(alone)}.", sure
    undecided = sum(pair.decision == "ambiguous" for pair in fused.pairs)
    if undecided:
        pairs = "one pair" if undecided == 1 else f"{undecided} pairs"
        return f"None of the {n} maps were merged: of {pairs} it can't be decided how they lie.", ""
    return f"None of the {n} maps overlap. Nothing was merged.", ""


def facts(fused: FusedMap) -> list[list[str]]:
    """Rows of label and text: where the maps lie, how many landmarks they share, and how well these are known."""
    rows: list[list[str]] = []
    if any(m.extra.get("simulated") for m in fused.sources.values()):
        rows.append(["Data", _origin(list(fused.sources.values()))])
    if len(fused.maps) == 2 and fused.decision == "merged" and fused.pairs and fused.pairs[0].T12 is not None:
        first, second = map(text, fused.pairs[0].maps)
        rows.append([f"{second} lies in {first} at", f"{transform_text(fused.pairs[0].T12)}  (± 1 σ)"])
        rows.append(["Common landmarks", str(len(fused.pairs[0].correspondences))])
    merged = {k for k, names in enumerate(fused.groups) if len(names) > 1}
    within = [l for l in fused.landmarks if l.group in merged]
    if within:
        rows += _landmarks(within)
    return rows


def _origin(maps: Sequence[LandmarkMap]) -> str:
    made = sum(bool(m.extra.get("simulated")) for m in maps)
    how = "simulated" if made == len(maps) else f"{made} of {len(maps)} maps simulated"
    return f"{how}, a reconstruction" if any(m.extra.get("reconstruction") for m in maps) else how


def _landmarks(landmarks: Sequence[FusedLandmark]) -> list[list[str]]:
    worst = [float(np.sqrt(max(np.linalg.eigvalsh(l.covariance[:2, :2])[-1], 0.0))) for l in landmarks]
    doubtful = sum(l.existence < 0.5 for l in landmarks)
    common = sum(sum(bool(ids) for ids in l.sources.values()) > 1 for l in landmarks)
    return [
        ["Landmarks after merging", f"{len(landmarks)}, of which {common} were seen by several robots"],
        ["Their position σ", f"{number(float(np.median(worst)))} m (median), {number(max(worst))} m (largest)"],
        [
            "Doubtful",
            "none" if not doubtful else f"{doubtful} that rather {'is' if doubtful == 1 else 'are'} not there",
        ],
    ]
