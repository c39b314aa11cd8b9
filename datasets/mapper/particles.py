"""Which landmark each detection of a whole log is, where they have neither names nor arms: by particles.

A filter with one estimate can't take back an association, and one wrong one leads to the next. Particles keep several
histories side by side (FastSLAM 2.0; M. Montemerlo and S. Thrun, 2003): each has a pose, systematic errors of the
odometry, and landmarks with a small Kalman filter each, and decides for itself what a detection is. Those whose
landmarks foretell what is seen live on.

A filter may still lose the true history, where the robot turned for long without seeing anything: no particle is near
it then. That shows: what its particles foretold of the log (`Association.nats`, an estimate of the marginal
likelihood; A. Doucet, N. de Freitas and N. Gordon, 2001, section 1.3) is far less than of a filter that kept it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernels
from ..errors import ConfigError
from ..logs import Detection, Event, Odometry, Sensors
from .odometry import DeadReckoning

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Squared distances [sigmas] beyond this are of another landmark (4.5e-5 of the right ones, in 2 dimensions).
_GATE = 20.0
#: A landmark is in plain sight between these distances [m] and so far to either side [rad], more than this sure of.
_PLAIN = (0.7, 4.0, 0.4)
_SURE = 5
#: A landmark goes when it was not seen in plain sight more often than this, and so often per sighting.
_MISSES, _MISSES_PER_HIT = 6, 4
#: Share of the systematic errors' spread that resampling keeps; the rest is drawn anew (J. Liu and M. West, 2001).
_KEPT = 0.995
_ARRAYS = ("pose", "systematic", "weights", "mean", "P", "key", "type", "hits", "misses", "next_key")


@dataclass(frozen=True, slots=True)
class ParticleConfig:
    """How many ``particles``, in how many ``runs`` of the filter, and what they take a detection for.

    ``new_density``, ``false_density`` [1/m^2]: density of a detection of a landmark that isn't known, and of none at
    all. ``near`` [m]: so near to a known landmark no other one begins. ``step`` [m], ``turn`` [rad]: detections count
    when the robot moved so much since the last that did; those between share their errors. ``miss`` [nats]: what a
    sure landmark in plain sight that isn't seen takes from a particle. ``again`` [nats]: what a second detection of one
    landmark at one moment takes; landmarks closer than ``near`` are one here. ``floor`` [m]: what each sighting adds to
    a landmark's own error. ``temper``: the share of each log-likelihood
    that counts, since errors of successive readings are correlated. ``least``: landmarks with fewer sightings are
    left out.

    >>> ParticleConfig(particles=0)
    Traceback (most recent call last):
    ...
    mapfuse.datasets.errors.ConfigError: particles must be at least 1, not 0
    """

    particles: int = 500
    runs: int = 6
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

    def __post_init__(self) -> None:
        for name in ("particles", "runs"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False, slots=True)
class Association:
    """What one history says: of each detection, by its number in the log, the number of its landmark; each landmark's
    type; and how likely the log is by the filter that found it [nats]."""

    landmark_from_number: Mapping[int, int]
    type_from_landmark: Mapping[int, str]
    nats: float


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """A detection: its number in the log, its type's, ahead and left [m] ``z`` (2,), covariance ``R`` (2, 2)."""

    number: int
    type: int
    z: Array
    R: Array


@dataclass(frozen=True, eq=False, slots=True)
class _Frame:
    """Detections of one moment, and the motion since the frame before: pose (3,), derivatives (3, 3), noise (3, 3)."""

    motion: Array
    by: Array
    Q: Array
    seen: tuple[_Seen, ...]


def is_nameless(event: Detection) -> bool:
    """Whether nothing but its type and place says which landmark a detection is."""
    return event.id is None and not event.arms


def in_plain_sight(poses: Array, places: Array) -> NDArray[np.bool_]:
    """Whether a robot at ``poses`` (n, 3) has ``places`` (m, 2) before it, neither too close nor far; (n, m).

    >>> in_plain_sight(np.array([[0.0, 0.0, 0.0]]), np.array([[2.0, 0.0], [-2.0, 0.0], [9.0, 0.0]])).tolist()
    [[True, False, False]]
    """
    nearest, farthest, side = _PLAIN
    x, y = (places[None] - poses[:, None, :2]).transpose(2, 0, 1)
    aside = np.abs((np.arctan2(y, x) - poses[:, 2:] + np.pi) % (2 * np.pi) - np.pi)
    away = np.hypot(x, y)
    return np.asarray((away > nearest) & (away < farthest) & (aside < side))


def associate(events: Iterable[Event], sensors: Sensors, config: ParticleConfig, seed: int) -> Association:
    """What the likeliest particle of the likeliest run says; the same events and seed give the same.

    Detections with names or arms are passed over, and those between two moments that count (``config.step``).
    """
    types: dict[str, int] = {}
    frames = list(_frames(events, sensors, config, types))
    rngs = [np.random.default_rng([seed, run]) for run in range(config.runs)]
    return max((_one_run(frames, list(types), sensors, config, rng) for rng in rngs), key=lambda found: found.nats)


def _one_run(
    frames: Sequence[_Frame], names: Sequence[str], sensors: Sensors, config: ParticleConfig, rng: np.random.Generator
) -> Association:
    particles = _Particles(sensors, config, rng)
    chosen: list[Indices] = []
    parents: list[Indices | None] = []
    for frame in frames:
        chosen.append(particles.take(frame))
        parents.append(particles.resampled())
    best = int(np.argmax(particles.weights))
    landmark_from_number: dict[int, int] = {}
    type_from_landmark: dict[int, str] = {}
    for frame, landmarks, who in zip(reversed(frames), reversed(chosen), reversed(parents), strict=True):
        if who is not None:
            best = int(who[best])
        for seen, landmark in zip(frame.seen, landmarks[best].tolist(), strict=True):
            if landmark >= 0:
                landmark_from_number[seen.number] = landmark
                type_from_landmark[landmark] = names[seen.type]
    return Association(landmark_from_number, type_from_landmark, particles.nats)


def _frames(
    events: Iterable[Event], sensors: Sensors, config: ParticleConfig, types: dict[str, int]
) -> Iterable[_Frame]:
    """The moments that count; ``types`` learns the types' numbers."""
    reckoning = DeadReckoning.of(sensors, 20.0)
    number, at = -1, -np.inf
    frame: tuple[Array, Array, Array] | None = None
    seen: list[_Seen] = []
    for event in events:
        if isinstance(event, Odometry):
            late = reckoning.last is not None and event.t < reckoning.last.t
            if not late and np.isfinite(event.x + event.y + event.theta + event.t):
                reckoning.odometry(event)
        if not isinstance(event, Detection):
            continue
        number += 1
        if not (is_nameless(event) and np.isfinite(event.range + event.bearing + event.t) and event.range > 0):
            continue
        if event.t != at:
            if frame is not None and seen:
                yield _Frame(*frame, tuple(seen))
            moved = reckoning.length >= config.step or abs(reckoning.theta) >= config.turn
            frame, seen = None, []
            if at == -np.inf or moved:
                motion = reckoning.motion()
                frame = np.array(motion.pose), motion.by_systematic()[:, :3], motion.covariance_matrix()
                reckoning.restart(0.0, 0.0, 0.0, 0.0)
            at = event.t
        if frame is not None:
            seen.append(_seen(number, types.setdefault(event.type, len(types)), event, sensors))
    if frame is not None and seen:
        yield _Frame(*frame, tuple(seen))


def _seen(number: int, type_: int, event: Detection, sensors: Sensors) -> _Seen:
    c, s = np.cos(event.bearing), np.sin(event.bearing)
    B = np.array([[c, -s * event.range], [s, c * event.range]])
    sigma = sensors.detection_sigma(event.range)
    R = B @ np.diag([sigma**2, sensors.bearing_sigma**2]) @ B.T + 1e-8 * np.eye(2)
    return _Seen(number, type_, event.range * np.array([c, s]), R)


class _Particles:
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

    def take(self, frame: _Frame) -> Indices:
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
            np.array(_PLAIN),
            _SURE,
            _MISSES,
            _MISSES_PER_HIT,
        )
        return np.asarray(out)

    @property
    def nats(self) -> float:
        """Log-likelihood of the log so far: of each stretch between two resamplings the mean over the particles."""
        return self._before + float(np.logaddexp.reduce(self.weights)) - float(np.log(len(self.weights)))

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
