"""Simulated maps follow docs/measurement-model.md: each row's errors against its stated sigma, at 99.9 %.

What is true is taken from the floor and from `Recording.meant`; the links' and arms' errors are worked out here anew.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import binom, chi2, nbinom

from mapfuse.datasets import se2
from mapfuse.datasets.simulation import MILKA, VESPUCCI, explore, make_floor, record

RECORDINGS = 160
BENT = np.deg2rad(25)


@dataclass(frozen=True)
class Arm:
    """A recorded arm: heading and true direction in the map's frame, by how far it's off; where its link leads."""

    link: object
    corridor: float
    true: float
    error: float
    far: int | None
    bent: bool


@dataclass(frozen=True)
class Case:
    floor: object
    route: object
    recording: object
    positions: np.ndarray
    arms: list

    @property
    def map(self):
        return self.recording.map


def corridor_directions(case_floor, recording, landmark):
    """True arm directions in the world: of the place, or of the corridor that a false alarm lies on."""
    place = recording.place_from_id[landmark.id]
    x, y, turn = recording.meant[landmark.id]
    if place is not None:
        return [arm.direction + turn for arm in case_floor.place_from_id[place].arms]
    for corridor in case_floor.corridors:
        a, b = (case_floor.place_from_id[i].xy for i in (corridor.places[0], corridor.places[-1]))
        along = (b - a) / np.hypot(*(b - a))
        t = (np.array([x, y]) - a) @ along
        if 0 < t < np.hypot(*(b - a)) and np.hypot(*(a + t * along - [x, y])) < 1e-6:
            return [np.arctan2(along[1], along[0]) + k * np.pi / 2 for k in range(4)]
    raise AssertionError("a false alarm that is on no corridor")


def case_of(seed, robot, kind="irregular"):
    rng = np.random.default_rng(seed)
    floor = make_floor(kind, rng)
    route = explore(floor, rng, rng.uniform(0.4, 0.9))
    recording = record(floor, route, robot, rng, "A")
    recorded, frame = recording.map, recording.frame
    positions = se2.transform(se2.inverse(frame), np.array([recording.meant[i][:2] for i in recorded.ids]))
    arms = []
    for k, landmark in enumerate(recorded.landmarks):
        directions = [d - frame[2] for d in corridor_directions(floor, recording, landmark)]
        found = []
        for link in landmark.links:
            corridor = min(directions, key=lambda d: abs(se2.wrap(d - link.heading)))
            far, true, bent = None, corridor, False
            if link.connected_to_id is not None:
                far = recorded.index_from_id[link.connected_to_id]
                chord = np.arctan2(*(positions[far] - positions[k])[::-1])
                bent = bool(abs(se2.wrap(chord - corridor)) > BENT)
                true = corridor if bent else chord
            error = float(se2.wrap(link.heading - true))
            found.append(Arm(link, corridor, true, error, far, bent))
        arms.append(found)
    return Case(floor, route, recording, positions, arms)


@pytest.fixture(scope="module")
def cases():
    return [case_of(seed, (VESPUCCI, MILKA)[seed % 2].with_compass(False)) for seed in range(RECORDINGS)]


def assert_chi_square(squares, dof, level=0.999):
    """The sum of whitened squares lies in its two-sided band."""
    assert dof > 50
    low, high = chi2.ppf([(1 - level) / 2, (1 + level) / 2], dof)
    assert low < np.sum(squares) < high, f"{np.sum(squares) / dof:.3f} per degree of freedom of {dof}"


def assert_binomial(hits, of, rate, level=0.999):
    low, high = binom.ppf([(1 - level) / 2, (1 + level) / 2], of, rate)
    assert low <= hits <= high, f"{hits} of {of} = {hits / of:.3f} instead of {rate}"


def test_row_1_half_of_an_arms_error_is_shared_by_its_landmark(cases):
    shared, own, dof = [], [], 0
    for case in cases:
        half = case.map.noise.heading_sigma**2 / 2
        for arms in case.arms:
            errors = np.array([arm.error for arm in arms])
            shared.append(np.mean(errors) ** 2 / (half * (1 + 1 / len(errors))))
            own.append(np.sum((errors - np.mean(errors)) ** 2) / half)
            dof += len(errors) - 1
    assert_chi_square(shared, len(shared))
    assert_chi_square(own, dof)


def test_row_2_landmark_headings(cases):
    squares = []
    for case in cases:
        for arms in case.arms:
            k = len(arms)
            off = np.mean([se2.wrap(arm.link.heading - arm.corridor) for arm in arms])
            squares.append(off**2 / (case.map.noise.heading_sigma**2 * (0.5 + 0.5 / k)))
    # travelled arms point to where the robot means the next place to be: a little more than the row says
    assert 0.97 < np.mean(squares) < 1.06


def test_row_3_directions_of_links_relative_to_the_landmark(cases):
    rng, squares = np.random.default_rng(0), []
    for case in cases:
        for arms in case.arms:
            straight = [arm for arm in arms if arm.far is not None and not arm.bent]
            if straight and len(arms) > 1:
                one = straight[rng.integers(len(straight))]
                off = one.error - np.mean([arm.error for arm in arms])
                squares.append(off**2 / (case.map.noise.heading_sigma**2 / 2 * (1 - 1 / len(arms))))
    assert_chi_square(squares, len(squares))


def test_rows_3_and_4_distances_are_one_reading_that_both_ends_record(cases):
    squares = {1: [], 2: []}
    for case in cases:
        for k, arms in enumerate(case.arms):
            for arm in arms:
                if arm.far is None or arm.bent:
                    continue
                back = [a.link for a in case.arms[arm.far] if a.far == k and not a.bent]
                assert [link.distance for link in back] == [arm.link.distance]
                assert back[0].travel_counter == arm.link.travel_counter
                length = np.hypot(*(case.positions[arm.far] - case.positions[k]))
                sigma = (0.1 + 0.02 * length) / np.sqrt(arm.link.travel_counter)
                if k < arm.far:
                    squares[min(arm.link.travel_counter, 2)].append(((arm.link.distance - length) / sigma) ** 2)
    assert_chi_square(squares[1], len(squares[1]))
    assert_chi_square(squares[2], len(squares[2]))


def test_row_5_bent_links_carry_the_error_of_the_travelled_distance(cases):
    along, across = [], []
    for case in cases:
        for k, arms in enumerate(case.arms):
            for arm in (a for a in arms if a.bent):
                assert not [a for a in case.arms[arm.far] if a.far == k]
                heading_error = np.mean([a.error for a in arms])
                true = case.positions[arm.far] - case.positions[k]
                recorded = case.map.positions[arm.far] - case.map.positions[k]
                assert abs(se2.wrap(np.arctan2(recorded[1], recorded[0]) - arm.link.heading)) > np.deg2rad(20)
                off = se2.rotation(-heading_error) @ recorded - true
                unit, noise = true / np.hypot(*true), case.map.noise
                along.append((off @ unit / noise.distance_sigma(arm.link.distance)) ** 2)
                across.append((off @ [-unit[1], unit[0]] / (arm.link.distance * noise.heading_sigma)) ** 2)
    assert_chi_square(along, len(along))
    assert_chi_square(across, len(across))


def test_straight_links_look_straight(cases):
    for case in cases:
        for k, arms in enumerate(case.arms):
            for arm in (a for a in arms if a.far is not None and not a.bent):
                x, y = case.map.positions[arm.far] - case.map.positions[k]
                assert abs(se2.wrap(np.arctan2(y, x) - arm.link.heading)) < np.deg2rad(20)


def test_row_6_the_landmark_nearest_to_the_start_ties_the_frame(cases):
    squares = []
    for case in cases:
        k = int(np.argmin(np.hypot(*case.map.positions.T)))
        assert k == int(np.argmin(np.hypot(*case.positions.T)))
        squares.append(np.sum((case.map.positions[k] - case.positions[k]) ** 2) / 0.3**2)
    assert_chi_square(squares, 2 * len(squares))


def test_row_9_compass_readings_with_an_offset_per_robot():
    robot = replace(VESPUCCI, bent_compass=0.0)
    within, offsets, dof = [], [], 0
    for seed in range(90):
        case = case_of(seed, robot)
        off = np.array([
            se2.wrap(arm.link.compass - (arm.true + case.recording.frame[2] - case.floor.north))
            for arms in case.arms
            for arm in arms
        ])  # fmt: skip
        offsets.append(np.mean(off) ** 2 / (0.1**2 + 0.2**2 / len(off)))
        within.append(np.sum((off - np.mean(off)) ** 2) / 0.2**2)
        dof += len(off) - 1
    assert_chi_square(offsets, len(offsets))
    assert_chi_square(within, dof)


def test_row_9_steel_bends_some_readings_to_anywhere():
    sure = replace(VESPUCCI, noise=replace(VESPUCCI.noise, compass_sigma=1e-9, compass_offset_sigma=0.0))
    off = np.array([
        se2.wrap(arm.link.compass - (arm.true + case.recording.frame[2] - case.floor.north))
        for case in (case_of(seed, sure) for seed in range(40))
        for arms in case.arms
        for arm in arms
    ])  # fmt: skip
    bent = off[np.abs(off) > 1e-6]
    assert_binomial(len(bent), len(off), 0.05)
    assert_binomial(np.sum(np.abs(bent) > np.pi / 2), len(bent), 0.5)


def test_row_9_an_unknown_offset_is_anywhere():
    lost = replace(VESPUCCI, noise=replace(VESPUCCI.noise, compass_offset_sigma=None))
    offsets = []
    for seed in range(60):
        case = case_of(seed, lost)
        arm = case.arms[0][0]
        offsets.append(se2.wrap(arm.link.compass - (arm.true + case.recording.frame[2] - case.floor.north)))
    assert_binomial(np.sum(np.abs(offsets) > np.pi / 2), 60, 0.5)


def test_row_10_each_robot_has_half_of_the_variance_between_two(cases):
    places, turns = [], []
    for case in cases:
        for identifier, place in case.recording.place_from_id.items():
            if place is not None:
                *xy, turn = case.recording.meant[identifier]
                places.append(np.sum((xy - case.floor.place_from_id[place].xy) ** 2) / (0.05**2 / 2))
                turns.append(turn**2 / (0.01**2 / 2))
    assert_chi_square(places, 2 * len(places))
    assert_chi_square(turns, len(turns))


@pytest.mark.parametrize(("robot", "door_rate"), [(VESPUCCI, 0.92), (MILKA, 0.85)])
def test_row_11_detection_rates(cases, robot, door_rate):
    passed, recorded = Counter(), Counter()
    for case in (c for c in cases if c.map.robot == robot.name):
        for place in set(case.route.places) - {case.route.places[0]}:
            kind = case.floor.place_from_id[place].type
            passed[kind] += 1
            recorded[kind] += place in case.recording.true_places
    assert_binomial(recorded["door"], passed["door"], door_rate)
    # a missed corner that would pass for a straight corridor is drawn again, so a little more is seen
    sonar = recorded["corner"] + recorded["junction"], passed["corner"] + passed["junction"]
    assert 0.79 < sonar[0] / sonar[1] < 0.85


@pytest.mark.parametrize(("kind", "rate"), [("corner", 0.2), ("junction", 0.2), ("door", 0.03)])
@pytest.mark.parametrize("detections", [1, 2])
def test_row_11_false_alarms_to_the_power_of_the_detections(cases, kind, rate, detections):
    true = false = 0
    for case in cases:
        for identifier, place in case.recording.place_from_id.items():
            landmark = case.map[identifier]
            if (landmark.type, landmark.detection_counter) == (kind, detections):
                false += place is None
                true += place is not None
    low, high = nbinom.ppf([0.0005, 0.9995], true, 1 - rate**detections)
    assert true > 100
    assert low <= false <= high, f"{false} false of {true + false}"


def test_arms_that_were_not_travelled_are_missing_now_and_then(cases):
    listed = total = 0
    for case in cases:
        for landmark, arms in zip(case.map.landmarks, case.arms, strict=True):
            place = case.recording.place_from_id[landmark.id]
            if place is not None:
                sealed = [a for a in case.floor.place_from_id[place].arms if a.type in ("blocked", "door")]
                total += len(sealed)
                listed += sum(arm.link.type in ("blocked", "door") for arm in arms)
    assert_binomial(listed, total, 0.95)


def least_squares_residuals(case, positions, headings):
    """All that a map says, whitened, as a function of positions (n, 2) and landmark headings (n,): rows 1, 3, 5, 6."""
    noise, recorded, rows = case.map.noise, case.map.positions, []
    anchor = int(np.argmin(np.hypot(*recorded.T)))
    rows.append((recorded[anchor] - positions[anchor]) / noise.position_sigma)
    for k, arms in enumerate(case.arms):
        off = []
        for arm in arms:
            true = headings[k] + arm.corridor - arms[0].corridor
            if arm.far is not None and not arm.bent:
                step = positions[arm.far] - positions[k]
                true = np.arctan2(step[1], step[0])
                if k < arm.far:
                    sigma = noise.distance_sigma(arm.link.distance, arm.link.travel_counter)
                    rows.append([(arm.link.distance - np.hypot(*step)) / sigma])
            off.append(float(se2.wrap(arm.link.heading - true)))
        covariance = noise.heading_sigma**2 / 2 * (np.eye(len(arms)) + 1)
        rows.append(np.linalg.solve(np.linalg.cholesky(covariance), off))
        for arm in (a for a in arms if a.bent):
            seen = se2.rotation(-np.mean(off)) @ (recorded[arm.far] - recorded[k])
            unit, left = seen / np.hypot(*seen), seen - (positions[arm.far] - positions[k])
            across = left @ [-unit[1], unit[0]] / (arm.link.distance * noise.heading_sigma)
            rows.append([left @ unit / noise.distance_sigma(arm.link.distance), across])
    return np.concatenate(rows)


def test_least_squares_by_the_model_is_consistent_on_these_maps(cases):
    nees, dof = [], 0
    for case in cases[:60]:
        n = len(case.map)
        truth = np.concatenate([case.positions.ravel(), [arms[0].corridor for arms in case.arms]])

        def residuals(x, case=case, n=n):
            return least_squares_residuals(case, x[: 2 * n].reshape(-1, 2), x[2 * n :])

        at_truth = residuals(truth)
        J = np.stack([(residuals(truth + step) - at_truth) / 1e-6 for step in 1e-6 * np.eye(3 * n)], axis=1)
        # a heading that all arms leave free (each one leads along a link) is held weakly
        covariance = np.linalg.inv(J.T @ J + 1e-6 * np.eye(3 * n))
        error = (-covariance @ J.T @ at_truth)[: 2 * n]
        nees.append(error @ np.linalg.solve(covariance[: 2 * n, : 2 * n], error))
        dof += 2 * n
    assert_chi_square(nees, dof)
