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
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matching_floors import pair_of_maps
from scipy.special import chdtri

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Gyro, Log, Odometry
from mapfuse.datasets.mapper import truth_of_map
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.mrclam import ROBOTS, read_mrclam_log, read_mrclam_truth
from mapfuse.datasets.simulation import MILKA, VESPUCCI, build, hospital_like, make_building, simulate_logs
from mapfuse.datasets.simulation.simulated_log import SimulatedLog
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import FusedMap, fuse
from mapfuse.fusion.online import LandmarkSeen, Merged, OnlineConfig, OnlineFuser, Revised, Unmerged
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
        half, most = (100 * np.quantile(times, q) for q in (0.5, 0.9))
        yield f"First merge at {half:.0f} % of the run (median); 90 % of them by {most:.0f} %."


def _before_loops(row: Row) -> bool:
    closed = [row["end"] if t is None else t for t in row["closed"]]
    return row["merged"] is not None and row["merged"] < max(closed)


def _band(dof: int, n: int) -> str:
    if not n:
        return "-"
    low, high = (float(chdtri(dof, q)) / dof for q in (0.975, 0.025))
    return f"{low:.2f} to {high:.2f}"


# Four robots on one floor


def four(seed: int, _: argparse.Namespace) -> Row:
    """Four robots, each of a half or more of an irregular floor, started anywhere."""
    site = make_building("irregular", seed)
    logs = simulate_logs(site, (VESPUCCI, MILKA, VESPUCCI, MILKA), seed, scans=False, share=0.7)
    replay = Replay([Log(log.header, log.events) for log in logs])
    merges = [event.t for _ in replay.run() for event in replay.fuser.events() if isinstance(event, Merged)]
    fused = replay.fuser.fused()
    off = [_off(fused, group, logs) for group in fused.groups if len(group) > 1]
    return {
        "groups": len(fused.groups),
        "largest": max(len(group) for group in fused.groups),
        "off": max(off, default=0.0),
        "merges": merges,
        "end": replay.t,
    }


def _off(fused: FusedMap, group: Sequence[str], logs: Sequence[SimulatedLog]) -> float:
    """How far [m, mean] the worst placed map of a group lies from where it is, its first map being right."""
    start = {log.header.name: log.truth.path[0, 1:] for log in logs}
    worst = 0.0
    for name in group[1:]:
        points = fused.sources[name].positions
        true = se2.between(start[group[0]], start[name])
        apart = se2.transform(fused.frames[name].T.array, points) - se2.transform(true, points)
        worst = max(worst, float(np.hypot(*apart.T).mean()))
    return worst


def four_table(rows: Sequence[Row]) -> Iterator[str]:
    """How many ended as one group."""
    n = len(rows)
    one = sum(row["groups"] == 1 for row in rows)
    yield "# Four simulated robots on one floor, started anywhere"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    yield f"| one group at the end | 95 % | {100 * one / n:.0f} % ({one} of {n}) |"
    yield f"| a map of a group more than 5 m (mean) off | none | {sum(row['off'] > 5 for row in rows)} |"
    yield f"| three of the four together | | {sum(row['largest'] == 3 for row in rows)} |"


# A floor that looks the same from both ends


def symmetric(seed: int, _: argparse.Namespace) -> Row:
    """Two maps of a symmetric floor, landmark by landmark, without compass; then something that breaks the symmetry.

    Both robots have everything by heart; only when all of it has been told they see the three doors near the middle
    of one side, which the other side lacks.
    """
    rng = np.random.default_rng(seed)
    one, two, late1, late2, true = symmetric_maps(rng)
    fuser = OnlineFuser()
    numbers = {"A": 0, "B": 0}
    t, early = 0.0, False

    def tell(name: str, landmark: Landmark) -> None:
        nonlocal t
        t += 1.0
        fuser.take(LandmarkSeen(robot=name, sequence=numbers[name], t=t, landmark=landmark))
        numbers[name] += 1
        fuser.advance()

    for a, b in zip(one, two, strict=True):
        tell("A", a)
        tell("B", b)
    fuser.advance(force=True)
    early = fuser.fused().decision == "merged" or any(isinstance(e, Merged) for e in fuser.events())
    before = fuser.fused().pairs[0]
    needed: int | None = None
    course: list[float] = []
    for k, (a, b) in enumerate(zip(late1, late2, strict=True)):
        tell("A", a)
        tell("B", b)
        fuser.advance(force=True)
        course.append(fuser.fused().pairs[0].probability)
        if needed is None and fuser.fused().decision == "merged":
            needed = k + 1
    fused = fuser.fused()
    wrong = False
    if fused.decision == "merged":
        off = fused.frames["B"].T.array - true
        wrong = bool(np.hypot(*off[:2]) > 3.0 or abs(se2.wrap(off[2])) > 0.5)
    return {
        "early": early,
        "rivals": [h.probability for h in before.hypotheses[:3]],
        "needed": needed,
        "course": course,
        "wrong": wrong,
        "probability": fused.probability,
    }


def symmetric_maps(
    rng: np.random.Generator,
) -> tuple[list[Landmark], list[Landmark], list[Landmark], list[Landmark], np.ndarray]:
    """A corridor of 72 m with ends, junctions and doors that a half turn maps onto itself, as two robots have it, and
    late landmarks that one end has and the other hasn't. The last value is the true T12."""
    at = [-36.0, -30.0, -25.0, -18.0, -10.0, -4.0]
    kinds = ["end", "door+", "door-", "door+", "junction+", "door-"]
    places = [(x, kind) for x, kind in zip(at, kinds, strict=True)]
    flipped = {"door+": "door-", "door-": "door+", "junction+": "junction-", "end": "end2"}
    places += [(-x, flipped[kind]) for x, kind in reversed(places)]
    # as a robot tells them that goes to and fro from the middle: of each two that look alike one after the other
    places.sort(key=lambda place: (abs(place[0]), place[0]))
    late = [(13.5, "door+"), (20.5, "door-"), (27.0, "door+"), (33.0, "junction+")]
    late += [(7.5, "door-"), (1.5, "door+"), (15.5, "door-"), (23.0, "junction-")]
    frames = [np.array([*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi)]) for _ in range(2)]
    told: list[tuple[list[Landmark], list[Landmark]]] = []
    for frame in frames:
        told.append(_told(places, late, frame, rng))
    return told[0][0], told[1][0], told[0][1], told[1][1], np.asarray(se2.between(frames[0], frames[1]))


def _told(
    places: Sequence[tuple[float, str]], late: Sequence[tuple[float, str]], frame: np.ndarray, rng: np.random.Generator
) -> tuple[list[Landmark], list[Landmark]]:
    arms = {
        "end": ((0, "open"), (90, "blocked"), (180, "blocked"), (-90, "blocked")),
        "end2": ((180, "open"), (90, "blocked"), (0, "blocked"), (-90, "blocked")),
        "junction+": ((0, "open"), (180, "open"), (90, "open"), (-90, "blocked")),
        "junction-": ((0, "open"), (180, "open"), (-90, "open"), (90, "blocked")),
        "door+": ((0, "open"), (180, "open"), (90, "door"), (-90, "blocked")),
        "door-": ((0, "open"), (180, "open"), (-90, "door"), (90, "blocked")),
    }
    type_of = {"end": "corner", "end2": "corner", "junction+": "junction", "junction-": "junction"}
    into = se2.inverse(frame)

    def chain(row: Sequence[tuple[float, str]], named: Callable[[int], str]) -> list[Landmark]:
        order = sorted(range(len(row)), key=lambda k: row[k][0])
        found = []
        for k, (x, kind) in enumerate(row):
            rank = order.index(k)
            xy = se2.transform(into, np.array([x, 0.0])) + rng.normal(0, 0.1, 2)
            links = []
            for degrees, type_ in arms[kind]:
                heading = float(se2.wrap(np.deg2rad(degrees) - frame[2] + rng.normal(0, 0.03)))
                far = order[rank + 1] if degrees == 0 and rank + 1 < len(row) else None
                far = order[rank - 1] if degrees == 180 and rank else far
                if far is None or type_ != "open":
                    links.append(Link(type_, heading))
                else:
                    d = abs(row[far][0] - x)
                    links.append(Link(type_, heading, None, named(far), d + rng.normal(0, 0.1 + 0.02 * d), 1))
            found.append(Landmark(named(k), type_of.get(kind, "door"), float(xy[0]), float(xy[1]), links=tuple(links)))
        return found

    every = [*places, *late]
    known = chain(places, lambda k: f"l{k}")
    after = chain(every, lambda k: f"l{k}")
    return known, after[len(places) :]


def symmetric_table(rows: Sequence[Row]) -> Iterator[str]:
    """Ambiguous until something is seen that breaks the symmetry."""
    n = len(rows)
    needed = [row["needed"] for row in rows if row["needed"] is not None]
    yield "# A simulated floor that looks the same from both ends, no compass"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    yield f"| merged while both ends look alike | never | {sum(row['early'] for row in rows)} of {n} |"
    yield f"| merged once one end is seen to differ | within a few landmarks | {len(needed)} of {n} |"
    if needed:
        yield f"| landmarks it took, median and most of 8 | | {np.median(needed):.0f}, {max(needed)} |"
    yield f"| merged the wrong way round | none | {sum(row['wrong'] for row in rows)} |"


# Latency


def latency(seed: int, arguments: argparse.Namespace) -> Row:
    """Two maps that grow to 500 landmarks each, landmark by landmark; weighing in a worker process."""
    rng = np.random.default_rng(seed)
    size = 120 if arguments.quick else 500
    pair = pair_of_maps(size, "irregular", rng)
    order = [walked(m) for m in (pair.map1, pair.map2)]
    fuser = OnlineFuser(OnlineConfig(delay=None), worker=True)
    for m in (pair.map1, pair.map2):
        fuser.add_robot(m.name, m.noise)
    taken, advanced, taken_cpu, advanced_cpu, sizes, answers = [], [], [], [], [], []
    numbers = {"A": 0, "B": 0}
    t = 0.0
    for k in range(max(len(o) for o in order)):
        for m, row in zip((pair.map1, pair.map2), order, strict=True):
            if k >= len(row):
                continue
            t += 0.1
            message = LandmarkSeen(robot=m.name, sequence=numbers[m.name], t=t, landmark=m.landmarks[row[k]])
            numbers[m.name] += 1
            begin, cpu = time.perf_counter(), time.thread_time()
            fuser.take(message)
            middle, cpu_middle = time.perf_counter(), time.thread_time()
            answered = fuser.advance()
            end, cpu_end = time.perf_counter(), time.thread_time()
            taken.append(middle - begin)
            advanced.append(end - begin)
            taken_cpu.append(cpu_middle - cpu)
            advanced_cpu.append(cpu_end - cpu)
            sizes.append(k + 1)
            if answered:
                answers.append((k + 1, fuser.fused_at, t, fuser.fused().decision))
            time.sleep(PAUSE_S)
    begin = time.perf_counter()
    fuser.advance(force=True)
    last = time.perf_counter() - begin
    decision = fuser.fused().decision
    fuser.close()
    return {
        "size": size,
        "take": _quantiles(taken),
        "event": _quantiles(advanced),
        "take_cpu": _quantiles(taken_cpu),
        "event_cpu": _quantiles(advanced_cpu),
        "load": os.getloadavg()[0],
        "by_size": [
            [low, *_quantiles([x for x, n in zip(advanced_cpu, sizes, strict=True) if low < n <= low + size // 5])]
            for low in range(0, size, size // 5)
        ],
        "answers": len(answers),
        "last_weighing": last,
        "decision": decision,
    }


#: Landmarks of the latency benchmark come this far apart [s], twenty a second from both robots together.
PAUSE_S = 0.05


def walked(m: LandmarkMap) -> list[int]:
    """Landmarks as a robot comes to them along links, what hangs on none at the end."""
    seen, row, todo = set(), [], list(range(len(m)))
    for first in todo:
        stack = [first]
        while stack:
            k = stack.pop()
            if k in seen:
                continue
            seen.add(k)
            row.append(k)
            far = [m.index_from_id[l.connected_to_id] for l in m.landmarks[k].links if l.connected_to_id is not None]
            stack += [f for f in far if f not in seen]
    return row


def _quantiles(values: Sequence[float]) -> list[float]:
    """Median, 99th percentile and largest [ms]."""
    if not values:
        return [float("nan")] * 3
    return [float(1000 * np.quantile(values, q)) for q in (0.5, 0.99, 1.0)]


def latency_table(rows: Sequence[Row]) -> Iterator[str]:
    """Median and 99th percentile, and how both grow."""
    yield "# Latency per landmark event, two simulated maps that grow"
    yield ""
    for row in rows:
        yield f"{row['size']} landmarks each, twenty landmark events a second, weighed in another process:"
        yield ""
        yield "| | median [ms] | 99 % [ms] | largest [ms] |"
        yield "|---|---|---|---|"
        yield "| asked | 5 | 50 | |"
        for name, said in (
            ("event", "taken in and advanced, by the clock"),
            ("take", "taken in alone, by the clock"),
            ("event_cpu", "taken in and advanced, processor time"),
            ("take_cpu", "taken in alone, processor time"),
        ):
            yield f"| {said} | " + " | ".join(f"{value:.2f}" for value in row[name]) + " |"
        for low, *values in row["by_size"]:
            yield (
                f"| {low + 1} to {low + row['size'] // 5} landmarks each | "
                + " | ".join(f"{value:.2f}" for value in values)
                + " |"
            )
        yield ""
        yield (
            f"{row['answers']} answers meanwhile, the last weighing took {row['last_weighing']:.1f} s: "
            f"{row['decision'].replace('_', ' ')}. The machine's two processors had a load of {row['load']:.1f}."
        )


# A long stream of events


def stream(seed: int, arguments: argparse.Namespace) -> Row:
    """Robots that drive through a hospital again and again: events a second and memory."""
    import resource

    logs = simulate_logs(build(hospital_like()), (VESPUCCI, MILKA), seed, starts=("p9", "p13"), scans=False)
    rounds = 2 if arguments.quick else 8
    replay = Replay([Log(log.header, Repeated(log.events, rounds)) for log in logs])
    begin, cpu = time.perf_counter(), time.process_time()
    memory, spent = [], []
    length = logs[0].events[-1].t + 1.0
    count = 0
    due = length
    for t, name, event in replay.events():
        if t >= due:
            due += length
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            spent.append(time.process_time() - cpu)
        replay.t = t
        replay.step(name, event, t)
        count += 1
    replay.finish()
    memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    spent.append(time.process_time() - cpu)
    return {
        "events": count,
        "log_seconds": replay.t,
        "wall": time.perf_counter() - begin,
        "cpu": time.process_time() - cpu,
        "memory_mb": memory,
        "spent": spent,
    }


class Repeated:
    """The odometry of a drive, there and back in time, with its detections once: a robot that goes on driving."""

    def __init__(self, events: Sequence[Any], rounds: int) -> None:
        self.events, self.rounds = events, rounds

    def __iter__(self) -> Iterator[Any]:
        import msgspec

        length = self.events[-1].t + 1.0
        last = next(e for e in reversed(self.events) if isinstance(e, Odometry))
        for k in range(self.rounds):
            for event in self.events:
                if k == 0:
                    yield event
                elif isinstance(event, Odometry):  # standing still, its sensors going on
                    yield msgspec.structs.replace(last, t=event.t + k * length)
                elif isinstance(event, Gyro):
                    yield msgspec.structs.replace(event, t=event.t + k * length, rate=0.0)


def stream_table(rows: Sequence[Row]) -> Iterator[str]:
    """Events a second."""
    yield "# A long stream: two simulated robots through the hospital, then standing with their sensors on"
    yield ""
    yield "| events | log [s] | events per CPU second | memory after each round [MB] |"
    yield "|---|---|---|---|"
    for row in rows:
        memory = ", ".join(f"{m:.0f}" for m in row["memory_mb"])
        yield f"| {row['events']:,} | {row['log_seconds']:.0f} | {row['events'] / row['cpu']:.0f} | {memory} |"


# Recorded: MRCLAM 6


def mrclam(seed: int, arguments: argparse.Namespace) -> Row:
    """All five robots of MRCLAM 6 replayed; seed 0: barcodes name a robot's own landmarks, and are no names between
    robots; 1: none at all."""
    home = arguments.folder / "MRCLAM_Dataset6"
    barcodes = (seed - arguments.first) % 2 == 0
    logs = [read_mrclam_log(home, robot, barcodes=barcodes) for robot in ROBOTS]
    replay = Replay(logs)
    merges = [event.t for _ in replay.run() for event in replay.fuser.events() if isinstance(event, Merged)]
    fused = replay.fuser.fused()
    named = {}
    places: dict[str, np.ndarray] = {}
    for log, robot in zip(logs, ROBOTS, strict=True):
        truth = read_mrclam_truth(home, robot)
        places = {**places, **truth.places}
        sources = replay.feeds[log.header.name].mapper.sources
        for landmark, detections in sources.items():
            seen = Counter(truth.detections[k] for k in detections).most_common(1)[0][0]
            named[log.header.name, landmark] = seen
    largest = max(range(len(fused.groups)), key=lambda k: len(fused.groups[k]))
    found, true = [], []
    for landmark in fused.landmarks:
        if landmark.group == largest:
            tubes = Counter(named.get((name, i)) for name, ids in landmark.sources.items() for i in ids)
            tube = tubes.most_common(1)[0][0]
            if tube is not None:
                found.append((landmark.x, landmark.y))
                true.append(places[tube])
    apart = np.hypot(*se2.align(np.array(true), np.array(found)).residuals.T)
    return {
        "barcodes": barcodes,
        "groups": len(fused.groups),
        "largest": len(fused.groups[largest]),
        "landmarks": len(found),
        "rms": float(np.sqrt(np.mean(apart**2))),
        "worst": float(apart.max()),
        "merges": merges,
    }


def mrclam_table(rows: Sequence[Row]) -> Iterator[str]:
    """One group, and how near to the survey."""
    yield "# MRCLAM 6, recorded: five robots' raw logs replayed together"
    yield ""
    yield "Asked: one group, fused landmarks at most 0.15 m rms from the survey (laid on by the best rigid motion)."
    yield ""
    yield "| barcodes | groups | robots in the largest | landmarks there | rms [m] | worst [m] |"
    yield "|---|---|---|---|---|---|"
    for row in rows:
        said = "within each robot's log only" if row["barcodes"] else "none"
        numbers = f"{row['groups']} | {row['largest']} | {row['landmarks']} | {row['rms']:.3f} | {row['worst']:.2f}"
        yield f"| {said} | {numbers} |"


Measured = tuple[Callable[[int, argparse.Namespace], Row], Callable[[Sequence[Row]], Iterator[str]], int, int]
MEASURED: dict[str, Measured] = {
    "four": (four, four_table, 100, 2),
    "hospital": (hospital, hospital_table, 200, 3),
    "latency": (latency, latency_table, 1, 1),
    "mrclam": (mrclam, mrclam_table, 2, 1),
    "stream": (stream, stream_table, 1, 1),
    "symmetric": (symmetric, symmetric_table, 40, 3),
}

if __name__ == "__main__":
    main()
