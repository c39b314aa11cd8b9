"""What the engine costs: pairs per second with one worker and with two, and the client's share of the work.

    .venv/bin/python benchmarks/batch_engine.py [--maps 12] [--write]

A simulated city's pairs, compared once by each number of workers, on an otherwise idle machine. The overhead is the
client's processor time, which reads maps, hands out jobs and commits answers, against the seconds of its workers.
"""

from __future__ import annotations

import argparse
import platform
import time
from contextlib import closing
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

from city import city

from mapfuse.fusion.batch.engine import Job, LocalEngine
from mapfuse.fusion.batch.ledger import Ledger, key_of
from mapfuse.fusion.batch.packing import PairJob, config_bytes, map_bytes
from mapfuse.fusion.batch.tasks import compare_maps
from mapfuse.fusion.config import FuseConfig

HERE = Path(__file__).resolve().parent


def measure(jobs: list[Job], count: int, folder: Path) -> tuple[float, float]:
    """Pairs per second, and the client's processor time as a share of the workers' seconds."""
    with closing(LocalEngine(count)) as engine, Ledger(folder / f"{count}.sqlite") as ledger:
        for _ in engine.run(compare_maps, jobs[: 2 * count]):  # workers are up, kernels are loaded
            pass
        begin, own, work = time.perf_counter(), time.process_time(), 0.0
        for key, done in engine.run(compare_maps, jobs):
            ledger.finish(key, done)
            work += done.seconds
        return len(jobs) / (time.perf_counter() - begin), (time.process_time() - own) / work


def main() -> None:
    """Print the table, and keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=int, default=12)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    settings = config_bytes(FuseConfig())
    maps = [map_bytes(found.map) for found in city(1_000_001, args.maps // 4, 4)]
    jobs = [Job(key_of("pair", a, b), PairJob(settings, a, b).to_bytes()) for a, b in combinations(maps, 2)]
    with TemporaryDirectory() as folder:
        rates = {count: measure(jobs, count, Path(folder)) for count in (1, 2)}
    lines = [
        "# The engine",
        "",
        f"{len(jobs)} pairs of simulated maps; {platform.machine()}, Python {platform.python_version()}, "
        f"{datetime.now(UTC):%Y-%m-%d}.",
        "",
        "| workers | pairs per second | against one | client's processor time / workers' time |",
        "|---|---|---|---|",
        *(
            f"| {count} | {rate:.2f} | {rate / rates[1][0]:.2f} | {100 * own:.1f} % |"
            for count, (rate, own) in rates.items()
        ),
        "",
    ]
    print("\n".join(lines))
    if args.write:
        (HERE / "results" / "batch-engine.md").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
