"""The paper's two robots as parameter sets of one model (section 2: what they carry, feature detection rates)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..logs import Sensors
from ..maps import Noise


@dataclass(frozen=True, slots=True)
class Driving:
    """How a robot drives and how often it writes its log down.

    ``speed`` [m/s], ``turn_rate`` [rad/s] where it turns on the spot, both reached with ``acceleration`` [m/s^2] and
    ``turn_acceleration`` [rad/s^2]; ``turn_radius`` [m] round a corner. ``wander`` [m]: standard deviation of its
    distance from the middle of the corridor, smooth over ``wander_length`` [m].

    ``rate`` [Hz] of odometry and gyro; compass and scans come with every so many of these (``compass_every``,
    ``scan_every``). ``sightings``: least and most detections of a pass. Scan k has the bearing
    ``scan_start + k scan_step`` [rad], ``scan_count`` of them.
    """

    speed: float = 0.4
    acceleration: float = 0.4
    turn_rate: float = 0.8
    turn_acceleration: float = 1.6
    turn_radius: float = 0.5
    wander: float = 0.08
    wander_length: float = 2.0
    rate: float = 5.0
    compass_every: int = 2
    scan_every: int = 5
    sightings: tuple[int, int] = (1, 3)
    scan_start: float = -np.pi / 2
    scan_step: float = np.pi / 36
    scan_count: int = 37


@dataclass(frozen=True, slots=True)
class Robot:
    """What a robot is: its name, its noise, whether it carries a compass.

    ``arm_sensed``: probability that an arm which was not travelled is in the record. ``bent_compass``: share of
    compass readings that steel makes worthless. ``stated_noise_factor`` multiplies the standard deviations that its
    maps state (1: they state what was simulated). ``noise`` is of the maps that are drawn by the measurement model;
    ``sensors`` and ``driving`` are of the logs, where the maps come from a mapper.
    """

    name: str
    noise: Noise = field(default_factory=Noise)
    compass: bool = True
    arm_sensed: float = 0.95
    bent_compass: float = 0.05
    stated_noise_factor: float = 1.0
    sensors: Sensors = field(default_factory=lambda: Sensors(compass_sigma=0.1))
    driving: Driving = field(default_factory=Driving)

    def with_compass(self, compass: bool) -> Robot:
        """The same robot with or without a compass."""
        return replace(self, compass=compass)

    @property
    def stated_noise(self) -> Noise:
        """The noise as this robot's maps state it."""
        names = (
            "distance_sigma_per_metre",
            "distance_sigma_floor",
            "heading_sigma",
            "position_sigma",
            "compass_sigma",
        )
        factor = self.stated_noise_factor
        return replace(self.noise, **{name: factor * getattr(self.noise, name) for name in names})


#: A Pioneer 1-AT: sonar features 81 % right with 20 % false alarms (over 300), colour-blob doors 92 % with 3 % (over
#: 180). Seven sonars look ahead and to the sides; four wheels skid in turns, which a gyroscope makes up for. What the
#: paper doesn't say (all standard deviations, ranges, speed) is chosen.
VESPUCCI = Robot(
    "vespucci",
    Noise(),
    sensors=Sensors(
        odometry_scale_sigma=0.02,
        odometry_turn_scale_sigma=0.05,
        odometry_curve_sigma=0.005,
        odometry_turn_sigma=0.02,
        odometry_turn_sigma_per_turn=0.05,
        gyro_sigma=0.002,
        compass_sigma=0.1,
        field_of_view=np.pi,
        scan_range=5.0,
        scan_sigma=0.03,
    ),
    driving=Driving(scan_step=np.pi / 6, scan_count=7),
)

#: A Pioneer 2-DX: sixteen sonars all round with the same rates; laser door detector 85 % (over 130), of whose false
#: alarms the paper says nothing: 3 % as well. Two driven wheels, no gyroscope; the laser scans the half ahead.
MILKA = Robot(
    "milka",
    Noise(door_detection_rate=0.85, door_false_alarm_rate=0.03),
    sensors=Sensors(compass_sigma=0.1, door_detection_rate=0.85, scan_range=8.0),
)
