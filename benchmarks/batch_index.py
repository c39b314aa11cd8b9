"""What the index of a folder proposes in a simulated city: share of pairs tried, true ones missed, time per map.

    .venv/bin/python benchmarks/batch_index.py [--buildings 100] [--maps 10] [--seed 1000001] [--write]

Quick form: ``--buildings 20``. True pairs are those of one building that share so many true places. The constants of
`mapfuse.matching.index` were set on seed 1; the table is of another.
"""

from __future__ import annotations

import argparse
import platform
import resource
import time
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path

from city import city

from mapfuse.matching.index import MapIndex

TUNING_SEED, TEST_SEED = 1, 1_000_001
BANDS = ((0, 4), (5, 7), (8, 10), (11, 10_000))
HERE = Path(__file__).resolve().parent


def measure(seed: int, buildings: int, maps_each: int) -> str:
    """One row of the table."""
    index, by_name = MapIndex(), {}
    adding = 0.0
    for found in city(seed, buildings, maps_each):
        begin = time.process_time()
        index.add(found.map)
        adding += time.process_time() - begin
        by_name[found.map.name] = (found.building, found.places)
    begin = time.process_time()
    proposed = {(p.map1, p.map2) for p in index.pairs()}
    seconds = adding + time.process_time() - begin
    n = len(by_name)
    missed = {band: [0, 0] for band in BANDS}
    for first in range(0, n, maps_each):
        names = sorted(by_name)[first : first + maps_each]
        for a, b in combinations(names, 2):
            common = len(by_name[a][1] & by_name[b][1])
            count = next(missed[band] for band in BANDS if band[0] <= common <= band[1])
            count[0] += (a, b) not in proposed
            count[1] += 1
    cells = " | ".join(f"{lost} of {every}" for lost, every in missed.values())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    share = 100 * len(proposed) / (n * (n - 1) / 2)
    return f"| {n} | {buildings} | {share:.2f} % | {cells} | {1e3 * seconds / n:.0f} | {memory:.0f} |"


def main() -> None:
    """Print the table, and keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--buildings", type=int, nargs="+", default=[100])
    parser.add_argument("--maps", type=int, default=10)
    parser.add_argument("--seed", type=int, default=TEST_SEED)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    about = f"Simulated city of irregular floors, seed {args.seed}; {platform.machine()}"
    lines = [
        "# The index of a folder",
        "",
        f"{about}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}. Missed: pairs of one building",
        "that are not tried, by the number of true places they share.",
        "",
        "| maps | buildings | pairs tried | missed, 0 to 4 | 5 to 7 | 8 to 10 | 11 and more | ms a map | MB |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for buildings in args.buildings:
        lines.append(measure(args.seed, buildings, args.maps))
        print(lines[-1], flush=True)
    if args.write:
        (HERE / "results" / "batch-index.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
