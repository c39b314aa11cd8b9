"""What a whole fusion of two maps costs once everything is compiled.

Run: ``.venv/bin/python benchmarks/fuse_bench.py [--sizes N ...] [--repeat N] [--quick] [--write]``. Processor time of
one core for ``fuse([map1, map2])`` on simulated floors (`matching_floors`, half of each map shared): of each kind of
floor and each seed the best of N runs, then the mean over these. Maps are new objects in each run, so that nothing is
kept of them; only the kernels are warm. Times are also told in units of the reference workload, and judged so by the
gate (``run.py``): on a busy machine both take longer. The 0.05 s that are aimed at for 20 landmarks are reached on a
quiet machine only, so that the gate judges them by the tolerance against the baseline. ``--quick``: 20 landmarks only,
one run. ``--write`` keeps the table in ``benchmarks/results/fuse-times.md``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # idle threads spin, and count as processor time

import argparse
import datetime
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import reference
from baseline import Metric
from matching_floors import pair_of_maps

from mapfuse.fusion import fuse

#: Landmarks of each map, and the time promised for fusing two [s] on a machine that takes `reference.NOMINAL_MS`.
PROMISED_S = {20: None, 100: 0.3, 300: 1.5}
KINDS = ("irregular", "alike")
#: Tuning seeds.
SEEDS = (500, 501, 502)
RESULTS = Path(__file__).with_name("results") / "fuse-times.md"


@dataclass(frozen=True, slots=True)
class FuseRow:
    """Processor time [s] of fusing two maps, mean and most over floors, and by the reference workload's."""

    landmarks: int
    mean_s: float
    most_s: float
    ratio: float


def seconds(kind: str, landmarks: int, seed: int, repeat: int) -> float:
    """Best processor time [s] of fusing one pair of maps, after a run that isn't counted."""
    pair = pair_of_maps(landmarks, kind, np.random.default_rng(seed))
    times = []
    for _ in range(repeat + 1):
        maps = [replace(pair.map1), replace(pair.map2)]
        begin = time.process_time()
        fuse(maps)
        times.append(time.process_time() - begin)
    return min(times[1:])


def rows(sizes: Sequence[int], repeat: int) -> list[FuseRow]:
    """Every size, the reference before and after."""
    found = []
    for landmarks in sizes:
        before = reference.processor_seconds(3 * repeat)
        times = [seconds(kind, landmarks, seed, repeat) for kind in KINDS for seed in SEEDS]
        unit = min(before, reference.processor_seconds(3 * repeat))
        mean = sum(times) / len(times)
        found.append(FuseRow(landmarks, mean, max(times), mean / unit))
    return found


def metrics(repeat: int) -> list[Metric]:
    """Times of every size, within what was promised."""
    found = []
    for row in rows(list(PROMISED_S), repeat):
        name = f"fuse, two maps of {row.landmarks}"
        promised = PROMISED_S[row.landmarks]
        limit = None if promised is None else promised * 1e3 / reference.NOMINAL_MS
        found += [
            Metric(f"{name}: processor", row.mean_s * 1e3, "ms", tolerance=None),
            Metric(f"{name}: processor / reference", row.ratio, "x", tolerance=0.5, limit=limit),
        ]
    return found


def table(found: Sequence[FuseRow]) -> str:
    """The rows as Markdown."""
    lines = ["| landmarks a map | mean | most | by the reference | promised |", "|---:|---:|---:|---:|---:|"]
    for row in found:
        promised = PROMISED_S.get(row.landmarks)
        most = "" if promised is None else f"{promised:g} s"
        lines.append(f"| {row.landmarks} | {row.mean_s:.3f} s | {row.most_s:.3f} s | {row.ratio:.2f} | {most} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(PROMISED_S), metavar="N")
    parser.add_argument("--repeat", type=int, default=5, metavar="N")
    parser.add_argument("--quick", action="store_true", help="20 landmarks only, one run")
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    arguments = parser.parse_args()
    sizes, repeat = ([20], 1) if arguments.quick else (arguments.sizes, arguments.repeat)
    found = table(rows(sizes, repeat))
    print(found)
    if arguments.write:
        machine = f"{os.cpu_count()} cores ({platform.machine()}), {datetime.date.today()}"
        title = f"# Fusing two maps, warm\n\n`benchmarks/fuse_bench.py`, {machine}, kinds {', '.join(KINDS)}"
        RESULTS.write_text(f"{title}, tuning seeds {', '.join(map(str, SEEDS))}, best of {repeat} runs.\n\n{found}\n")


if __name__ == "__main__":
    main()
