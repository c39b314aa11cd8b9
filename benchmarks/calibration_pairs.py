"""Classes of simulated pairs that calibration is measured on, and what is kept of each pair."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mapfuse.datasets import LandmarkMap, se2
from mapfuse.datasets.simulation.explore import SimulationError
from mapfuse.datasets.simulation.generate import FloorKind
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.datasets.simulation.robots import MILKA, VESPUCCI
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import FuseConfig, FusedMap, fuse
from mapfuse.fusion.score import score_pair
from mapfuse.matching import MatchingConfig, propose

#: A hypothesis this near [m] to the true placement, over the landmarks that both maps have, is the true one.
RIGHT_M = 3.0
_DRAWS = 2000


@dataclass(frozen=True, slots=True)
class PairClass:
    """One class of pairs: the floor, whether both maps show it, compass, common landmarks, and how wrong the stated
    noise is. ``symmetric``: the building looks the same from two ends."""

    name: str
    kind: FloorKind = "irregular"
    same: bool = True
    compass: bool = False
    common: tuple[int, int] = (8, 99)
    share: tuple[float, float] = (0.4, 0.9)
    stated: float = 1.0

    @property
    def symmetric(self) -> bool:
        """Whether such floors look the same from two ends."""
        return self.kind == "symmetric"

    def draw(self, seed: int) -> tuple[LandmarkMap, LandmarkMap, Truth]:
        """The pair of a seed; simulated."""
        robots = (
            replace(VESPUCCI, stated_noise_factor=self.stated),
            replace(MILKA, stated_noise_factor=self.stated),
        )
        rng = np.random.default_rng([seed, 0])
        low, high = self.common
        for _ in range(_DRAWS):
            try:
                pair = simulated_pair(
                    rng,
                    self.kind,
                    same=self.same,
                    compass=self.compass,
                    min_common=low,
                    robots=robots,
                    share=self.share,
                )
            except SimulationError:  # some floors are too small for two robots to start apart
                continue
            if not self.same or len(pair[2].true_pairs("A", "B")) <= high:
                return pair
        raise SimulationError(f"no pair with {low} to {high} common landmarks came about in {_DRAWS} draws")


FEW, SMALL = (5, 7), (0.2, 0.5)
CLASSES: Mapping[str, PairClass] = {
    c.name: c
    for c in (
        PairClass("irregular"),
        PairClass("irregular, compass", compass=True),
        PairClass("irregular, 5-7 common", common=FEW, share=SMALL),
        PairClass("irregular, 0-4 common", common=(0, 4), share=SMALL),
        PairClass("irregular, different", same=False),
        PairClass("irregular, different, compass", same=False, compass=True),
        PairClass("oblique", "oblique"),
        PairClass("oblique, 5-7 common", "oblique", common=FEW, share=SMALL),
        PairClass("oblique, different", "oblique", same=False),
        PairClass("oblique, different, compass", "oblique", same=False, compass=True),
        PairClass("alike", "alike"),
        PairClass("alike, compass", "alike", compass=True),
        PairClass("alike, 5-7 common", "alike", common=FEW, share=SMALL),
        PairClass("alike, different", "alike", same=False),
        PairClass("alike, different, compass", "alike", same=False, compass=True),
        PairClass("wings", "wings"),
        PairClass("wings, 5-7 common", "wings", common=FEW, share=SMALL),
        PairClass("wings, different", "wings", same=False),
        PairClass("wings, different, compass", "wings", same=False, compass=True),
        PairClass("symmetric", "symmetric"),
        PairClass("symmetric, compass", "symmetric", compass=True),
        PairClass("symmetric, different", "symmetric", same=False),
        PairClass("symmetric, different, compass", "symmetric", same=False, compass=True),
        PairClass("irregular, noise stated half", stated=0.5),
        PairClass("irregular, noise stated double", stated=2.0),
        PairClass("alike, different, noise stated half", "alike", same=False, stated=0.5),
    )
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is kept of one pair.

    ``right``: the first hypothesis is the true one (None where the maps show different floors); ``listed``: one of them
    is. ``rivals``: hypotheses with a probability of 0.01 or more. ``count_margin``: matches of paper mode's best less
    those of its second. ``nees`` of T12 and of one landmark, of merges. ``raw``: evidence of the first [nats].
    ``existence`` of each fused landmark of a merge: its probability, whether it is there, and whether the other robot
    could have refuted it, having passed there.
    """

    pair_class: str
    seed: int
    decision: str
    probability: float
    no_overlap: float
    right: bool | None
    listed: bool | None
    rivals: int
    wrong: bool
    common: int
    matches: tuple[int, int]
    raw: float
    paper_right: bool | None
    count_margin: int
    nees_T12: float
    nees_landmark: float
    ellipse: tuple[int, int]
    seconds: float
    reason: str
    existence: tuple[tuple[float, bool, bool], ...] = field(default=())


def displacement(T12: np.ndarray, map2: LandmarkMap, truth: Truth) -> float:
    """Root mean square distance [m] between where T12 and the true one put map 2's common landmarks."""
    common = {b for _, b in truth.true_pairs("A", "B")}
    points = np.array([[l.x, l.y] for l in map2.landmarks if l.id in common])
    if not len(points):
        return float("inf")
    off = se2.transform(T12, points) - se2.transform(truth.T12("A", "B").array, points)
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def run_pair(job: tuple[str, int, FuseConfig]) -> Outcome:
    """Fuse the pair of a class and a seed."""
    name, seed, config = job
    pair_class = CLASSES[name]
    map1, map2, truth = pair_class.draw(seed)
    begin = time.process_time()
    fused = fuse([map1, map2], config)
    seconds = time.process_time() - begin
    pair, score = fused.pairs[0], score_pair(fused, truth)
    right = listed = paper_right = None
    paper = propose(map1, map2, MatchingConfig(mode="paper"))
    margin = paper[0].count - (paper[1].count if len(paper) > 1 else 0) if paper else 0
    if pair_class.same:
        right = bool(score.reported and score.right >= 0.8 * score.reported)
        listed = right or any(displacement(h.T12.array, map2, truth) < RIGHT_M for h in pair.hypotheses)
        paper_right = bool(paper) and displacement(paper[0].T12.array, map2, truth) < RIGHT_M
    nees = score.nees_landmarks
    return Outcome(
        name,
        seed,
        pair.decision,
        pair.probability,
        pair.no_overlap_probability,
        right,
        listed,
        sum(h.probability >= 0.01 for h in pair.hypotheses),
        score.merged_wrongly if pair_class.same else pair.decision == "merged",
        score.common,
        (score.right, score.reported),
        pair.hypotheses[0].log_evidence if pair.hypotheses else float("-inf"),
        paper_right,
        margin,
        score.nees_T12,
        float(np.random.default_rng(seed).choice(nees)) if len(nees) else float("nan"),
        (int((nees < 5.991).sum()), len(nees)),
        seconds,
        pair.reason,
        _existence(fused, truth) if pair.decision == "merged" else (),
    )


def _existence(fused: FusedMap, truth: Truth) -> tuple[tuple[float, bool, bool], ...]:
    """Of every fused landmark: existence, whether it is there, whether the other robot could have refuted it."""
    missed = {(name, i) for name, ids in fused.pairs[0].hypotheses[0].missed.items() for i in ids}
    found = []
    for landmark in fused.landmarks:
        recorded = [(name, i) for name, ids in landmark.sources.items() for i in ids]
        there = any(truth.landmarks[name][i] is not None for name, i in recorded)
        found.append((landmark.existence, there, len(recorded) == 1 and recorded[0] in missed))
    return tuple(found)
