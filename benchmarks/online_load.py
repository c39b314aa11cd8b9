"""What a landmark event, a correction and a long stream cost. Part of ``benchmarks/online.py``."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matching_floors import pair_of_maps

from mapfuse.datasets.datum import JointCovariance
from mapfuse.datasets.logs import Gyro, Log, Odometry
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation import MILKA, VESPUCCI, build, hospital_like, simulate_logs
from mapfuse.datasets.values import frozen_array
from mapfuse.fusion.online import Correction, LandmarkSeen, OnlineConfig, OnlineFuser
from mapfuse.fusion.online.replay import Replay

Row = dict[str, Any]


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


# Corrections


def correction(seed: int, arguments: argparse.Namespace) -> Row:
    """What it costs to take in a map whole, by its size: the first time, again a little elsewhere, and while merged."""
    sizes = (50, 150) if arguments.quick else (50, 100, 150, 200, 500, 1000)
    rng = np.random.default_rng(seed)
    rows = []
    for size in sizes:
        pair = pair_of_maps(size, "irregular", rng)
        fuser = OnlineFuser()
        spent = []
        for k, m in enumerate((with_joint(pair.map1, rng), with_joint(pair.map2, rng))):
            for again in range(2):
                told = m if not again else shifted(m, rng)
                message = Correction(robot=m.name, sequence=again, t=float(2 * k + again), map=told)
                begin = time.thread_time()
                fuser.take(message)
                spent.append(time.thread_time() - begin)
        rows.append([size, *(1000 * s for s in spent)])
    return {"rows": rows}


def with_joint(m: LandmarkMap, rng: np.random.Generator) -> LandmarkMap:
    """The map with a joint covariance of positions and headings, as the mapper gives one."""
    n = 3 * len(m)
    common = rng.normal(0, 0.1, (n, 6))
    matrix = common @ common.T + np.diag(np.tile([0.01, 0.01, 0.001], len(m)))
    return m.replace(joint_covariance=JointCovariance(m.ids, 3, frozen_array(matrix)))


def shifted(m: LandmarkMap, rng: np.random.Generator) -> LandmarkMap:
    """Every landmark a little elsewhere."""
    moved = (replace(l, x=l.x + rng.normal(0, 0.05), y=l.y + rng.normal(0, 0.05)) for l in m.landmarks)
    return m.replace(landmarks=tuple(moved))


def correction_table(rows: Sequence[Row]) -> Iterator[str]:
    """Milliseconds by size."""
    yield "# What it costs to take in a map whole (`Correction`), simulated maps with joint covariances"
    yield ""
    yield "| landmarks | first [ms] | again, all elsewhere [ms] | second map, first [ms] | again [ms] |"
    yield "|---|---|---|---|---|"
    for row in rows:
        for size, *spent in row["rows"]:
            yield f"| {size} | " + " | ".join(f"{s:.0f}" for s in spent) + " |"
    yield ""
    yield "Processor time; nothing is weighed in it."
