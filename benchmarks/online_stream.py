"""An hour of two robots at a thousand events a second: what it costs, and what it takes to keep. Part of
``benchmarks/online.py``."""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.simulation import MILKA, VESPUCCI, Robot, build, simulate_logs
from mapfuse.datasets.simulation.floors import DoorAt, Floor, floor_from_graph
from mapfuse.datasets.simulation.simulated_log import Stop
from mapfuse.fusion.online.replay import Replay

Row = dict[str, Any]

#: Columns and rows of corridors, gaps between them [m], share of the corridors that aren't there, doors' distance [m].
COLUMNS, ROWS, GAPS, LEFT_OUT, DOORS_APART = 10, 7, (8.0, 15.0), 0.25, (4.0, 9.0)
#: Of odometry, and of the gyro of the robot that has one [Hz]; the compass has 2.5 Hz. Both robots write a thousand
#: events a second.
RATE, COMPASS_EVERY = 330.0, 132
#: In how many parts of equal time the run is told.
PARTS = 12


def large_floor(rng: np.random.Generator) -> Floor:
    """Right-angled corridors that one robot needs more than an hour for."""
    xs, ys = (np.cumsum(rng.uniform(*GAPS, count)) for count in (COLUMNS, ROWS))
    nodes = [(float(x), float(y)) for y in ys for x in xs]
    edges = [(r * COLUMNS + c, r * COLUMNS + c + 1) for r in range(ROWS) for c in range(COLUMNS - 1)]
    edges += [(r * COLUMNS + c, (r + 1) * COLUMNS + c) for r in range(ROWS - 1) for c in range(COLUMNS)]
    ways = np.bincount(np.ravel(edges), minlength=len(nodes))
    kept, left = [], round((1 - LEFT_OUT) * len(edges))
    for count, k in enumerate(rng.permutation(len(edges))):
        a, b = edges[k]
        # a node of three ways keeps them: none becomes a bend that is none, none is cut off
        if len(edges) - count + len(kept) > left and min(ways[a], ways[b]) > 3:
            ways[[a, b]] -= 1
        else:
            kept.append((a, b))
    doors = []
    for a, b in kept:
        length = float(np.hypot(*np.subtract(nodes[a], nodes[b])))
        along = 2.5 + float(rng.uniform(0, DOORS_APART[0]))
        while along < length - 2.5:
            doors.append(DoorAt(a, b, along, int(rng.choice([-1, 1]))))
            along += float(rng.uniform(*DOORS_APART))
    return floor_from_graph("large", nodes, kept, doors, float(rng.uniform(-np.pi, np.pi)))


def at_rate(robot: Robot) -> Robot:
    """The robot as it writes its log many times a second."""
    return replace(robot, driving=replace(robot.driving, rate=RATE, compass_every=COMPASS_EVERY))


def write_drives(seed: int, duration: float, folder: str) -> None:
    """Two robots' logs of ``duration`` [s], from opposite corners of the floor."""
    floor = large_floor(np.random.default_rng(seed))
    corners = [min(floor.places, key=lambda place, way=way: way * (place.x + place.y)).id for way in (1, -1)]
    robots = [at_rate(robot) for robot in (VESPUCCI, MILKA)]
    for log in simulate_logs(build(floor), robots, seed, starts=corners, stop=Stop(time=duration), scans=False):
        write_log(log.log, Path(folder) / f"{log.header.name}.log.jsonl")


def stream(seed: int, arguments: argparse.Namespace) -> Row:
    """Two robots that explore a large floor: events a second, and memory in the course of it."""
    duration = (arguments.events or (60_000 if arguments.quick else 3_600_000)) / 1000
    with tempfile.TemporaryDirectory() as folder:
        # in a process of its own, so that what the simulation takes isn't counted
        writing = multiprocessing.get_context("spawn").Process(target=write_drives, args=(seed, duration, folder))
        writing.start()
        writing.join()
        if writing.exitcode:
            raise SystemExit("the logs couldn't be simulated")
        replay = Replay([read_log(path) for path in sorted(Path(folder).glob("*.log.jsonl"))])
        rows = []
        cpu, count = time.process_time(), 0
        due = duration / PARTS
        for t, name, event in replay.events():
            if t >= due:
                rows.append(_state(replay, count, time.process_time() - cpu))
                due += duration / PARTS
            replay.t = t
            replay.step(name, event, t)
            count += 1
        replay.finish()
        rows.append(_state(replay, count, time.process_time() - cpu))
    fused = replay.fuser.fused()
    return {"rows": rows, "decision": fused.decision}


def _state(replay: Replay, count: int, seconds: float) -> list[float]:
    """Time of the log, events, processor time, landmarks of both maps, largest memory [MB] until now."""
    landmarks = sum(len(feed.mapper.map().landmarks) for feed in replay.feeds.values())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [replay.t, count, seconds, landmarks, memory]


def stream_table(rows: Sequence[Row]) -> Iterator[str]:
    """Part by part."""
    yield "# An hour's log: two simulated robots explore a large floor, a thousand events a second"
    for row in rows:
        yield ""
        yield "| log until [s] | events | landmarks of both maps | events a CPU second | largest memory [MB] |"
        yield "|---|---|---|---|---|"
        before = np.zeros(5)
        *parts, end = row["rows"]
        for part in parts:
            t, events, seconds, landmarks, memory = part
            rate = (events - before[1]) / (seconds - before[2])
            yield f"| {t:.0f} | {events:,.0f} | {landmarks:.0f} | {rate:,.0f} | {memory:.0f} |"
            before = np.array(part)
        yield ""
        events, seconds = end[1:3]
        yield (
            f"In all {events:,.0f} events in {seconds:.0f} s of processor time, {events / seconds:,.0f} a second, with "
            "reading the logs from disk, mappers, smoother and weighing in one process; "
            f"{seconds - before[2]:.0f} s of these are the last weighing, after the last event. The answer at the end: "
            f"{row['decision'].replace('_', ' ')}. The logs are simulated and read as a stream. Memory follows the "
            "joint covariances of both maps, which grow with the square of their landmarks."
        )
