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
    """Hypotheses best first with their probabilities (k,), what they weigh (k,) [nats] (`log_weights`), the
    probability of no overlap, and the decision. ``alike`` [nats]: what no overlap weighs more because the maps may
    show two floors of one plan (`log_alike`)."""

    ranked: tuple[Weighed, ...]
    probabilities: Array
    weights: Array
    no_overlap: float
    decision: PairDecision
    alike: float = 0.0


def log_weights(log_odds: Array, alias: Array, evidence: EvidenceConfig, spared: Array | float = 0.0) -> Array:
    """What each hypothesis weighs against no overlap (k,) [nats], before the overlap prior.

    Each hypothesis weighs its odds against none. But where a second hypothesis beats none as well, the building may
    repeat itself, and which of the two overlaps more then says nothing (repetition rule, docs/evidence.md): a rival k
    of the best one b is right where b is its image, or b right where k is. ``alias`` (k, 2) [nats]: the odds of what b
    shows, and of what k shows, at an image of the right place against at the right place itself; (k,): of what each
    shows, whichever is its rival. ``spared`` (k,) [nats]: what each didn't pay for the search, and may have by chance.
    """
    if not len(log_odds):
        return np.zeros(0)
    best = int(np.argmax(log_odds))
    if alias.ndim == 1:
        alias = np.column_stack([np.full(len(alias), alias[best]), alias])
    rho = min(max(evidence.repetition_rate, 1e-300), 1 - 1e-12)
    # odds that the building repeats itself, less how far a wrong hypothesis gets by chance
    repeats = np.log(rho) - np.log1p(-rho) - evidence.repetition_odds - spared
    weights = (
        log_odds
        + np.logaddexp(0.0, repeats + log_odds[best] + alias[:, 0])
        - np.logaddexp(0.0, repeats + log_odds + alias[:, 1])
    )
    weights[best] = log_odds[best]
    return np.asarray(weights)


def log_alike(log_odds: Array, alike: Array, evidence: EvidenceConfig) -> float:
    """What "no overlap" weighs more [nats], since the maps may show two floors that were built to one plan.

    Such floors agree as one floor does: what agrees says nothing then, and what is missing all. ``alike`` (k,) [nats]:
    the odds of what each hypothesis shows on another floor against on the same one (docs/evidence.md, "Another floor
    of one plan").

    >>> odds = np.array([40.0])
    >>> round(log_alike(odds, np.array([7.0]), EvidenceConfig(alike_rate=0.5)) - 40.0, 3)  # 7 + log 0.5
    6.307
    """
    if not len(log_odds):
        return 0.0
    rate = min(max(evidence.alike_rate, 1e-300), 1 - 1e-12)
    return float(np.logaddexp.reduce([np.log1p(-rate), *(np.log(rate) + log_odds + alike)]))


def probabilities(weights: Array, overlap_prior: float) -> Array:
    """Probabilities of hypotheses that weigh so much (`log_weights`) and, last, of no overlap: (k + 1,)."""
    none = float(np.log1p(-overlap_prior) - np.log(overlap_prior))
    everything = np.append(weights, none)
    weight = np.exp(everything - everything.max())
    return np.asarray(weight / weight.sum())


def posterior(log_odds: Array, alias: Array, evidence: EvidenceConfig, overlap_prior: float) -> Array:
    """Probabilities of the hypotheses of one pair of maps (k,) and, last, of no overlap: (k + 1,)."""
    return probabilities(log_weights(log_odds, alias, evidence), overlap_prior)


def decide(weighed: list[Weighed], alias: Array, evidence: EvidenceConfig, config: DecisionConfig) -> Verdict:
    """The verdict over all weighed hypotheses of one pair of maps; ``alias`` as in `log_weights`."""
    odds = np.array([w.log_odds for w in weighed])
    weights = log_weights(odds, alias, evidence, np.array([w.spared for w in weighed]))
    other_floor = log_alike(odds, np.array([w.alike for w in weighed]), evidence)
    everything = probabilities(weights - other_floor, config.overlap_prior)
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
    return Verdict(ranked, ordered, weights[order], none, decision, other_floor)
