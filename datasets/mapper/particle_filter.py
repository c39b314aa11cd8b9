"""One filter of particles, which side by side decide for themselves what a detection is: FastSLAM 2.0.

Each has a pose, systematic errors of the odometry, and landmarks with a small Kalman filter each (M. Montemerlo and
S. Thrun, 2003). Those whose landmarks foretell what is seen live on. Several such filters: `particles`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernels
from ..errors import ConfigError
from ..logs import Sensors

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Squared distances [sigmas] beyond this are of another landmark (4.5e-5 of the right ones, in 2 dimensions).
_GATE = 20.0
#: A landmark is in plain sight between these distances [m] and so far to either side [rad], more than this sure of.
PLAIN = (0.7, 4.0, 0.4)
_SURE = 5
#: A landmark goes when it was not seen in plain sight more often than this, and so often per sighting.
_MISSES, _MISSES_PER_HIT = 6, 4
#: Share of the systematic errors' spread that resampling keeps; the rest is drawn anew (J. Liu and M. West, 2001).
_KEPT = 0.995
#: A short log gets at most so many times as many runs.
_MOST = 3.0
_ARRAYS = ("pose", "systematic", "weights", "mean", "P", "key", "type", "hits", "misses", "next_key")


@dataclass(frozen=True, slots=True)
class ParticleConfig:
    """How many ``particles`` in each of how many ``filters`` of how many ``runs``, and what they take a detection for.

    ``behind`` [nats]: a filter that has foretold so much less of the log than the best one of its run goes on from
    another one's particles; the odds against it are then 22,000 to 1. ``moments``: a log of fewer that count gets more
    runs in proportion, so that it takes as much work, up to three times as many.

    ``new_density``, ``false_density`` [1/m^2]: density of a detection of a landmark that isn't known, and of none at
    all. ``near`` [m]: so near to a known landmark no other one begins. ``step`` [m], ``turn`` [rad]: detections count
    when the robot moved so much since the last that did; those between share their errors. ``miss`` [nats]: what a
    sure landmark in plain sight that isn't seen takes from a particle. ``again`` [nats]: what a second detection of one
    landmark at one moment takes; landmarks closer than ``near`` are one here. ``floor`` [m]: what each sighting adds to
    a landmark's own error. ``temper``: the share of each log-likelihood that counts, since successive readings have
    errors in common. ``least``: landmarks with fewer sightings are left out.

    >>> ParticleConfig(particles=0)
    Traceback (most recent call last):
    ...
    mapfuse.datasets.errors.ConfigError: particles must be at least 1, not 0
    """

    particles: int = 500
    filters: int = 12
    runs: int = 2
    moments: int = 2400
    behind: float = 10.0
    new_density: float = 0.003
    false_density: float = 0.0004
    near: float = 0.6
    step: float = 0.05
    turn: float = 0.05
    miss: float = 0.1
    again: float = 3.0
    floor: float = 0.01
    temper: float = 0.7
    least: int = 5

    def runs_for(self, moments: int) -> int:
        """How many runs a log of so many moments gets.

        >>> [ParticleConfig(runs=2).runs_for(moments) for moments in (5000, 1200, 100)]
        [2, 4, 6]
        """
        return round(self.runs * min(_MOST, max(1.0, self.moments / max(moments, 1))))

    def __post_init__(self) -> None:
        for name in ("particles", "filters", "runs", "moments"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not self.behind > 0:
            raise ConfigError(f"behind must be above 0, not {self.behind}")


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """A detection: its number in the log, its type's, ahead and left [m] ``z`` (2,), covariance ``R`` (2, 2)."""

    number: int
    type: int
    z: Array
    R: Array


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """Detections of one moment, and the motion since the frame before: pose (3,), derivatives (3, 3), noise (3, 3)."""

    motion: Array
    by: Array
    Q: Array
    seen: tuple[Seen, ...]


class Particles:
    """N particles with room for M landmarks each, and ``nats``: what they foretold of the log so far.

    ``pose`` (N, 3); ``systematic`` (N, 3): shares of distance and turn, curvature [rad/m]; ``weights`` (N,) [nats];
    ``mean`` (N, M, 2) and ``P`` (N, M, 2, 2): landmarks; ``key`` (N, M): their numbers in their particle, -1 where
    there is none; ``type``, ``hits``, ``misses`` (N, M).
    """

    def __init__(self, sensors: Sensors, config: ParticleConfig, rng: np.random.Generator) -> None:
        n, m = config.particles, 16
        sigmas = [sensors.odometry_scale_sigma, sensors.odometry_turn_scale_sigma, sensors.odometry_curve_sigma]
        self.config, self.rng, self._before = config, rng, 0.0
        self.kernels = kernels("_particle_kernels", __package__, "the particle filter")
        self.pose, self.weights, self.next_key = np.zeros((n, 3)), np.zeros(n), np.zeros(n, dtype=np.intp)
        self.systematic = rng.normal(size=(n, 3)) * np.array(sigmas)
        self.mean, self.P = np.zeros((n, m, 2)), np.tile(np.eye(2), (n, m, 1, 1))
        self.key, self.type = np.full((n, m), -1, dtype=np.intp), np.full((n, m), -1, dtype=np.intp)
        self.hits, self.misses = np.zeros((n, m)), np.zeros((n, m))

    def take(self, frame: Frame) -> Indices:
        """Move on and take in what was seen: the number (N, D) of each detection's landmark, -1 for none."""
        config, count = self.config, len(frame.seen)
        while (self.key < 0).sum(axis=1).min() < count:
            self._make_room()
        out = self.kernels.take(
            np.ascontiguousarray(frame.motion),
            np.ascontiguousarray(frame.by),
            np.ascontiguousarray(frame.Q),
            np.array([seen.z for seen in frame.seen]),
            np.array([seen.R for seen in frame.seen]),
            np.array([seen.type for seen in frame.seen]),
            self.rng.random((len(self.pose), count)),
            self.rng.normal(size=self.pose.shape),
            *(getattr(self, name) for name in _ARRAYS),
            _GATE,
            np.log(config.new_density),
            np.log(config.false_density),
            config.near,
            config.again,
            config.temper,
            config.miss,
            config.floor,
            np.array(PLAIN),
            _SURE,
            _MISSES,
            _MISSES_PER_HIT,
        )
        return np.asarray(out)

    @property
    def nats(self) -> float:
        """Log-likelihood of the log so far: of each stretch between two resamplings the mean over the particles."""
        return self._before + float(np.logaddexp.reduce(self.weights)) - float(np.log(len(self.weights)))

    def follow(self, other: Particles) -> None:
        """Go on from another filter's particles, with random numbers of one's own."""
        for name in _ARRAYS:
            setattr(self, name, getattr(other, name).copy())
        self._before = other._before

    def _make_room(self) -> None:
        """Double the room for landmarks."""
        n, m = self.key.shape
        self.mean = np.concatenate([self.mean, np.zeros((n, m, 2))], axis=1)
        self.P = np.concatenate([self.P, np.tile(np.eye(2), (n, m, 1, 1))], axis=1)
        self.key, self.type = (np.concatenate([a, np.full((n, m), -1)], axis=1) for a in (self.key, self.type))
        self.hits, self.misses = (np.concatenate([a, np.zeros((n, m))], axis=1) for a in (self.hits, self.misses))

    def resampled(self) -> Indices | None:
        """Where few particles have most of the weight, draw them anew: of each its parent; None where not."""
        n = len(self.weights)
        share = np.exp(self.weights - self.weights.max())
        share /= share.sum()
        if 1 / float(np.sum(share**2)) >= n / 2:
            return None
        self._before = self.nats
        at = (np.arange(n) + self.rng.random()) / n
        who = np.minimum(np.searchsorted(np.cumsum(share), at), n - 1)
        for name in _ARRAYS:
            setattr(self, name, getattr(self, name)[who])
        s = self.systematic
        fresh = np.sqrt(1 - _KEPT**2) * s.std(axis=0) * self.rng.normal(size=s.shape)
        self.systematic = s.mean(axis=0) + _KEPT * (s - s.mean(axis=0)) + fresh
        self.weights = np.zeros(n)
        return who
