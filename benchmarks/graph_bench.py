"""What a pair's graph costs beside GTSAM's own optimisation and marginals of it, and what preparing a map costs.

Run: ``.venv/bin/python benchmarks/graph_bench.py [--sizes N ...] [--repeat N] [--large N]``. Processor time on
simulated floors (`matching_floors`, seed 1, half of each map shared), recorded positions as start; the best of N runs,
both sides in the same run. *ours*: build, solve, gate, refit, and the covariance of every pose; the maps' own
measurements are prepared, and matches that the gate takes out are left out before.
*gtsam*: Levenberg-Marquardt with its defaults and ``Marginals`` key by key, of a graph already built.
``--large``: all covariances of one map of N landmarks.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from baseline import Metric
from matching_floors import pair_of_maps

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.factors import Problem, map_measurements, pair_problem, single_map_problem
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.solve import Solution, solve

SEED = 1
CONFIG = SolvingConfig()
#: Landmarks of both maps together.
SIZES = (20, 200, 2000)
#: Landmarks of a map, and the time promised for preparing it [s].
PREPARED_S = {100: 0.02, 1000: 0.3, 10_000: 5.0}


@dataclass(frozen=True, slots=True)
class GraphRow:
    """Processor times [s] of one size."""

    landmarks: int
    poses: int
    ours_s: float
    gtsam_s: float
    rejected: int

    @property
    def ratio(self) -> float:
        """Ours by GTSAM's."""
        return self.ours_s / self.gtsam_s


def best(run: Callable[[], object], repeat: int) -> float:
    """Least processor time [s] of one thread, after a run that isn't counted."""
    run()
    times = []
    for _ in range(repeat):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def whole(map1: LandmarkMap, map2: LandmarkMap, T12: np.ndarray, matches: list[tuple[str, str]]) -> Solution:
    """A pair from maps and hypothesis to the covariance of every pose."""
    solution = solve(pair_problem(map1, map2, T12, matches), CONFIG)
    solution.covariances(solution.problem.keys.in_order)
    return solution


def of_gtsam(problem: Problem) -> None:
    """The same by GTSAM alone, its graph and values given."""
    graph, values = problem.graph(), problem.values()
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    marginals = gtsam.Marginals(graph, values)
    for key in values.keys():  # noqa: SIM118
        marginals.marginalCovariance(key)


def row(landmarks: int, repeat: int) -> GraphRow:
    """Both sides at one size."""
    pair = pair_of_maps(landmarks // 2, "irregular", np.random.default_rng(SEED))
    map1, map2 = pair.map1, pair.map2
    matches = [(map1.ids[i], map2.ids[j]) for i, j in pair.pairs]
    for r, recorded in enumerate((map1, map2)):
        map_measurements(recorded, r)
    solution = whole(map1, map2, pair.T12, matches)
    rejected = len(solution.rejected)  # they would be solved without, one by one, which GTSAM isn't asked to do
    gone = {(m.pair[0].id, m.pair[1].id) for m in solution.rejected}
    matches = [match for match in matches if match not in gone]
    problem = solution.problem.starting_at(pair_problem(map1, map2, pair.T12, matches).initial)
    built = time.process_time()
    problem.graph(), problem.values()
    built = time.process_time() - built
    ours = best(lambda: whole(map1, map2, pair.T12, matches), repeat)
    theirs = best(lambda: of_gtsam(problem), repeat) - built
    return GraphRow(landmarks, len(problem.keys), ours, theirs, rejected)


def prepare_seconds(landmarks: int, repeat: int, *, whole: bool = False) -> float:
    """Processor time [s] of preparing a map never seen before; ``whole``: with its dense covariance."""
    pair = pair_of_maps(landmarks, "irregular", np.random.default_rng(SEED))

    def run() -> None:
        fresh = LandmarkMap("fresh", pair.map1.landmarks, noise=pair.map1.noise)
        prepared = prepare(fresh, CONFIG, max_landmarks=landmarks * 2)
        _ = prepared.straightened
        if whole:
            _ = prepared.covariance

    return best(run, repeat)


def metrics(repeat: int) -> list[Metric]:
    """What the gate watches."""
    out = [
        Metric(f"graph of {n} landmarks: time / GTSAM's", row(n, repeat).ratio, "x", tolerance=0.5, limit=1.5)
        for n in SIZES
    ]
    for n in (100, 1000):
        seconds = prepare_seconds(n, repeat)
        out.append(Metric(f"prepare {n}: time", 1e3 * seconds, "ms", tolerance=None, limit=1e3 * PREPARED_S[n]))
    return out


def all_covariances(landmarks: int) -> None:
    """One large map: optimum, then every pose's covariance."""
    pair = pair_of_maps(landmarks, "irregular", np.random.default_rng(SEED))
    steps = [time.process_time()]
    problem = single_map_problem(pair.map1)
    steps.append(time.process_time())
    solution = solve(problem, CONFIG)
    steps.append(time.process_time())
    keys = solution.landmark_keys(0)
    solution.covariances(keys)
    steps.append(time.process_time())
    solution.joint_covariance(keys[:10])
    steps.append(time.process_time())
    names = ("measurements", "optimum", "all covariances", "joint covariance of ten more")
    print(f"\none map of {len(keys)} landmarks")
    for name, seconds in zip(names, np.diff(steps), strict=True):
        print(f"{name:30} {seconds:8.2f} s")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="*", default=list(SIZES))
    parser.add_argument("--prepare", type=int, nargs="*", default=[20, 100, 300, 1000])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--large", type=int, default=0, metavar="N")
    arguments = parser.parse_args()
    print(f"{'landmarks':>9} {'poses':>6} {'ours':>10} {'gtsam':>10} {'ratio':>6} {'rejected':>8}")
    for n in arguments.sizes:
        r = row(n, arguments.repeat)
        print(f"{n:9} {r.poses:6} {1e3 * r.ours_s:7.1f} ms {1e3 * r.gtsam_s:7.1f} ms {r.ratio:6.2f} {r.rejected:8}")
    print(f"\n{'prepare':>9} {'without':>10} {'with dense covariance':>22}")
    for n in arguments.prepare:
        both = [prepare_seconds(n, arguments.repeat, whole=w) for w in (False, True)[: 1 + (n <= 900)]]
        print(f"{n:9} {1e3 * both[0]:7.1f} ms" + (f" {1e3 * both[1]:19.1f} ms" if len(both) > 1 else ""))
    if arguments.large:
        all_covariances(arguments.large)


if __name__ == "__main__":
    main()
