"""How often the matcher has the truth in its list, and first: on simulated floors with known truth; prints a table.

    .venv/bin/python benchmarks/matching_accuracy.py [--quick] [--tuning] [--write] [--ablation]

Each row is many pairs of maps (`matching_floors`). Right: within 1 m and 5 degrees of the truth, taken at the middle of
the common landmarks. Where maps are bent by drift no single T12 is true: right is a hypothesis with 8 or more true
matches that are more than half of all it has. Seeds are `TEST_SEEDS`; ``--tuning`` takes `TUNING_SEEDS`.
``--write`` keeps the table in ``benchmarks/results/``. ``--ablation``: what each part of the matcher buys.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from matching_floors import FloorPair, Kind, pair_of_maps

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS
from mapfuse.matching import Hypothesis, MatchingConfig, propose
from mapfuse.matching.voting import SETTINGS, Settings, propose_by_votes

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
    T12, middle = hypothesis.T12.array, pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a twentieth of the pairs")
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    seed = (TUNING_SEEDS if arguments.tuning else TEST_SEEDS)[50_000]
    lines = (ablation if arguments.ablation else accuracy)(seed, arguments.quick)
    which = "tuning" if arguments.tuning else "test"
    about = (
        f"Simulated floors, {which} seeds from {seed}; {platform.machine()}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    )
    print(about)
    if arguments.write:
        name = "matching-ablation.md" if arguments.ablation else "matching-accuracy.md"
        (HERE / "results" / name).write_text("\n".join([about, "", *lines, ""]))


if __name__ == "__main__":
    main()
