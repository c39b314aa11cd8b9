"""Maps merged while they grow: hospital pair, four robots, a symmetric floor, latency, and MRCLAM 6.

    .venv/bin/python benchmarks/online.py hospital [--count 200] [--first 3000000] [--write] [--quick]
    .venv/bin/python benchmarks/online.py four|symmetric|latency|stream [...]
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
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Log
from mapfuse.datasets.mapper import truth_of_map
from mapfuse.datasets.simulation import MILKA, VESPUCCI, build, hospital_like, simulate_logs
from mapfuse.datasets.simulation.simulated_log import SimulatedLog
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import FusedMap, fuse
from mapfuse.fusion.online import Merged, Revised, Unmerged
from mapfuse.fusion.online.replay import Replay
from mapfuse.fusion.score import score_pair

HERE = Path(__file__).resolve().parent
#: Seeds that nothing was tuned on.
FIRST_TEST_SEED = 3_000_000
TENTHS = 10
#: The loop around the block of lifts, corner by corner [m, world].
RING = np.array([(-9, -6), (9, -6), (9, -2), (9, 6), (-9, 6), (-9, 1.5), (-9, -6)], dtype=float)

Row = dict[str, Any]


def main() -> None:
    """Measure one thing, print the table, keep it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=sorted(MEASURED))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--count", type=int)
    parser.add_argument("--first", type=int, default=FIRST_TEST_SEED)
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
        print(json.dumps(row), flush=True)
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


def _rows(path: Path | None) -> list[Row]:
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


# Two robots in the hospital


def hospital(seed: int, _: argparse.Namespace) -> Row:
    """One pair: West and East wing, replayed together."""
    logs = simulate_logs(build(hospital_like()), (VESPUCCI, MILKA), seed, starts=("p9", "p13"), scans=False)
    row = replayed(logs)
    row["closed"] = [_ring_closed(log) for log in logs]
    return row


def replayed(logs: Sequence[SimulatedLog]) -> Row:
    """A replay of two robots: when they merged, what was wrong, errors at each tenth, and the batch result."""
    replay = Replay([Log(log.header, log.events) for log in logs])
    true = _true_T12(logs[0], logs[1])
    end = max(log.events[-1].t for log in logs)
    tenths: list[float | None] = []
    merges: list[tuple[float, bool]] = []
    parted: list[float] = []
    for moment in replay.run(every=end / TENTHS):
        for event in replay.fuser.events():
            if isinstance(event, Merged | Revised):
                merges.append((event.t, _is_wrong(replay, logs)))
            elif isinstance(event, Unmerged):
                parted.append(event.t)
        if not moment.weighed or moment.t >= end:
            tenths.append(_nees(replay, true))
    fused = replay.fuser.fused()
    batch = fuse([feed.map() for feed in replay.feeds.values()])
    return {
        "end": end,
        "merged": merges[0][0] if merges else None,
        "wrong": [t for t, wrong in merges if wrong],
        "parted": parted,
        "decision": fused.decision,
        "wrong_at_end": fused.decision == "merged" and _is_wrong(replay, logs),
        "tenths": tenths[:TENTHS],
        "from_batch": _from_batch(fused, batch),
        "batch": batch.decision,
        "place_nees": _place_nees(replay, logs),
    }


def _true_T12(one: SimulatedLog, two: SimulatedLog) -> np.ndarray:
    return np.asarray(se2.between(one.truth.path[0, 1:], two.truth.path[0, 1:]))


def _is_wrong(replay: Replay, logs: Sequence[SimulatedLog]) -> bool:
    """Whether the merge that is held is wrong (`mapfuse.fusion.score.PairScore`)."""
    fused = replay.fuser.fused()
    truths = [
        truth_of_map(fused.sources[log.header.name], replay.feeds[log.header.name].mapper.sources, log.truth)
        for log in logs
    ]
    frames = {name: frame for truth in truths for name, frame in truth.frames.items()}
    landmarks = {name: ids for truth in truths for name, ids in truth.landmarks.items()}
    places = {place: xy for truth in truths for place, xy in truth.places.items()}
    return score_pair(fused, Truth(frames, landmarks, places)).merged_wrongly


def _nees(replay: Replay, true: np.ndarray) -> float | None:
    """NEES of T12 (3 degrees of freedom) as held now; None where nothing is merged."""
    try:
        fused = replay.fuser.fused()
    except Exception:  # nothing has come yet
        return None
    if fused.decision != "merged":
        return None
    T = fused.frames[fused.maps[1]].T
    error = T.array - true
    error[2] = se2.wrap(error[2])
    return float(error @ np.linalg.solve(T.covariance, error))


def _from_batch(fused: FusedMap, batch: FusedMap) -> float | None:
    """Largest difference of T12 from the batch's in its standard deviations."""
    if fused.decision != batch.decision or fused.decision != "merged":
        return None
    T, B = fused.frames[fused.maps[1]].T, batch.frames[fused.maps[1]].T
    off = T.array - B.array
    off[2] = se2.wrap(off[2])
    return float(np.max(np.abs(off) / np.sqrt(np.diag(B.covariance))))


def _place_nees(replay: Replay, logs: Sequence[SimulatedLog]) -> list[float | None]:
    """NEES (3) of each robot's pose at the end, in the first one's frame."""
    found: list[float | None] = []
    places = replay.fuser.places()
    for log in logs:
        place = places.get(log.header.name)
        if place is None or place.frame_of != logs[0].header.name:
            found.append(None)
            continue
        error = place.pose.array - se2.between(logs[0].truth.path[0, 1:], log.truth.path[-1, 1:])
        error[2] = se2.wrap(error[2])
        found.append(float(error @ np.linalg.solve(place.pose.covariance, error)))
    return found


def _ring_closed(log: SimulatedLog) -> float | None:
    """When a robot has been everywhere around the block of lifts; None: never."""
    steps = [np.linspace(a, b, max(2, int(np.hypot(*(b - a))))) for a, b in pairwise(RING)]
    path = log.truth.path
    last = 0.0
    for point in np.concatenate(steps):
        near = np.flatnonzero(np.hypot(*(path[:, 1:3] - point).T) < 2.0)
        if not len(near):
            return None
        last = max(last, float(path[near[0], 0]))
    return last


def hospital_table(rows: Sequence[Row]) -> Iterator[str]:
    """What was asked, and what came out."""
    n = len(rows)
    before = sum(_before_loops(row) for row in rows)
    wrong = [row for row in rows if row["wrong"]]
    left = sum(row["wrong_at_end"] for row in rows)
    merged = [row for row in rows if row["decision"] == "merged"]
    apart = [row["from_batch"] for row in rows if row["from_batch"] is not None]
    same = sum(row["decision"] == row["batch"] for row in rows)
    yield "# Two simulated robots in one hospital, merged while they map"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    yield f"| merged before both have closed the central loop | 90 % | {100 * before / n:.1f} % ({before} of {n}) |"
    yield f"| ever merged wrongly | at most 0.5 % | {100 * len(wrong) / n:.1f} % ({len(wrong)}) |"
    yield f"| of these not un-merged or put right at the end | none | {left} |"
    yield f"| merged at the end | | {100 * len(merged) / n:.1f} % ({len(merged)}) |"
    yield f"| decision at the end is the batch's | all | {same} of {n} |"
    yield f"| T12 from the batch's [sigma], largest | 0.1 | {max(apart, default=float('nan')):.2g} |"
    place = [value for row in rows for value in row["place_nees"] if value is not None]
    band = _band(3 * len(place), len(place))
    yield f"| mean NEES of robots' poses at the end, / 3 | {band} | {np.mean(place) / 3:.2f} |"
    yield ""
    yield "NEES of T12 at each tenth of the run, over its 3 degrees of freedom, of those merged by then:"
    yield ""
    yield "| tenth | merged | mean NEES / 3 | 95 % band |"
    yield "|---|---|---|---|"
    for k in range(TENTHS):
        values = [row["tenths"][k] for row in rows if len(row["tenths"]) > k and row["tenths"][k] is not None]
        if values:
            yield f"| {k + 1} | {len(values)} | {np.mean(values) / 3:.2f} | {_band(3 * len(values), len(values))} |"
    times = sorted(row["merged"] / row["end"] for row in rows if row["merged"] is not None)
    if times:
        yield ""
        yield f"First merge at {100 * np.median(times):.0f} % of the run (median); 90 % of them by "
        yield f"{100 * np.quantile(times, 0.9):.0f} %."


def _before_loops(row: Row) -> bool:
    closed = [row["end"] if t is None else t for t in row["closed"]]
    return row["merged"] is not None and row["merged"] < max(closed)


def _band(dof: int, n: int) -> str:
    if not n:
        return "-"
    low, high = (float(chdtri(dof, q)) / dof for q in (0.975, 0.025))
    return f"{low:.2f} to {high:.2f}"


Measured = tuple[Callable[[int, argparse.Namespace], Row], Callable[[Sequence[Row]], Iterator[str]], int, int]
MEASURED: dict[str, Measured] = {"hospital": (hospital, hospital_table, 200, 3)}

if __name__ == "__main__":
    main()
