"""The mapper on MRCLAM: landmark error of fifteen recorded drives against the survey of the arena.

    .venv/bin/python benchmarks/recorded_logs.py FOLDER [--without-barcodes] [--seeds 301 302 303] [--quick] [--write]

FOLDER holds ``MRCLAM_Dataset2``, ``4`` and ``6``, not part of the repository. Each robot's map is laid onto the
survey by the rigid motion that fits best; a landmark is the tube that most of its detections were of. ``--quick`` takes
one drive of each set and writes nothing. The instruments'
parameters and where they come from are in `mapfuse.datasets.mrclam`. ``--write`` keeps the table in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.mapper import Mapper
from mapfuse.datasets.mapper.naming import name_detections
from mapfuse.datasets.mrclam import ROBOTS, read_mrclam_log, read_mrclam_truth

SETS = (2, 4, 6)
HERE = Path(__file__).resolve().parent
ABOUT = """Named by `mapfuse.datasets.mapper.naming.name_detections`, as it is without any setting; {count} seeds of the
particles. The mapper alone has a median of 0.692 m and a worst of 2.185 m. But how the
names are found, how many particles and filters, and when a landmark isn't there, was developed with these drives in
view: this is a development figure. In set 6 tubes stand in groups 0.18 m apart. Only the landmarks in a map count, each
as the tube that most of its detections were of."""


@dataclass(frozen=True, slots=True)
class Row:
    """One robot: landmarks in its map, tubes among them, rms and largest distance [m], processor time [s]."""

    number: int
    robot: int
    landmarks: int
    tubes: int
    rms: float
    worst: float
    seconds: float


def measure(folder: Path, number: int, robot: int, barcodes: bool, seed: int) -> Row:
    """Map one log and compare."""
    home = folder / f"MRCLAM_Dataset{number}"
    log, truth = read_mrclam_log(home, robot, barcodes=barcodes), read_mrclam_truth(home, robot)
    begin = time.process_time()
    named = name_detections(log, seed=seed)  # leaves those with barcodes as they are
    mapper, log = Mapper(log.header), named.log
    for event in log.events:
        mapper.update(event)
    map_, sources = mapper.map(), mapper.sources
    seconds = time.process_time() - begin
    tubes = [
        Counter(truth.detections[named.numbers[k]] for k in sources[l.id]).most_common(1)[0][0] for l in map_.landmarks
    ]
    surveyed = np.array([truth.places[tube or ""] for tube in tubes])
    apart = np.hypot(*se2.align(surveyed, map_.positions).residuals.T)
    rms, worst = float(np.sqrt(np.mean(apart**2))), float(apart.max())
    return Row(number, robot, len(tubes), len(set(tubes)), rms, worst, seconds)


def table(rows: Sequence[Row], which: str, count: int) -> str:
    """What was measured, drive by drive; with several seeds the rms of each."""
    errors = np.array([row.rms for row in rows]).reshape(-1, count)
    each = [f"{np.median(of_seed):.3f} and {of_seed.max():.3f}" for of_seed in errors.T]
    lines = [
        f"# MRCLAM {which} barcodes",
        "",
        f"Rms of a map's landmarks [m]: median {np.median(errors):.3f}, worst {errors.max():.3f}, {len(errors)} drives"
        + (f", {count} seeds each (seed by seed {'; '.join(each)})" if count > 1 else "")
        + f". {platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}.",
        "",
        "| set | robot | landmarks | tubes of 15 | rms [m] | worst [m] | processor [s] |",
        "|---|---|---|---|---|---|---|",
    ]
    for k in range(0, len(rows), count):
        of_drive = rows[k : k + count]
        cells = [
            ", ".join(str(row.landmarks) for row in of_drive),
            ", ".join(str(row.tubes) for row in of_drive),
            ", ".join(f"{row.rms:.3f}" for row in of_drive),
            f"{max(row.worst for row in of_drive):.2f}",
            f"{np.mean([row.seconds for row in of_drive]):.1f}",
        ]
        lines.append(f"| {rows[k].number} | {rows[k].robot} | {' | '.join(cells)} |")
    if which == "without":
        lines += ["", ABOUT.format(count=count)]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the table, and keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--without-barcodes", action="store_true")
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302, 303], help="of particles, without barcodes")
    parser.add_argument("--quick", action="store_true", help="one drive of each set, one seed")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    barcodes = not arguments.without_barcodes
    seeds = arguments.seeds[:1] if barcodes or arguments.quick else arguments.seeds
    rows = []
    for number in SETS:
        for robot in ROBOTS[:1] if arguments.quick else ROBOTS:
            for seed in seeds:
                rows.append(measure(arguments.folder, number, robot, barcodes, seed))
                print(rows[-1], flush=True)
    which = "with" if barcodes else "without"
    text = table(rows, which, len(seeds))
    print(text)
    if arguments.write and not arguments.quick:
        (HERE / "results" / f"mrclam-{which}-barcodes.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
