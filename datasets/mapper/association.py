"""Which known landmark a detection is: kind, arms and Mahalanobis distance against a new landmark.

Log-likelihood ratios in nats: a detection of landmark i with innovation r has the density N(r; 0, S_i); one of a
landmark that isn't in the map yet has the density ``landmark_density``. Arms add what their types say, and take away
what their directions say against i; that directions agree says little where all corridors are at right angles.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import log, pi

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as _chi2

from ..arms import wrap
from ..logs import SensedArm
from .config import MapperConfig
from .filter import JointFilter
from .memory import Arm, Known

Array = NDArray[np.float64]

#: A landmark's sighting that misses it by less [m], or by less than this times the gate, begins no landmark beside it.
NEAR = 0.75
WIDER = 4.0
#: Predicted positions of the detected point worse than this [m] are no ground to tell neighbours apart.
LOST = 1.0


@lru_cache(maxsize=64)
def chi2_beyond(tail: float, dof: int) -> float:
    """The squared distance in sigmas that is exceeded with probability ``tail``."""
    return float(_chi2.isf(tail, dof))


@dataclass(frozen=True, slots=True)
class Overlaid:
    """Sensed arms on a landmark's: ``pairs`` (known arm, sensed arm), their mean ``residual`` [rad], ``nats``."""

    pairs: tuple[tuple[int, int], ...]
    residual: float
    nats: float


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A known landmark that a detection may be: how likely [nats], squared distance [sigmas], residual and its S."""

    key: int
    nats: float
    squared: float
    residual: Array
    S: Array
    overlaid: Overlaid


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a detection is: a known landmark (``candidate``), a new one (``new``), or unclear."""

    candidate: Candidate | None
    new: bool


def overlay(known: Sequence[Arm], sensed: Sequence[SensedArm], direction: float, config: MapperConfig) -> Overlaid:
    """Lay sensed arms on a landmark that faces ``direction`` [rad, from the robot]; each arm meets one at most.

    >>> arms = [Arm(0.0, 1, {"open": 1}), Arm(1.57, 1, {"blocked": 1})]
    >>> overlay(arms, [SensedArm("blocked", 1.6)], 0.0, MapperConfig()).pairs
    ((1, 0),)
    """
    found = []
    for j, arm in enumerate(sensed):
        for m, own in enumerate(known):
            off = wrap_any(arm.bearing - direction - own.off)
            if abs(off) < config.arm_tolerance:
                found.append((abs(off), m, j, off))
    pairs: list[tuple[int, int]] = []
    residuals: list[float] = []
    nats = 0.0
    for _, m, j, off in sorted(found):
        if any(m == a or j == b for a, b in pairs):
            continue
        pairs.append((m, j))
        residuals.append(off)
        nats += _types(known[m].passable, sensed[j].type, config)
    residual = sum(residuals) / len(residuals) if residuals else 0.0
    return Overlaid(tuple(sorted(pairs)), residual, nats)


def _types(passable: bool | None, sensed: str, config: MapperConfig) -> float:
    if passable is None or sensed == "unknown":
        return 0.0
    same = passable == (sensed != "blocked")
    return log((config.arm_right if same else 1 - config.arm_right) / 0.5)


def wrap_any(angle: float) -> float:
    """`arms.wrap` for any finite number."""
    return wrap(angle)


def heading_variance(known: Sequence[Arm], overlaid: Overlaid, arm_sigma: float) -> float:
    """Variance [rad^2] of the mean residual of the arms that meet.

    Where all known arms meet, the landmark's direction is what they say together; where some don't, the errors of
    their first readings show.
    """
    n = len(overlaid.pairs)
    left = 1 - n / len(known)
    counts = sum(1 / known[m].count for m, _ in overlaid.pairs) / n
    return arm_sigma**2 / n * (1 + left * counts)


def candidates(
    kalman: JointFilter,
    landmarks: Mapping[int, Known],
    type_: str,
    z: Array,
    R: Array,
    arms: Sequence[SensedArm],
    arm_sigma: float,
    config: MapperConfig,
    taken: Collection[int],
) -> list[Candidate]:
    """All landmarks of the type that are near what was seen, likeliest first; ``z`` (2,) ahead and left [m]."""
    same = [l for l in landmarks.values() if l.type == type_ and l.key not in taken]
    if not same:
        return []
    x, P = kalman.x, kalman.P
    at = np.array([l.at for l in same])
    c, s = np.cos(x[2]), np.sin(x[2])
    back = np.array([[c, s], [-s, c]])
    offset = np.column_stack([x[at] - x[0], x[at + 1] - x[1]])
    predicted = offset @ back.T
    rows = at[:, None] + np.arange(2)
    own = P[rows[:, :, None], rows[:, None, :]]
    cross = np.moveaxis(P[:3][:, rows], 1, 0)
    Hp = np.zeros((len(same), 2, 3))
    Hp[:, :, :2] = -back
    Hp[:, 0, 2], Hp[:, 1, 2] = predicted[:, 1], -predicted[:, 0]
    mixed = Hp @ cross @ back.T
    S = Hp @ P[:3, :3] @ np.swapaxes(Hp, 1, 2) + mixed + np.swapaxes(mixed, 1, 2) + back @ own @ back.T + R
    r = z - predicted
    squared = np.einsum("ki,kij,kj->k", r, np.linalg.inv(S), r)
    gate = chi2_beyond(config.gate, 2) * WIDER
    distance = np.hypot(r[:, 0], r[:, 1])
    found = []
    for k in np.flatnonzero((squared < gate) | (distance < NEAR)):
        found.append(_candidate(kalman, same[k], float(squared[k]), r[k], S[k], arms, arm_sigma, config))
    return sorted(found, key=lambda candidate: (-candidate.nats, candidate.key))


def expected(
    kalman: JointFilter,
    landmark: Known,
    z: Array,
    R: Array,
    arms: Sequence[SensedArm],
    arm_sigma: float,
    config: MapperConfig,
) -> Candidate:
    """A detection as one of a landmark that is known by its name."""
    x, P, at = kalman.x, kalman.P, landmark.at
    c, s = np.cos(x[2]), np.sin(x[2])
    gx, gy = x[at] - x[0], x[at + 1] - x[1]
    u, v = c * gx + s * gy, c * gy - s * gx
    H = np.array([[-c, -s, v, c, s], [s, -c, -u, -s, c]])
    columns = np.array([0, 1, 2, at, at + 1])
    S = H @ P[columns[:, None], columns] @ H.T + R
    r = np.array([z[0] - u, z[1] - v])
    squared = float(r @ np.linalg.solve(S, r))
    return _candidate(kalman, landmark, squared, r, S, arms, arm_sigma, config)


def _candidate(
    kalman: JointFilter,
    landmark: Known,
    squared: float,
    r: Array,
    S: Array,
    arms: Sequence[SensedArm],
    arm_sigma: float,
    config: MapperConfig,
) -> Candidate:
    nats = -squared / 2 - log(2 * pi) - 0.5 * log(float(np.linalg.det(S))) - log(config.landmark_density)
    overlaid = Overlaid((), 0.0, 0.0)
    if landmark.turn is not None and arms:
        x, P, turn = kalman.x, kalman.P, landmark.turn
        overlaid = overlay(landmark.arms, arms, float(x[turn] - x[2]), config)
        if overlaid.pairs:
            spread = float(P[turn, turn] + P[2, 2] - 2 * P[turn, 2])
            variance = spread + heading_variance(landmark.arms, overlaid, arm_sigma)
            turned = overlaid.residual**2 / variance
            squared += turned
            nats += overlaid.nats - turned / 2
        else:
            # none of the arms lies where one is known
            squared += chi2_beyond(config.gate, 1)
            nats += log(1 - config.arm_right) - log(config.arm_right)
    return Candidate(landmark.key, float(nats), squared, r, S, overlaid)


def judge(found: Sequence[Candidate], R: Array, config: MapperConfig) -> Verdict:
    """Take the likeliest candidate, begin a new landmark, or leave the detection alone.

    A detection near landmarks that can't be told apart begins a new one only where the robot itself is lost: the new
    one is joined with the right old one later, when several agree. A robot that knows where it is would only make
    a double of what it stands before.
    """
    if not found:
        return Verdict(None, True)
    best = found[0]
    rival = found[1].nats if len(found) > 1 else -np.inf
    dof = 3 if best.overlaid.pairs else 2
    clear = best.nats >= config.accept_nats and best.nats - rival >= config.margin_nats
    if clear and best.squared < chi2_beyond(config.gate, dof):
        return Verdict(best, False)
    lost = float(np.linalg.eigvalsh(best.S - R)[-1]) > LOST**2
    return Verdict(None, lost)
