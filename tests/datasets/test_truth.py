"""Truth files: round trip, every broken rule at once, and what the truth answers."""

import json
import pickle

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.datasets.truth import Truth, read_truth, write_truth


def small_truth(**changes):
    fields = {
        "frames": {"A": [0.0, 0.0, 0.0], "B": [3.0, 1.0, np.pi / 2]},
        "landmarks": {"A": {"a1": "p", "a2": None, "a3": "q"}, "B": {"b1": "q", "b2": "p", "b3": "p"}},
        "places": {"p": [2.0, 5.0], "q": [-1.0, 0.5]},
    }
    return Truth(**(fields | changes))


def test_answers_by_hand():
    truth = small_truth()
    T12 = truth.T12("A", "B")
    assert (T12.x, T12.y, T12.theta) == pytest.approx((3.0, 1.0, np.pi / 2))
    # turned by -90 degrees, p - (3, 1) = (-1, 4) becomes (4, 1)
    assert truth.position("B", "b2") == pytest.approx([4.0, 1.0])
    assert truth.position("A", "a2") is None
    assert truth.true_pairs("A", "B") == (("a1", "b2"), ("a1", "b3"), ("a3", "b1"))
    assert truth.true_pairs("B", "A") == (("b1", "a3"), ("b2", "a1"), ("b3", "a1"))


def test_t21_is_the_inverse():
    truth = simulated_pair(4)[2]
    both = se2.compose(truth.T12("A", "B").array, truth.T12("B", "A").array)
    assert both == pytest.approx(np.zeros(3), abs=1e-12)


def test_file_round_trip_keeps_every_bit_and_unknown_keys(tmp_path):
    truth = simulated_pair(11)[2]
    truth = Truth(truth.frames, truth.landmarks, truth.places, {"simulated": True, "seed": {"value": 11}})
    write_truth(truth, tmp_path / "x.truth.json")
    again = read_truth(tmp_path / "x.truth.json")
    assert again == truth
    assert again.extra == {"simulated": True, "seed": {"value": 11}}
    write_truth(again, tmp_path / "y.truth.json")
    assert (tmp_path / "x.truth.json").read_bytes() == (tmp_path / "y.truth.json").read_bytes()
    assert json.loads((tmp_path / "x.truth.json").read_bytes())["format"] == "mapfuse.truth/1"


def test_values_are_frozen_and_survive_pickling():
    truth = small_truth()
    again = pickle.loads(pickle.dumps(truth))
    assert again == truth
    with pytest.raises(ValueError, match="read-only"):
        again.places["p"][0] = 7.0


def test_the_documented_example_is_read(tmp_path):
    text = (
        '{"format": "mapfuse.truth/1", "frames": {"D7": {"x": 0, "y": 0, "theta": 0}}, '
        '"landmarks": {"D7": {"c1": "true-17", "f3": null}}, "places": {"true-17": {"x": 1, "y": 2}}}'
    )
    (tmp_path / "D7.truth.json").write_text(text)
    truth = read_truth(tmp_path / "D7.truth.json")
    assert truth.landmarks["D7"] == {"c1": "true-17", "f3": None}
    assert truth.places["true-17"].tolist() == [1.0, 2.0]


def test_all_broken_rules_are_listed_at_once(tmp_path):
    document = {
        "format": "mapfuse.truth/1",
        "frames": {"A": {"x": 0, "y": "zero"}, "B": 3},
        "landmarks": {"A": {"c1": "nowhere", "c2": 4}, "C": [], "D": {}},
        "places": {"p": {"x": True, "y": 1}},
    }
    file = tmp_path / "bad.truth.json"
    file.write_text(json.dumps(document))
    with pytest.raises(FileFormatError) as caught:
        read_truth(file)
    assert {problem.place for problem in caught.value.problems} == {
        "frames.A.y",
        "frames.A.theta",
        "frames.B",
        "landmarks.A.c1",
        "landmarks.A.c2",
        "landmarks.C",
        "landmarks.D",
        "places.p.x",
    }
    assert caught.value.path == file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ('{"format": "mapfuse.truth/1", "frames": {', "JSON"),
        ("[1, 2]", "must be an object"),
        ('{"format": "mapfuse.truth/2"}', "mapfuse.truth/2"),
        ('{"frames": {}}', "format"),
        ('{"format": "mapfuse.truth/1", "frames": {}, "landmarks": {}}', "places: is missing"),
        ('{"format": "mapfuse.truth/1", "frames": {"A": {"x": NaN, "y": 0, "theta": 0}}, "landmarks": {}, '
         '"places": {}}', r"frames\.A\.x: must be a finite number"),
        ('{"format": "mapfuse.truth/1", "frames": {}, "frames": {}, "landmarks": {}, "places": {}}', "stands twice"),
    ],
)  # fmt: skip
def test_hostile_files_are_refused_with_the_reason(tmp_path, text, said):
    file = tmp_path / "bad.truth.json"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=said):
        read_truth(file)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.truth\.json"):
        read_truth(tmp_path / "none.truth.json")


@pytest.mark.parametrize(
    "changes",
    [
        {"frames": {"A": [0.0, np.nan, 0.0]}},
        {"landmarks": {"A": {"a1": "nowhere"}}},
        {"extra": {"x": np.inf}},
    ],
)
def test_a_broken_truth_is_not_written(tmp_path, changes):
    with pytest.raises(MapfuseError, match="can't be written"):
        write_truth(small_truth(**changes), tmp_path / "x.truth.json")
    assert not list(tmp_path.iterdir())
