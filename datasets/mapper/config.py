"""`MapperConfig`: the mapper's parameters, each with its unit; what the sensors are known to be stands in the log."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..errors import ConfigError


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Parameters of the mapper.

    Association: a detection is taken for a known landmark within the Mahalanobis ``gate`` (chi-square of its degrees
    of freedom, as a tail probability), when its log-likelihood exceeds that of a new landmark by ``accept_nats`` and
    that of any other known one by ``margin_nats``. ``landmark_density`` [1/m^2] is how common landmarks of one type
    are where the robot drives. ``arm_right``: probability that a sensed arm is of the right type. ``arm_tolerance``
    [rad]: a sensed arm and a known one are the same arm.

    Sightings: those of one landmark from within ``sighting_step`` [m] and ``sighting_turn`` [rad] of each other are
    one reading, since they share their errors; only the first counts.

    Loops: landmarks met within the last ``fresh_length`` [m] of travel are tested together against older ones that
    were last seen at least ``loop_length`` [m] before them; they are joined when the log-odds exceed ``loop_nats``
    and those of any rival by ``loop_margin_nats``. ``seen_twice``: probability that one place stands twice in a map,
    for the last look for doubles.

    Keyframes: one is made at each detection and at least every ``stretch`` [m] of travel, of robots whose scans
    have many beams every ``scan_stretch``, and before a scan where the robot has turned by ``scan_turn`` [rad] since
    the last one. The path is written every
    ``path_step`` [m]. Compass readings of the last ``compass_window`` [m] make one reading every ``compass_stretch``
    shares of the bend's length. A landmark is passed where the robot comes within ``pass_distance`` [m] of it.
    ``smooth_every``: the filter is linearised anew when the keyframes have grown by this share since the last time.

    Walls: pieces of scans are joined where they are within ``wall_tolerance`` [m] of one line and no further apart
    than ``wall_gap`` [m]; walls shorter than ``wall_length`` [m] are left out.

    Robustness: ``robust_gate`` is the squared residual in sigmas beyond which a detection loses weight in the
    smoother, ``max_speed`` [m/s] beyond which an odometry step is a jump. ``forget_below``: a landmark whose
    probability of existence is below is left out of the map.

    >>> MapperConfig(gate=2.0)
    Traceback (most recent call last):
    ...
    mapfuse.datasets.errors.ConfigError: gate must be above 0 and below 1, not 2.0
    """

    gate: float = 1e-3
    accept_nats: float = 0.5
    margin_nats: float = 1.5
    landmark_density: float = 0.05
    arm_right: float = 0.9
    arm_tolerance: float = 0.6
    sighting_step: float = 0.1
    sighting_turn: float = 0.1
    fresh_length: float = 40.0
    loop_length: float = 3.0
    loop_nats: float = 4.0
    loop_margin_nats: float = 1.5
    seen_twice: float = 0.05
    stretch: float = 5.0
    scan_stretch: float = 5.0
    scan_turn: float = 1000.0
    compass_window: float = 0.5
    compass_stretch: float = 0.75
    pass_distance: float = 1.2
    path_step: float = 0.5
    smooth_every: float = 0.25
    robust_gate: float = 13.8
    max_speed: float = 20.0
    forget_below: float = 0.02
    wall_gap: float = 0.6
    wall_tolerance: float = 0.15
    wall_length: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 < value < float("inf"):
                raise ConfigError(f"{field.name} must be a positive finite number, not {value}")
        for name in ("gate", "arm_right", "seen_twice", "forget_below"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name} must be above 0 and below 1, not {getattr(self, name)}")


#: For maps with keyframes: what is seen from one is only as well known as odometry from there on.
WITH_KEYFRAMES = MapperConfig(stretch=3.0, scan_stretch=1.0, scan_turn=0.3)
