"""Maps merged while they grow: hospital pair, four robots, a symmetric floor, latency, and MRCLAM 6.

    .venv/bin/python benchmarks/online.py hospital [--count 200] [--first 3000000] [--write] [--quick]
    .venv/bin/python benchmarks/online.py four|symmetric|latency|correction|stream [...]
    .venv/bin/python benchmarks/online.py mrclam FOLDER [...]

Simulated but for ``mrclam``; FOLDER holds ``MRCLAM_Dataset6``, not part of the repository. ``--rows FILE`` keeps every
run as a line of JSON and goes on where it stopped. ``--write`` keeps the table in ``benchmarks/results``. What is
measured, and what of it was reached, stands in docs/online.md.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from online_corridor import symmetric, symmetric_table
from online_groups import four, four_table, mrclam, mrclam_table
from online_load import correction, correction_table, latency, latency_picture, latency_table
from online_pairs import hospital, hospital_table
from online_stream import stream, stream_table

HERE = Path(__file__).resolve().parent
#: Seeds that nothing was tuned on.
FIRST_TEST_SEED = 3_000_000

Row = dict[str, Any]


def main() -> None:
    """Measure one thing, print the table, keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=sorted(MEASURED))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--count", type=int)
    parser.add_argument("--first", type=int, default=FIRST_TEST_SEED)
    parser.add_argument("--events", type=int, help="length of the stream; an hour at 1,000 a second is 3600000")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--quick", action="store_true", help="a few runs only")
    arguments = parser.parse_args()
    run, table, usual, few = MEASURED[arguments.what]
    count = arguments.count or (few if arguments.quick else usual)
    rows = _rows(arguments.rows)
    done = {row["seed"] for row in rows}
    for seed in range(arguments.first, arguments.first + count):
        if seed in done:
            continue
        start = time.process_time()
        row = {"seed": seed, **run(seed, arguments)}
        row["seconds"] = time.process_time() - start
        rows.append(row)
        print(json.dumps(row)[:2000], flush=True)
        if arguments.rows is not None:
            with arguments.rows.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    first, last = min(row["seed"] for row in rows), max(row["seed"] for row in rows)
    text = "\n".join(
        [
            *table(rows),
            "",
            f"{len(rows)} runs, seeds {first} to {last}. {platform.machine()}, Python {platform.python_version()}, "
            f"{datetime.now(UTC):%Y-%m-%d}. `benchmarks/online.py {arguments.what}`",
            "",
        ]
    )
    print(text)
    if arguments.write:
        (HERE / "results" / f"online-{arguments.what}.md").write_text(text, encoding="utf-8")
        if arguments.what == "latency":
            latency_picture(rows, HERE.parent / "docs" / "images" / "online-latency.png")


def _rows(path: Path | None) -> list[Row]:
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


Measured = tuple[Callable[[int, argparse.Namespace], Row], Callable[[Sequence[Row]], Iterator[str]], int, int]
MEASURED: dict[str, Measured] = {
    "correction": (correction, correction_table, 1, 1),
    "four": (four, four_table, 100, 2),
    "hospital": (hospital, hospital_table, 200, 3),
    "latency": (latency, latency_table, 1, 1),
    "mrclam": (mrclam, mrclam_table, 3, 1),
    "stream": (stream, stream_table, 1, 1),
    "symmetric": (symmetric, symmetric_table, 40, 3),
}

if __name__ == "__main__":
    main()
