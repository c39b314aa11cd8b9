"""Real recordings for tests: maps without names of their own, and separately what is known about them.

The third-party ones lie beside the repository and are never copied into it; where they are absent, a test that needs
them is skipped. Ids are made up and the order is shuffled, so that neither can tell which landmarks are the same.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth
from mapfuse.datasets.victoria_park import victoria_park_halves, victoria_park_path

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"

# The sigmas and rates below were set knowing the residuals under the reference transforms (0.27 to 0.35 m per axis
# between two indoor maps, 0.08 to 0.23 m of a robot's tubes from the survey): one value per data set, no test of them.
SLIDESLAM_NOISE = Noise(position_sigma=0.25, detection_rate=0.6, false_alarm_rate=0.2)
#: Tubes are told by their barcodes, so that hardly one is false.
MRCLAM_NOISE = Noise(position_sigma=0.15, detection_rate=0.95, false_alarm_rate=0.02)
MRCLAM_SETS = (2, 4, 6)
ROBOTS = (1, 2, 3, 4, 5)


def point_map(name, types, positions, noise, rng, detections=None):
    """A map of labelled points in random order with made-up ids, and each id's place in the input."""
    order = rng.permutation(len(positions))
    detections = np.ones(len(positions), dtype=int) if detections is None else detections
    index_from_id = {f"p{k}": int(i) for k, i in enumerate(order, start=1)}
    landmarks = tuple(
        Landmark(id_, types[i], *positions[i].tolist(), visit_counter=int(n), detection_counter=int(n))
        for (id_, i), n in zip(index_from_id.items(), detections[order], strict=True)
    )
    return LandmarkMap(name, landmarks, noise=noise), index_from_id


def slideslam_map(path, rng):
    """An object map ``class x y z`` of one robot; heights are dropped."""
    rows = np.loadtxt(path)
    types = [f"class-{int(label)}" for label in rows[:, 0]]
    return point_map(path.stem, types, rows[:, 1:3], SLIDESLAM_NOISE, rng)[0]


def mrclam_map(path, rng):
    """A robot's tubes ``true_id,x_m,y_m,n_obs`` as a map without their ids, and the true id of each of its own."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    positions = np.array([(float(row["x_m"]), float(row["y_m"])) for row in rows])
    detections = np.array([int(row["n_obs"]) for row in rows])
    map_, index_from_id = point_map(path.stem, ["tube"] * len(rows), positions, MRCLAM_NOISE, rng, detections)
    return map_, {id_: rows[i]["true_id"] for id_, i in index_from_id.items()}


def mrclam_places(path):
    """Surveyed places of the tubes: ``Landmark_Groundtruth.dat`` has subject, x, y and their standard deviations."""
    return {str(int(subject)): np.array([x, y]) for subject, x, y, *_ in np.loadtxt(path, comments="#")}


@pytest.fixture(scope="session")
def shared_data():
    """Folder of the third-party recordings."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the third-party recordings (../shared/data) aren't here")
    return SHARED_DATA.resolve()


@pytest.fixture(scope="session")
def slideslam_maps(shared_data):
    """Indoor object maps of three robots, in the order of their numbers."""
    rng = np.random.default_rng(10)
    return tuple(slideslam_map(shared_data / "slideslam" / f"robot{k}Map_indoor.txt", rng) for k in (0, 1, 2))


@pytest.fixture(scope="session")
def slideslam_T12():
    """(robot of map 1, robot of map 2) -> T12, found by a search with labels; the three close to about 0.3 m."""
    degrees = {(0, 1): (1.66, -3.58, 88.7), (0, 2): (-2.28, 1.18, 4.8), (1, 2): (4.88, 3.98, -84.4)}
    return {pair: Transform(x, y, float(np.deg2rad(turn))) for pair, (x, y, turn) in degrees.items()}


@pytest.fixture(scope="session")
def _mrclam(shared_data):
    rng = np.random.default_rng(20)
    found = {}
    poses = json.loads((shared_data / "mrclam" / "derived" / "map_to_ground_truth.json").read_text())
    for number in MRCLAM_SETS:
        places = mrclam_places(shared_data / "mrclam" / f"MRCLAM_Dataset{number}" / "Landmark_Groundtruth.dat")
        maps, frames, landmarks = [], {}, {}
        for robot in ROBOTS:
            path = shared_data / "mrclam" / "derived" / f"mrclam_ds{number}_r{robot}.csv"
            map_, landmarks[map_.name] = mrclam_map(path, rng)
            pose = poses[f"DS{number}_R{robot}"]
            frames[map_.name] = np.array([pose["tx"], pose["ty"], se2.wrap(np.deg2rad(pose["theta_deg"]))])
            maps.append(map_)
        found[number] = (tuple(maps), Truth(frames, landmarks, places))
    return found


@pytest.fixture(scope="session")
def mrclam_maps(_mrclam):
    """Set number -> maps of its five robots, tubes without names."""
    return {number: maps for number, (maps, _) in _mrclam.items()}


@pytest.fixture(scope="session")
def mrclam_truth(_mrclam):
    """Set number -> truth of its five maps, from the survey of the arena."""
    return {number: truth for number, (_, truth) in _mrclam.items()}


@pytest.fixture(scope="session")
def victoria_park():
    """(map 1, map 2, truth) of the drive cut in two halves."""
    try:
        victoria_park_path()
    except MapfuseError as error:
        pytest.skip(str(error))
    return victoria_park_halves()
