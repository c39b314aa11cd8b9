"""A log of a million events as a stream: memory, and odometry events per second through reader and mapper.

Run: ``python benchmarks/log_bench.py [--events N] [--json]``. The log is written to a temporary file, and read in a
process of its own, so that its peak memory is that of reading alone or of reading and mapping. One event in 500 is a
detection of one of eight landmarks on a ring; the others are odometry at 50 Hz.

What limits it: a line is decoded in C at about a microsecond; the mapper's dead reckoning, with its covariance and the
derivatives by the systematic errors, is interpreted Python at some microseconds per pose that moved; filter and
smoother are paid for at detections.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from math import atan2, cos, hypot, pi, sin
from pathlib import Path

from baseline import Metric

from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logs import Detection, Event, Log, LogHeader, Odometry, Sensors

EVENTS = 1_000_000
_DETECTION_EVERY = 500
_RADIUS, _SPEED, _RATE = 8.0, 0.4, 50.0
#: A reader that only reads, and one that maps.
JOBS = ("read", "map")
_ONE_THREAD = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True)
class Row:
    """One job: events, processor time [s] of its loop, peak memory of its process [MB], landmarks found."""

    job: str
    events: int
    seconds: float
    peak_mb: float
    landmarks: int

    @property
    def per_second(self) -> float:
        """Events per second of processor time."""
        return self.events / self.seconds


def drive(count: int) -> Iterator[Event]:
    """A drive round a circle of 8 m radius that sees a landmark every ten seconds; odometry without error."""
    places = [((_RADIUS + 1.5) * cos(k * pi / 4), (_RADIUS + 1.5) * sin(k * pi / 4)) for k in range(8)]
    for k in range(count):
        t = k / _RATE
        turned = _SPEED * t / _RADIUS
        x, y, theta = _RADIUS * sin(turned), _RADIUS * (1 - cos(turned)), turned
        if k % _DETECTION_EVERY or not k:
            yield Odometry(t, x, y, theta)
            continue
        # the circle's centre is (0, r) in the frame of the start
        near = min(places, key=lambda p: hypot(p[0] - x, p[1] + _RADIUS - y))
        dx, dy = near[0] - x, near[1] + _RADIUS - y
        yield Detection(t, "tree", hypot(dx, dy), atan2(dy, dx) - theta, id=str(places.index(near)))


def write(path: Path, count: int) -> None:
    """The log that is measured."""
    write_log(Log(LogHeader("ring", sensors=Sensors()), drive(count)), path)


def run(job: str, path: Path) -> Row:
    """One job in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--job", job, str(path)], check=True, capture_output=True, env=_ONE_THREAD, text=True
    )
    return Row(**json.loads(done.stdout))


def measure(job: str, path: Path) -> Row:
    """One job in this process."""
    log = read_log(path)
    if job == "read":
        begin, count = time.process_time(), 0
        for _ in log.events:
            count += 1
        return Row(job, count, time.process_time() - begin, _peak_mb(), 0)
    from mapfuse.datasets.mapper import Mapper

    mapper, count = Mapper(log.header), 0
    begin = time.process_time()
    for event in log.events:
        mapper.update(event)
        count += 1
    seconds = time.process_time() - begin
    return Row(job, count, seconds, _peak_mb(), len(mapper.map().landmarks))


def _peak_mb() -> float:
    """Most memory that this process has held [MB].

    Linux counts into ``ru_maxrss`` what the parent held when it started this process; ``VmHWM`` begins anew.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1e3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def rows(count: int) -> list[Row]:
    """Both jobs on one log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring.log.jsonl"
        write(path, count)
        return [run(job, path) for job in JOBS]


def metrics(count: int = EVENTS) -> list[Metric]:
    """What is promised: under 300 MB, and more than 50,000 events a second, reader and mapper together.

    Compared with the baseline is what mapping costs above reading, both of one run.
    """
    read, mapped = rows(count)
    ratio = mapped.seconds / read.seconds
    out = [Metric(f"log of {count:,} events: map / read", ratio, "x", tolerance=0.5)]
    for row in (read, mapped):
        name = f"log of {row.events:,} events, {row.job}"
        out.append(Metric(f"{name}: memory", row.peak_mb, "MB", tolerance=None, limit=300.0))
        out.append(
            Metric(f"{name}: events per second", row.per_second, "/s", better="higher", tolerance=None, limit=50_000.0)
        )
    return out


def main() -> None:
    """Print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=EVENTS, metavar="N")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--job", nargs=2, metavar=("JOB", "LOG"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        print(json.dumps(asdict(measure(arguments.job[0], Path(arguments.job[1])))))
        return
    found = rows(arguments.events)
    if arguments.json:
        print(json.dumps([asdict(row) for row in found], indent=1))
        return
    print(f"{'job':6} {'events':>10} {'events/s':>10} {'memory MB':>10} {'landmarks':>10}")
    for row in found:
        print(f"{row.job:6} {row.events:10,} {row.per_second:10,.0f} {row.peak_mb:10.0f} {row.landmarks:10}")


if __name__ == "__main__":
    main()
