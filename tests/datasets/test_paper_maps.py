"""The reconstruction of the paper's maps, and the hospital pair: sizes, ways, overlaps, truth, made by the script."""

import re

import numpy as np
import pytest

from mapfuse.datasets import read_map, recordings, se2
from mapfuse.datasets.paper import DIRECTIONS, HOSPITAL_WALL_ERROR, SIZES, TABLE_1
from mapfuse.datasets.recordings import HOSPITAL, PAPER_MAPS
from mapfuse.datasets.recordings.make_paper_maps import CUL_DE_SAC, hospital_building, hospital_logs, main, paper_map
from mapfuse.datasets.truth import read_truth

LOOP = {"p0": (0, 0), "p1": (25, 0), "p2": (25, 9), "p3": (17, 9), "p4": (17, 15), "p5": (0, 15), "p6": (0, 6)}


@pytest.fixture(scope="module")
def maps():
    return {name: read_map(recordings.path(name)) for name in (*PAPER_MAPS, *HOSPITAL)}


@pytest.fixture(scope="module")
def truths():
    return {scene: read_truth(recordings.truth_path(scene)) for scene in ("paper", "hospital")}


@pytest.fixture(scope="module")
def drives():
    return hospital_logs()


NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")


# the two smallest, one of each direction of travel
@pytest.mark.parametrize("name", ["D1", "D16"])
def test_the_script_makes_the_shipped_maps_to_the_byte(name, tmp_path):
    (made,) = main(tmp_path, names=(name,))
    assert made.read_bytes() == recordings.path(name).read_bytes()


def test_the_script_makes_a_large_map_to_the_last_digit(tmp_path):
    """Thousands of sums that another processor adds in another order: one of them may round to the other side."""
    (made,) = main(tmp_path, names=(HOSPITAL[1],))
    text, shipped = made.read_text(), recordings.path(HOSPITAL[1]).read_text()
    assert NUMBER.sub("#", text) == NUMBER.sub("#", shipped)
    numbers, expected = ([float(number) for number in NUMBER.findall(part)] for part in (text, shipped))
    assert numbers == pytest.approx(expected, abs=1.1e-6)


def test_nothing_else_lies_in_their_folders():
    for scene, names in (("paper", PAPER_MAPS), ("hospital", HOSPITAL)):
        folder = recordings.truth_path(scene).parent
        expected = {f"{name}.map.json" for name in names} | {f"{scene}.truth.json"}
        assert {file.name for file in folder.iterdir()} == expected


def test_each_map_has_the_size_in_the_paper_so_that_candidates_are_those_of_the_table(maps):
    assert {name: len(maps[name]) for name in PAPER_MAPS} == dict(SIZES)
    for row in TABLE_1:
        first, second = row.pair
        assert len(maps[first]) * len(maps[second]) == row.candidates


def test_each_says_what_it_is(maps):
    for name, made in maps.items():
        assert made.name == name
        assert made.extra["simulated"] is True
        assert ("Reconstruction" in made.extra["note"]) == (name in PAPER_MAPS)
        assert made.extra.get("reconstruction", False) == (name in PAPER_MAPS)
        assert made.robot in ("vespucci", "milka")
    assert maps["D1"].robot == "milka"  # said in the caption of Fig. 5


def angle_around(path):
    """Angle [rad] by which a path (n, 2) goes round the middle of the loop, counter-clockwise."""
    middle = np.array([12.5, 5.0])
    around = np.arctan2(*(path - middle).T[::-1])
    return float(np.sum(se2.wrap(np.diff(around))))


@pytest.mark.parametrize("name", PAPER_MAPS)
def test_robots_went_round_the_way_of_the_table(name, maps, truths):
    world = se2.transform(truths["paper"].frames[name], maps[name].path[:, 1:3])
    turned = angle_around(world)
    assert abs(turned) > 0.2
    assert (turned > 0) == (DIRECTIONS[name] == "counter-clockwise")


def test_d9_holds_the_cul_de_sac_that_d7_lacks(truths):
    assert CUL_DE_SAC in truths["paper"].landmarks["D9"].values()
    assert CUL_DE_SAC not in truths["paper"].landmarks["D7"].values()


def test_d1_is_of_the_northern_corridor_only(truths):
    places = [place for place in truths["paper"].landmarks["D1"].values() if place is not None]
    assert places
    assert all(truths["paper"].places[place][1] == 15 for place in places)


def test_combined_maps_are_of_the_same_part_of_the_floor(truths):
    """Each pair of the table shares places; that follows from the starts, not from any result."""
    for row in TABLE_1:
        assert len(truths["paper"].true_pairs(*row.pair)) >= 1, row.label


@pytest.mark.parametrize("name", [*PAPER_MAPS, *HOSPITAL])
def test_maps_are_true_to_a_metre_which_is_the_papers_figure(name, maps, truths):
    truth = truths["paper" if name in PAPER_MAPS else "hospital"]
    assert set(truth.landmarks[name]) == set(maps[name].ids)
    real = [(l.x, l.y, *where) for l in maps[name].landmarks if (where := truth.position(name, l.id)) is not None]
    assert len(real) >= 0.7 * len(maps[name])  # a fifth of a map may be false alarms
    at, true = np.split(np.array(real), 2, axis=1)
    # laid over the plan as a whole, as section 4.2 does it
    assert np.hypot(*se2.align(true, at).residuals.T).max() < HOSPITAL_WALL_ERROR


def test_places_are_those_of_the_floor(truths):
    places = truths["paper"].places
    assert {i: tuple(places[i]) for i in LOOP} == LOOP


def test_the_hospital_logs_are_those_of_the_maps(drives, maps, truths):
    for name in HOSPITAL:
        drive = drives[name]
        assert drive.header.name == name
        assert drive.header.extra["simulated"] is True
        assert truths["hospital"].frames[name] == pytest.approx(drive.truth.path[0, 1:], abs=1e-6)
        assert maps[name].path[-1, 0] <= drive.events[-1].t


def test_each_robot_explores_its_wing_and_goes_round_the_lifts(drives):
    building = hospital_building()
    ring = [building.floor.place_from_id[f"p{k}"].xy for k in range(6)]
    for name, side in zip(HOSPITAL, (-1, 1), strict=True):
        path = drives[name].truth.path[:, 1:3]
        assert all(np.hypot(*(path - corner).T).min() < 1.0 for corner in ring)
        far = side * path[:, 0]
        assert far.max() > 25  # from the far end of its own wing
        assert far.min() > -11  # never into the other one
        assert far[0] > 25


def test_another_seed_gives_another_drive(drives):
    other = hospital_logs(2)
    assert set(other) == set(HOSPITAL)
    assert other[HOSPITAL[0]].events != drives[HOSPITAL[0]].events


def test_unknown_names_are_key_errors():
    with pytest.raises(KeyError, match="D20"):
        recordings.path("D20")
    with pytest.raises(KeyError, match="D0"):
        paper_map("D0")
    with pytest.raises(KeyError, match="school"):
        recordings.truth_path("school")
