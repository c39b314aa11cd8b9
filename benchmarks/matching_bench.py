"""Times of the matchers on alike corridor buildings and on unlabelled points; prints a table.

Run: ``python benchmarks/matching_bench.py [--repeat N] [--json] [--sizes N ...] [--cold] [--write]``. Times are the
best of N runs on one core, warm. ``--sizes``: `propose` in the default mode on maps of so many landmarks, with what is
done once per map and the memory above the input; ``--cold``: the first call of a process, with kernels from the cache
and without. ``--write`` keeps both in ``benchmarks/results/matching-times.md``. The gate is that of ``run.py``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import reference
from matching_floors import pair_of_maps

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively
from mapfuse.matching.landmark_arrays import landmark_arrays
from mapfuse.matching.point_pairs import match_point_pairs
from mapfuse.matching.propose import propose
from mapfuse.matching.settings import SETTINGS

TRUE_T12 = np.array([12.0, -7.0, 0.8])


@dataclass(frozen=True, slots=True)
class Row:
    """One measured job: best time [ms], how many hypotheses, and how far the best one is from the truth [m]."""

    job: str
    milliseconds: float
    hypotheses: int
    displacement_m: float


def corridor_building(n: int, rng: np.random.Generator) -> list[Landmark]:
    """About n places of alike corridors in a lattice: half of them junctions and corners, half doors."""
    side = max(2, round(np.sqrt(n / 2)))
    pitch = 9.0
    places: list[Landmark] = []
    for row in range(side):
        for column in range(side):
            opened = [column + 1 < side, row + 1 < side, column > 0, row > 0]
            opened = [o and (rng.random() < 0.8) for o in opened]
            headings = (0.0, np.pi / 2, np.pi, -np.pi / 2)
            links = tuple(Link("open" if o else "blocked", h) for o, h in zip(opened, headings, strict=True))
            kind = "junction" if sum(opened) > 2 else "corner"
            places.append(Landmark(f"s{row}.{column}", kind, column * pitch, row * pitch, links=links))
            places.append(Landmark(f"d{row}.{column}", "door", (column + rng.uniform(0.2, 0.8)) * pitch, row * pitch))
    return places[:n]


def recorded(places: list[Landmark], T: np.ndarray, rng: np.random.Generator) -> LandmarkMap:
    """The places seen in the frame ``T`` with noise, four fifths of them, shuffled."""
    back = se2.inverse(T)
    seen = []
    for place in places:
        x, y = se2.transform(back, [place.x, place.y]) + rng.normal(0, 0.3, 2)
        links = tuple(
            Link(l.type, float(se2.wrap(l.heading + back[2] + rng.normal(0, 0.03))))
            for l in place.links
            if l.heading is not None
        )
        seen.append(Landmark(place.id, place.type, x, y, links=links))
    return LandmarkMap("m", tuple(seen[k] for k in rng.permutation(len(seen))))


def unlabelled(n: int, rng: np.random.Generator) -> tuple[LandmarkMap, LandmarkMap]:
    """Two maps of n points each, two thirds in common, 0.2 m of noise."""
    shared = rng.uniform(0, 6 * np.sqrt(n), (2 * n // 3, 2))
    maps = []
    for T in (np.zeros(3), TRUE_T12):
        own = rng.uniform(0, 6 * np.sqrt(n), (n - len(shared), 2))
        points = se2.transform(se2.inverse(T), np.vstack([shared, own])) + rng.normal(0, 0.2, (n, 2))
        maps.append(LandmarkMap("m", tuple(Landmark(str(k), "tree", *p) for k, p in enumerate(points))))
    return maps[0], maps[1]


#: Landmarks per map -> promised time of `propose` [ms], of what is done once per map [ms], and memory [MB].
PROMISED = {
    20: (1.0, None, None),
    100: (5.0, 20.0, None),
    1000: (25.0, 300.0, 20.0),
    10_000: (80.0, 5000.0, 60.0),
    100_000: (1500.0, None, 400.0),
}


@dataclass(frozen=True, slots=True)
class SizeRow:
    """`propose` on two maps of about ``n`` landmarks: best and median processor time [ms], memory above the input [MB],
    right or not, and the best time of the reference workload before and after [ms].

    The memory is what numpy has at most at a time; the kernels' own arrays add some 100 bytes a landmark.
    """

    n: int
    propose_ms: float
    median_ms: float
    per_map_ms: float
    memory_mb: float
    right: bool
    reference_ms: float


def prepare(recorded: LandmarkMap) -> None:
    """What is done once per map, but for its index of cells: that waits for the first pair (0.6 ms of 10,000)."""
    arrays = landmark_arrays(recorded)
    for name in ("travelled", "patterns", "isolation_by_place", "rates", "spread"):
        getattr(arrays, name)
    seen_by_other = tuple(recorded.noise.detection(label) for label in arrays.labels)
    arrays.facing(seen_by_other, arrays.travelled.has_links, len(recorded) > SETTINGS.sorted)


def size_row(n: int, repeat: int) -> SizeRow:
    """Alike floors, half overlap."""
    small = pair_of_maps(100, "alike", np.random.default_rng(0))
    propose(small.map1, small.map2)  # every kernel is loaded
    pair = pair_of_maps(n, "alike", np.random.default_rng(n))
    once = []
    for k in range(1 if n > 1000 else 5):
        # a copy is another map, for which nothing is kept yet
        copies = [recorded.replace(name=f"{recorded.name}{k}") for recorded in (pair.map1, pair.map2)]
        begin = time.process_time()
        for copy in copies:
            prepare(copy)
        once.append((time.process_time() - begin) / 2)
    per_map = min(once)
    prepare(pair.map1)
    prepare(pair.map2)
    slow = reference.processor_seconds(5)
    times = []
    # short calls are disturbed more easily, and cost little
    for _ in range(max(repeat, min(20 * repeat, 10_000 // n))):
        begin = time.process_time()
        found = propose(pair.map1, pair.map2)
        times.append(time.process_time() - begin)
    slow = min(slow, reference.processor_seconds(5))
    tracemalloc.start()
    propose(pair.map1, pair.map2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    middle = pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
    off = se2.transform(found[0].T12.array, middle) - se2.transform(pair.T12, middle)
    best, median = 1e3 * min(times), 1e3 * float(np.median(times))
    return SizeRow(n, best, median, 1e3 * per_map, peak / 1e6, bool(np.hypot(*off) < 1.0), 1e3 * slow)


#: Points per map -> promised time of `propose` [ms].
PROMISED_POINTS = {100: 50.0, 1000: 1000.0}


def points_times(n: int, repeat: int) -> tuple[float, float, float]:
    """Best and median processor time of `propose` on two maps of n points, and of the reference workload [ms]."""
    one, two = unlabelled(n, np.random.default_rng(n))
    slow, times = reference.processor_seconds(5), []
    propose(one, two)
    for _ in range(repeat):
        begin = time.process_time()
        propose(one, two)
        times.append(time.process_time() - begin)
    slow = min(slow, reference.processor_seconds(5))
    return 1e3 * min(times), 1e3 * float(np.median(times)), 1e3 * slow


_FIRST_CALL = """
import time
from mapfuse.datasets.simulation import simulated_pair
map1, map2, _ = simulated_pair(1)
begin = time.process_time()
from mapfuse.matching import propose
propose(map1, map2)
print(time.process_time() - begin)
"""


def first_calls() -> tuple[float, float]:
    """Processor seconds of the first call of a process: with nothing in the cache, and with the kernels in it."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", _FIRST_CALL]
        cold, warm = (
            float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
            for _ in range(2)
        )
    return cold, warm


def size_table(sizes: list[int], repeat: int, cold: bool) -> list[str]:
    """Lines of a table; the promised figures in brackets."""
    lines = [
        "| landmarks per map | propose, ms | median | to the reference | once per map, ms | memory, MB | right |",
        "|---|---|---|---|---|---|---|",
    ]
    for n in sizes:
        row = size_row(n, repeat)
        promised = PROMISED.get(n, (None, None, None))
        values = [
            f"{value:.3g}" + (f" ({limit:g})" if limit else "")
            for value, limit in zip((row.propose_ms, row.per_map_ms, row.memory_mb), promised, strict=True)
        ]
        relative = [f"{row.median_ms:.3g}", f"{row.propose_ms / row.reference_ms:.3g}"]
        if promised[0]:
            relative[1] += f" ({promised[0] / reference.NOMINAL_MS:.3g})"
        cells = [values[0], *relative, *values[1:], "yes" if row.right else "no"]
        lines.append(f"| {n} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    lines += ["", "| points without headings or labels | ms | median | to the reference |", "|---|---|---|---|"]
    for n, limit in PROMISED_POINTS.items():
        best, median, slow = points_times(n, repeat)
        ratio = f"{best / slow:.3g} ({limit / reference.NOMINAL_MS:.3g})"
        lines.append(f"| {n} x {n} | {best:.3g} ({limit:g}) | {median:.3g} | {ratio} |")
        print(lines[-1], flush=True)
    if cold:
        without, kept = first_calls()
        lines += [
            "",
            f"First call of a process: {without:.1f} s without kernels in the cache (20), {kept:.2f} s with (1.5).",
        ]
    about = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    return [
        "Simulated alike floors, half overlap; best and median processor time of many calls, promised figures in "
        f"brackets. {about}, {datetime.now(UTC):%Y-%m-%d}, load {os.getloadavg()[0]:.0f}. The reference is a fixed "
        f"workload (`benchmarks/reference.py`) that takes {reference.NOMINAL_MS:g} ms on a quiet machine; its best "
        "time just before and after each row divides the best time.",
        "",
        *lines,
    ]


def measured(job: str, points2: np.ndarray, run: Callable[[], Any], repeat: int, T12: np.ndarray = TRUE_T12) -> Row:
    """Best time of ``repeat`` runs after a warm one."""
    found, times = run(), []
    for _ in range(repeat):
        begin = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - begin)
    off = se2.transform(found[0].T12.array, points2) - se2.transform(T12, points2)
    return Row(job, round(1e3 * min(times), 2), len(found), round(float(np.hypot(*off.T).mean()), 3))


def rows(repeat: int) -> list[Row]:
    """All jobs."""
    out = []
    for n in (20, 100, 300):
        rng = np.random.default_rng(n)
        places = corridor_building(n, rng)
        one, two = recorded(places, np.zeros(3), rng), recorded(places, TRUE_T12, rng)
        for name, config in (("H1 H2", MatchingConfig()), ("H1 only", MatchingConfig(use_h2=False))):
            job = f"exhaustive {name} {n} x {n}"
            out.append(measured(job, two.positions, lambda: match_exhaustively(one, two, config).best(64), repeat))  # noqa: B023
            job += " all values"
            out.append(measured(job, two.positions, lambda: match_exhaustively(one, two, config).hypotheses, repeat))  # noqa: B023
    for n in (20, 100, 1000):
        pair = pair_of_maps(n, "alike", np.random.default_rng(n))
        middle = pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
        job = f"propose {n} x {n}"
        out.append(measured(job, middle[None], lambda: propose(pair.map1, pair.map2), repeat, pair.T12))  # noqa: B023
    for n in (20, 40, 100, 300):
        one, two = unlabelled(n, np.random.default_rng(n))
        out.append(measured(f"point pairs {n} x {n}", two.positions, lambda: match_point_pairs(one, two), repeat))  # noqa: B023
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--sizes", type=int, nargs="+", help="landmarks per map")
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    if arguments.sizes:
        text = "\n".join([*size_table(arguments.sizes, arguments.repeat, arguments.cold), ""])
        print(text)
        if arguments.write:
            (Path(__file__).parent / "results" / "matching-times.md").write_text(text)
        return
    table = rows(arguments.repeat)
    if arguments.json:
        print(json.dumps([asdict(row) for row in table], indent=1))
        return
    print(f"{'job':44} {'ms':>9} {'found':>7} {'off by m':>9}")
    for row in table:
        print(f"{row.job:44} {row.milliseconds:9.2f} {row.hypotheses:7} {row.displacement_m:9.3f}")


if __name__ == "__main__":
    main()
