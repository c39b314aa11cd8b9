"""The same drives recorded again: errors that are new, and covariances that hold."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.simulation import MILKA, VESPUCCI, SimulationError, simulated_pair
from mapfuse.fusion import fuse
from mapfuse.fusion.analysis import Drives, consistency, rerecord, run_trials
from mapfuse.fusion.score import nees_of_transform

SEED = 1_000_003  # of the test seeds


@pytest.fixture(scope="module")
def drives():
    """Drives with half of the corridors each, so that many pairs are fused soon."""
    return Drives.drawn(SEED, share=(0.5, 0.6), min_common=10)


@pytest.fixture(scope="module")
def trials(drives):
    """Thirty recordings of them fused, associations not given."""
    return run_trials(drives.pair(np.random.default_rng([SEED, k])) for k in range(30))


def test_recordings_share_the_drives_and_nothing_else(drives):
    one, again, other = (drives.pair(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one[0] == again[0]
    assert one[2].places.keys() == other[2].places.keys()
    assert np.allclose(one[2].T12("A", "B").array, other[2].T12("A", "B").array)
    seen = [{place for place in pair[2].landmarks["A"].values() if place} for pair in (one, other)]
    assert seen[0] <= set(drives.routes[0].places)
    assert seen[1] <= set(drives.routes[0].places)
    shared = sorted(seen[0] & seen[1])
    assert len(shared) > 5
    at = [
        {place: pair[2].position("A", i) for i, place in pair[2].landmarks["A"].items() if place}
        for pair in (one, other)
    ]
    assert all(np.allclose(at[0][place], at[1][place]) for place in shared)  # true positions in the map's frame
    assert drives.common >= 10


def test_other_robots_drive_the_same_way(drives):
    again = drives.with_robots(MILKA.with_compass(False), VESPUCCI.with_compass(True))
    map1, map2, _ = again.pair(np.random.default_rng(4))
    assert again.routes is drives.routes
    assert (map1.robot, map2.robot) == ("milka", "vespucci")
    assert not any(link.compass is not None for l in map1.landmarks for link in l.links)
    assert any(link.compass is not None for l in map2.landmarks for link in l.links)


def test_what_cannot_come_about_is_said(monkeypatch):
    monkeypatch.setattr(rerecord, "_TRIES", 3)
    with pytest.raises(SimulationError, match="no routes with 500 common places came about in 3 draws"):
        Drives.drawn(SEED, min_common=500)


def test_covariances_hold_over_recordings_of_the_same_drives(trials):
    assert len(trials) == 30
    assert len(trials.merged) >= 27
    assert trials.merged_wrongly == 0
    # 99.9 % of the means of so many NEES lie here
    found = trials.consistency
    assert abs(found.mean - 3) < 3.3 * np.sqrt(6 / len(found.nees))
    # and the errors scatter as the mean of the stated covariances says
    stated = trials.covariances.mean(axis=0)
    scatter = consistency(trials.errors - trials.errors.mean(axis=0), stated)
    assert scatter.mean == pytest.approx(3, abs=4 * np.sqrt(6 / len(trials.merged)))


def test_a_trial_is_what_the_pair_says():
    map1, map2, truth = simulated_pair(SEED)
    (trial,) = run_trials([(map1, map2, truth)]).all
    pair = fuse([map1, map2]).pairs[0]
    assert trial.matches == len(pair.correspondences)
    assert np.array_equal(trial.covariance, pair.T12.covariance)
    true = truth.T12("A", "B")
    off = pair.T12.array - true.array
    assert trial.error == pytest.approx([*off[:2], se2.wrap(off[2])])
    assert trial.score.nees_T12 == nees_of_transform(pair.T12, true)


def test_pairs_without_any_hypothesis_count_and_say_nothing():
    map1, _, truth = simulated_pair(SEED)
    empty = map1.replace(name="B", landmarks=())
    trials = run_trials([(map1, empty, truth)])
    assert (len(trials), len(trials.merged), trials.errors.shape) == (1, 0, (0, 3))
    assert np.isnan(trials.all[0].error).all()
    with pytest.raises(MapfuseError, match="no errors to judge"):
        _ = trials.consistency
