"""Many pairs in a few numbers: means and medians with bootstrap intervals over pairs, and paired tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap, wilcoxon

from .evaluation import Evaluation

Array = NDArray[np.float64]

#: Draws of the bootstrap, share of them in the interval, and the seed of the draws.
DRAWS, CONFIDENCE, SEED = 9999, 0.95, 0


@dataclass(frozen=True, slots=True)
class Interval:
    """A statistic over ``n`` pairs and the bounds between which it lies with 95 % (percentile bootstrap over pairs).

    Bounds are those of the value itself where there is one pair only.
    """

    value: float
    low: float
    high: float
    n: int


def interval(
    values: Iterable[float | None], statistic: Callable[..., Array] = np.mean, seed: int = SEED
) -> Interval | None:
    """The interval of a statistic of the values that are known; None where none is. The same seed, the same bounds.

    >>> found = interval([1.0, 2.0, 3.0, None])
    >>> found.value, found.n, found.low <= 2.0 <= found.high
    (2.0, 3, True)
    """
    known = np.array([value for value in values if value is not None], dtype=float)
    if not len(known):
        return None
    value = float(statistic(known))
    if len(known) == 1 or np.ptp(known) == 0:
        return Interval(value, value, value, len(known))
    bounds = bootstrap(
        (known,),
        statistic,
        n_resamples=DRAWS,
        confidence_level=CONFIDENCE,
        method="percentile",
        batch=max(1, 2_000_000 // len(known)),
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(value, float(bounds.low), float(bounds.high), len(known))


@dataclass(frozen=True, slots=True)
class MethodSummary:
    """One method over all pairs.

    ``pairs``: those that it did, ``failed``: those that it couldn't. ``merged``, ``wrong``: merges, and wrong ones
    (None without truth). Over pairs: mean ``correctness`` of the matches and mean share of ``eliminated`` false alarms;
    medians of ``error_m`` [m], ``error_rad`` [rad], ``rms`` [m], ``rms_aligned`` [m] and ``seconds``.
    """

    method: str
    pairs: int
    failed: int
    merged: int
    wrong: int | None
    correctness: Interval | None
    eliminated: Interval | None
    error_m: Interval | None
    error_rad: Interval | None
    rms: Interval | None
    rms_aligned: Interval | None
    seconds: Interval | None


def summaries(evaluations: Sequence[Evaluation], seed: int = SEED) -> tuple[MethodSummary, ...]:
    """A summary per method, in their order."""
    return tuple(_summary(name, found, seed) for name, found in by_method(evaluations).items())


def by_method(evaluations: Iterable[Evaluation]) -> dict[str, list[Evaluation]]:
    """Evaluations by method, pairs in order."""
    found: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        found.setdefault(e.method, []).append(e)
    return found


def _summary(name: str, evaluations: Sequence[Evaluation], seed: int) -> MethodSummary:
    done = [e for e in evaluations if e.merge is not None]
    truths = [e.truth for e in done if e.truth is not None]

    def median(values: Iterable[float | None]) -> Interval | None:
        return interval(values, np.median, seed)

    return MethodSummary(
        name,
        len(done),
        len(evaluations) - len(done),
        sum(e.decision == "merged" for e in done),
        sum(bool(e.merged_wrongly) for e in done) if truths else None,
        interval([e.correctness for e in done], seed=seed),
        interval([e.eliminated_share for e in done], seed=seed),
        median(t.error_m for t in truths),
        median(t.error_rad for t in truths),
        median(t.rms for t in truths),
        median(t.rms_aligned for t in truths),
        median(e.seconds for e in done),
    )


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Two methods on the pairs that both measured.

    ``metric``: what is compared. ``ratio``: median over pairs of the second's by the first's, with its interval; None
    where the first one's is 0 in all. ``p``: probability of such differences if neither were better (Wilcoxon's
    signed-rank test; for right merges the exact sign test over the pairs in which they differ); None without pairs.
    """

    metric: str
    first: str
    second: str
    n: int
    ratio: Interval | None
    p: float | None


def paired(evaluations: Sequence[Evaluation], first: str, second: str, seed: int = SEED) -> tuple[PairedTest, ...]:
    """Two methods compared pair by pair: rms, rms after alignment, error of T12 [m], and how many merges are right."""
    found = by_method(evaluations)
    one, two = ({e.maps: e for e in found.get(name, ()) if e.truth is not None} for name in (first, second))
    both = [(one[maps], two[maps]) for maps in one if maps in two]
    tests = []
    for metric in ("rms", "rms_aligned", "error_m"):
        values = [(getattr(a.truth, metric), getattr(b.truth, metric)) for a, b in both]
        known = np.array([v for v in values if None not in v], dtype=float).reshape(-1, 2)
        positive = known[known[:, 0] > 0]
        ratio = interval((positive[:, 1] / positive[:, 0]).tolist(), np.median, seed)
        tests.append(PairedTest(metric, first, second, len(known), ratio, _signed_rank(known[:, 1] - known[:, 0])))
    right = [(_merged_rightly(a), _merged_rightly(b)) for a, b in both]
    wins, losses = sum(b and not a for a, b in right), sum(a and not b for a, b in right)
    p = float(binomtest(wins, wins + losses).pvalue) if wins + losses else None
    tests.append(PairedTest("merged rightly", first, second, len(right), None, p))
    return tuple(tests)


def _merged_rightly(e: Evaluation) -> bool:
    return e.decision == "merged" and not e.merged_wrongly


def _signed_rank(differences: Array) -> float | None:
    if not np.any(differences):
        return None
    return float(wilcoxon(differences).pvalue)
