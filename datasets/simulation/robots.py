"""The paper's two robots as parameter sets of one model (section 2: feature detection rates)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ..maps import Noise


@dataclass(frozen=True, slots=True)
class Robot:
    """What a robot is: its name, its noise, whether it carries a compass.

    ``arm_sensed``: probability that an arm which was not travelled is in the record. ``bent_compass``: share of
    compass readings that steel makes worthless. ``stated_noise_factor`` multiplies the standard deviations that its
    maps state (1: they state what was simulated).
    """

    name: str
    noise: Noise = field(default_factory=Noise)
    compass: bool = True
    arm_sensed: float = 0.95
    bent_compass: float = 0.05
    stated_noise_factor: float = 1.0

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


#: Sonar features 81 % right with 20 % false alarms (over 300), colour-blob doors 92 % with 3 % (over 180).
VESPUCCI = Robot("vespucci", Noise())

#: The same sonar rates; laser door detector 85 % (over 130); the paper states no false alarms for it: 3 % as well.
MILKA = Robot("milka", Noise(door_detection_rate=0.85, door_false_alarm_rate=0.03))
