"""Merges and covariances on simulated pairs of maps with known truth, in blocks of 200 pairs.

    .venv/bin/python benchmarks/consistency.py --blocks 5 --jobs 2 --write

Pairs of one irregular floor (8 or more common landmarks) and pairs of different floors, associations not given. NEES:
of T12 (3 degrees of freedom) and of one landmark a pair, drawn by the pair's seed (2); each with the 95 % band of the
block's mean. Seeds are `TEST_SEEDS`; ``--tuning`` takes `TUNING_SEEDS` instead. ``--write`` keeps the table in
``benchmarks/results/consistency.md``.
"""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS, simulated_pair
from mapfuse.fusion import fuse
from mapfuse.fusion.score import PairScore, score_pair

BLOCK = 200
HERE = Path(__file__).resolve().parent


def same_floor(job: tuple[int, str]) -> tuple[PairScore, float]:
    """Score of a pair of one floor, and the NEES of one of its landmarks (NaN where nothing was merged)."""
    seed, kind = job
    map1, map2, truth = simulated_pair(seed, kind)
    score = score_pair(fuse([map1, map2]), truth)
    nees = score.nees_landmarks
    return score, float(np.random.default_rng(seed).choice(nees)) if len(nees) else float("nan")


def different_floors(job: tuple[int, str]) -> str:
    """Decision on a pair of different floors."""
    seed, kind = job
    return fuse(simulated_pair(seed, kind, same=False)[:2]).decision


def with_band(values: Sequence[float], dof: int) -> str:
    """Mean and the 95 % band of the mean of that many chi-square values."""
    half = 1.96 * np.sqrt(2 * dof / len(values))
    return f"{np.mean(values):.2f} ({dof - half:.2f} to {dof + half:.2f})"


def row(name: str, scored: Sequence[tuple[PairScore, float]], decisions: Sequence[str]) -> str:
    """One line of the table."""
    merged = [(score, nees) for score, nees in scored if score.decision == "merged"]
    wrong = sum(score.merged_wrongly for score, _ in merged)
    right, reported = (sum(getattr(s, which) for s, _ in merged) for which in ("right", "reported"))
    return " | ".join(
        [
            f"| {name}",
            f"{len(merged)} of {len(scored)}",
            f"{wrong}",
            f"{right} of {reported}",
            with_band([score.nees_T12 for score, _ in merged], 3),
            with_band([nees for _, nees in merged], 2),
            f"{sum(decision == 'merged' for decision in decisions)} of {len(decisions)} |",
        ]
    )


def main() -> None:
    """Run the blocks and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first block")
    parser.add_argument("--kind", default="irregular", choices=["irregular", "oblique", "alike", "symmetric"])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    seeds = TUNING_SEEDS if args.tuning else TEST_SEEDS
    lines = [
        "| pairs | merged | wrongly | correspondences right | NEES of T12 | NEES of a landmark | different merged |",
        "|---|---|---|---|---|---|---|",
    ]
    everything: list[tuple[PairScore, float]] = []
    refused: list[str] = []
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # one thread a process; workers load numpy anew
        os.environ.setdefault(variable, "1")
    with get_context("spawn").Pool(args.jobs) as pool:
        for block in range(args.first, args.first + args.blocks):
            jobs = [(seed, args.kind) for seed in seeds[block * BLOCK : (block + 1) * BLOCK]]
            scored = pool.map(same_floor, jobs, chunksize=4)
            decisions = pool.map(different_floors, jobs, chunksize=4)
            lines.append(row(f"seeds {jobs[0][0]} to {jobs[-1][0]}", scored, decisions))
            print(lines[-1], flush=True)
            everything += scored
            refused += decisions
    lines.append(row("all", everything, refused))
    which = "tuning" if args.tuning else "test"
    about = f"{args.kind} floors, {which} seeds; {platform.machine()}, Python {platform.python_version()}"
    text = "\n".join([f"{about}, {datetime.now(UTC):%Y-%m-%d}", "", *lines, ""])
    print(text)
    if args.write:
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / f"consistency-{args.kind}.md").write_text(text)


if __name__ == "__main__":
    main()
