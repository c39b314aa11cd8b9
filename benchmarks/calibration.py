"""Is the probability true? Thousands of simulated pairs with known truth: reliability, ROC, risk and coverage.

    .venv/bin/python benchmarks/calibration.py --pairs 300 --jobs 2 --write

Pairs of the classes in `calibration_pairs`, ``--pairs`` of each. Seeds are `TEST_SEEDS`, on which nothing was tuned,
from ``--first`` on; ``--tuning`` takes `TUNING_SEEDS` instead. ``--noise`` fuses with `estimate_noise`. ``--write``
keeps the tables in ``benchmarks/results/calibration.md`` and the figures in ``docs/images/calibration.png``, or, with
a name, the tables in a file of that name alone; ``--classes`` picks some classes. Everything is simulated from the
measurement model that the estimator assumes.
"""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from calibration_pairs import CLASSES, Outcome, run_pair

from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS
from mapfuse.fusion import FuseConfig
from mapfuse.fusion.config import SolvingConfig

HERE = Path(__file__).resolve().parent
#: Seeds of one class are this far from those of the next.
APART = 10_000
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.997, 0.9995, 1.0)
Array = np.ndarray


def share(part: Sequence[bool]) -> str:
    """How many of them, with the 95 % bound above where there are few."""
    hits, n = int(sum(part)), len(part)
    return f"{hits} of {n}" if n else "-"


def upper(hits: int, n: int) -> float:
    """Upper end of the 95 % interval of a rate (Clopper and Pearson 1934), one-sided."""
    from scipy.stats import beta

    return float(beta.ppf(0.95, hits + 1, n - hits)) if hits < n else 1.0


def with_band(values: Sequence[float], dof: int) -> str:
    """Mean and the 95 % band of the mean of that many chi-square values."""
    if not len(values):
        return "-"
    half = 1.96 * np.sqrt(2 * dof / len(values))
    return f"{np.mean(values):.2f} ({dof - half:.2f} to {dof + half:.2f})"


def class_table(outcomes: Sequence[Outcome]) -> list[str]:
    """One line a class: what was decided, and whether the covariances hold."""
    lines = [
        "| class | pairs | merged | wrongly | ambiguous | no overlap | truth first | truth listed | NEES of T12 "
        "| NEES of a landmark | in 95 % ellipse | s a pair |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, pair_class in CLASSES.items():
        of_class = [o for o in outcomes if o.pair_class == name]
        if not of_class:
            continue
        merged = [o for o in of_class if o.decision == "merged"]
        right = [o for o in merged if not o.wrong]
        inside, landmarks = np.sum([o.ellipse for o in right], axis=0) if right else (0, 0)
        lines.append(
            f"| {name} | {len(of_class)} | {len(merged)} | {sum(o.wrong for o in merged)} "
            + "".join(f"| {sum(o.decision == other for o in of_class)} " for other in ("ambiguous", "no_overlap"))
            + (f"| {sum(bool(o.right) for o in of_class)} | {sum(bool(o.listed) for o in of_class)} " if pair_class.same
               else "| - | - ")
            + f"| {with_band([o.nees_T12 for o in right], 3)} | {with_band([o.nees_landmark for o in right], 2)} "
            + (f"| {inside / landmarks:.3f} " if landmarks else "| - ")
            + f"| {np.mean([o.seconds for o in of_class]):.3f} |"
        )  # fmt: skip
    return lines


def reliability(probability: Array, right: Array) -> list[str]:
    """How often the first hypothesis is right, by its probability."""
    lines = ["| probability | pairs | mean | right |", "|---|---|---|---|"]
    for low, high in pairwise(BINS):
        inside = (probability >= low) & ((probability < high) | (high == 1.0))
        if inside.any():
            mean, found = probability[inside].mean(), right[inside].mean()
            lines.append(f"| {low:g} to {high:g} | {inside.sum()} | {mean:.4f} | {found:.4f} |")
    return lines


def calibration_error(probability: Array, right: Array) -> float:
    """Expected calibration error over ten equal bins (Naeini et al. 2015)."""
    bins = np.minimum((probability * 10).astype(int), 9)
    gaps = [abs(probability[bins == b].mean() - right[bins == b].mean()) * (bins == b).mean() for b in np.unique(bins)]
    return float(np.sum(gaps))


def by_count(outcomes: Sequence[Outcome]) -> tuple[Array, Array]:
    """What paper mode says: the margin of its count as a probability, fitted to these very pairs, and whether it is
    right. Being fitted in hindsight it is the best that a margin can do."""
    margin = np.array([o.count_margin for o in outcomes])
    right = np.array([bool(o.paper_right) for o in outcomes])
    fitted = np.zeros(len(margin))
    for value in np.unique(margin):
        fitted[margin == value] = right[margin == value].mean()
    return fitted, right


def _well_stated(outcome: Outcome) -> bool:
    """Whether the maps state their noise as it was simulated."""
    return CLASSES[outcome.pair_class].stated == 1.0


def _percent(part: int, whole: int, digits: int) -> str:
    return f"{part / whole:.{digits}%}" if whole else "-"


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """The figures that are asked for."""
    right = np.array([bool(o.right) for o in outcomes])
    probability = np.array([o.probability for o in outcomes])
    raw = 1 / (1 + np.exp(-np.clip([o.raw for o in outcomes], -500, 500)))
    merged = [o for o in outcomes if o.decision == "merged"]
    different = [o for o in outcomes if not CLASSES[o.pair_class].same]
    symmetric = [o for o in outcomes if CLASSES[o.pair_class].symmetric and CLASSES[o.pair_class].same]
    plain = [o for o in outcomes if CLASSES[o.pair_class].same and not CLASSES[o.pair_class].symmetric]
    many, few = [o for o in plain if o.common >= 8], [o for o in plain if 5 <= o.common <= 7]
    blind, seeing = ([o for o in symmetric if CLASSES[o.pair_class].compass is c] for c in (False, True))
    wrong = sum(o.wrong for o in merged)
    apart = sum(o.wrong for o in different)
    fitted, paper_right = by_count(outcomes)
    existence = [e for o in merged if not o.wrong for e in o.existence]
    false = [p < 0.5 for p, there, refutable in existence if refutable and not there]
    true = [p < 0.5 for p, there, _ in existence if there]
    stated = [o.ellipse for o in merged if not o.wrong and _well_stated(o)]
    inside, landmarks = (sum(counts[k] for counts in stated) for k in (0, 1))

    def accepted(of: Sequence[Outcome]) -> str:
        return share([o.decision == "merged" for o in of])

    return [
        f"- merges that are wrong: {wrong} of {len(merged)} ({_percent(wrong, len(merged), 4)}; at most "
        f"{upper(wrong, len(merged)):.2%} with 95 % confidence)",
        f"- pairs of different floors that were merged: {apart} of {len(different)} "
        f"({_percent(apart, len(different), 3)}; at most {upper(apart, len(different)):.2%})",
        f"- accepted on floors that are not symmetric: with 8 or more common landmarks {accepted(many)}, "
        f"{accepted([o for o in many if _well_stated(o)])} where the noise is as stated; with 5 to 7 {accepted(few)}",
        f"- symmetric floors without compass: merged wrongly {share([o.wrong for o in blind])}, truth listed "
        f"{share([bool(o.listed) for o in blind])}, two placements or more of 1 % or more "
        f"{share([o.rivals >= 2 for o in blind])}; with compass merged right "
        f"{share([o.decision == 'merged' and not o.wrong for o in seeing])}",
        f"- expected calibration error {calibration_error(probability, right):.4f}; Brier score "
        f"{np.mean((probability - right) ** 2):.4f}, of the evidence of the first alone "
        f"{np.mean((raw - right) ** 2):.4f}, of the margin of paper mode's count, fitted in hindsight, "
        f"{np.mean((fitted - paper_right) ** 2):.4f}",
        f"- 95 % ellipses of landmarks hold {_percent(inside, landmarks, 1)} of {landmarks} where the noise is as "
        "stated",
        f"- existence below 0.5, in right merges: of false landmarks that the other robot passed {share(false)}, of "
        f"true ones {share(true)}",
    ]  # fmt: skip


def existence_table(outcomes: Sequence[Outcome]) -> list[str]:
    """How often a fused landmark is there, by its probability of existence."""
    pairs = [(p, there) for o in outcomes if o.decision == "merged" and not o.wrong for p, there, _ in o.existence]
    if not pairs:
        return []
    probability, there = np.array(pairs, dtype=float).T
    lines = ["| existence | landmarks | mean | there |", "|---|---|---|---|"]
    for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 0.99), (0.99, 1.0)):
        inside = (probability >= low) & ((probability < high) | (high == 1.0))
        if inside.any():
            mean, found = probability[inside].mean(), there[inside].mean()
            lines.append(f"| {low:g} to {high:g} | {inside.sum()} | {mean:.3f} | {found:.3f} |")
    return lines


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Reliability diagram, ROC and risk-coverage curve of ours and of paper mode's margin."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    right = np.array([bool(o.right) for o in outcomes])
    probability = np.array([o.probability for o in outcomes])
    fitted, paper_right = by_count(outcomes)
    fig, (left, middle, last) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    edges = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.99, 1.0])
    place = np.digitize(probability, edges[1:-1])
    bins = np.unique(place)
    mean = [probability[place == b].mean() for b in bins]
    found = np.array([right[place == b].mean() for b in bins])
    error = 1.96 * np.sqrt(np.maximum(found * (1 - found), 0.01) / [np.sum(place == b) for b in bins])
    left.plot([0, 1], [0, 1], color="0.7", lw=1)
    left.errorbar(mean, found, yerr=error, fmt="o", ms=4, capsize=2)
    left.set(xlabel="probability of the first hypothesis", ylabel="how often it is right", title="reliability")
    for label, score, truth in (("mapfuse", probability, right), ("margin of paper mode's count", fitted, paper_right)):
        order = np.argsort(-score, kind="stable")
        hits, misses = np.cumsum(truth[order]), np.cumsum(~truth[order])
        middle.plot(misses / max(misses[-1], 1), hits / max(hits[-1], 1), label=label)
        accepted = np.arange(1, len(order) + 1)
        last.plot(accepted / len(order), misses / accepted, label=label)
    middle.set(xlabel="wrong ones accepted", ylabel="right ones accepted", title="ROC")
    middle.legend(loc="lower right", frameon=False)
    last.axvline((probability >= 0.99).mean(), color="0.7", lw=1)
    last.set(xlabel="share of pairs that are merged", ylabel="share of these that are wrong", title="risk and coverage")
    fig.suptitle(f"{len(outcomes)} simulated pairs of {len({o.pair_class for o in outcomes})} classes")
    fig.savefig(path, dpi=110)


def report(outcomes: Sequence[Outcome], about: str) -> str:
    """All tables."""
    right = np.array([bool(o.right) for o in outcomes])
    probability = np.array([o.probability for o in outcomes])
    sections: list[Callable[[], list[str]]] = [
        lambda: [about],
        lambda: summary(outcomes),
        lambda: class_table(outcomes),
        lambda: reliability(probability, right),
        lambda: existence_table(outcomes),
    ]
    wrong = [f"- {o.pair_class}, seed {o.seed}: {o.probability:.4f}, {o.reason}" for o in outcomes if o.wrong]
    return "\n\n".join("\n".join(section()) for section in [*sections, lambda: ["Merged wrongly:", "", *wrong]]) + "\n"


def main() -> None:
    """Run the pairs, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--first", type=int, default=200_000, help="number of the first seed")
    parser.add_argument("--classes", nargs="*", default=list(CLASSES), metavar="CLASS")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--noise", action="store_true", help="estimate the noise of each map")
    parser.add_argument("--write", nargs="?", const="calibration", metavar="NAME", help="of the file, calibration")
    args = parser.parse_args()
    seeds = TUNING_SEEDS if args.tuning else TEST_SEEDS
    config = FuseConfig(solving=SolvingConfig(estimate_noise=args.noise))
    first = args.first % len(seeds)
    places = [((first + APART * k) % len(seeds), name) for k, name in enumerate(CLASSES) if name in args.classes]
    jobs = [(name, seeds[place + n], config) for n in range(args.pairs) for place, name in places]
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # one thread a process; workers load numpy anew
        os.environ.setdefault(variable, "1")
    outcomes: list[Outcome] = []
    with get_context("spawn").Pool(args.jobs) as pool:
        for outcome in pool.imap(run_pair, jobs, chunksize=4):
            outcomes.append(replace(outcome, reason=outcome.reason if outcome.wrong else ""))
            if len(outcomes) % 200 == 0:
                print(f"{len(outcomes)} of {len(jobs)}", flush=True)
    which = f"{'tuning' if args.tuning else 'test'} seeds, {args.pairs} of each class from {seeds[first]} on"
    noise = ", noise estimated" if args.noise else ""
    machine = f"{platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    text = report(outcomes, f"Simulated pairs, {which}{noise}; {machine}")
    print(text)
    if args.write:
        name = f"{args.write}-noise" if args.noise else args.write
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / f"{name}.md").write_text(text)
        if name == "calibration":
            draw(outcomes, HERE.parent / "docs" / "images" / "calibration.png")


if __name__ == "__main__":
    main()
