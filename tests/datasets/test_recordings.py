"""The built-in recordings: found, well-formed, marked as simulated, made by the script, and true to their truth."""

import numpy as np
import pytest

from mapfuse.datasets import recordings
from mapfuse.datasets.mapfile import read_map
from mapfuse.datasets.recordings.make_recordings import main
from mapfuse.datasets.truth import read_truth


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return {file.name: file.read_bytes() for file in main(tmp_path_factory.mktemp("recordings"))}


def test_the_script_makes_the_shipped_files_to_the_byte(made):
    shipped = [recordings.path(name) for name in recordings.names()]
    shipped += [recordings.truth_path(scene) for scene in recordings.SCENES]
    assert {file.name: file.read_bytes() for file in shipped} == made


def test_there_are_no_other_recordings_beside_them(made):
    folder = recordings.path(recordings.names()[0]).parent
    assert {file.name for file in folder.glob("*.json")} == set(made)


@pytest.mark.parametrize("name", recordings.names())
def test_maps_are_named_after_their_files_and_marked_as_simulated(name):
    recorded = read_map(recordings.path(name))
    assert recorded.name == name
    assert recorded.robot in name
    assert recorded.extra["simulated"] is True
    assert "Simulated" in recorded.extra["note"]
    assert recorded.path[0].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert len(recorded.walls) > 4
    readings = [link.compass for landmark in recorded.landmarks for link in landmark.links]
    assert all(reading is not None for reading in readings)


def test_the_ground_floor_overlaps_and_one_map_of_it_is_unfinished():
    name1, name2 = recordings.SCENES["ground-floor"]
    map1, map2 = read_map(recordings.path(name1)), read_map(recordings.path(name2))
    truth = read_truth(recordings.truth_path("ground-floor"))
    same = truth.true_pairs(name1, name2)
    assert len(same) >= 9
    assert len(map2) < len(map1)
    assert set(truth.landmarks[name1]) == set(map1.ids)
    assert set(truth.landmarks[name2]) == set(map2.ids)
    T12 = truth.T12(name1, name2)
    apart = [np.hypot(*(map1.positions[map1.index_from_id[a]] - T12.apply([map2[b].x, map2[b].y]))) for a, b in same]
    assert np.median(apart) < 1.5


def test_the_two_buildings_share_nothing():
    name1, name2 = recordings.SCENES["two-buildings"]
    truth = read_truth(recordings.truth_path("two-buildings"))
    assert truth.true_pairs(name1, name2) == ()
    for name in (name1, name2):
        assert set(truth.landmarks[name]) == set(read_map(recordings.path(name)).ids)


@pytest.mark.parametrize("find", [recordings.path, recordings.truth_path])
def test_an_unknown_name_is_a_key_error(find):
    with pytest.raises(KeyError, match="attic"):
        find("attic")
