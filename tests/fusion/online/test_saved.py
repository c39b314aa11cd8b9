"""State files that are damaged: refused in one sentence that names the file and the place, never with a traceback."""

from __future__ import annotations

import copy
import json
import logging
import random

import numpy as np
import pytest

from mapfuse.datasets import FileFormatError, Landmark, LandmarkMap, Link
from mapfuse.datasets.logs import Detection, Log, LogHeader, Odometry, SensedArm, Sensors
from mapfuse.datasets.maps import JointCovariance
from mapfuse.fusion import OnlineFuser
from mapfuse.fusion.online import Correction, LandmarkLink, LandmarkSeen, Placed, Removed
from mapfuse.fusion.online.replay import Replay

PLACES = {"a": (0.0, 0.0), "b": (7.0, 0.0), "c": (7.0, 4.0)}


def told(robot, turned):
    """A corrected map, landmarks and a link by themselves, one removed, and where the robot is."""
    links = {"a": (Link("open", 0.0, None, "b", 7.0, 1), Link("blocked", 1.5)), "b": (Link("open", 1.6),)}
    landmarks = tuple(
        Landmark(name, "junction", x * turned, y * turned, links=links.get(name, ())) for name, (x, y) in PLACES.items()
    )
    joint = JointCovariance(("a", "b"), 2, np.eye(4) * 0.1)
    whole = LandmarkMap(robot, landmarks, robot, joint_covariance=joint)
    said = {"robot": robot, "t": 1.0}
    return [
        Correction(sequence=0, map=whole, **said),
        LandmarkSeen(sequence=1, landmark=Landmark("d", "door", 3.0, 1.0, links=(Link("door", 0.2),)), **said),
        LandmarkLink(sequence=2, id="d", link=Link("open", -1.0), **said),
        LandmarkLink(sequence=3, id="d", link=Link("open", 2.0, None, "a", 3.0, 1), **said),
        Removed(sequence=4, id="c", **said),
        Placed(sequence=5, pose=np.zeros(3), covariance=np.eye(5), order=("a",), positions=np.zeros((1, 2)), **said),
    ]


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    """The document of two robots' fuser."""
    fuser = OnlineFuser()
    for robot, turned in (("west", 1.0), ("east", -1.0)):
        fuser.add_robot(robot)
        for message in told(robot, turned):
            fuser.take(message)
    fuser.advance(force=True)
    file = tmp_path_factory.mktemp("state") / "whole.json"
    fuser.save(file)
    return json.loads(file.read_text())


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    """The document of a replay of two short logs."""
    arms = (SensedArm("open", 0.0), SensedArm("blocked", 1.5))
    events = [event for k in range(1, 9) for event in (Odometry(k, k / 2, 0.0, 0.0), Detection(k, "corner", 1.0, 0.5))]
    events.append(Detection(9.0, "junction", 1.0, -0.5, arms, "j"))
    header = Sensors(compass_sigma=0.1, extra={"by": "hand"})
    replay = Replay([Log(LogHeader(name, sensors=header), tuple(events)) for name in ("west", "east")])
    for _ in replay.run():
        pass
    file = tmp_path_factory.mktemp("replay") / "whole.json"
    replay.save(file)
    return json.loads(file.read_text())


def damaged(document, path, value):
    """The document with another value at a path; `...`: with none."""
    changed = copy.deepcopy(document)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return changed


def paths(value, at=()):
    """Where something stands; of each list the first two."""
    parts = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, part in parts:
        yield (*at, key)
        yield from paths(part, (*at, key))


SEGMENT = ("segments", 0)


@pytest.mark.parametrize(
    ("path", "value", "place"),
    [
        ((*SEGMENT, "noise", "position_sigma"), "x", r"segments\[0\]\.noise\.position_sigma: must be a number"),
        ((*SEGMENT, "noise", "detection_rate"), 2.0, r"segments\[0\]\.noise\.detection_rate: must be a probability"),
        ((*SEGMENT, "noise", "extra"), "x", r"segments\[0\]\.noise\.extra: must be an object"),
        ((*SEGMENT, "records", 0, "map", "links"), "x", r"segments\[0\]\.records\[0\]\.map\.links: must be a list"),
        ((*SEGMENT, "records", 0, "map", "x"), None, r"segments\[0\]\.records\[0\]\.map\.x: must be a number"),
        ((*SEGMENT, "records", 0, "map", "links", 0), 3, r"segments\[0\]\.records\[0\]\.map\.links\[0\]: must be an"),
        ((*SEGMENT, "records", 0, "id"), "z", r"segments\[0\]\.records\[0\]\.id"),
        ((*SEGMENT, "ways", 0, "map", "links"), [], r"segments\[0\]\.ways\[0\]\.map\.links: must hold one link"),
        ((*SEGMENT, "base", "landmarks", 0, "x"), "x", r"segments\[0\]\.base\.landmarks\[0\]\.x: must be a number"),
        ((*SEGMENT, "base", "landmarks", 0, "x"), 1e300, r"segments\[0\]\.base\.landmarks\[0\]: .a. lies beyond"),
        ((*SEGMENT, "base", "landmarks", 0, "x"), 1e8, r"segments\[0\]\.base\.landmarks\[0\]: .a. lies more than"),
        ((*SEGMENT, "records", 0, "map", "x"), 1e300, r"segments\[0\]\.records\[0\]\.map: .d. lies beyond"),
        ((*SEGMENT, "noise", "compass_sigma"), 1e300, r"segments\[0\]\.noise\.compass_sigma: is beyond"),
        ((*SEGMENT, "base", "noise", "compass_sigma"), 1e300, r"segments\[0\]\.base\.noise\.compass_sigma: is beyond"),
        (("weighed", 0, "noise", "compass_sigma"), 1e300, r"weighed\[0\]\.noise\.compass_sigma: is beyond"),
        ((*SEGMENT, "placed", "positions", 0), [0.0], r"segments\[0\]\.placed"),
        ((*SEGMENT, "placed", "pose"), [0.0], r"segments\[0\]\.placed"),
        ((*SEGMENT, "placed", "t"), "x", r"Expected `float`, got `str` - at `\$\.segments\[0\]\.placed\.t`"),
        ((*SEGMENT, "robot"), "", r"segments\[0\]: needs a robot"),
        ((*SEGMENT, "robot"), "east", r"segments\[1\]: 'east' stands there already"),
        (("noise", "west", "position_sigma"), -1, r"noise\.west\.position_sigma: must be 0 or more"),
        (("noise", "west", "extra"), "x", r"noise\.west\.extra: must be an object"),
        (("weighed", 0, "name"), "z", r"weighed\[0\]\.name: 'z' is no map"),
        (("weighed", 1, "landmarks"), None, r"weighed\[1\]\.landmarks: must be a list"),
        (("config", "weigh_every"), "x", r"config: Expected `int`, got `str` - at `\$\.weigh_every`"),
        (("config", "weigh_every"), -1, r"config: online\.weigh_every is -1"),
        (("config", "fuse"), [], r"config: Expected `object`, got `array` - at `\$\.fuse`"),
    ],
)
def test_a_damaged_fuser_is_refused_by_its_place(state, path, value, place, tmp_path):
    file = tmp_path / "damaged.json"
    file.write_text(json.dumps(damaged(state, path, value)))
    with pytest.raises(FileFormatError, match=place) as caught:
        OnlineFuser.load(file)
    assert caught.value.path == file


def test_noise_that_is_null_is_as_by_default(state, tmp_path):
    """As in a map: and what is computed with it later finds a number."""
    file = tmp_path / "null.json"
    file.write_text(json.dumps(damaged(state, (*SEGMENT, "noise", "position_sigma"), None)))
    assert OnlineFuser.load(file).segments["west"].noise.position_sigma == 0.3


@pytest.mark.parametrize(
    ("path", "value", "place"),
    [
        (("header", "sensors", "gyro_sigma"), "x", r"header\.sensors\.gyro_sigma: must be a number, not \"x\""),
        (("header", "sensors"), [], r"header\.sensors: must be an object"),
        (("header", "name"), ..., r"header\.name: is missing"),
        (("config", "gate"), 7.0, r"config: gate must be above 0 and below 1"),
        (("config", "gate"), "x", r"Expected `float`, got `str`"),
        (("x",), [0.0], r"P: "),
        (("P", 0), [0.0], r"P: must be a list of"),
        (("format",), "mapfuse.mapper/9", r"format: must be 'mapfuse.mapper/1'"),
        (("state", "memory", "sightings", 0, "keyframe"), 99, r"state\.memory\.sightings: names number 99"),
        (("state", "by_name", "j"), 77, r"state\.by_name: 'j' is no landmark"),
        (("state", "memory", "poses"), [], r"state\.memory\.poses: holds 0 poses"),
    ],
)
def test_a_damaged_mapper_is_refused_by_its_place(replay, path, value, place, tmp_path):
    file = tmp_path / "damaged.json"
    file.write_text(json.dumps(damaged(replay, ("feeds", "west", "mapper", *path), value)))
    with pytest.raises(FileFormatError, match=rf"feeds\.west\.mapper.*{place}") as caught:
        Replay.resume(file, [])
    assert caught.value.path == file


def test_what_the_header_holds_besides_is_kept(replay, tmp_path):
    file = tmp_path / "state.json"
    file.write_text(json.dumps(replay))
    again = Replay.resume(file, [])
    assert again.feeds["west"].mapper.sensors == Sensors(compass_sigma=0.1, extra={"by": "hand"})
    again.save(file)
    assert json.loads(file.read_text()) == replay


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that overflow
@pytest.mark.parametrize("which", ["state", "replay"])
def test_any_damage_is_refused_in_a_sentence_or_does_no_harm(which, request, tmp_path, caplog):
    """Values of the wrong kind, too large or gone at random places, seed 7: `FileFormatError` or a state that works."""
    caplog.set_level(logging.ERROR)
    document = request.getfixturevalue(which)
    chance = random.Random(7)
    top = "feeds" if which == "replay" else None
    everywhere = [p for p in paths(document) if top is None or (p[0] == top and len(p) > 1)]
    file, refused = tmp_path / "damaged.json", []
    for path in chance.sample(everywhere, 80):
        value = chance.choice([None, "x", -1, 1e300, [], {}, True, ...])
        file.write_text(json.dumps(damaged(document, path, value)))
        try:
            if which == "replay":
                Replay.resume(file, []).save(tmp_path / "again.json")
            else:
                fuser = OnlineFuser.load(file)
                fuser.save(tmp_path / "again.json")
        except FileFormatError as error:
            refused.append(str(error))
    assert all(said.startswith(f"{file}: ") for said in refused)
    assert len(refused) > 30
