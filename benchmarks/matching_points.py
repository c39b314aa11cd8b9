"""Times and accuracy of the search among landmarks without heading, beside other matchers; prints a table.

Run: ``python benchmarks/matching_points.py [--quick] [--pairs N] [--alone] [--json FILE]``. Simulated maps are made
from test seeds, which no parameter was set on; Halmstad's corners are a development figure: noise and bend were set
with the answer in view. Right: mean displacement of the common landmarks below 1 m, three standard deviations or two
of the bend's (simulated), below 5 % of the map's diagonal (Halmstad). Times are of one call, maps' own arrays made
before, kernels compiled: process time of ours, wall time of the others.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import baselines
import numpy as np
import point_maps
from point_maps import PointPair

from mapfuse.datasets.simulation.pairs import TEST_SEEDS
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.point_pairs import match_point_pairs

#: Landmarks, overlap, noise per axis and map [m], labels, bend [m], pairs.
JOBS = (
    (20, 0.5, 0.1, 1, 0.0, 100),
    (100, 0.5, 0.1, 1, 0.0, 100),
    (100, 0.35, 0.3, 1, 0.0, 100),
    (100, 0.35, 0.5, 1, 0.0, 100),
    (100, 0.35, 0.5, 4, 0.0, 100),
    (100, 0.5, 0.2, 1, 1.0, 100),
    (1000, 0.35, 0.1, 1, 0.0, 20),
    (1000, 0.35, 0.5, 1, 0.0, 20),
    (1000, 0.35, 0.5, 4, 0.0, 20),
    (10000, 0.35, 0.3, 1, 0.0, 2),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One matcher on one job: how many are right first and right anywhere in the list, and times [ms]."""

    job: str
    matcher: str
    pairs: int
    first: int
    listed: int
    median_ms: float
    worst_ms: float


def measured(
    job: str, pairs: list[PointPair], config: MatchingConfig, is_right: Callable[[PointPair, object], bool]
) -> Row:
    """Our matcher on all pairs."""
    first = listed = 0
    times = []
    match_point_pairs(pairs[0].map1, pairs[0].map2, config)
    for pair in pairs:
        point_arrays_of(pair)
        begin = time.process_time()
        found = match_point_pairs(pair.map1, pair.map2, config)
        times.append(time.process_time() - begin)
        right = [is_right(pair, hypothesis.T12.array) for hypothesis in found]
        first += bool(right and right[0])
        listed += any(right)
    return Row(job, "mapfuse", len(pairs), first, listed, *_milliseconds(times))


def compared(
    job: str, pairs: list[PointPair], sigma: float, is_right: Callable[[PointPair, object], bool]
) -> list[Row]:
    """The other matchers on the same pairs; each that is missing says why."""
    out = []
    for other in baselines.baselines():
        if other.missing or other.name == "paper mode":  # that needs headings
            if other.missing:
                print(f"{other.name}: {other.missing}")
            continue
        answers = [other.run(pair.map1, pair.map2, max(1.0, 3 * sigma)) for pair in pairs]
        right = sum(a.T12 is not None and is_right(p, a.T12) for p, a in zip(pairs, answers, strict=True))
        out.append(Row(job, other.name, len(pairs), right, right, *_milliseconds([a.seconds for a in answers])))
    return out


def point_arrays_of(pair: PointPair) -> None:
    """Work out what is kept with each map."""
    from mapfuse.matching.landmark_arrays import landmark_arrays
    from mapfuse.matching.point_arrays import point_arrays

    for recorded in (pair.map1, pair.map2):
        point_arrays(landmark_arrays(recorded))


def _milliseconds(seconds: list[float]) -> tuple[float, float]:
    return round(1e3 * float(np.median(seconds)), 1), round(1e3 * max(seconds), 1)


def rows(quick: bool, most: int, others: bool) -> list[Row]:
    """All jobs."""
    out = []
    for n, overlap, sigma, labels, bend, wanted in JOBS:
        if quick and n > 1000:
            continue
        count = min(wanted, most, 4 if quick else wanted)
        pairs = [
            point_maps.simulated_points(TEST_SEEDS.start + s, n, overlap, sigma, labels, bend) for s in range(count)
        ]
        job = f"{n} points, overlap {overlap:.0%}, {sigma} m, {labels} labels" + (f", bend {bend} m" if bend else "")
        limit = max(1.0, 3 * sigma, 2 * bend)
        out.append(measured(job, pairs, MatchingConfig(), lambda p, T: p.off(T) < limit))  # noqa: B023
        show(out[-1])
        if others:
            for row in compared(job, pairs, sigma, lambda p, T: p.off(T) < limit):  # noqa: B023
                out.append(row)
                show(row)
    if point_maps.HALMSTAD.is_dir():
        pairs = point_maps.halmstad_pairs()
        right = lambda p, T: p.off(T) < 0.05 * point_maps.diagonal(p.map2)  # noqa: E731
        out.append(measured("Halmstad E5 corners (development)", pairs, point_maps.HALMSTAD_CONFIG, right))
        show(out[-1])
    else:
        print("Halmstad E5: the recordings aren't here")
    return out


def show(row: Row) -> None:
    """One line of the table."""
    print(
        f"| {row.job} | {row.matcher} | {row.first}/{row.pairs} | {row.listed}/{row.pairs} "
        f"| {row.median_ms} | {row.worst_ms} |",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="four pairs of each, none of 10,000")
    parser.add_argument("--pairs", type=int, default=1000, help="at most so many of each")
    parser.add_argument("--alone", action="store_true", help="without the other matchers")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print("| job | matcher | first | in the list | median ms | worst ms |\n|---|---|---|---|---|---|")
    table = rows(arguments.quick, arguments.pairs, not arguments.alone)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in table], indent=1) + "\n")


if __name__ == "__main__":
    main()
