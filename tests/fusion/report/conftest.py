"""Results to be shown, made by hand: simulated grids of corridors that two robots saw in part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis

T12 = Transform(9.0, -3.0, 2.0, np.diag([0.04, 0.01, 1e-4]))
HOME = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))
#: Nats by part of the evidence, as `mapfuse.fusion.evidence.Terms` names them.
EVIDENCE = {"prior": -9.0, "matches": 30.5, "misses": -4.25, "void": 6.0, "junctions": 0.0}


def grid(columns: int, rows: int, step: float = 6.0) -> dict[str, tuple[float, float]]:
    return {f"p{c}-{r}": (step * c, step * r) for c in range(columns) for r in range(rows)}


def neighbours(name: str, places: dict[str, tuple[float, float]]) -> list[str]:
    c, r = map(int, name[1:].split("-"))
    return [n for n in (f"p{c + 1}-{r}", f"p{c}-{r + 1}", f"p{c - 1}-{r}", f"p{c}-{r - 1}") if n in places]


def recorded(name: str, seen: dict[str, tuple[float, float]], T: np.ndarray) -> LandmarkMap:
    """The places as one robot has them, whose frame ``T`` (3,) lies at."""
    at = {p: se2.transform(se2.inverse(T), xy) for p, xy in seen.items()}
    landmarks = []
    for p, (x, y) in at.items():
        links = [
            Link("open", float(np.arctan2(*(at[q] - at[p])[::-1])), connected_to_id=q, distance=6.0)
            for q in neighbours(p, seen)
        ]
        landmarks.append(Landmark(p, "junction", float(x), float(y), None, tuple(links), 3, 2))
    walls = [xy + np.array([[1.0, 1.0], [5.0, 1.0]]) for xy in list(at.values())[:3]]
    return LandmarkMap(name, tuple(landmarks), robot="milka", walls=tuple(walls), extra={"simulated": True})


def merged_result(columns: int = 5, rows: int = 3, names: tuple[str, str] = ("D7", "D9")) -> FusedMap:
    """Two maps merged: robot 1 saw all but the last column, robot 2 all but the first."""
    places = grid(columns, rows)
    seen1 = {p: xy for p, xy in places.items() if not p.startswith(f"p{columns - 1}-")}
    seen2 = {p: xy for p, xy in places.items() if not p.startswith("p0-")}
    maps = (recorded(names[0], seen1, np.zeros(3)), recorded(names[1], seen2, T12.array))
    common = sorted(seen1.keys() & seen2.keys())
    landmarks = tuple(
        FusedLandmark(
            f"m{k}", 0, "junction", x, y, 0.0, np.diag([0.04, 0.09, 1e-3]),
            {name: (p,) for name, seen in zip(names, (seen1, seen2), strict=True) if p in seen},
            0.2 if k == 0 else 0.97, (), 3, 2,
        )
        for k, (p, (x, y)) in enumerate(places.items())
    )  # fmt: skip
    best = RankedHypothesis(
        T12, len(common) - 1, 41.2, 0.98, correspondences=tuple((p, p) for p in common[1:]),
        missed={names[0]: (common[0],), names[1]: ()}, evidence=EVIDENCE,
    )  # fmt: skip
    rival = RankedHypothesis(
        Transform(20.0, 1.0, -2.5, np.diag([0.1, 0.1, 1e-3])), 1, 3.0, 0.015,
        correspondences=((common[0], common[1]),), missed={names[0]: (), names[1]: ()}, evidence={"prior": -9.0},
    )  # fmt: skip
    pair = PairResult(
        names, "merged", 0.98, 0.005, (best, rival), best.correspondences, "because of what matches",
        np.diag([0.09, 0.04, 4e-4]),
    )  # fmt: skip
    n = len(landmarks)
    spread = np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 3)
    joint = JointCovariance(tuple(l.id for l in landmarks), 3, np.kron(spread, np.diag([0.04, 0.09, 1e-3])))
    return FusedMap(
        "merged", 0.98, names, (names,), {names[0]: Frame(0, HOME), names[1]: Frame(0, T12)}, (pair,), landmarks,
        {"mapfuse": "0.1.0", "inputs": {}, "config": {}}, {m.name: m for m in maps}, (joint,),
    )  # fmt: skip


def undecided(fused: FusedMap, decision: str) -> FusedMap:
    """The same two maps with nothing merged."""
    pair = fused.pairs[0]
    shares = (0.55, 0.4) if decision == "ambiguous" else (0.003, 0.001)
    hypotheses = tuple(replace(h, probability=p) for h, p in zip(pair.hypotheses, shares, strict=True))
    pair = replace(
        pair, decision=decision, probability=shares[0], no_overlap_probability=1 - sum(shares), hypotheses=hypotheses
    )
    alone = tuple(
        FusedLandmark(l.id + name, k, l.type, l.x, l.y, None, np.eye(2) * 0.01, {name: (l.id,)}, 0.9)
        for k, name in enumerate(fused.maps)
        for l in fused.sources[name].landmarks
    )
    return replace(
        fused, decision=decision, probability=1.0, pairs=(pair,), landmarks=alone, joint_covariances=(),
        groups=tuple((name,) for name in fused.maps),
        frames={name: Frame(k, HOME) for k, name in enumerate(fused.maps)},
    )  # fmt: skip


def three_maps(fused: FusedMap) -> FusedMap:
    """A third map that overlaps with neither of the two merged ones."""
    other = LandmarkMap("D1", (Landmark("tree 1", "tree", 0.0, 0.0), Landmark("tree 2", "tree", 4.0, 1.0)))
    none = [
        PairResult((name, "D1"), "no_overlap", 0.0, 1.0, (), (), "nothing to compare", overruled_by=fused.maps)
        for name in fused.maps
    ]
    alone = tuple(
        FusedLandmark(f"t{k}", 1, l.type, l.x, l.y, None, np.eye(2) * 0.01, {"D1": (l.id,)}, 0.9)
        for k, l in enumerate(other.landmarks)
    )
    return replace(
        fused, decision="partial", maps=(*fused.maps, "D1"), groups=(*fused.groups, ("D1",)),
        pairs=(*fused.pairs, *none), landmarks=(*fused.landmarks, *alone),
        frames={**fused.frames, "D1": Frame(1, HOME)}, sources={**fused.sources, "D1": other},
    )  # fmt: skip


@pytest.fixture(scope="session")
def merged() -> FusedMap:
    return merged_result()


@pytest.fixture(scope="session")
def results(merged: FusedMap) -> dict[str, FusedMap]:
    """One result of every kind, by its decision."""
    return {
        "merged": merged,
        "ambiguous": undecided(merged, "ambiguous"),
        "no_overlap": undecided(merged, "no_overlap"),
        "partial": three_maps(merged),
        "not embedded": replace(merged, sources={}),
        "large": merged_result(40, 25),
    }


@pytest.fixture(scope="session")
def make_merged() -> Callable[..., FusedMap]:
    return merged_result
