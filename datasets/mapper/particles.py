"""Which landmark each detection of a whole log is, where they have neither names nor arms: by particles.

A filter with one estimate can't take back an association, and one wrong one leads to the next. Particles keep several
histories side by side (FastSLAM 2.0; M. Montemerlo and S. Thrun, 2003): each has a pose, systematic errors of the
odometry, and landmarks with a small Kalman filter each, and decides for itself what a detection is. Those whose
landmarks foretell what is seen live on. What the likeliest one says at the end of the log names the detections; the
mapper then estimates the map, with its covariance, as if the names had been given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from ..logs import Detection, Event, Log, Odometry, Sensors
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
_FAR = 1e6


@dataclass(frozen=True, slots=True)
class ParticleConfig:
    """How many ``particles``, and what they take a detection for.

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

    particles: int = 150
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
        if self.particles < 1:
            raise ConfigError(f"particles must be at least 1, not {self.particles}")


@dataclass(frozen=True, eq=False, slots=True)
class NamedLog:
    """A log whose detections have names, and ``numbers``: of each of its detections the number in the log before."""

    log: Log
    numbers: tuple[int, ...]


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


def name_detections(log: Log, config: ParticleConfig | None = None, *, seed: int = 0) -> NamedLog:
    """Name the detections that have neither a name nor arms; such as fit no landmark, or weren't looked at, go.

    Detections with names or arms, and all other events, stay as they are. The same log and seed give the same names.

    >>> from mapfuse.datasets.logs import LogHeader
    >>> moves = [Odometry(0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(20)]
    >>> looks = [Detection(0.1 * k, "tree", 4 - 0.1 * k, 0.0) for k in range(20)]
    >>> events = sorted([*moves, *looks], key=lambda event: event.t)
    >>> named = name_detections(Log(LogHeader("D7"), events))
    >>> {event.id for event in named.log.events if isinstance(event, Detection)}
    {'tree.1'}
    """
    config = config or ParticleConfig()
    events = list(log.events)
    landmark_from_number, type_from_landmark = _associated(events, log.header.sensors, config, seed)
    counts = Counter(landmark_from_number.values())
    out: list[Event] = []
    numbers: list[int] = []
    names: dict[int, str] = {}
    taken = {event.id for event in events if isinstance(event, Detection)}
    number = -1
    for event in events:
        if isinstance(event, Detection):
            number += 1
            if _is_nameless(event):
                landmark = landmark_from_number.get(number, -1)
                if landmark < 0 or counts[landmark] < config.least:
                    continue
                if landmark not in names:
                    names[landmark] = _free_name(type_from_landmark[landmark], taken)
                out.append(msgspec.structs.replace(event, id=names[landmark]))
                numbers.append(number)
                continue
            numbers.append(number)
        out.append(event)
    return NamedLog(Log(log.header, out), tuple(numbers))


def _is_nameless(event: Detection) -> bool:
    return event.id is None and not event.arms


def _free_name(type_: str, taken: set[str | None]) -> str:
    k = 1
    while f"{type_}.{k}" in taken:
        k += 1
    taken.add(f"{type_}.{k}")
    return f"{type_}.{k}"


def _associated(
    events: Iterable[Event], sensors: Sensors, config: ParticleConfig, seed: int
) -> tuple[dict[int, int], dict[int, str]]:
    """The landmark of each detection, by its number, as the likeliest particle has it; the type of each landmark."""
    types: dict[str, int] = {}
    frames = list(_frames(events, sensors, config, types))
    names = list(types)
    particles = _Particles(sensors, config, np.random.default_rng(seed))
    chosen: list[Indices] = []
    parents: list[Indices | None] = []
    for frame in frames:
        chosen.append(particles.take(frame))
        parents.append(particles.resampled())
    best = int(np.argmax(particles.weights))
    out: dict[int, int] = {}
    type_from_landmark: dict[int, str] = {}
    for frame, landmarks, who in zip(reversed(frames), reversed(chosen), reversed(parents), strict=True):
        if who is not None:
            best = int(who[best])
        for seen, landmark in zip(frame.seen, landmarks[best].tolist(), strict=True):
            if landmark >= 0:
                out[seen.number] = landmark
                type_from_landmark[landmark] = names[seen.type]
    return out, type_from_landmark


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
        if not (_is_nameless(event) and np.isfinite(event.range + event.bearing + event.t) and event.range > 0):
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
    """N particles with room for M landmarks each.

    ``pose`` (N, 3); ``systematic`` (N, 3): shares of distance and turn, curvature [rad/m]; ``weights`` (N,) [nats];
    ``mean`` (N, M, 2) and ``P`` (N, M, 2, 2): landmarks; ``key`` (N, M): their numbers in their particle, -1 where
    there is none; ``type``, ``hits``, ``misses`` (N, M).
    """

    def __init__(self, sensors: Sensors, config: ParticleConfig, rng: np.random.Generator) -> None:
        n, m = config.particles, 16
        sigmas = [sensors.odometry_scale_sigma, sensors.odometry_turn_scale_sigma, sensors.odometry_curve_sigma]
        self.config, self.rng = config, rng
        self.pose, self.weights, self.next_key = np.zeros((n, 3)), np.zeros(n), np.zeros(n, dtype=np.intp)
        self.systematic = rng.normal(size=(n, 3)) * np.array(sigmas)
        self.mean, self.P = np.full((n, m, 2), _FAR), np.tile(np.eye(2), (n, m, 1, 1))
        self.key, self.type = np.full((n, m), -1, dtype=np.intp), np.full((n, m), -1, dtype=np.intp)
        self.hits, self.misses = np.zeros((n, m)), np.zeros((n, m))

    def take(self, frame: _Frame) -> Indices:
        """Move on and take in what was seen: the number (N, D) of each detection's landmark, -1 for none."""
        m, C = self._moved(frame)
        used = np.zeros(self.key.shape, dtype=bool)
        slots = np.column_stack([self._decide(seen, m, C, used) for seen in frame.seen])
        C = (C + np.swapaxes(C, 1, 2)) / 2 + 1e-10 * np.eye(3)
        noise = self.rng.normal(size=m.shape)
        self.pose = m + np.einsum("nij,nj->ni", np.linalg.cholesky(C), noise)
        self._miss(used)
        out = np.column_stack([self._learn(seen, slots[:, d]) for d, seen in enumerate(frame.seen)])
        self._forget()
        self.weights = self.weights - self.weights.max()
        return out

    def _moved(self, frame: _Frame) -> tuple[Array, Array]:
        """Predicted poses (N, 3) and their covariances (N, 3, 3)."""
        dx, dy, turn = (frame.motion + self.systematic @ frame.by.T).T
        c, s = np.cos(self.pose[:, 2]), np.sin(self.pose[:, 2])
        m = self.pose + np.column_stack([c * dx - s * dy, s * dx + c * dy, turn])
        G = np.zeros((len(m), 3, 3))
        G[:, 0, 0], G[:, 0, 1], G[:, 1, 0], G[:, 1, 1], G[:, 2, 2] = c, -s, s, c, 1.0
        return m, G @ frame.Q @ np.swapaxes(G, 1, 2)

    def _decide(self, seen: _Seen, m: Array, C: Array, used: NDArray[np.bool_]) -> Indices:
        """Draw what a detection is: a landmark's place (N,), -1 for nothing, -2 for a new one.

        Poses ``m`` and ``C`` are corrected by those that are taken for known ones, in place.
        """
        B = _turned_back(m)
        uv = np.einsum("nij,nkj->nki", B, self.mean - m[:, None, :2])
        H = np.zeros((*uv.shape, 3))
        H[..., :2] = -B[:, None]
        H[..., 0, 2], H[..., 1, 2] = uv[..., 1], -uv[..., 0]
        S = H @ C[:, None] @ np.swapaxes(H, 2, 3) + B[:, None] @ self.P @ np.swapaxes(B, 1, 2)[:, None] + seen.R
        inverse, determinant = _inverse(S)
        r = seen.z - uv
        squared = np.einsum("nki,nkij,nkj->nk", r, inverse, r)
        same = (self.key >= 0) & (self.type == seen.type)
        fits = same & (squared < _GATE)
        near = (fits | (same & (np.hypot(r[..., 0], r[..., 1]) < self.config.near))).any(axis=1)
        nats = -squared / 2 - np.log(2 * np.pi) - 0.5 * np.log(determinant)
        nats = np.column_stack(
            [
                np.where(fits, nats - self.config.again * used, -np.inf),
                np.where(near, -np.inf, np.log(self.config.new_density)),
                np.full(len(m), np.log(self.config.false_density)),
            ]
        )
        top = nats.max(axis=1)
        p = np.exp(nats - top[:, None])
        total = p.sum(axis=1)
        self.weights = self.weights + self.config.temper * (top + np.log(total))
        pick = (np.cumsum(p, axis=1) < (self.rng.random(len(m)) * total)[:, None]).sum(axis=1)
        room = self.key.shape[1]
        who = np.flatnonzero(pick < room)
        Hp = H[who, pick[who]]
        K = C[who] @ np.swapaxes(Hp, 1, 2) @ inverse[who, pick[who]]
        m[who] += np.einsum("nij,nj->ni", K, r[who, pick[who]])
        C[who] -= K @ Hp @ C[who]
        used[who, pick[who]] = True
        return np.where(pick < room, pick, np.where(pick == room, -2, -1))

    def _miss(self, used: NDArray[np.bool_]) -> None:
        """Count the landmarks in plain sight that were not seen."""
        nearest, farthest, side = _PLAIN
        uv = np.einsum("nij,nkj->nki", _turned_back(self.pose), self.mean - self.pose[:, None, :2])
        away, aside = np.hypot(uv[..., 0], uv[..., 1]), np.abs(np.arctan2(uv[..., 1], uv[..., 0]))
        missed = (self.key >= 0) & (away > nearest) & (away < farthest) & (aside < side) & ~used
        self.misses += missed
        self.weights = self.weights - self.config.miss * (missed & (self.hits > _SURE)).sum(axis=1)

    def _learn(self, seen: _Seen, slots: Indices) -> Indices:
        """Correct the landmarks at ``slots`` (N,) or begin them, given the poses; their numbers (N,)."""
        out = np.full(len(slots), -1, dtype=np.intp)
        back = _turned_back(self.pose)
        turn = np.swapaxes(back, 1, 2)
        places, R = self.pose[:, :2] + turn @ seen.z, turn @ seen.R @ back
        who = np.flatnonzero(slots >= 0)
        at = slots[who]
        P = self.P[who, at]
        K = P @ _inverse(P + R[who])[0]
        self.mean[who, at] += np.einsum("nij,nj->ni", K, places[who] - self.mean[who, at])
        # readings of one landmark share errors, and it may be several that stand close together
        self.P[who, at] = P - K @ P + self.config.floor**2 * np.eye(2)
        self.hits[who, at] += 1
        out[who] = self.key[who, at]
        new = np.flatnonzero(slots == -2)
        if len(new):
            self._make_room(new)
            at = np.argmax(self.key[new] < 0, axis=1)
            self.mean[new, at], self.P[new, at] = places[new], R[new]
            self.key[new, at], self.type[new, at] = self.next_key[new], seen.type
            self.hits[new, at], self.misses[new, at] = 1, 0
            out[new] = self.next_key[new]
            self.next_key[new] += 1
        return out

    def _make_room(self, who: Indices) -> None:
        """Double the room for landmarks where one of these particles has none left."""
        if (self.key[who] < 0).any(axis=1).all():
            return
        shape = self.key.shape
        self.mean = np.concatenate([self.mean, np.full((*shape, 2), _FAR)], axis=1)
        self.P = np.concatenate([self.P, np.tile(np.eye(2), (*shape, 1, 1))], axis=1)
        self.key, self.type = (np.concatenate([a, np.full_like(a, -1)], axis=1) for a in (self.key, self.type))
        self.hits, self.misses = (np.concatenate([a, np.zeros_like(a)], axis=1) for a in (self.hits, self.misses))

    def _forget(self) -> None:
        """Drop landmarks that were not seen where they should have been, again and again."""
        gone = (self.key >= 0) & (self.misses > _MISSES + _MISSES_PER_HIT * self.hits)
        self.key[gone], self.mean[gone] = -1, _FAR

    def resampled(self) -> Indices | None:
        """Where few particles have most of the weight, draw them anew: of each its parent; None where not."""
        n = len(self.weights)
        share = np.exp(self.weights - self.weights.max())
        share /= share.sum()
        if 1 / float(np.sum(share**2)) >= n / 2:
            return None
        at = (np.arange(n) + self.rng.random()) / n
        who = np.minimum(np.searchsorted(np.cumsum(share), at), n - 1)
        for name in ("pose", "mean", "P", "key", "type", "hits", "misses", "next_key"):
            setattr(self, name, getattr(self, name)[who])
        s = self.systematic[who]
        fresh = np.sqrt(1 - _KEPT**2) * s.std(axis=0) * self.rng.normal(size=s.shape)
        self.systematic = s.mean(axis=0) + _KEPT * (s - s.mean(axis=0)) + fresh
        self.weights = np.zeros(n)
        return who


def _turned_back(poses: Array) -> Array:
    """Matrices (N, 2, 2) that turn directions in the map into the robot's frame."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.moveaxis(np.array([[c, s], [-s, c]]), 2, 0)


def _inverse(S: Array) -> tuple[Array, Array]:
    """Inverses and determinants of matrices (..., 2, 2)."""
    a, b, c, d = S[..., 0, 0], S[..., 0, 1], S[..., 1, 0], S[..., 1, 1]
    determinant = a * d - b * c
    return np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2) / determinant[..., None, None], determinant
