"""Which landmark each detection of a whole log is, where they have neither names nor arms: by particles.

A filter with one estimate can't take back an association, and one wrong one leads to the next. Particles keep several
histories side by side (`particle_filter`), but not for long: after a turn on the spot two groups of landmarks can
explain what is seen alike, and all particles soon descend from the few that foretold the first glances best. If those
are wrong, it shows only later, when no particle is left that knows better.

So several filters go side by side, and do not mix as long as the log doesn't tell them apart: each may settle on
another history. One whose particles foretold far less of the log than the best filter's (`Particles.nats`, an estimate
of the marginal likelihood; A. Doucet, N. de Freitas and N. Gordon, 2001, section 1.3) has lost the true history, and
goes on from another one's particles. So each such place needs a filter that is right there, and not the whole log one
that is right everywhere. (Particles on islands: C. Verge, C. Dubarry, P. Del Moral and E. Moulines, Statistics and
Computing 25, 2015; there islands are drawn anew by their weights.)

What looks worse by 10 nats may still be right: a glance that the true history takes for chance and a wrong one for a
landmark costs it as much, and it is told apart a minute later only. By then all filters may go on from the wrong one.
So all this is run several times, each for itself, and the run that foretold most of the log counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..logs import Detection, Event, Odometry, Sensors
from .odometry import DeadReckoning
from .particle_filter import PLAIN, Array, Frame, ParticleConfig, Particles, Seen

#: What is remembered of each moment: of each particle of each filter its landmarks and its parent.
_Small = NDArray[np.int32]


@dataclass(frozen=True, eq=False, slots=True)
class Association:
    """What one history says: of each detection, by its number in the log, the number of its landmark; each landmark's
    type; and what its filter foretold of the log [nats], more than an estimate of the marginal likelihood by what it
    owes to being chosen."""

    landmark_from_number: Mapping[int, int]
    type_from_landmark: Mapping[int, str]
    nats: float


def is_nameless(event: Detection) -> bool:
    """Whether nothing but its type and place says which landmark a detection is."""
    return event.id is None and not event.arms


def in_plain_sight(poses: Array, places: Array) -> NDArray[np.bool_]:
    """Whether a robot at ``poses`` (n, 3) has ``places`` (m, 2) before it, neither too close nor far; (n, m).

    >>> in_plain_sight(np.array([[0.0, 0.0, 0.0]]), np.array([[2.0, 0.0], [-2.0, 0.0], [9.0, 0.0]])).tolist()
    [[True, False, False]]
    """
    nearest, farthest, side = PLAIN
    x, y = (places[None] - poses[:, None, :2]).transpose(2, 0, 1)
    aside = np.abs((np.arctan2(y, x) - poses[:, 2:] + np.pi) % (2 * np.pi) - np.pi)
    away = np.hypot(x, y)
    return np.asarray((away > nearest) & (away < farthest) & (aside < side))


def associate(events: Iterable[Event], sensors: Sensors, config: ParticleConfig, seed: int) -> Association:
    """What the likeliest particle of the likeliest filter of all runs says; the same events and seed give the same.

    Detections with names or arms are passed over, and those between two moments that count (``config.step``).
    """
    types: dict[str, int] = {}
    frames = list(_frames(events, sensors, config, types))
    found = (
        _run(frames, list(types), sensors, config, (seed, number)) for number in range(config.runs_for(len(frames)))
    )
    return max(found, key=lambda association: association.nats)


def _run(
    frames: Sequence[Frame], names: Sequence[str], sensors: Sensors, config: ParticleConfig, seed: tuple[int, int]
) -> Association:
    """Several filters side by side through the whole log."""
    filters = [Particles(sensors, config, np.random.default_rng([*seed, k])) for k in range(config.filters)]
    rng = np.random.default_rng([*seed, config.filters])
    chosen: list[list[_Small]] = []
    parents: list[list[tuple[int, _Small | None]]] = []
    for frame in frames:
        chosen.append([particles.take(frame).astype(np.int32) for particles in filters])
        drawn = [particles.resampled() for particles in filters]
        before = [k if heir is None else heir for k, heir in enumerate(_succession(filters, config.behind, rng))]
        parents.append([(k, None if (who := drawn[k]) is None else who.astype(np.int32)) for k in before])
    return _traced(frames, names, filters, chosen, parents)


def _succession(filters: Sequence[Particles], behind: float, rng: np.random.Generator) -> list[int | None]:
    """Of each filter the one from whose particles it goes on, drawn by likelihood; None for its own."""
    nats = np.array([particles.nats for particles in filters])
    ahead = np.flatnonzero(nats >= nats.max() - behind)
    if len(ahead) == len(filters):
        return [None] * len(filters)
    share = np.exp(nats[ahead] - nats.max())
    heirs: list[int | None] = [None] * len(filters)
    for k in np.flatnonzero(nats < nats.max() - behind).tolist():
        heir = heirs[k] = int(rng.choice(ahead, p=share / share.sum()))
        filters[k].follow(filters[heir])
    return heirs


def _traced(
    frames: Sequence[Frame],
    names: Sequence[str],
    filters: Sequence[Particles],
    chosen: Sequence[Sequence[_Small]],
    parents: Sequence[Sequence[tuple[int, _Small | None]]],
) -> Association:
    """The history of the likeliest particle of the likeliest filter, from the last moment back."""
    filter_ = int(np.argmax([particles.nats for particles in filters]))
    best, nats = int(np.argmax(filters[filter_].weights)), filters[filter_].nats
    landmark_from_number: dict[int, int] = {}
    type_from_landmark: dict[int, str] = {}
    for frame, landmarks, before in zip(reversed(frames), reversed(chosen), reversed(parents), strict=True):
        filter_, who = before[filter_]
        if who is not None:
            best = int(who[best])
        for seen, landmark in zip(frame.seen, landmarks[filter_][best].tolist(), strict=True):
            if landmark >= 0:
                landmark_from_number[seen.number] = landmark
                type_from_landmark[landmark] = names[seen.type]
    return Association(landmark_from_number, type_from_landmark, nats)


def _frames(
    events: Iterable[Event], sensors: Sensors, config: ParticleConfig, types: dict[str, int]
) -> Iterable[Frame]:
    """The moments that count; ``types`` learns the types' numbers."""
    reckoning = DeadReckoning.of(sensors, 20.0)
    number, at = -1, -np.inf
    frame: tuple[Array, Array, Array] | None = None
    seen: list[Seen] = []
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
                yield Frame(*frame, tuple(seen))
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
        yield Frame(*frame, tuple(seen))


def _seen(number: int, type_: int, event: Detection, sensors: Sensors) -> Seen:
    c, s = np.cos(event.bearing), np.sin(event.bearing)
    B = np.array([[c, -s * event.range], [s, c * event.range]])
    sigma = sensors.detection_sigma(event.range)
    R = B @ np.diag([sigma**2, sensors.bearing_sigma**2]) @ B.T + 1e-8 * np.eye(2)
    return Seen(number, type_, event.range * np.array([c, s]), R)
