"""What maps cost that are no maps: none or one landmark, all on a line, all at one place, all alike; prints a table.

    .venv/bin/python benchmarks/matching_degenerate.py [--quick] [--write]

Each map is matched with itself, once with headings (all landmarks alike corners) and once as points of one label. The
bounds are those of an ordinary map of as many landmarks, or of the next size that something was promised for; points
have none beyond 1,000 landmarks, so that 50,000 are held to 10 s and the memory of 100,000 landmarks with headings.
``--quick`` leaves out the 50,000. ``--write`` keeps the table in ``benchmarks/results/matching-degenerate.md``.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import reference
from matching_bench import prepare
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.matching import propose
from mapfuse.matching.landmark_arrays import landmark_arrays
from mapfuse.matching.point_arrays import point_arrays

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Case:
    """A map by name, and how long and how large `propose` may be with headings and without [ms, MB]."""

    name: str
    xy: Array
    headed: tuple[float, float]
    points: tuple[float, float]


def cases(quick: bool) -> list[Case]:
    """All of them, small ones first."""
    small, thousand = ((1.0, 20.0), (50.0, 20.0)), ((25.0, 20.0), (1000.0, 60.0))
    line = np.column_stack([5.0 * np.arange(1000), np.zeros(1000)])
    out = [
        Case("no landmark", np.zeros((0, 2)), *small),
        Case("1 landmark", np.zeros((1, 2)), *small),
        Case("2 landmarks", np.array([[0.0, 0.0], [5.0, 1.0]]), *small),
        Case("1,000 on a line, evenly", line, *thousand),
        Case(
            "1,000 on a line, unevenly", line + np.random.default_rng(0).uniform(-2, 2, (1000, 1)) * [1, 0], *thousand
        ),
        Case("1,000 at one place", np.zeros((1000, 2)), *thousand),
    ]
    if not quick:
        grid = 5.0 * np.stack(np.meshgrid(np.arange(250.0), np.arange(200.0)), axis=-1).reshape(-1, 2)
        out.append(Case("50,000 alike on a grid", grid, (1500.0, 400.0), (10_000.0, 400.0)))
    return out


def corners(name: str, xy: Array) -> LandmarkMap:
    """Corners that all look alike."""
    kinds = ("open", "blocked", "blocked", "open")
    links = tuple(Link(kind, float(se2.wrap(k * np.pi / 2))) for k, kind in enumerate(kinds))
    return LandmarkMap(
        name, tuple(Landmark(f"{name}{k}", "corner", *p, links=links) for k, p in enumerate(xy.tolist()))
    )


def trees(name: str, xy: Array) -> LandmarkMap:
    """Points that all look alike."""
    return LandmarkMap(name, tuple(Landmark(f"{name}{k}", "tree", *p) for k, p in enumerate(xy.tolist())))


def resident(which: str) -> float:
    """Memory of this process [MB]: ``VmRSS`` now, ``VmHWM`` at most since `forget_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(which))) / 1e3


def forget_peak() -> None:
    """Let ``VmHWM`` begin anew; Linux only."""
    Path("/proc/self/clear_refs").write_text("5")


def measured(one: LandmarkMap, two: LandmarkMap) -> tuple[float, float, int]:
    """Best processor time [ms], memory above the maps [MB], and how many hypotheses; arrays of the maps made before."""
    for recorded in (one, two):
        if len(recorded):
            prepare(recorded)
            point_arrays(landmark_arrays(recorded))
    forget_peak()
    before = resident("VmRSS")
    found = propose(one, two)
    memory = max(0.0, resident("VmHWM") - before)
    times: list[float] = []
    # short calls are disturbed more easily, and cost little
    while len(times) < 3 or (len(times) < 60 and sum(times) < 2.0):
        begin = time.process_time()
        found = propose(one, two)
        times.append(time.process_time() - begin)
    return 1e3 * min(times), memory, len(found)


def table(quick: bool) -> list[str]:
    """Lines of the table; bounds in brackets."""
    lines = ["| map with itself | landmarks | time, ms | memory, MB | hypotheses |", "|---|---|---|---|---|"]
    warm = np.random.default_rng(1).uniform(0, 60, (60, 2))
    for make in (corners, trees):
        propose(make("a", warm), make("b", warm))  # every kernel is loaded
    for case in cases(quick):
        for make, what, (most_ms, most_mb) in (
            (corners, "with headings", case.headed),
            (trees, "points", case.points),
        ):
            one, two = make("a", case.xy), make("b", case.xy)
            ms, mb, found = measured(one, two)
            lines.append(f"| {case.name} | {what} | {ms:.3g} ({most_ms:g}) | {mb:.2g} ({most_mb:g}) | {found} |")
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="without the 50,000")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    lines = table(arguments.quick)
    about = (
        f"Best processor time of several calls, bounds in brackets; memory is that of the process above the maps and "
        f"what is kept with them. {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"{datetime.now(UTC):%Y-%m-%d}; load {os.getloadavg()[0]:.0f}, reference workload "
        f"{1e3 * reference.processor_seconds(5):.1f} ms."
    )
    print(about)
    if arguments.write:
        path = Path(__file__).parent / "results" / "matching-degenerate.md"
        path.write_text("\n".join([about, "", *lines, ""]))


if __name__ == "__main__":
    main()
