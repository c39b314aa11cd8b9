"""How often the matcher has the truth in its list, and first: on simulated floors with known truth; prints a table.

    .venv/bin/python benchmarks/matching_accuracy.py [--quick] [--tuning] [--first N] [--write]
        [--ablation | --baselines [--pairs N]]

Each row is many pairs of maps (`matching_floors`). Right: within 1 m and 5 degrees of the truth, taken at the middle of
the common landmarks. Where maps are bent by drift no single T12 is true: right is a hypothesis with 8 or more true
matches that are more than half of all it has. Seeds are `TEST_SEEDS`; ``--tuning`` takes `TUNING_SEEDS`;
``--first``: from which on, since test seeds are fresh once.
``--write`` keeps the table in ``benchmarks/results/``. ``--ablation``: what each part of the matcher buys.
``--baselines``: other matchers beside ours on the same pairs (`baselines`), how often right and how long.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import baselines
import numpy as np
from matching_bench import prepare
from matching_floors import FloorPair, Kind, pair_of_maps
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS
from mapfuse.matching import Hypothesis, MatchingConfig, propose
from mapfuse.matching.settings import SETTINGS, Settings
from mapfuse.matching.voting import propose_by_votes

HERE = Path(__file__).resolve().parent
Matcher = Callable[[LandmarkMap, LandmarkMap], list[Hypothesis]]


@dataclass(frozen=True, slots=True)
class Case:
    """A row: pairs of maps of one sort, and what was promised of them (shares of pairs)."""

    n: int
    kind: Kind
    overlap: float
    pairs: int
    drift: float = 0.0
    listed: float | None = None
    first: float | None = None

    @property
    def name(self) -> str:
        """In words."""
        bent = f", drift {self.drift:.0%}" if self.drift else ""
        return f"{self.n} landmarks, {self.kind}, overlap {self.overlap:.0%}{bent}"


CASES = (
    Case(20, "irregular", 0.5, 600, listed=0.995, first=0.98),
    Case(20, "oblique", 0.5, 600, listed=0.995, first=0.98),
    Case(20, "alike", 0.5, 600, listed=0.97, first=0.80),
    Case(100, "alike", 0.35, 300, listed=0.99, first=0.97),
    Case(100, "irregular", 0.35, 200),
    Case(100, "oblique", 0.35, 200),
    Case(300, "irregular", 0.5, 100, drift=0.02, listed=0.98),
    Case(300, "alike", 0.5, 100, drift=0.02, listed=0.98),
    Case(1000, "alike", 0.5, 20),
    Case(10_000, "alike", 0.5, 3),
)


def is_right(hypothesis: Hypothesis, pair: FloorPair, drift: float) -> bool:
    """Whether a hypothesis is the truth, see above."""
    if drift:
        true = {(pair.map1.ids[i], pair.map2.ids[j]) for i, j in pair.pairs.tolist()}
        found = len(true & set(hypothesis.correspondences))
        return found >= 8 and 2 * found > hypothesis.count
    return is_near(hypothesis.T12.array, pair)


def is_near(T12: NDArray[np.float64], pair: FloorPair) -> bool:
    """Whether T12 (3,) is within 1 m and 5 degrees of the truth, at the middle of the common landmarks."""
    middle = pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
    off = np.hypot(*(se2.transform(T12, middle) - se2.transform(pair.T12, middle)))
    return bool(off < 1.0 and abs(se2.wrap(T12[2] - pair.T12[2])) < np.deg2rad(5.0))


def counts(case: Case, first_seed: int, pairs: int, matcher: Matcher) -> tuple[int, int, float]:
    """Of so many pairs: truth listed, truth first, and mean number of common landmarks."""
    listed = first = common = 0
    for seed in range(first_seed, first_seed + pairs):
        pair = pair_of_maps(case.n, case.kind, np.random.default_rng(seed), overlap=case.overlap, drift=case.drift)
        right = [is_right(h, pair, case.drift) for h in matcher(pair.map1, pair.map2)]
        listed += any(right)
        first += bool(right and right[0])
        common += len(pair.pairs)
    return listed, first, common / pairs


def interval(k: int, n: int) -> str:
    """A share in percent with its 95 % interval (Wilson)."""
    p, z = k / n, 1.96
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = ((middle + sign * half) / (1 + z * z / n) for sign in (-1, 1))
    return f"{100 * p:.1f} ({100 * low:.1f} to {100 * high:.1f})"


#: What is left out, one at a time.
ABLATION: dict[str, Settings] = {
    "everything": SETTINGS,
    "arms not compared": replace(SETTINGS, arm=0.0, contradiction=0.0),
    "no misses and no void (matches alone)": replace(SETTINGS, against=False),
    "no charge for repetition": replace(SETTINGS, repeats=False),
    "no growth of tolerance with distance": replace(SETTINGS, grow=False),
    "no alignment (candidates as they are)": replace(SETTINGS, looseness=0.0, refine=False),
    "one rotation mode only": replace(SETTINGS, modes=1, direct=0),
}
ABLATION_CASES = (
    Case(20, "alike", 0.5, 100),
    Case(100, "alike", 0.35, 40),
    Case(300, "irregular", 0.5, 12, drift=0.02),
)


def accuracy(first_seed: int, quick: bool) -> list[str]:
    """The table of all cases, as lines."""
    lines = ["| pairs | n | common | in the list, % | asked | first, % | asked |", "|---|---|---|---|---|---|---|"]
    for case in CASES:
        pairs = max(2, case.pairs // 20) if quick else case.pairs
        if quick and case.n > 1000:
            continue
        listed, first, common = counts(case, first_seed, pairs, propose)
        asked = [f"{100 * share:.1f}" if share else "" for share in (case.listed, case.first)]
        shares = [interval(k, pairs) for k in (listed, first)]
        lines.append(f"| {case.name} | {pairs} | {common:.1f} | {shares[0]} | {asked[0]} | {shares[1]} | {asked[1]} |")
        print(lines[-1], flush=True)
    return lines


def ablation(first_seed: int, quick: bool) -> list[str]:
    """The table of what each part buys, as lines: in the list / first of so many pairs."""
    lines = ["| left out | " + " | ".join(case.name for case in ABLATION_CASES) + " |"]
    lines.append("|---|" + "---|" * len(ABLATION_CASES))
    for name, settings in ABLATION.items():
        cells = []
        for case in ABLATION_CASES:
            pairs = max(2, case.pairs // 20) if quick else case.pairs

            def matcher(one: LandmarkMap, two: LandmarkMap, chosen: Settings = settings) -> list[Hypothesis]:
                return propose_by_votes(one, two, MatchingConfig(), settings=chosen)

            listed, first, _ = counts(case, first_seed, pairs, matcher)
            cells.append(f"{listed} / {first} of {pairs}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    return lines


#: For the other matchers; paper mode finishes in the first only.
BASELINE_CASES = (Case(100, "alike", 0.5, 10), Case(1000, "alike", 0.5, 5), Case(10_000, "alike", 0.5, 2))
#: The others' tolerance [m]: what counts as right.
BASELINE_TOLERANCE = 1.0
#: Processor time [s] after which one of the others is ended.
BASELINE_LIMIT_S = 60


@dataclass(frozen=True, slots=True)
class Trial:
    """One matcher on one pair: right or not, processor time of all its threads and wall time [s].

    ``ended``: it had used up its processor time and was ended, so that both are bounds.
    """

    right: bool
    processor: float
    wall: float
    ended: bool = False


def our_trial(pair: FloorPair) -> Trial:
    """Our first hypothesis; what is done once per map isn't timed."""
    prepare(pair.map1)
    prepare(pair.map2)

    def run() -> tuple[list[Hypothesis], float]:
        begin = time.perf_counter()
        return propose(pair.map1, pair.map2), time.perf_counter() - begin

    (found, wall), processor = baselines.best_of_calls(run, lambda answer: answer[1])
    return Trial(bool(found) and is_near(found[0].T12.array, pair), processor, wall)


def baseline_trial(baseline: baselines.Baseline, pair: FloorPair) -> Trial | str:
    """Its one answer, or why it did not try; the descriptor, worked out once per map, isn't timed."""
    described = baselines.descriptors(pair.map1, pair.map2)
    found = baselines.run_within(baseline, pair.map1, pair.map2, BASELINE_TOLERANCE, described, BASELINE_LIMIT_S)
    if found is None:
        return Trial(False, float(BASELINE_LIMIT_S), float(BASELINE_LIMIT_S), ended=True)
    answer, processor = found
    if answer.T12 is None and not answer.seconds:
        return answer.reason
    return Trial(answer.T12 is not None and is_near(answer.T12, pair), processor, answer.seconds)


def baseline_row(case: Case, name: str, trials: Sequence[Trial], ours: Sequence[Trial]) -> str:
    """A line of the table: medians over the pairs, and their ratios to ours."""
    cells = [case.name, name, f"{sum(trial.right for trial in trials)}/{len(trials)}"]
    more = ">" if any(trial.ended for trial in trials) else ""
    for kind in ("processor", "wall"):
        own, reference = (float(np.median([getattr(trial, kind) for trial in some])) for some in (trials, ours))
        cells += [f"{more}{1e3 * own:.1f}", f"{more}{own / reference:.1f}"]
    return "| " + " | ".join(cells) + " |"


def compared(first_seed: int, quick: bool, most: int = 10) -> list[str]:
    """The table of ours and the other matchers on the same pairs, as lines."""
    lines = [
        "| pairs | matcher | right | processor, ms | to ours | wall, ms | to ours |",
        "|---|---|---|---|---|---|---|",
    ]
    known = baselines.baselines()
    for case in BASELINE_CASES[: 1 if quick else None]:
        seeds = range(first_seed, first_seed + min(most, 2 if quick else case.pairs))
        pairs = [pair_of_maps(case.n, case.kind, np.random.default_rng(s), overlap=case.overlap) for s in seeds]
        propose(pairs[0].map1, pairs[0].map2)  # loads the kernels
        ours = [our_trial(pair) for pair in pairs]
        lines.append(baseline_row(case, "mapfuse", ours, ours))
        print(lines[-1], flush=True)
        for baseline in known:
            tried = [baseline.missing or baseline_trial(baseline, pair) for pair in pairs]
            skipped = [trial for trial in tried if isinstance(trial, str)]
            trials = [trial for trial in tried if isinstance(trial, Trial)]
            if skipped:
                lines.append(f"| {case.name} | {baseline.name} | skipped: {skipped[0]} | | | | |")
            else:
                lines.append(baseline_row(case, baseline.name, trials, ours))
            print(lines[-1], flush=True)
    return lines


def baseline_notes() -> str:
    """Versions, and what was measured how."""
    versions = []
    for name, package in (("Open3D", "open3d"), ("KISS-Matcher", "kiss_matcher")):
        try:
            versions.append(f"{name} {version(package)}")
        except PackageNotFoundError:
            versions.append(f"{name} not installed")
    return (
        f"{', '.join(versions)}; OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'not set')}, load of the machine "
        f"{os.getloadavg()[0]:.1f}. Right: the first hypothesis, or the one answer, is within 1 m and 5 degrees. Times "
        f"are medians over the pairs, of each the best of {baselines.CALLS} calls (one, if that takes "
        f"{baselines.LONG_CALL_S:g} s), without what is done once per map (our arrays, the others' descriptors). "
        "Compare processor times (all threads): wall times hold the machine's other work. The others' "
        f"tolerance is {BASELINE_TOLERANCE:g} m and was not tuned, nor were their other settings. Each of them runs "
        f"in a process of its own, which is ended after {BASELINE_LIMIT_S} s of processor time. Their times hold the "
        "search for partners by descriptor (390 numbers a landmark); KISS-Matcher's is ours, by products of matrices."
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a twentieth of the pairs")
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--first", type=int, default=60_000, help="which of the seeds is the first one")
    which_table = parser.add_mutually_exclusive_group()
    which_table.add_argument("--ablation", action="store_true")
    which_table.add_argument("--baselines", action="store_true", help="ours beside the other matchers that are there")
    parser.add_argument("--pairs", type=int, default=10, help="of baselines: at most so many of each sort")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    seed = (TUNING_SEEDS if arguments.tuning else TEST_SEEDS)[arguments.first]
    table, name = accuracy, "matching-accuracy.md"
    if arguments.ablation:
        table, name = ablation, "matching-ablation.md"
    elif arguments.baselines:
        seed += 10_000
        table, name = compared, "matching-baselines.md"
    lines = table(seed, arguments.quick, arguments.pairs) if table is compared else table(seed, arguments.quick)
    which = "tuning" if arguments.tuning else "test"
    about = (
        f"Simulated floors, {which} seeds from {seed}; {platform.machine()}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    )
    if arguments.baselines:
        about += "\n\n" + baseline_notes()
    print(about)
    if arguments.write:
        (HERE / "results" / name).write_text("\n".join([about, "", *lines, ""]))


if __name__ == "__main__":
    main()
