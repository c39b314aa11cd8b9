"""Walls in the graph and in the decision: T12 on bent maps, its NEES, and a floor that one alcove tells from its image.

Maps are drawn from the joint covariance that they state (`drifted`): simulated, and nothing was tuned on these seeds.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from mapfuse.datasets import se2, write_map
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation.drifted import drifted, driven
from mapfuse.factors import FrameKey, LandmarkKey, build_problem, pair_problem
from mapfuse.fusion import fuse, read_fused
from mapfuse.fusion.batch.packing import config_bytes, config_from_bytes
from mapfuse.fusion.cli import main
from mapfuse.fusion.config import FuseConfig, SolvingConfig, WallsConfig
from mapfuse.fusion.pair import NEGLIGIBLE
from mapfuse.fusion.solve import solve
from mapfuse.fusion.wallfit import evidence_of_walls, with_walls

WALLS = WallsConfig(use=True)
WIDTH = 1.0
CORNERS = np.array([[-18.0, -9.0], [18.0, -9.0], [18.0, 9.0], [-18.0, 9.0]])
HALF = np.array(
    [[-18, -9.6], [-13, -8.5], [-7, -9.5], [-1, -8.6], [4, -9.4], [11, -8.4], [18, -9.2], [17.6, -3], [18.3, 4]]
)
#: Symmetric under half a turn, as the corridors are.
MARKS = np.concatenate([HALF, -HALF])


def ring(alcove: bool) -> list[np.ndarray]:
    """Both walls of a corridor round a rectangle; the upper one with a recess of four metres, 1.5 deep, or without."""
    found = []
    for a, b in ((18 + WIDTH, 9 + WIDTH), (18 - WIDTH, 9 - WIDTH)):
        corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]])
        found += [corners[k : k + 2] for k in range(4)]
    if alcove:
        y = found[2][0, 1]
        recess = [[9.0, y], [9.0, y + 1.5], [5.0, y + 1.5], [5.0, y]]
        found[2] = np.concatenate([found[2][:1], recess, found[2][1:]])
    return found


def pair(seed: int, alcove: bool = False, *, anywhere: bool = False) -> tuple[LandmarkMap, LandmarkMap, np.ndarray]:
    """Two robots that drive round in opposite directions from two corners, and their T12.

    ``anywhere``: landmarks elsewhere for each seed.
    """
    rng = np.random.default_rng(seed)
    marks = MARKS
    if anywhere:
        half = np.column_stack([np.linspace(-18, 18, 8), -9 + rng.uniform(-0.7, 0.7, 8)])
        half = np.concatenate([half, [[18.0, rng.uniform(-5, 5)]]])
        marks = np.concatenate([half, -half])
    ways = driven(CORNERS, 0), driven(CORNERS, 1, back=True)
    first, second = (drifted(name, ring(alcove), way, marks, rng) for name, way in zip("AB", ways, strict=True))
    return first, second, np.asarray(se2.between(ways[0][0], ways[1][0]))


def test_walls_lessen_the_error_of_T12_and_its_covariance_holds() -> None:
    errors, nees = [], []
    for seed in range(2_100_000, 2_100_024):
        first, second, T12 = pair(seed)
        matches = [(name, name) for name in first.ids]
        without = solve(pair_problem(first, second, T12 + np.array([0.1, 0.1, 0.01]), matches), SolvingConfig())
        fit = with_walls(without, WALLS)
        assert fit is not None
        found = []
        for solution in (without, fit.solution):
            error = solution.frame(1) - T12
            error[2] = se2.wrap(error[2])
            found.append(error)
        errors.append(found)
        nees.append(found[1] @ np.linalg.solve(fit.solution.covariance(FrameKey(1)), found[1]))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.hypot(*rms[1, :2]) < 0.8 * np.hypot(*rms[0, :2])
    assert rms[1, 2] < 0.8 * rms[0, 2]
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_walls_of_three_maps_lessen_the_errors_of_their_frames_and_covariances_hold() -> None:
    """Each wall is in three offsets, which know three walls' errors: counted as three, NEES would leave the band."""
    errors, nees = [], []
    for seed in range(2_150_000, 2_150_016):
        rng = np.random.default_rng(seed)
        ways = driven(CORNERS, 0), driven(CORNERS, 1, back=True), driven(CORNERS, 2)
        maps = [drifted(name, ring(True), way, MARKS, rng) for name, way in zip("ABC", ways, strict=True)]
        frames = [np.asarray(se2.between(ways[0][0], way[0])) for way in ways]
        same = [[LandmarkKey(r, name) for r in range(3)] for name in maps[0].ids]
        matches = [match for place in same for match in combinations(place, 2)]
        without = solve(build_problem(maps, frames, matches), SolvingConfig())
        fit = with_walls(without, WALLS, ((0, 1), (0, 2), (1, 2)))
        assert fit is not None
        found = []
        for solution in (without, fit.solution):
            off = np.array([solution.frame(r) - frames[r] for r in (1, 2)])
            off[:, 2] = se2.wrap(off[:, 2])
            found.append(off)
        errors.append(found)
        C = fit.solution.joint_covariance([FrameKey(1), FrameKey(2)])
        nees.append(found[1].ravel() @ np.linalg.solve(C, found[1].ravel()))
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert np.hypot(*rms[1, :2]) < 0.8 * np.hypot(*rms[0, :2])
    assert rms[1, 2] < 0.8 * rms[0, 2]
    low, high = chi2.ppf([0.005, 0.995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_walls_are_in_the_result_whichever_map_comes_first() -> None:
    first, second, T12 = pair(2_160_000, alcove=True)
    config = FuseConfig(walls=WALLS)
    one, other = (fuse(maps, config) for maps in ([first, second], [second, first]))
    assert one.decision == other.decision == "merged"
    there, back = one.frames["B"].T, other.frames["A"].T.inverse()
    assert np.asarray(se2.between(there.array, back.array)) == pytest.approx(np.zeros(3), abs=1e-3)
    assert np.sqrt(np.diag(back.covariance)) == pytest.approx(np.sqrt(np.diag(there.covariance)), rel=0.02)
    assert np.asarray(se2.between(T12, there.array)) == pytest.approx(np.zeros(3), abs=0.5)


def test_walls_that_are_not_where_they_were_seen_are_gated() -> None:
    first, second, T12 = pair(3)
    joint = second.joint_covariance
    assert joint is not None
    assert joint.keyframes is not None
    kept = joint.keyframes
    walls = np.array(kept.walls)
    walls[::30, [2, 4]] += 0.5  # every thirtieth piece half a metre to the left
    moved = type(kept)(kept.poses, walls, kept.with_landmarks, kept.matrix)
    wrong = second.replace(joint_covariance=type(joint)(joint.order, joint.rows, joint.matrix, {}, moved))
    matches = [(name, name) for name in first.ids]
    fits = [with_walls(solve(pair_problem(first, m, T12, matches), SolvingConfig()), WALLS) for m in (second, wrong)]
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[1].count < fits[0].count
    apart = fits[1].solution.frame(1) - fits[0].solution.frame(1)
    apart[2] = se2.wrap(apart[2])
    assert np.abs(apart).max() < 3 * np.sqrt(np.diag(fits[0].solution.covariance(FrameKey(1)))).max()


def test_nothing_is_said_where_a_map_has_no_keyframes() -> None:
    first, second, T12 = pair(0)
    bare = second.replace(joint_covariance=None, walls=())
    solution = solve(pair_problem(first, bare, T12, [(name, name) for name in first.ids]), SolvingConfig())
    assert with_walls(solution, WALLS) is None
    assert evidence_of_walls(solution, WALLS) is None


@pytest.mark.parametrize("seed", range(2_200_000, 2_200_006))
def test_one_alcove_decides_a_symmetric_floor_and_only_with_walls(seed: int) -> None:
    first, second, T12 = pair(seed, alcove=True)
    without = fuse([first, second])
    assert without.decision == "ambiguous"
    found = fuse([first, second], FuseConfig(walls=WALLS))
    assert found.decision == "merged"
    best = found.pairs[0].hypotheses[0]
    assert abs(float(se2.wrap(best.T12.theta - T12[2]))) < 0.2
    assert found.pairs[0].hypotheses[1].evidence["walls"] < -4.0


def test_walls_are_asked_of_every_rival_that_counts() -> None:
    """Landmarks in even rows lie on each other in dozens of ways: what walls take from some must not go to the rest."""
    first, second, T12 = pair(1_950_010, alcove=True, anywhere=True)
    found = fuse([first, second], FuseConfig(walls=WALLS))
    hypotheses = found.pairs[0].hypotheses
    assert found.decision == "merged"
    assert abs(float(se2.wrap(hypotheses[0].T12.theta - T12[2]))) < 0.2
    assert len(hypotheses) > 20
    assert all(h.evidence["walls"] < 0 for h in hypotheses[1:] if h.probability >= NEGLIGIBLE)


def test_without_the_alcove_walls_do_not_decide_either() -> None:
    first, second, _ = pair(2_300_000)
    assert fuse([first, second], FuseConfig(walls=WALLS)).decision == "ambiguous"


def test_the_parameters_of_walls_reach_the_workers_of_a_batch() -> None:
    config = FuseConfig(walls=WallsConfig(use=True, gate_m=0.5))
    assert config_from_bytes(config_bytes(config)) == config


def test_the_command_lets_walls_speak(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, _ = pair(2_200_000, alcove=True)
    files = [tmp_path / f"{m.name}.map.json" for m in (first, second)]
    for file, m in zip(files, (first, second), strict=True):
        write_map(m, file)
    output = tmp_path / "out.fused.json"
    arguments = ["mapfuse", "fuse", *map(str, files), "--walls", "--quiet", "-o", str(output)]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code in (0, None)
    fused = read_fused(output)
    assert fused.decision == "merged"
    assert fused.provenance["config"]["walls"]["use"] is True
