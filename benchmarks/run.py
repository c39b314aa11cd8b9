"""All benchmarks against the committed baseline.

Run: ``.venv/bin/python benchmarks/run.py [--repeat N] [--gate] [--update-baseline] [--json]``. With ``--gate`` the exit
code is 1 where a metric got worse than its tolerance or breaks its limit, three times in a row. Times are the best of N
runs; those that are compared across machines are divided by a reference workload of the same run (unit ``x``).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: idle threads spin, and count as processor time

import argparse
import json
import sys
from dataclasses import asdict

import baseline
import command_bench
import fuse_bench
import log_bench
import matching_bench
import reference
from baseline import Metric

#: Jobs of the matcher that are compared, with the limit [ms] that was promised for them on a machine that takes
#: `reference.NOMINAL_MS` for the reference workload.
_MATCHING_LIMIT_MS = {
    "exhaustive H1 H2 20 x 20": 5.0,
    "exhaustive H1 H2 100 x 100": 100.0,
    "exhaustive H1 H2 300 x 300": None,
    "propose 20 x 20": None,
    "propose 100 x 100": None,
    "propose 1000 x 1000": None,
    "point pairs 40 x 40": 100.0,
    "point pairs 300 x 300": None,
}
_ATTEMPTS = 3


def matching_metrics(repeat: int) -> list[Metric]:
    """Times and accuracy of the matchers."""
    # the reference before and after, since a slow moment in it would flatter every ratio
    before = reference.best_seconds(reference.work, 3 * repeat)
    rows = matching_bench.rows(repeat)
    reference_s = min(before, reference.best_seconds(reference.work, 3 * repeat))
    out = []
    for row in rows:
        if row.job not in _MATCHING_LIMIT_MS:
            continue
        limit = _MATCHING_LIMIT_MS[row.job]
        if limit is not None:
            out.append(Metric(f"{row.job}: time", row.milliseconds, "ms", tolerance=None))
        ratio = row.milliseconds / 1e3 / reference_s
        most = None if limit is None else limit / reference.NOMINAL_MS
        out.append(Metric(f"{row.job}: time / reference", ratio, "x", tolerance=0.5, limit=most))
        out.append(Metric(f"{row.job}: off", row.displacement_m, "m", tolerance=0.02))
    return out


def measure(repeat: int) -> list[Metric]:
    """Every metric, once."""
    return [
        *matching_metrics(repeat),
        *fuse_bench.metrics(repeat),
        *command_bench.metrics(repeat),
        *log_bench.metrics(),
    ]


def main() -> int:
    """Measure, compare, print; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5, metavar="N")
    parser.add_argument("--gate", action="store_true", help="exit with 1 where a metric got worse")
    parser.add_argument("--update-baseline", action="store_true", help="make this run the baseline")
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON")
    arguments = parser.parse_args()

    before = baseline.read()
    metrics = measure(arguments.repeat)
    if arguments.update_baseline:
        baseline.write(metrics)
    failed = baseline.failures(metrics, before) if arguments.gate else []
    for _ in range(1, _ATTEMPTS):
        if failed:
            metrics = baseline.best_of(metrics, measure(arguments.repeat))
            failed = baseline.failures(metrics, before)

    if arguments.json:
        print(json.dumps([asdict(metric) for metric in metrics], indent=1))
    else:
        print(f"{'metric':56} {'value':>9} {'':3} {'before':>9}")
        for m in metrics:
            print(f"{m.name:56} {m.value:9.4g} {m.unit:3} {before.get(m.name, float('nan')):9.4g}")
    for reason in failed:
        print(f"worse: {reason}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
