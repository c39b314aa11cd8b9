"""The parts of a hypothesis' evidence in words, and which landmarks each of them speaks of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

#: Which landmarks a part of the evidence points at: matched ones, passed ones, both, or none.
Marks = Literal["matches", "missed", "both", "none"]

#: Name in `mapfuse.fusion.evidence.Terms` -> label, what it means, and what it points at.
WORDS: Mapping[str, tuple[str, str, Marks]] = {
    "prior": (
        "Any one placement",
        "Before looking, map 2 could lie in very many ways: each single one is improbable.",
        "none",
    ),
    "matches": (
        "Corridor landmarks that coincide",
        "Landmarks of both maps lie where they would if they were the same, along the corridors.",
        "matches",
    ),
    "points": ("Points that coincide", "Labelled points of both maps lie on each other in the plane.", "matches"),
    "regular": (
        "Discount for a regular building",
        "Where corridors and doors repeat at even distances, landmarks coincide more easily than by chance.",
        "matches",
    ),
    "stated": ("What you said of it", "How well the placement agrees with what was stated of it beforehand.", "none"),
    "misses": (
        "Landmarks that were missed",
        "The other robot passed these landmarks and did not record them.",
        "missed",
    ),
    "void": (
        "Emptiness that both agree on",
        "Both robots travelled stretches where neither recorded anything.",
        "none",
    ),
    "arms": (
        "Arms that contradict",
        "A robot drove where the other one found the way blocked, or arms of the same landmark differ.",
        "matches",
    ),
    "crossings": (
        "Corridors that cross without a junction",
        "A corridor of one map leads across a corridor of the other one, and neither robot recorded a junction there.",
        "none",
    ),
    "compass": ("Compasses", "How well the norths of both robots agree under this placement.", "none"),
    "known": (
        "Known to be the same",
        "The maps themselves say of some landmarks that they are the same (same_as).",
        "matches",
    ),
    "walls": ("Walls", "Walls of one map on walls of the other one, or across the way that its robot took.", "none"),
}


def evidence_rows(evidence: Mapping[str, float]) -> list[dict[str, Any]]:
    """Parts of the evidence [nats] that say anything, strongest first, for the page.

    >>> [row["label"] for row in evidence_rows({"void": 0.0, "misses": -4.0, "matches": 30.0})]
    ['Corridor landmarks that coincide', 'Landmarks that were missed']
    """
    rows = []
    for name, nats in sorted(evidence.items(), key=lambda item: (-abs(item[1]), item[0])):
        label, why, marks = WORDS.get(name, (name.replace("_", " "), "", "none"))
        if round(nats, 2):
            rows.append({"name": name, "label": label, "why": why, "marks": marks, "nats": round(float(nats), 2)})
    return rows
