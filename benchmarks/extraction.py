"""Landmarks out of occupancy grids: halves of one grid fused, and how repeatable extraction is.

    .venv/bin/python benchmarks/extraction.py halves GRID.yaml --first 0 --seeds 20 --write
    .venv/bin/python benchmarks/extraction.py repeatability GRID.yaml --write
    .venv/bin/python benchmarks/extraction.py repeatability GRID.yaml --other GRID2.yaml

``halves`` cuts the grid in two across a random direction (30 % of it in both), turns and shifts each at random,
extracts and fuses. Judged are seeds from 0 on; whatever was tuned was tuned on seeds from `TUNING` on (``--tuning``).
``repeatability`` compares the landmarks of a grid with those of the same grid turned by random angles of tuning seeds,
or with another session's grid in the same frame. Three seeds are the quick form of either.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from time import process_time

import numpy as np

from mapfuse.datasets import LandmarkMap, se2
from mapfuse.datasets.arms import overlay, signature
from mapfuse.datasets.extract import Grid, extract_landmarks, grid_halves, merged_grid, read_grid
from mapfuse.fusion import fuse

TUNING = 1_000_000
Sighting = tuple[str, float, bool, list[float], list[float]]
HERE = Path(__file__).resolve().parent
#: Beyond this [m] two landmarks are not the same one.
REACH = 1.0


def halves_row(grid: Grid, seed: int) -> tuple[str, str, float, float]:
    """One line of the table, the decision, and the errors of T12: mean over map 2's landmarks [m], angle [deg]."""
    grid1, grid2, truth = grid_halves(grid, np.random.default_rng(seed))
    begin = process_time()
    map1, map2 = extract_landmarks(grid1), extract_landmarks(grid2)
    extracted = process_time()
    fused = fuse([map1, map2])
    pair = fused.pairs[0]
    seconds = (extracted - begin) / 2, process_time() - extracted
    metres, degrees = float("nan"), float("nan")
    if pair.T12 is not None:
        found = np.array([pair.T12.x, pair.T12.y, pair.T12.theta])
        off = se2.transform(found, map2.positions) - se2.transform(truth, map2.positions)
        metres = float(np.hypot(off[:, 0], off[:, 1]).mean())
        degrees = float(np.rad2deg(abs(se2.wrap(found[2] - truth[2]))))
    text = (
        f"| {seed} | {len(map1)}, {len(map2)} | {fused.decision} | {pair.probability:.4f} "
        f"| {len(pair.correspondences)} | {metres:.3f} | {degrees:.2f} | {seconds[0]:.1f} | {seconds[1]:.1f} |"
    )
    return text, fused.decision, metres, degrees


def halves(grid: Grid, first: int, count: int) -> list[str]:
    """The table of that many cuts."""
    lines = [
        "| seed | landmarks | decision | probability | common | mean error [m] | [deg] | extraction [CPU s] | fusion |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = []
    for seed in range(first, first + count):
        rows.append(halves_row(grid, seed))
        print(rows[-1][0], flush=True)
    merged = [row for row in rows if row[1] == "merged"]
    wrong = [row for row in merged if row[2] >= 0.3 or row[3] >= 1.0]
    metres, degrees = (max((row[k] for row in merged), default=0.0) for k in (2, 3))
    worst = f"{metres:.3f} m and {degrees:.2f} deg"
    verdict = f"{len(merged)} of {count} merged, {len(wrong)} of them off by 0.3 m or 1 degree; worst {worst}"
    return [*lines, *(row[0] for row in rows), "", verdict]


def sightings(map1: LandmarkMap, map2: LandmarkMap, T12: np.ndarray) -> Iterator[Sighting]:
    """Of each landmark of map 1: type, existence, whether map 2 has it, how far off [m per axis], arms' turn [rad]."""
    at2 = se2.transform(T12, map2.positions)
    for k, landmark in enumerate(map1.landmarks):
        alike = [j for j in range(len(map2)) if map2.types[j] == landmark.type]
        apart = [float(np.hypot(*(map1.positions[k] - at2[j]))) for j in alike]
        if not apart or min(apart) > REACH:
            yield landmark.type, landmark.existence or 1.0, False, [], []
            continue
        j = alike[int(np.argmin(apart))]
        arms1, arms2 = signature(landmark), signature(map2.landmarks[j])
        turned = [
            float(se2.wrap(arms2.headings[b] + T12[2] - arms1.headings[a]))
            for a, b in overlay(arms1, arms2, float(T12[2])).pairs
            if arms1.passable[a] == arms2.passable[b]
        ]
        yield landmark.type, landmark.existence or 1.0, True, (map1.positions[k] - at2[j]).tolist(), turned


def repeatability(grid: Grid, other: Grid | None, count: int) -> list[str]:
    """The table of what is found again."""
    map1 = extract_landmarks(grid)
    found = []
    if other is not None:
        map2, same = extract_landmarks(other), np.zeros(3)
        found = [*sightings(map1, map2, same), *sightings(map2, map1, same)]
    for seed in range(TUNING, TUNING + (count if other is None else 0)):
        turn = np.array([0.0, 0.0, np.random.default_rng(seed).uniform(-np.pi, np.pi)])
        map2 = extract_landmarks(merged_grid([grid], [turn]))
        found += [*sightings(map1, map2, se2.inverse(turn)), *sightings(map2, map1, turn)]
    lines = [
        "| landmarks | count | found again | sigma per axis [m] | sigma of an arm [rad] |",
        "|---|---|---|---|---|",
    ]
    low = [0.0, 0.6, 0.75, 0.9, 1.01]
    groups = [(t, [f for f in found if f[0] == t]) for t in ("corner", "junction", "door")]
    shares = [(f"existence {a} to {min(b, 1.0)}", [f for f in found if a <= f[1] < b]) for a, b in pairwise(low)]
    for name, ours in [*groups, *shares, ("all", found)]:
        off = np.array([x for f in ours for x in f[3]])
        turned = np.array([x for f in ours for x in f[4]])
        if len(off) and len(turned):
            # two maps' errors are compared, each with half of the variance
            spread = [float(np.sqrt(np.mean(values**2) / 2)) for values in (off, turned)]
            again = np.mean([f[2] for f in ours])
            lines.append(f"| {name} | {len(ours)} | {100 * again:.0f} % | {spread[0]:.3f} | {spread[1]:.3f} |")
    return lines


def main() -> None:
    """Run one of the two and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["halves", "repeatability"])
    parser.add_argument("grid", type=Path)
    parser.add_argument("--other", type=Path, help="another session's grid, in the same frame")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    grid = read_grid(args.grid).grid
    if args.what == "halves":
        table = halves(grid, args.first + (TUNING if args.tuning else 0), args.seeds)
    else:
        table = repeatability(grid, None if args.other is None else read_grid(args.other).grid, args.seeds)
    where = f"{platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    compared = "" if args.other is None else f" against {args.other.stem}"
    text = "\n".join([f"{args.what}: {args.grid.stem}{compared}; {where}", "", *table, ""])
    print(text)
    if args.write:
        name = f"extraction-{args.what}{'-sessions' if args.other else ''}.md"
        (HERE / "results" / name).write_text(text)


if __name__ == "__main__":
    main()
