"""`mapfuse batch` on recordings: Victoria Park's 200 local maps; MRCLAM's 15 with three indoor object maps; Halmstad.

    .venv/bin/python benchmarks/batch_folders.py SHARED_DATA RUNS victoria-park [--maps 200] [--jobs 2]
    .venv/bin/python benchmarks/batch_folders.py SHARED_DATA RUNS arenas
    .venv/bin/python benchmarks/batch_folders.py SHARED_DATA RUNS halmstad

SHARED_DATA is not part of the repository; ids are dropped and frames are each map's own. RUNS keeps folders and
ledgers, so that a measurement that was stopped goes on. Quick form: ``--maps 20``. What is printed goes into
``benchmarks/results/batch-folders.md`` by hand, with what it ran on.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import compare_real
import gtsam
import numpy as np
from compare_real import Pair
from numpy.typing import NDArray
from scipy.io import loadmat

from mapfuse.datasets import JointCovariance, Landmark, LandmarkMap, Noise, read_map, se2, write_map
from mapfuse.fusion.batch.engine import LocalEngine
from mapfuse.fusion.batch.run import run_batch
from mapfuse.fusion.config import FuseConfig

Array = NDArray[np.float64]

#: As in tests/conftest.py: set knowing the residuals, one value per data set.
SLIDESLAM_NOISE = Noise(position_sigma=0.25, detection_rate=0.6, false_alarm_rate=0.2)
MRCLAM_NOISE = Noise(position_sigma=0.15, detection_rate=0.95, false_alarm_rate=0.02)
TREES_NOISE = Noise(position_sigma=0.3, detection_rate=0.8, false_alarm_rate=0.05)
#: A map is placed wrongly where it disagrees with one of its nearest placed neighbours by more than this [m].
WRONG_M, NEIGHBOURS = 2.0, 3
#: Numbers of shared trees that pairs are counted by.
SHARED = ((0, 0), (1, 3), (4, 5), (6, 7), (8, 9), (10, 12), (13, 99))


def victoria_park(data: Path, count: int) -> tuple[list[LandmarkMap], Array, NDArray[np.intp]]:
    """The first local maps, ids dropped; poses (n, 3) solved with the true ids; how many trees they share (n, n)."""
    rng = np.random.default_rng(30)
    maps, ids, ends, at = [], [], [], []
    for number in range(1, count + 1):
        file = loadmat(data / "vicpark_local_maps" / f"localmap_{number}.mat")
        state, P = file["localmap_st"], file["localmap_P"]
        ends.append(state[:3, 1])
        tree, xy = state[3::2, 0].astype(int), state[3:, 1].reshape(-1, 2)
        order = rng.permutation(len(tree))
        rows = (3 + 2 * order[:, None] + np.arange(2)).ravel()
        C = P[np.ix_(rows, rows)]
        marks = tuple(Landmark(f"p{k}", "tree", *xy[i].tolist()) for k, i in enumerate(order.tolist()))
        joint = JointCovariance(tuple(m.id for m in marks), 2, (C + C.T) / 2)
        maps.append(LandmarkMap(f"v{number:03d}", marks, noise=TREES_NOISE, joint_covariance=joint))
        ids.append(tree)
        at.append(xy)
    seen = [set(of_map.tolist()) for of_map in ids]
    shared = np.array([[len(a & b) for b in seen] for a in seen], dtype=np.intp)
    return maps, _solved(ids, at, ends), shared


def _solved(ids: list[Array], at: list[Array], ends: list[Array]) -> Array:
    """Poses of local maps that see trees with known ids: least squares over all sightings."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.addPriorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))
    start = np.zeros(3)
    for k in range(len(ids)):
        if k:
            start = se2.compose(start, ends[k - 1])
        values.insert(k, gtsam.Pose2(*start))
        for tree, (x, y) in zip(ids[k].tolist(), at[k], strict=True):
            key, distance = gtsam.symbol("t", tree), float(np.hypot(x, y))
            if not values.exists(key):
                values.insert(key, gtsam.Point2(*se2.transform(start, np.array([x, y]))))
            graph.add(gtsam.BearingRangeFactor2D(k, key, gtsam.Rot2(np.arctan2(y, x)), distance, _sighting(distance)))
    # plain first: from where the odometry left it, the robust cost would let go of the loops that it has to close
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    robust = gtsam.NonlinearFactorGraph()
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
    for factor in (graph.at(i) for i in range(graph.size())):
        model = factor.noiseModel()
        robust.add(factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(cauchy, model)))
    values = gtsam.LevenbergMarquardtOptimizer(robust, values).optimize()
    poses = (values.atPose2(k) for k in range(len(ids)))
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


def _sighting(distance: float) -> gtsam.noiseModel.Diagonal:
    """0.3 m across and along, as bearing [rad] and range [m]."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([0.3 / max(distance, 1.0), 0.3]))


def arenas(data: Path) -> list[LandmarkMap]:
    """All five robots of three MRCLAM sets, tubes without names, and three indoor object maps."""
    rng = np.random.default_rng(20)
    maps = []
    for path in sorted((data / "mrclam" / "derived").glob("*.csv")):
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        order = rng.permutation(len(rows))
        marks = tuple(
            Landmark(
                f"p{k}", "tube", float(rows[i]["x_m"]), float(rows[i]["y_m"]), detection_counter=int(rows[i]["n_obs"])
            )
            for k, i in enumerate(order.tolist())
        )
        maps.append(LandmarkMap(path.stem, marks, noise=MRCLAM_NOISE))
    for path in sorted((data / "slideslam").glob("*_indoor.txt")):
        objects = rng.permutation(np.loadtxt(path))
        marks = tuple(Landmark(f"p{k}", f"class-{int(c)}", x, y) for k, (c, x, y, _) in enumerate(objects.tolist()))
        maps.append(LandmarkMap(path.stem, marks, noise=SLIDESLAM_NOISE))
    return maps


def coverage(shared: NDArray[np.intp], names: list[str], run: Path) -> str:
    """Pairs by the number of trees they share: all, compared, merged by themselves, in one group."""
    place, group = {name: k for k, name in enumerate(names)}, {name: g for name, (g, _) in _placed(run).items()}
    compared, merged = np.zeros((2, *shared.shape), dtype=bool)
    with (run / "pairs.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            pair = tuple(sorted((place[row["map1"]], place[row["map2"]])))
            compared[pair], merged[pair] = True, row["decision"] == "merged"
    together = np.array([[a in group and group[a] == group.get(b) for b in names] for a in names])
    lines = ["| shared trees | pairs | compared | merged | in one group |", "|---|---|---|---|---|"]
    upper = np.triu(np.ones(shared.shape, dtype=bool), 1)
    for low, high in SHARED:
        of_band = upper & (shared >= low) & (shared <= high)
        counts = (int((of_band & which).sum()) for which in (of_band, compared, merged, together))
        lines.append(f"| {low} to {high} | {' | '.join(map(str, counts))} |")
    return "\n".join(lines)


def halmstad() -> tuple[list[LandmarkMap], list[Pair], FuseConfig]:
    """The corners of 14 sensor maps of floor E5, the 91 pairs with their truth, and parameters in metres."""
    pairs = list(compare_real.halmstad())
    maps = {m.name: m for pair in pairs for m in (pair.map1, pair.map2)}
    return [maps[name] for name in sorted(maps)], pairs, pairs[0].config


def judged_pairs(pairs: Sequence[Pair], run: Path) -> str:
    """How many pairs the groups lay on each other rightly, wrongly, or not."""
    placed = _placed(run)
    right, wrong = 0, []
    for pair in pairs:
        names = pair.map1.name, pair.map2.name
        if not all(name in placed for name in names) or placed[names[0]][0] != placed[names[1]][0]:
            continue
        common = [pair.map2.index_from_id[b] for _, b in pair.truth.true_pairs(*names)]
        at = pair.map2.positions[common]
        T12 = se2.between(placed[names[0]][1], placed[names[1]][1])
        off = float(np.hypot(*(se2.transform(T12, at) - pair.truth.T12(*names).apply(at)).T).mean())
        right += off < pair.limit
        wrong += [f"{names[0]}-{names[1]} {off:.2f} of {pair.limit:.2f} m"] if off >= pair.limit else []
    return f"{right} of {len(pairs)} pairs right, wrong: {wrong}, the others in different groups"


def _placed(run: Path) -> dict[str, tuple[str, Array]]:
    """Group and pose of each map that has them."""
    with (run / "maps.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["group"]]
    return {row["map"]: (row["group"], np.array([float(row[k]) for k in ("x", "y", "theta")])) for row in rows}


def judged(poses: Array, names: list[str], maps: list[LandmarkMap], run: Path) -> str:
    """How many maps are placed, in how many groups, and which disagree with their nearest placed neighbours."""
    place = {name: k for k, name in enumerate(names)}
    placed = _placed(run)
    wrong = set()
    for name, (group, T) in placed.items():
        beside = [other for other, (g, _) in placed.items() if g == group and other != name]
        beside.sort(key=lambda other: float(np.hypot(*(poses[place[other]] - poses[place[name]])[:2])))
        for other in beside[:NEIGHBOURS]:
            found = se2.between(placed[other][1], T)
            truth = se2.between(poses[place[other]], poses[place[name]])
            at = maps[place[name]].positions
            if np.hypot(*(se2.transform(found, at) - se2.transform(truth, at)).T).mean() > WRONG_M:
                wrong.add(name)
    sizes = sorted((sum(g == k for g, _ in placed.values()) for k in {g for g, _ in placed.values()}), reverse=True)
    return f"{len(placed)} of {len(names)} placed, groups of {sizes}; disagree with neighbours: {sorted(wrong)}"


def main() -> None:
    """Run one folder and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("which", choices=["victoria-park", "arenas", "halmstad"])
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    poses, shared, pairs, config = None, None, [], FuseConfig()
    if args.which == "arenas":
        maps = arenas(args.data)
    elif args.which == "halmstad":
        maps, pairs, config = halmstad()
    else:
        maps, poses, shared = victoria_park(args.data, args.maps)
    folder = args.runs / f"{args.which}-{len(maps)}"
    folder.mkdir(parents=True, exist_ok=True)
    for recorded in maps:
        write_map(recorded, folder / f"{recorded.name}.map.json")
    run = args.runs / f"{args.which}-{len(maps)}-run"
    begin = time.perf_counter()
    with closing(LocalEngine(args.jobs)) as engine:
        summary = run_batch(folder, run, config, engine)
    print(f"{summary}\n{time.perf_counter() - begin:.0f} s with {args.jobs} workers")
    if shared is not None:
        print(coverage(shared, [m.name for m in maps], run))
    if poses is not None:
        print(judged(poses, [m.name for m in maps], [read_map(folder / f"{m.name}.map.json") for m in maps], run))
    if pairs:
        print(judged_pairs(pairs, run))
    for path in sorted((run / "groups").glob("*.json")):
        print(path.name, json.loads(path.read_bytes())["groups"])


if __name__ == "__main__":
    main()
