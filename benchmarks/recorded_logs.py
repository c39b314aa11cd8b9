"""The mapper on MRCLAM: landmark error of fifteen recorded drives against the survey of the arena.

    .venv/bin/python benchmarks/recorded_logs.py FOLDER [--without-barcodes] [--write]

FOLDER holds ``MRCLAM_Dataset2``, ``4`` and ``6``, not part of the repository. Each robot's map is laid onto the
survey by the rigid motion that fits best; a landmark is the tube that most of its detections were of. The instruments'
parameters and where they come from are in `mapfuse.datasets.mrclam`. ``--write`` keeps the table in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections import Counter
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
ABOUT = """Named by `mapfuse.datasets.mapper.naming.name_detections`, seed {seed}; the mapper alone has a median of
0.692 m and a worst of 2.185 m. How many particles and runs, and when a landmark isn't there, were set with these
drives in view: this is a development figure. In set 6 tubes stand in groups 0.18 m apart. Only the landmarks in a map
count, each as the tube that most of its detections were of."""


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
    named = name_detections(log, seed=seed)
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


def main() -> None:
    """Print the table, and keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--without-barcodes", action="store_true")
    parser.add_argument("--seed", type=int, default=0, help="of the particles, without barcodes")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    barcodes = not arguments.without_barcodes
    rows = []
    for number in SETS:
        for robot in ROBOTS:
            rows.append(measure(arguments.folder, number, robot, barcodes, arguments.seed))
            print(rows[-1], flush=True)
    errors = [row.rms for row in rows]
    which = "with" if barcodes else "without"
    lines = [
        f"# MRCLAM {which} barcodes",
        "",
        f"Rms of a map's landmarks [m]: median {np.median(errors):.3f}, worst {max(errors):.3f} of {len(rows)} drives. "
        f"{platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}.",
        "",
        "| set | robot | landmarks | tubes of 15 | rms [m] | worst [m] | processor [s] |",
        "|---|---|---|---|---|---|---|",
        *(
            f"| {r.number} | {r.robot} | {r.landmarks} | {r.tubes} | {r.rms:.3f} | {r.worst:.2f} | {r.seconds:.1f} |"
            for r in rows
        ),
    ]
    if not barcodes:
        lines += ["", ABOUT.format(seed=arguments.seed)]
    text = "\n".join(lines) + "\n"
    print(text)
    if arguments.write:
        (HERE / "results" / f"mrclam-{which}-barcodes.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
