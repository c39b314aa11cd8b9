"""Simulated maps of one robot, solved alone: as far off as their joint covariance says."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from mapfuse.datasets import se2
from mapfuse.datasets.simulation import MILKA, VESPUCCI, explore, irregular_floor, record
from mapfuse.factors import LandmarkKey, axes, single_map_problem


def joint_error(seed):
    """Squared Mahalanobis distance of all positions of a map from what its robot meant, and their number.

    Not from the true places: those differ between robots by row 10, which is no error of a single map.
    """
    rng = np.random.default_rng(seed)
    floor = irregular_floor(rng)
    robot = (VESPUCCI, MILKA)[seed % 2].with_compass(seed % 3 == 0)
    recording = record(floor, explore(floor, rng, share=float(rng.uniform(0.4, 0.9))), robot, rng, "m")
    problem = single_map_problem(recording.map)
    graph = problem.graph()
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.values()).optimize()
    poses = problem.poses(values)
    landmarks = [LandmarkKey(0, name) for name in recording.map.ids]
    keys = [problem.keys.key(landmark) for landmark in landmarks]
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(gtsam.KeyVector(keys))
    C = np.block([[joint.at(a, b) for b in keys] for a in keys])
    C = axes.joint_to_axes([poses[landmark][2] for landmark in landmarks], C)
    meant = se2.transform(se2.inverse(recording.frame), np.array([recording.meant[l.id][:2] for l in landmarks]))
    e = (np.array([poses[landmark][:2] for landmark in landmarks]) - meant).ravel()
    positions = np.flatnonzero(np.arange(len(C)) % 3 < 2)
    return float(e @ np.linalg.solve(C[np.ix_(positions, positions)], e)), len(e)


def in_band(seeds, probability):
    """Whether the sum over maps lies in the band that so much of a chi-square falls in."""
    errors = [joint_error(seed) for seed in seeds]
    total, dof = (sum(column) for column in zip(*errors, strict=True))
    low, high = chi2.ppf([(1 - probability) / 2, (1 + probability) / 2], dof)
    return low < total < high


def test_a_map_is_as_far_off_as_its_joint_covariance_says():
    # fixed maps with some 2300 numbers: a band of 9 %
    assert in_band(range(30_000, 30_060), 0.998)


@pytest.mark.statistics
def test_hundreds_of_maps_are_as_far_off_as_their_joint_covariances_say():
    assert in_band(range(31_000, 31_400), 0.95)
