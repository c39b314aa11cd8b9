"""Merged, ambiguous, or no overlap: the posterior over all hypotheses and none, and the sentence that says why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import DecisionConfig, EvidenceConfig
from .evidence import Weighed
from .result import PairDecision

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Hypotheses best first with their probabilities (k,), that of no overlap, and the decision."""

    ranked: tuple[Weighed, ...]
    probabilities: Array
    no_overlap: float
    decision: PairDecision
    reason: str


def posterior(log_odds: Array, contradiction: Array, evidence: EvidenceConfig, overlap_prior: float) -> Array:
    """Probabilities of the hypotheses (k,) and, last, of no overlap: (k + 1,).

    Each hypothesis weighs its odds against none. But where a second hypothesis beats none as well, the building may
    repeat itself, and which of the two overlaps more then says nothing (repetition rule, docs/evidence.md): with the
    probability that it does so, a rival is compared with the best one only by what contradicts either.
    """
    if not len(log_odds):
        return np.ones(1)
    best = int(np.argmax(log_odds))
    rho = evidence.repetition_rate
    # probability that the building repeats, given how far a wrong hypothesis would have to go by chance
    by_chance = np.exp(-np.clip(log_odds - evidence.repetition_odds, -50, 50))
    repeats = rho / (rho + (1 - rho) * by_chance)
    alike = log_odds[best] + contradiction - contradiction[best]
    with np.errstate(divide="ignore"):
        log_weight = np.logaddexp(np.log1p(-repeats) + log_odds, np.log(repeats) + alike)
    log_weight[best] = log_odds[best]
    none = float(np.log1p(-overlap_prior) - np.log(overlap_prior))
    everything = np.append(log_weight, none)
    weight = np.exp(everything - everything.max())
    return weight / weight.sum()


def decide(weighed: list[Weighed], evidence: EvidenceConfig, config: DecisionConfig) -> Verdict:
    """The verdict over all weighed hypotheses of one pair of maps."""
    odds = np.array([w.log_odds for w in weighed])
    against = np.array([w.contradiction for w in weighed])
    everything = posterior(odds, against, evidence, config.overlap_prior)
    order = np.lexsort((-odds, -everything[:-1])) if len(odds) else np.zeros(0, dtype=np.intp)
    ranked = tuple(weighed[k] for k in order)
    probabilities, none = everything[:-1][order], float(everything[-1])
    decision: PairDecision
    if len(ranked) and probabilities[0] >= config.accept:
        decision = "merged"
    elif none >= config.accept or not len(ranked):
        decision = "no_overlap"
    else:
        decision = "ambiguous"
    return Verdict(ranked, probabilities, none, decision, _reason(ranked, probabilities, none, decision))


def _names(w: Weighed) -> str:
    """The landmarks that matched, a few by name."""
    m1, m2 = w.growth.joined.m1.map, w.growth.joined.m2.map
    pairs = [f"{m1.ids[i]}={m2.ids[j]}" for i, j in zip(w.growth.i, w.growth.j, strict=True)]
    return ", ".join(pairs[:4]) + (", ..." if len(pairs) > 4 else "")


def _against(w: Weighed) -> str:
    m1, m2 = w.growth.joined.m1.map, w.growth.joined.m2.map
    missed = [f"{m1.name}:{m1.ids[k]}" for k in w.missed1] + [f"{m2.name}:{m2.ids[k]}" for k in w.missed2]
    if not missed:
        return "nothing against"
    more = ", ..." if len(missed) > 3 else ""
    return f"{len(missed)} passed without being seen by the other robot ({', '.join(missed[:3])}{more}) against"


def _reason(ranked: tuple[Weighed, ...], probabilities: Array, none: float, decision: PairDecision) -> str:
    if not ranked:
        return "no pair of landmarks proposes a transformation"
    best = ranked[0]
    text = f"{len(best.growth.i)} landmarks coincide ({_names(best)}), {_against(best)}; "
    text += f"log odds against no overlap {best.log_odds:+.1f}"
    if len(ranked) > 1:
        gap = np.log(max(probabilities[0], 1e-300)) - np.log(max(probabilities[1], 1e-300))
        text += f"; the nearest rival ({len(ranked[1].growth.i)} landmarks) is {gap:.1f} nats behind"
    if decision == "ambiguous":
        text = "not decided: " + text + f"; no overlap has {none:.3f}"
    elif decision == "no_overlap":
        text = "no overlap: of all placements the best one does not stand out: " + text
    return text
