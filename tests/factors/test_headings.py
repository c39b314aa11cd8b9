"""What a landmark's direction is off by: the half that all its arms share, and each arm's own (rows 1, 2, 9)."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import arms
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import CompassReading, HeadingPrior, single_map_problem
from mapfuse.factors.heading import arms_variance, heading_is_joint, heading_sigma

SIGMA = 0.04
NOISE = Noise(heading_sigma=SIGMA, compass_sigma=0.05)
#: Arms of a crossing, none near +-pi: with an arm there its heading jumps by quarter turns with the noise.
CROSSING = -2.0 + np.arange(4) * np.pi / 2


def crossing(k, joint=None, errors=None):
    """A map of one landmark x with k of the arms of a crossing, each with a compass reading."""
    errors = np.zeros(k) if errors is None else errors
    links = tuple(Link("open", float(h + e), float(h)) for h, e in zip(CROSSING, errors, strict=False))
    landmarks = (Landmark("x", "junction", 0.0, 0.0, links=links), Landmark("y", "tree", 3.0, 0.0))
    return LandmarkMap("m", landmarks, noise=NOISE, joint_covariance=joint)


WHOLE = JointCovariance(("x", "y"), 3, np.eye(6))


def test_of_a_heading_the_graph_estimates_the_half_that_all_arms_share():
    for k in (1, 2, 4):
        recorded = crossing(k)
        (prior,) = single_map_problem(recorded).of_kind(HeadingPrior)
        assert heading_sigma(recorded, recorded["x"]) == pytest.approx(SIGMA / np.sqrt(2))
        assert 1 / prior.noise.tt == pytest.approx(SIGMA / np.sqrt(2))


def test_a_heading_without_arms_has_all_of_its_error():
    stated = Landmark("c", "chair", 0.0, 0.0, heading=1.0, covariance=np.diag([1.0, 1.0, 0.2**2]))
    plain = Landmark("d", "chair", 2.0, 0.0, heading=1.0, covariance=np.diag([1.0, 1.0]))
    recorded = LandmarkMap("m", (stated, plain), noise=NOISE)
    assert [heading_sigma(recorded, l) for l in recorded.landmarks] == pytest.approx([0.2, SIGMA])
    assert arms_variance(recorded, plain, 1) == 0


@pytest.mark.parametrize("k", [1, 2, 4])
def test_rotation_and_arms_together_are_as_sure_as_the_recorded_heading(k):
    # row 2: the mean over k arms is off by heading_sigma^2 (1/2 + 1/(2k))
    recorded = crossing(k)
    landmark = recorded["x"]
    total = heading_sigma(recorded, landmark) ** 2 + arms_variance(recorded, landmark, k)
    assert total == pytest.approx(SIGMA**2 * (1 / 2 + 1 / (2 * k)))


def test_each_arm_used_adds_its_own_error():
    recorded = crossing(4)
    found = [arms_variance(recorded, recorded["x"], used) for used in (1, 2, 4)]
    assert found == pytest.approx([SIGMA**2 / 2, SIGMA**2 / 4, SIGMA**2 / 8])
    assert arms_variance(recorded, recorded["x"], 0) == 0


def test_of_a_joint_heading_the_mean_error_of_all_arms_is_known():
    joint = crossing(4, WHOLE)
    found = [arms_variance(joint, joint["x"], used) for used in (1, 2, 4)]
    assert found == pytest.approx([SIGMA**2 / 2 * 3 / 4, SIGMA**2 / 2 / 4, 0])


@pytest.mark.parametrize(("joint", "used"), [(None, 1), (None, 3), (WHOLE, 1), (WHOLE, 3)])
def test_its_variance_is_the_spread_of_arms_around_the_rotation(joint, used):
    # mean error of the arms used around the rotation: what their landmark estimates, less the own errors (row 2), or
    # with a joint covariance the true heading
    rng, errors = np.random.default_rng(4), []
    true = arms.heading_of(crossing(4)["x"])
    for _ in range(4000):
        own = rng.normal(0, SIGMA / np.sqrt(2), 4)
        recorded = crossing(4, joint, own)
        heading = arms.heading_of(recorded["x"])
        directions = (true if joint else heading) + (CROSSING + own - heading)[:used]
        errors.append((directions - CROSSING[:used]).mean())
    # the standard error of a variance over 4000 draws is 2.2 %
    assert np.var(errors) == pytest.approx(arms_variance(recorded, recorded["x"], used), rel=0.09)


@pytest.mark.parametrize(
    ("joint", "x_is", "y_is"),
    [
        (None, False, False),
        (JointCovariance(("x", "y"), 2, np.eye(4)), False, False),
        (JointCovariance(("x",), 3, np.eye(3)), True, False),
        (WHOLE, True, True),
    ],
)
def test_a_heading_is_joint_where_a_joint_covariance_of_three_rows_names_its_landmark(joint, x_is, y_is):
    recorded = crossing(2, joint)
    assert [heading_is_joint(recorded, recorded[name]) for name in ("x", "y")] == [x_is, y_is]


def reading_sigmas(recorded):
    return [1 / reading.noise.tt for reading in single_map_problem(recorded).of_kind(CompassReading)]


def test_a_compass_reading_is_off_by_the_arms_own_error_too():
    expected = np.sqrt(0.05**2 + SIGMA**2 / 2)
    assert reading_sigmas(crossing(4)) == pytest.approx([expected] * 4)


@pytest.mark.parametrize("k", [1, 3, 4])
def test_readings_of_headings_in_a_joint_covariance_are_one_together(k):
    """All the covariance is of has been measured with the same compass: k readings know north as well as one does."""
    one = 0.05**2 + (1 - 1 / k) * SIGMA**2 / 2  # the mean of the arms' own errors is in the covariance
    assert 1 / np.sum(1 / np.square(reading_sigmas(crossing(k, WHOLE)))) == pytest.approx(one)


def test_readings_of_headings_beside_a_joint_covariance_count_each():
    positions_only = JointCovariance(("x", "y"), 2, np.eye(4))
    of_y_only = JointCovariance(("y",), 3, np.eye(3))
    for joint in (positions_only, of_y_only):
        assert reading_sigmas(crossing(4, joint)) == pytest.approx(reading_sigmas(crossing(4)))


@pytest.mark.parametrize("heading", [None, 0.3])
def test_a_reading_of_an_arm_that_is_no_part_of_the_heading_is_off_by_all_of_the_arms_error(heading):
    landmark = Landmark("x", "junction", 0.0, 0.0, heading=heading, links=(Link("unknown", 0.3, 0.1),))
    recorded = LandmarkMap("m", (landmark,), noise=NOISE)
    assert reading_sigmas(recorded) == pytest.approx([np.hypot(0.05, SIGMA)])
