"""Merged, ambiguous, or no overlap: the posterior over all hypotheses and none."""

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


def log_weights(log_odds: Array, contradiction: Array, evidence: EvidenceConfig) -> Array:
    """What each hypothesis weighs against no overlap (k,) [nats], before the overlap prior.

    Each hypothesis weighs its odds against none. But where a second hypothesis beats none as well, the building may
    repeat itself, and which of the two overlaps more then says nothing (repetition rule, docs/evidence.md): with the
    probability that it does so, a rival is compared with the best one only by what contradicts either.
    """
    if not len(log_odds):
        return np.zeros(0)
    best = int(np.argmax(log_odds))
    rho = evidence.repetition_rate
    # probability that the building repeats, given how far a wrong hypothesis would have to go by chance
    by_chance = np.exp(-np.clip(log_odds - evidence.repetition_odds, -50, 50))
    repeats = rho / (rho + (1 - rho) * by_chance)
    alike = log_odds[best] + contradiction - contradiction[best]
    with np.errstate(divide="ignore"):
        weights = np.logaddexp(np.log1p(-repeats) + log_odds, np.log(repeats) + alike)
    weights[best] = log_odds[best]
    return np.asarray(weights)


def probabilities(weights: Array, overlap_prior: float) -> Array:
    """Probabilities of hypotheses that weigh so much (`log_weights`) and, last, of no overlap: (k + 1,)."""
    none = float(np.log1p(-overlap_prior) - np.log(overlap_prior))
    everything = np.append(weights, none)
    weight = np.exp(everything - everything.max())
    return np.asarray(weight / weight.sum())


def posterior(log_odds: Array, contradiction: Array, evidence: EvidenceConfig, overlap_prior: float) -> Array:
    """Probabilities of the hypotheses of one pair of maps (k,) and, last, of no overlap: (k + 1,)."""
    return probabilities(log_weights(log_odds, contradiction, evidence), overlap_prior)


def decide(weighed: list[Weighed], evidence: EvidenceConfig, config: DecisionConfig) -> Verdict:
    """The verdict over all weighed hypotheses of one pair of maps."""
    odds = np.array([w.log_odds for w in weighed])
    against = np.array([w.contradiction for w in weighed])
    everything = posterior(odds, against, evidence, config.overlap_prior)
    order = np.lexsort((-odds, -everything[:-1])) if len(odds) else np.zeros(0, dtype=np.intp)
    ranked = tuple(weighed[k] for k in order)
    ordered, none = everything[:-1][order], float(everything[-1])
    decision: PairDecision
    if ranked and ordered[0] >= config.accept:
        decision = "merged"
    elif none >= config.accept or not ranked:
        decision = "no_overlap"
    else:
        decision = "ambiguous"
    return Verdict(ranked, ordered, none, decision)
