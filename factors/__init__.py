"""Measurements as error terms: what maps say of their landmarks, as values that numpy and GTSAM evaluate alike.

Read in this order: `keys` (what is estimated), `noise` and `measurement` (what all error terms share), `link`, `frame`,
`heading`, `compass`, `joint`, `correspondence` (one kind of measurement each), `graph` (maps and a hypothesis to a
`Problem`), `axes` (our covariances and GTSAM's).
"""

from .compass import CompassReading, NorthOffset, NorthPrior
from .correspondence import Correspondence, arm_turn
from .frame import FrameAnchor, Gauge, TransformPrior, components, nearest_to_start
from .graph import Match, Problem, build_problem, map_measurements, pair_problem, single_map_problem
from .heading import HeadingPrior, RotationPin
from .joint import JointMeasurement
from .keys import CompassKey, FrameKey, KeyBook, LandmarkKey, NorthKey, Unknown
from .link import LinkMeasurement, RangeMeasurement, is_bent, travelled_links, twin
from .measurement import Between, Measurement, Prior
from .noise import DOUBT, STEEL, Loss, PoseNoise

__all__ = [
    "DOUBT",
    "STEEL",
    "Between",
    "CompassKey",
    "CompassReading",
    "Correspondence",
    "FrameAnchor",
    "FrameKey",
    "Gauge",
    "HeadingPrior",
    "JointMeasurement",
    "KeyBook",
    "LandmarkKey",
    "LinkMeasurement",
    "Loss",
    "Match",
    "Measurement",
    "NorthKey",
    "NorthOffset",
    "NorthPrior",
    "PoseNoise",
    "Prior",
    "Problem",
    "RangeMeasurement",
    "RotationPin",
    "TransformPrior",
    "Unknown",
    "arm_turn",
    "build_problem",
    "components",
    "is_bent",
    "map_measurements",
    "nearest_to_start",
    "pair_problem",
    "single_map_problem",
    "travelled_links",
    "twin",
]
