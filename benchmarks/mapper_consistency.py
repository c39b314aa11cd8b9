"""The mapper on simulated explorations with known truth: NEES, landmarks found once, loops, lengths over 50 m.

    .venv/bin/python benchmarks/mapper_consistency.py --count 200 [--quick] [--write]

Explorations of irregular floors with loops, compasses bent by steel, systematic odometry errors
(``docs/log-model.md``), associations not given; alternately both robots. NEES per degree of freedom: of all true
landmarks jointly, and of the robot's last pose; a chi-square divided by its degrees. Then the loop of 80 m
(`salvatori_like`) and the hospital floor.

How well the loop of 80 m closes is measured where its ends lie on each other: at all pairs of places of the way that
are truly within 2 m of each other with more than 60 m of way between them, by how far the offset between the two is
wrong in the map's path; the largest of a run counts. A robot that stops as soon as it is back, or misses the
landmarks there, can't know; so the runs that saw at least two places again after that way are told apart.
``loop gap`` is stricter, and says more of the map than of the
loop: the largest difference between the errors of any two landmarks within 10 m, neighbours on one corridor included.

Seeds are `TEST_SEEDS`; ``--tuning`` takes `TUNING_SEEDS` instead.
``--quick`` takes 10 explorations. ``--write`` keeps the table in ``benchmarks/results/mapper-consistency.md``.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Detection, Event, LogTruth
from mapfuse.datasets.mapper import Mapper, truth_of_map
from mapfuse.datasets.simulation import (
    MILKA,
    VESPUCCI,
    build,
    hospital_like,
    make_building,
    salvatori_like,
    simulate_log,
)
from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS

HERE = Path(__file__).resolve().parent
#: The paper's figure is over more than these metres.
FAR = 50.0
#: A loop has come back to a place: within these metres, with more than those of way in between.
BACK, ROUND = 2.0, 60.0
#: What the loop of 80 m is to close to [m].
CLOSED = 0.5
#: From so many places seen again on, a robot can know that it is back.
TOLD = 2


@dataclass(frozen=True, slots=True)
class Score:
    """One exploration: NEES per degree of freedom, true places detected and found once, rms and errors [m]."""

    landmarks: float
    pose: float
    filter_pose: float
    once: int
    detected: int
    rms: float
    aligned: float
    loop: float
    ends: float
    again: int
    length: float
    seconds: float


def explored(kind: str, seed: int) -> Score:
    """A building of a kind explored and mapped."""
    named = {"salvatori": salvatori_like, "hospital": hospital_like}
    building = build(named[kind](), seed=seed) if kind in named else make_building(kind, seed)  # type: ignore[arg-type]
    robot = (VESPUCCI, MILKA)[seed % 2]
    simulated = simulate_log(building, robot, np.random.default_rng(seed), name=f"{kind}-{seed}", scans=False)
    truth = simulated.truth
    mapper = Mapper(simulated.header)
    start = time.process_time()
    for event in simulated.events:
        mapper.update(event)
    made = mapper.map(joint=True)
    seconds = time.process_time() - start
    of_map = truth_of_map(made, mapper.sources, truth)
    places = of_map.landmarks[made.name]
    counts = Counter(place for place in places.values() if place is not None)
    detected = {place for place in truth.detections if place is not None}
    known = [k for k, i in enumerate(made.ids) if places[i] is not None and counts[places[i]] == 1]
    true = np.array([of_map.position(made.name, made.ids[k]) for k in known])
    error = made.positions[known] - true
    joint = made.joint_covariance
    assert joint is not None
    rows = (joint.rows * np.array(known)[:, None] + np.arange(2)).ravel()
    P = joint.matrix[np.ix_(rows, rows)]
    end = se2.between(truth.path[0, 1:], truth.path[-1, 1:])
    return Score(
        float(error.ravel() @ np.linalg.solve(P, error.ravel())) / error.size,
        _pose_nees(*mapper.final_pose(), end),
        _pose_nees(mapper.pose, mapper.pose_covariance, end),
        sum(counts[place] == 1 for place in detected),
        len(detected),
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(se2.align(true, made.positions[known]).residuals ** 2, axis=1)))),
        _gap(error, true),
        _ends_apart(np.asarray(made.path), truth.path),
        _seen_again(simulated.events, truth),
        _length_error(made.positions[known], true),
        seconds,
    )


def _pose_nees(pose: np.ndarray, covariance: np.ndarray, true: np.ndarray) -> float:
    error = pose - true
    error[2] = se2.wrap(error[2])
    return float(error @ np.linalg.solve(covariance, error)) / 3


def _gap(error: np.ndarray, true: np.ndarray) -> float:
    """How far a loop is from closed [m]: the largest difference of errors of landmarks no more than 10 m apart."""
    pairs = [(i, j) for i, j in combinations(range(len(true)), 2) if np.hypot(*(true[i] - true[j])) < 10.0]
    return max((float(np.hypot(*(error[i] - error[j]))) for i, j in pairs), default=0.0)


def _ends_apart(path: np.ndarray, true_path: np.ndarray) -> float:
    """How far the ends of a loop are from lying on each other as they should [m]; NaN where no loop was driven."""
    steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true_path[:, 1:3], axis=0).T))])
    x, y, way = (np.interp(path[:, 0], true_path[:, 0], column) for column in (*true_path[:, 1:3].T, steps))
    true, found = np.column_stack([x, y]), se2.transform(true_path[0, 1:], path[:, 1:3])
    places = np.hypot(*(true[:, None] - true[None]).transpose(2, 0, 1))
    i, j = np.nonzero((places < BACK) & (way[None] - way[:, None] > ROUND))
    error = found - true
    return float(np.hypot(*(error[i] - error[j]).T).max()) if len(i) else float("nan")


def _seen_again(events: Sequence[Event], truth: LogTruth) -> int:
    """How many true places were detected with more than `ROUND` metres of way in between."""
    steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth.path[:, 1:3], axis=0).T))])
    seen: dict[str, list[float]] = {}
    for t, place in zip((e.t for e in events if isinstance(e, Detection)), truth.detections, strict=True):
        if place is not None:
            seen.setdefault(place, []).append(float(np.interp(t, truth.path[:, 0], steps)))
    return sum(max(ways) - min(ways) > ROUND for ways in seen.values())


def _length_error(found: np.ndarray, true: np.ndarray) -> float:
    """Median error of distances above `FAR` metres between landmarks, as a share; NaN where there are none."""
    pairs = [(i, j) for i, j in combinations(range(len(true)), 2) if np.hypot(*(true[i] - true[j])) > FAR]
    shares = [abs(np.hypot(*(found[i] - found[j])) / np.hypot(*(true[i] - true[j])) - 1) for i, j in pairs]
    return float(np.median(shares)) if shares else float("nan")


def quantiles(values: Sequence[float], unit: str = "") -> str:
    """Median, 90 % and largest value."""
    known = np.array([v for v in values if np.isfinite(v)])
    if not len(known):
        return "-"
    return " / ".join(f"{v:.3g}{unit}" for v in (np.median(known), np.quantile(known, 0.9), known.max()))


def row(kind: str, scores: Sequence[Score]) -> str:
    """One line of the table."""
    once, detected = sum(s.once for s in scores), sum(s.detected for s in scores)
    ends = np.array([s.ends for s in scores if np.isfinite(s.ends)])
    told = np.array([s.ends for s in scores if np.isfinite(s.ends) and s.again >= TOLD])
    closed = (
        f"{quantiles(list(ends))} ({np.sum(ends <= CLOSED)} of {len(ends)} to {CLOSED} m; where {TOLD} places were "
        f"seen again {np.sum(told <= CLOSED)} of {len(told)}, the largest {told.max(initial=0.0):.2f})"
    )
    cells = [
        f"| {kind}",
        f"{len(scores)}",
        f"{np.mean([s.landmarks for s in scores]):.3f}",
        f"{np.mean([s.pose for s in scores]):.3f}",
        f"{np.mean([s.filter_pose for s in scores]):.3f}",
        f"{once} of {detected} ({100 * once / detected:.2f} %)",
        quantiles([s.aligned for s in scores]),
        closed if kind == "salvatori" else "-",
        quantiles([s.loop for s in scores]),
        quantiles([100 * s.length for s in scores]) if kind == "hospital" else "-",
        f"{np.mean([s.seconds for s in scores]):.2f} |",
    ]
    return " | ".join(cells)


HEAD = """| floor | runs | NEES landmarks | NEES pose | NEES of the filter's pose | true places found once \
| rms aligned [m] | the loop's ends apart [m] | loop gap [m] | lengths above 50 m, error [%] | CPU s per log |
|---|---|---|---|---|---|---|---|---|---|---|"""


def main() -> None:
    """Run, print, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20, help="explorations of irregular floors; the others half")
    parser.add_argument("--quick", action="store_true", help="10 explorations of irregular floors, 5 of the others")
    parser.add_argument("--tuning", action="store_true", help="seeds for development instead of those for figures")
    parser.add_argument("--write", action="store_true", help="keep the table in benchmarks/results")
    options = parser.parse_args()
    seeds = TUNING_SEEDS if options.tuning else TEST_SEEDS
    lines = []
    of_irregular = 10 if options.quick else options.count
    for kind, count in (("salvatori", of_irregular // 2), ("hospital", of_irregular // 2), ("irregular", of_irregular)):
        lines.append(row(kind, [explored(kind, seed) for seed in seeds[:count]]))
        print(lines[-1], flush=True)
    which = "tuning" if options.tuning else "test"
    made_on = f"{platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    title = f"simulated explorations, {which} seeds; {made_on}"
    note = "Three numbers: median, 90 % quantile, largest. NEES per degree of freedom (1 is right)."
    table = "\n".join([title, "", HEAD, *lines, "", note, ""])
    if options.write and not options.quick:
        (HERE / "results" / "mapper-consistency.md").write_text(table)


if __name__ == "__main__":
    main()
