"""Loop closing: landmarks that stand twice in the map, found together.

After a long way the robot's position is too uncertain to say which old landmark it sees again. What it sees then
begins new landmarks, and the decision waits until several of them agree with old ones *jointly*: pairs are added one
by one, each under the covariance that the ones before leave (joint compatibility; Neira and Tardos 2001, with
likelihoods instead of counts). Old landmarks along the way that were not seen, and new ones that fit nothing, count
against. A loop is closed when the odds are clear, and clearly better than those of any rival.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log, pi

import numpy as np
from numpy.typing import NDArray

from ..logs import SensedArm, Sensors
from .association import chi2_beyond, heading_variance, overlay
from .config import MapperConfig
from .memory import Known

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Pair = tuple[int, int]

#: At most so many new landmarks are tested together, and so many pairs are tried as the first one.
_FRESH, _SEEDS = 12, 40
#: Residuals beyond this tail of the chi-square join nothing. It is wide: a loop is where a filter's covariance is least
#: to be trusted, and a far residual costs its own likelihood anyway.
_GATE = 1e-6
#: How well two positions of one landmark agree apart from their covariance [m]: the filter is only linear.
_FLOOR = 0.05
#: An old landmark within this distance [m] of the way between two new ones should have been seen.
_BESIDE = 0.8


@dataclass(frozen=True, slots=True)
class Loop:
    """Landmarks that are the same: (newer, older) keys, and the log-odds [nats] for it."""

    pairs: tuple[Pair, ...]
    nats: float


@dataclass(frozen=True, eq=False, slots=True)
class Belief:
    """Means and covariance of some landmarks: ``rows`` of each key are x, y, and its direction where it has one."""

    x: Array
    P: Array
    rows: Mapping[int, Indices]

    def given(self, H: Array, columns: Indices, residual: Array, R: Array) -> Belief:
        """The belief after a residual that depends on the entries ``columns`` by ``H``."""
        PHt = self.P[:, columns] @ H.T
        S = H @ PHt[columns] + R
        K = np.linalg.solve(S, PHt.T).T
        P = self.P - K @ PHt.T
        return Belief(self.x + K @ residual, (P + P.T) / 2, self.rows)


def belief_of(x: Array, P: Array, landmarks: Sequence[Known]) -> Belief:
    """The part of a joint state that concerns these landmarks."""
    picked: list[int] = []
    rows: dict[int, Indices] = {}
    for landmark in landmarks:
        own = [landmark.at, landmark.at + 1] + ([] if landmark.turn is None else [landmark.turn])
        rows[landmark.key] = np.arange(len(picked), len(picked) + len(own))
        picked += own
    return Belief(x[picked], P[np.ix_(picked, picked)], rows)


def find_loop(
    x: Array, P: Array, landmarks: Mapping[int, Known], way: float, sensors: Sensors, config: MapperConfig
) -> Loop | None:
    """Landmarks seen lately that are older ones, if that is clear; ``way`` [m]: where on its way the robot is."""
    fresh = [l for l in landmarks.values() if l.last > way - config.fresh_length]
    fresh = sorted(fresh, key=lambda l: l.last)[-_FRESH:]
    near = _near(x, P, fresh, list(landmarks.values()))
    # the old one was out of sight when the other one began
    near = [(a, b) for a, b in near if landmarks[b].last < landmarks[a].first - config.loop_length]
    order = [l.key for l in sorted(fresh, key=lambda l: l.first)]
    return _best(x, P, landmarks, near, order, sensors, config)


def find_doubles(
    x: Array, P: Array, landmarks: Mapping[int, Known], apart: Collection[Pair], sensors: Sensors, config: MapperConfig
) -> Loop | None:
    """Landmarks of a whole map that are others, if that is clear; pairs in ``apart`` are surely two."""
    known = list(landmarks.values())
    near = [(a, b) for a, b in _near(x, P, known, known) if a > b and (a, b) not in apart]
    # what lies between the pairs is most of the map, and says nothing
    return _best(x, P, landmarks, near, (), sensors, config)


def _best(
    x: Array,
    P: Array,
    landmarks: Mapping[int, Known],
    near: Sequence[Pair],
    order: Sequence[int],
    sensors: Sensors,
    config: MapperConfig,
) -> Loop | None:
    if not near:
        return None
    named = {key for pair in near for key in pair}
    known = {key: l for key, l in landmarks.items() if key in named}
    belief = belief_of(x, P, list(known.values()))
    search = _Search(known, sensors, config)
    return search.best(belief, near, [key for key in order if key in known])


def _near(x: Array, P: Array, fresh: Sequence[Known], old: Sequence[Known]) -> list[Pair]:
    """(fresh, old) of one type that may be at one place."""
    if not old or not fresh:
        return []
    a, b = np.array([l.at for l in fresh]), np.array([l.at for l in old])
    rows_a, rows_b = a[:, None] + np.arange(2), b[:, None] + np.arange(2)
    own_a = P[rows_a[:, :, None], rows_a[:, None, :]]
    own_b = P[rows_b[:, :, None], rows_b[:, None, :]]
    cross = P[rows_a[:, None, :, None], rows_b[None, :, None, :]]
    S = own_a[:, None] + own_b[None] - cross - np.swapaxes(cross, 2, 3) + _FLOOR**2 * np.eye(2)
    r = x[rows_a][:, None] - x[rows_b][None]
    squared = np.einsum("abi,abij,abj->ab", r, np.linalg.inv(S), r)
    gate = chi2_beyond(_GATE, 2)
    return [
        (fresh[i].key, old[j].key)
        for i, j in zip(*np.nonzero(squared < gate), strict=True)
        if fresh[i].type == old[j].type
    ]


@dataclass(frozen=True, eq=False, slots=True)
class _Found:
    pairs: tuple[Pair, ...]
    nats: float


class _Search:
    """Grows hypotheses from single pairs."""

    def __init__(self, landmarks: Mapping[int, Known], sensors: Sensors, config: MapperConfig) -> None:
        self.landmarks, self.sensors, self.config = landmarks, sensors, config

    def best(self, belief: Belief, near: Sequence[Pair], order: Sequence[int]) -> Loop | None:
        """The likeliest set of pairs, if it is likely enough and no other comes near."""
        seeds = sorted(((self._pair(belief, pair)[0], pair) for pair in near), reverse=True)[:_SEEDS]
        found: dict[frozenset[Pair], _Found] = {}
        for nats, seed in seeds:
            if not np.isfinite(nats):
                break
            grown = self._grow(belief, seed, near, order)
            found.setdefault(frozenset(grown.pairs), grown)
        if not found:
            return None
        ranked = sorted(found.values(), key=lambda f: (-f.nats, f.pairs))
        top = ranked[0]
        rival = next((f.nats for f in ranked[1:] if _contradict(f.pairs, top.pairs)), 0.0)
        clear = top.nats >= self.config.loop_nats and top.nats - rival >= self.config.loop_margin_nats
        return Loop(top.pairs, top.nats) if clear else None

    def _grow(self, belief: Belief, seed: Pair, near: Sequence[Pair], order: Sequence[int]) -> _Found:
        pairs, total = [], 0.0
        left: list[Pair] = list(near)
        best: tuple[float, Pair] = (self._pair(belief, seed)[0], seed)
        while True:
            nats, pair = best
            pairs.append(pair)
            total += nats
            belief = self._joined(belief, pair)
            left = [p for p in left if not set(p) & set(pair)]
            rated = sorted(((self._pair(belief, p)[0], p) for p in left), reverse=True)
            if not rated or rated[0][0] <= 0:
                break
            best = rated[0]
        return _Found(tuple(sorted(pairs)), total - self._missed(belief, pairs, order))

    def _pair(self, belief: Belief, pair: Pair) -> tuple[float, float, float]:
        """How much likelier two landmarks are one than two [nats], and the mean turn between them with its variance."""
        a, b = (self.landmarks[key] for key in pair)
        i, j = belief.rows[a.key], belief.rows[b.key]
        r = belief.x[i[:2]] - belief.x[j[:2]]
        cross = belief.P[np.ix_(i[:2], j[:2])]
        S = belief.P[np.ix_(i[:2], i[:2])] + belief.P[np.ix_(j[:2], j[:2])] - cross - cross.T
        S = S + _FLOOR**2 * np.eye(2)
        squared = float(r @ np.linalg.solve(S, r))
        if squared > chi2_beyond(_GATE, 2):
            return -np.inf, 0.0, 0.0
        nats = -squared / 2 - log(2 * pi) - 0.5 * log(float(np.linalg.det(S))) - log(self.config.landmark_density)
        if a.turn is None or b.turn is None:
            return nats, 0.0, -1.0
        sensed = [SensedArm(arm.type, arm.off) for arm in a.arms]
        on = overlay(b.arms, sensed, float(belief.x[j[2]] - belief.x[i[2]]), self.config)
        if not on.pairs:
            return nats + log(1 - self.config.arm_right) - log(self.config.arm_right), 0.0, -1.0
        spread = float(belief.P[i[2], i[2]] + belief.P[j[2], j[2]] - 2 * belief.P[i[2], j[2]])
        variance = heading_variance(b.arms, on, self.sensors.arm_sigma) + self.sensors.arm_sigma**2 / len(on.pairs)
        turned = on.residual**2 / (spread + variance)
        if turned > chi2_beyond(_GATE, 1):
            return -np.inf, 0.0, 0.0
        return nats + on.nats - turned / 2, on.residual, variance

    def _joined(self, belief: Belief, pair: Pair) -> Belief:
        """The belief once the two are one."""
        _, residual, variance = self._pair(belief, pair)
        i, j = (belief.rows[key] for key in pair)
        dims = 3 if variance > 0 else 2
        H = np.concatenate([np.eye(dims), -np.eye(dims)], axis=1)
        r = belief.x[j[:dims]] - belief.x[i[:dims]]
        R = np.eye(dims) * _FLOOR**2
        if dims == 3:
            # the arms say how far their directions are apart; the directions' own zeros may differ
            r[2], R[2, 2] = -residual, variance
        return belief.given(H, np.concatenate([i[:dims], j[:dims]]), r, R)

    def _missed(self, belief: Belief, pairs: Sequence[Pair], order: Sequence[int]) -> float:
        """What is said against: fresh landmarks between the pairs that are none of the old, and the reverse."""
        matched = {a for a, _ in pairs}
        joined = {b for _, b in pairs}
        # order holds fresh ones only, but old ones may be among them
        order = [key for key in order if key not in joined]
        places = [k for k, key in enumerate(order) if key in matched]
        between = order[places[0] : places[-1] + 1] if places else []
        nats = 0.0
        for key in between:
            if key not in matched:
                nats -= self._unseen(self.landmarks[key])
        xy = {key: belief.x[belief.rows[key][:2]] for key in (*between, *self.landmarks)}
        for key, landmark in self.landmarks.items():
            if key in joined or key in order:
                continue
            if any(_beside(xy[key], xy[a], xy[b]) for a, b in pairwise(between)):
                nats -= self._unseen(landmark)
        return nats

    def _unseen(self, landmark: Known) -> float:
        """Log-probability that a pass doesn't see what stands in the map."""
        sensors = self.sensors
        return log(1 - sensors.detection(landmark.type) * (1 - sensors.false_alarm(landmark.type)) + 1e-3)


def _contradict(one: Sequence[Pair], other: Sequence[Pair]) -> bool:
    """Whether two sets of pairs place the robot differently: neither holds a pair of the other."""
    return not set(one) & set(other)


def _beside(p: Array, a: Array, b: Array) -> bool:
    """Whether a point lies beside the way from a to b, clear of its ends."""
    leg = b - a
    length = float(np.hypot(*leg))
    if length < 2 * _BESIDE:
        return False
    along = float((p - a) @ leg) / length
    across = abs(float(leg[0] * (p - a)[1] - leg[1] * (p - a)[0])) / length
    return across < _BESIDE < along < length - _BESIDE
