"""What is reported of a pair of maps: what it says alone, and what the maps around it make of that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform

from .consistent import Choice
from .pairwise import Candidate, Comparison
from .result import PairDecision, PairResult, RankedHypothesis

Array = NDArray[np.float64]

#: Of so many hypotheses, and of all that are at least this probable, it is told which landmarks they match.
TOLD, WORTH_TELLING = 3, 1e-4
#: Among more than two maps, hypotheses below the best few are left out where they are less probable than this: of
#: 160 maps they would be nine tenths of the file. Together they are less than the sum of a pair may be off.
NEGLIGIBLE = 1e-9


def pair_result(
    comparison: Comparison, choice: Choice, ids: tuple[Sequence[str], Sequence[str]], swapped: bool, least: float = 0.0
) -> PairResult:
    """The result of a pair, its maps named in the other order where ``swapped``; ``ids``: of both maps' landmarks.

    In a group the pair's own answer may be decided or overruled by the maps around it. Then the candidate that agrees
    with the group, if any, comes first with the group's probability, and the others share what is left. Hypotheses
    after the best three that are less probable than ``least`` are left out, but for `mixture_covariance`.
    """
    order, probabilities, none, decision, reason = _in_group(comparison, choice, swapped)
    names = comparison.maps[::-1] if swapped else comparison.maps
    candidates = [comparison.candidates[k] for k in order]
    transforms = [c.T12.inverse() if swapped else c.T12 for c in candidates]
    told = [
        _told(c, ids, comparison.maps, swapped) if k < TOLD or p >= WORTH_TELLING else {}
        for k, (c, p) in enumerate(zip(candidates, probabilities, strict=True))
    ]
    hypotheses = tuple(
        RankedHypothesis(T, len(c.matches), c.log_odds, float(p), evidence=c.terms.by_name, **more)
        for k, (T, c, p, more) in enumerate(zip(transforms, candidates, probabilities, told, strict=True))
        if k < TOLD or p >= least
    )
    return PairResult(
        maps=names,
        decision=decision,
        probability=float(probabilities[0]) if candidates else 0.0,
        no_overlap_probability=none,
        hypotheses=hypotheses,
        correspondences=hypotheses[0].correspondences if hypotheses else (),
        reason=reason,
        mixture_covariance=mixture(transforms, probabilities) if candidates else None,
        overruled_by=choice.overruled.get(comparison.maps),
    )


def _told(
    candidate: Candidate, ids: tuple[Sequence[str], Sequence[str]], maps: tuple[str, str], swapped: bool
) -> dict[str, Any]:
    """Which landmarks a candidate matches, and which the other robot passed unrecorded, by their ids."""
    matches = [(ids[0][i], ids[1][j]) for i, j in candidate.matches]
    missed = {
        maps[0]: tuple(sorted(ids[0][k] for k in candidate.missed1)),
        maps[1]: tuple(sorted(ids[1][k] for k in candidate.missed2)),
    }
    return {
        "correspondences": tuple(sorted((b, a) if swapped else (a, b) for a, b in matches)),
        "missed": {name: missed[name] for name in (maps[::-1] if swapped else maps)},
    }


def _in_group(
    comparison: Comparison, choice: Choice, swapped: bool
) -> tuple[list[int], Array, float, PairDecision, str]:
    """Order of the candidates, their probabilities, that of no overlap, the decision and the reason."""
    pair = comparison.maps
    order, own = list(range(len(comparison.candidates))), comparison.probabilities
    reason = comparison.reasons[1 if swapped else 0]
    number = next(k for k, names in enumerate(choice.groups) if pair[0] in names)
    chosen, together = choice.chosen.get(pair), pair[1] in choice.groups[number]
    if not together:
        if comparison.decision == "merged":
            return order, own, comparison.no_overlap, "ambiguous", f"other maps speak against it; alone: {reason}"
        return order, own, comparison.no_overlap, comparison.decision, reason
    if chosen == 0 and comparison.decision == "merged":
        return order, own, comparison.no_overlap, "merged", reason
    if chosen is None and (comparison.decision == "no_overlap" or pair not in choice.overruled):
        return order, own, comparison.no_overlap, comparison.decision, reason
    sure = choice.probability[number]
    around = ", ".join(choice.overruled.get(pair, ())) or "the maps around it"
    if chosen is None:
        probabilities = own * (1 - sure) / max(float(own.sum()), 1e-300)
        none = 1 - float(probabilities.sum())
        return (
            order,
            probabilities,
            none,
            "no_overlap",
            f"overruled by {around}, where these two share nothing; alone: {reason}",
        )
    order = [chosen, *(k for k in order if k != chosen)]
    rest = np.append(own[order[1:]], comparison.no_overlap)
    rest = rest * (1 - sure) / max(float(rest.sum()), 1e-300)
    what = "overruled" if comparison.decision == "merged" else "decided"
    return order, np.append(sure, rest[:-1]), float(rest[-1]), "merged", f"{what} by {around}; alone: {reason}"


def mixture(transforms: Sequence[Transform], probabilities: Array) -> Array:
    """Covariance of T12 over all hypotheses, given that the maps overlap: within them and between them."""
    means = np.array([[T.array] for T in transforms])
    covariances = np.array([[T.covariance] for T in transforms])
    _, within, between = moments(probabilities / probabilities.sum(), means, covariances)
    return np.asarray(within[0] + between[0])


def moments(weights: Array, poses: Array, covariances: Array) -> tuple[Array, Array, Array]:
    """Of n poses that k hypotheses place (k, n, 3) with covariances (k, n, 3, 3): mean (n, 3), covariance within the
    hypotheses (n, 3, 3), and between them.

    ``weights`` (k,) sum to 1. Angles are counted from those of the first hypothesis.

    >>> poses = np.array([[[0.0, 0.0, 0.0]], [[2.0, 0.0, 0.0]]])
    >>> mean, within, between = moments(np.array([0.5, 0.5]), poses, np.zeros((2, 1, 3, 3)))
    >>> mean[0].tolist(), between[0, 0].tolist()
    ([1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    """
    off = poses - poses[0]
    off[..., 2] = se2.wrap(off[..., 2])
    centre = np.einsum("k,kni->ni", weights, off)
    off = off - centre
    mean = poses[0] + centre
    mean[:, 2] = se2.wrap(mean[:, 2])
    within = np.einsum("k,knij->nij", weights, covariances)
    return mean, np.asarray(within), np.asarray(np.einsum("k,kni,knj->nij", weights, off, off))
