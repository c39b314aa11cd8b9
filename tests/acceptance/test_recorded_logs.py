"""The mapper on drives of real robots, against the survey of their arena.

Barcodes say which tube is which. Without them two drives are tried here, all of them, with several seeds, in
``benchmarks/recorded_logs.py``.
"""

from collections import Counter

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.mapper import Mapper
from mapfuse.datasets.mapper.naming import name_detections
from mapfuse.datasets.mrclam import ROBOTS, read_mrclam_log, read_mrclam_truth

#: Set and robot; where the instruments' parameters come from is said in `mapfuse.datasets.mrclam`.
DRIVES = tuple((number, robot) for number in (2, 4, 6) for robot in ROBOTS)


def landmark_rms(folder, number, robot, barcodes=True):
    """Tubes of a map, and the rms [m] of their places after the best rigid motion."""
    home = folder / "mrclam" / f"MRCLAM_Dataset{number}"
    log, truth = read_mrclam_log(home, robot, barcodes=barcodes), read_mrclam_truth(home, robot)
    named = name_detections(log)  # those with barcodes stay as they are
    mapper = Mapper(log.header)
    for event in named.log.events:
        mapper.update(event)
    map_, sources = mapper.map(), mapper.sources
    tubes = [
        Counter(truth.detections[named.numbers[k]] for k in sources[l.id]).most_common(1)[0][0] for l in map_.landmarks
    ]
    surveyed = np.array([truth.places[tube] for tube in tubes])
    apart = se2.align(surveyed, map_.positions).residuals
    return tubes, float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


@pytest.fixture(scope="module")
def with_barcodes(shared_data):
    return {drive: landmark_rms(shared_data, *drive) for drive in DRIVES}


def test_with_barcodes_every_tube_is_in_the_map_once(with_barcodes):
    for drive, (tubes, _) in with_barcodes.items():
        assert sorted(map(int, tubes)) == list(range(6, 21)), drive


def test_with_barcodes_landmarks_are_where_the_survey_has_them(with_barcodes):
    errors = [rms for _, rms in with_barcodes.values()]
    assert np.median(errors) <= 0.15
    assert max(errors) <= 0.25


@pytest.mark.parametrize(("robot", "least"), [(1, 5), (3, 8)])
def test_without_barcodes_particles_find_out_which_tube_is_which(shared_data, robot, least):
    """In set 6 tubes stand in six groups. Robot 3 turns between two that look alike: a lone filter goes wrong there."""
    tubes, rms = landmark_rms(shared_data, 6, robot, barcodes=False)
    assert len(tubes) >= least
    assert rms <= 0.4
