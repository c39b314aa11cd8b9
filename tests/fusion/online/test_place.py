"""Where a robot is, where its start is far away or hardly known: what it sees of its surroundings still says it."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Transform
from mapfuse.fusion import OnlineFuser
from mapfuse.fusion.online import Correction, Placed
from mapfuse.fusion.online.place import placed_in
from mapfuse.fusion.online.segment import Segment

SIGHT = 0.003
AROUND = np.array([[3.0, 1.0], [-2.0, 4.0], [1.0, -5.0]])


class Known:
    """What a smoother says of one map in its own frame: its landmarks are at known places, to a millimetre each."""

    def __init__(self, positions):
        self.positions = positions

    def first_of_group(self, name):
        return name

    def origin_of_group(self, name):
        return np.zeros(2)

    def local_landmarks(self, name):
        return {n: np.array([*xy, 0.0]) for n, xy in self.positions.items()}

    def local_frame(self, name):
        return Transform.from_array(np.zeros(3))

    def local_covariance(self, name, ids):
        return np.diag([0.0] * 3 + [1e-6, 1e-6, 0.0] * len(ids))


@pytest.mark.parametrize(
    ("sigma", "middle", "off"),
    [(1.0, 0.0, 2.0), (1e3, 0.0, 2.0), (1e4, 0.0, 2.0), (1.0, 1e6, 0.5), (1e3, 5e6, 2.0), (1e4, 5e6, 2.0)],
)
def test_a_robot_moves_with_its_landmarks_however_far_or_doubtful_its_start(sigma, middle, off):
    """All of it is off together by ``sigma`` [m], the sight of the landmarks by 3 mm: where these are known to be
    ``off`` metres beside where they were said to be, so is the robot, to the sight's accuracy."""
    ids = ("a", "b", "c")
    true = AROUND + middle
    together = np.array([[1.0, 0, 0, 1, 0, 1, 0, 1, 0], [0, 1, 0, 0, 1, 0, 1, 0, 1]])
    segment = Segment("r", 0)
    segment.take(
        Placed(
            robot="r",
            sequence=1,
            t=1.0,
            pose=np.array([middle + off, middle - off, 0.7]),
            covariance=sigma**2 * together.T @ together + SIGHT**2 * np.eye(9),
            order=ids,
            positions=true + np.array([off, -off]),
        )
    )
    pose = placed_in(segment, Known(dict(zip(ids, true, strict=True)))).pose
    assert np.abs(pose.array - [middle, middle, 0.7]).max() < 4 * SIGHT
    sigmas = np.sqrt(np.diag(pose.covariance))
    # one reading of 3 mm of itself, and three of the landmarks together
    assert sigmas[:2] == pytest.approx(np.sqrt(SIGHT**2 * (1 + 1 / 3) + 1e-6 / 3), rel=0.3)
    assert sigmas[2] == pytest.approx(SIGHT, rel=0.3)
    assert np.linalg.eigvalsh(pose.covariance).min() > 0


@pytest.mark.parametrize("heading", [0.0, np.pi / 4, -2.0])
def test_a_pose_known_in_one_direction_only_has_a_covariance(heading):
    """Along x hardly known at all, across to the last digit: turned into the robot's axes that was singular."""
    fuser = OnlineFuser()
    fuser.take(Correction(robot="r", sequence=0, t=0.0, map=LandmarkMap("r", (Landmark("a", "tree", 1.0, 2.0),))))
    C = np.diag([1e12, 0.0, 1e-6])
    fuser.take(Placed(robot="r", sequence=1, t=1.0, pose=np.array([5.0, 2.0, heading]), covariance=C))
    pose = fuser.places()["r"].pose
    assert np.allclose(pose.array, [5.0, 2.0, heading], atol=1e-6)
    assert np.isclose(pose.covariance[0, 0], 1e12, rtol=1e-6)
    assert 0 <= pose.covariance[1, 1] < 1.0
