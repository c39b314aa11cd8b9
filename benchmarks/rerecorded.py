"""Does T12's covariance hold for each pair of drives, or only on average over many? Drives recorded again and again.

    .venv/bin/python benchmarks/rerecorded.py --write
    .venv/bin/python benchmarks/rerecorded.py --quick

A few pairs of simulated drives (`mapfuse.fusion.analysis.Drives`), each recorded many times and fused, associations not
given: mean NEES of T12 of the merged ones with its 95 % band, share of 95 % ellipsoids that hold the truth with its
exact bounds, and by how much errors scatter against what is stated. Seeds are the first of `TEST_SEEDS`; recording k
of a drive has the generator ``[seed, k]``. ``--quick``: two drives, ten recordings. ``--write`` keeps the table in
``benchmarks/results/rerecorded.md``.
"""

from __future__ import annotations

import argparse
import logging
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mapfuse.datasets.simulation import TEST_SEEDS
from mapfuse.fusion.analysis import Drives, Trials, consistency, run_trials

DRIVES, RECORDINGS = 6, 100
HERE = Path(__file__).resolve().parent


def study(seed: int, recordings: int) -> tuple[Drives, Trials]:
    """One pair of drives, recorded and fused that often."""
    drives = Drives.drawn(seed, share=(0.35, 0.45), min_common=8)
    return drives, run_trials(drives.pair(np.random.default_rng([seed, k])) for k in range(recordings))


def row(name: str, common: str, trials: Trials) -> str:
    """One line of the table."""
    found = trials.consistency
    low, high = found.held_band
    return " | ".join(
        [
            f"| {name}",
            common,
            f"{len(trials.merged)} of {len(trials)}",
            f"{trials.merged_wrongly}",
            f"{found.mean:.2f} ({found.band[0]:.2f} to {found.band[1]:.2f})",
            f"{found.held:.1%} ({low:.1%} to {high:.1%})",
            f"{found.scale:.2f} |",
        ]
    )


def main() -> None:
    """Run the drives and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    logging.getLogger("mapfuse").setLevel(logging.ERROR)
    drives, recordings = (2, 10) if args.quick else (DRIVES, RECORDINGS)
    lines = [
        "| drives | places on both routes | merged | wrongly | mean NEES (95 % band) | in the 95 % ellipsoid "
        "| errors / stated |",
        "|" + "---|" * 7,
    ]
    everything: list[Trials] = []
    for seed in TEST_SEEDS[:drives]:
        driven, trials = study(seed, recordings)
        lines.append(row(f"seed {seed}", str(driven.common), trials))
        everything.append(trials)
        print(lines[-1], flush=True)
    together = Trials(tuple(trial for trials in everything for trial in trials.all))
    lines.append(row("all", "", together))
    scatter = consistency(
        np.concatenate([trials.errors - trials.errors.mean(axis=0) for trials in everything]), together.covariances
    )
    about = f"irregular floors, test seeds, simulated; {platform.machine()}, Python {platform.python_version()}"
    note = f"NEES of the errors about the mean error of their own drives: {scatter.mean:.2f}."
    text = "\n".join([f"{about}, {datetime.now(UTC):%Y-%m-%d}", "", *lines, "", note, ""])
    print(text)
    if args.write:
        (HERE / "results" / "rerecorded.md").write_text(text)


if __name__ == "__main__":
    main()
