"""From all that is remembered to a `LandmarkMap`: last look for doubles, passes, links, noise, walls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import log, pi
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import SensedArm
from ..maps import JointCovariance, Keyframes, LandmarkMap
from ..values import frozen_array
from .association import chi2_beyond, overlay
from .config import MapperConfig
from .joining import direction_of, joined, landmark_id
from .loops import find_doubles
from .memory import Known, Memory
from .passes import Pass, Track, existence, passes_of, track_of
from .records import Rows
from .smooth import Smoothed, arm_starts
from .state import joint_state
from .walljoins import seen_again
from .walls import walls_of
from .walltracks import Walls, followed_walls

if TYPE_CHECKING:
    from .mapper import Mapper

Array = NDArray[np.float64]

#: Landmarks of one type nearer to each other than this [m] are one: no building has such neighbours.
LEAST_DISTANCE = 0.5
#: Two landmarks that were seen at once from one place are two.
_FLOOR = 0.05
#: Rounds of joining doubles.
_ROUNDS = 10
#: Keyframes that a map tells of are at least this far [m] of way from each other.
_KEYFRAMES_APART = 2.5


@dataclass(frozen=True, eq=False)
class Finished:
    """The map as far as the log goes, and what it was made of.

    ``poses`` (K, 3): the keyframes; ``smoothed``: the optimum; ``landmarks``: doubles joined, all of them;
    ``kept``: keys of those in the map.
    """

    mapper: Mapper
    landmarks: Mapping[int, Known]
    memory: Memory
    smoothed: Smoothed
    passes: Mapping[int, Sequence[Pass]]
    existence: Mapping[int, float]
    track: Track

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """Keys of the landmarks in the map: named ones, and those that are not clearly false."""
        below = self.mapper.config.forget_below
        return tuple(key for key, l in self.landmarks.items() if l.name is not None or self.existence[key] >= below)

    @cached_property
    def sources(self) -> Mapping[str, tuple[int, ...]]:
        """Of each landmark of the map its detections, as their numbers in the log."""
        sightings = self.memory.sightings
        return {
            landmark_id(self.landmarks[k]): tuple(sightings[i].event for i in self.landmarks[k].sightings)
            for k in self.kept
        }

    @cached_property
    def place(self) -> Mapping[int, int]:
        """Place of each landmark in the estimate."""
        return {key: k for k, key in enumerate(self.landmarks)}

    def map(self, joint: bool, keyframes: bool = False) -> LandmarkMap:
        """The map; with the joint covariance of all landmarks if asked, and with the keyframes' in it."""
        rows = Rows(self)
        header = self.mapper.header
        landmarks, jacobians = rows.landmarks()
        covariance = self.smoothed.covariance
        t, pose = self.track.t, self.track.pose
        map_ = LandmarkMap(
            header.name,
            landmarks,
            header.robot,
            header.recorded_at,
            rows.noise(),
            walls=walls_of(self.memory.pieces, self.memory.hits, self.smoothed.estimate.poses, self.mapper.config),
            path=np.column_stack([np.maximum.accumulate(t), pose[:, :2], se2.wrap(pose[:, 2])]),
        )
        if not joint or not landmarks:
            return map_
        dims = 3 if all(len(J) == 3 for J in jacobians) else 2
        J = np.concatenate([j[:dims] for j in jacobians])
        matrix = se2.propagate(J, covariance)
        known = self._keyframes(J) if keyframes and map_.walls else None
        return map_.replace(joint_covariance=JointCovariance(map_.ids, dims, frozen_array(matrix), {}, known))

    def _keyframes(self, J: Array) -> Keyframes:
        """Keyframes all along the way, with the walls seen from each alone; ``J``: the landmarks' rows.

        Walls of the map are joined from scans of many keyframes, whose errors differ; those of one keyframe are not.
        """
        memory, poses = self.memory, self.smoothed.estimate.poses
        still = np.zeros_like(poses)
        chosen: list[int] = []
        walls: list[tuple[float, ...]] = []
        for k, frame in enumerate(memory.keyframes):
            if chosen and frame.way - memory.keyframes[chosen[-1]].way < _KEYFRAMES_APART:
                continue
            # what was seen a little further on is off by odometry until there
            pieces = [piece for piece in memory.pieces if piece.keyframe == k and piece.here]
            seen = walls_of(pieces, [hit for hit in memory.hits if hit.keyframe == k], still, self.mapper.config)
            if seen:
                ends = [(*a, *b) for line in seen for a, b in pairwise(line.tolist())]
                walls += [(float(len(chosen)), *numbers) for numbers in ends]
                chosen.append(k)
        matrix, with_border = self.smoothed.keyframe_covariance(np.array(chosen, dtype=np.intp))
        at = np.column_stack([poses[chosen, :2], se2.wrap(poses[chosen, 2])])
        return Keyframes(at, np.array(walls).reshape(-1, 5), with_border @ J.T, matrix)


def finish(mapper: Mapper, walls: bool = False) -> Finished:
    """All that the mapper remembers, solved once more with doubles joined.

    ``walls``: held straight by the walls that scans saw again and again (`walltracks`); they then help to find
    doubles, too.
    """
    landmarks, memory = mapper.landmarks, mapper.memory
    smoothed = mapper.smoothed(landmarks, memory)
    landmarks, memory, smoothed = _without_doubles(mapper, landmarks, memory, smoothed, None)
    if walls:
        landmarks, memory, smoothed = _held_by_walls(mapper, landmarks, memory, smoothed)
    here = mapper.reckoned()
    track = track_of(memory, smoothed.estimate.poses, here)
    near = mapper.config.pass_distance
    frames, e = memory.keyframes, smoothed.estimate
    passes, there = {}, {}
    for k, (key, landmark) in enumerate(landmarks.items()):
        seen = [frames[memory.sightings[i].keyframe].way for i in landmark.sightings]
        passes[key] = passes_of(e.landmarks[k], seen, track, mapper.sensors, near)
        there[key] = existence(landmark.type, passes[key], near, mapper.sensors)
    return Finished(mapper, landmarks, memory, smoothed, passes, there, track)


def _held_by_walls(
    mapper: Mapper, landmarks: Mapping[int, Known], memory: Memory, smoothed: Smoothed
) -> tuple[Mapping[int, Known], Memory, Smoothed]:
    """The solved map with the walls that were seen from several keyframes; as it is where there are none."""
    found = followed_walls(memory, smoothed.estimate.poses, mapper.sensors, mapper.config)
    if not len(found.lines):
        return landmarks, memory, smoothed
    straight = mapper.smoothed(landmarks, memory, found)
    if not straight.converged:
        return landmarks, memory, smoothed
    found, straight = seen_again(
        found.at(straight.estimate), straight, lambda walls: mapper.smoothed(landmarks, memory, walls)
    )
    return _without_doubles(mapper, landmarks, memory, straight, found)


def _without_doubles(
    mapper: Mapper, landmarks: Mapping[int, Known], memory: Memory, smoothed: Smoothed, walls: Walls | None
) -> tuple[Mapping[int, Known], Memory, Smoothed]:
    """The solved map with landmarks joined that stand twice, as long as there are any and the map bears it."""
    refused: set[tuple[int, int]] = set()
    for _ in range(_ROUNDS):
        pairs = _doubles(landmarks, memory, smoothed, mapper.config, refused)
        if not pairs:
            state = joint_state(smoothed, list(landmarks.values()))
            nameless = {key: l for key, l in state.landmarks.items() if l.name is None}
            loop = find_doubles(
                state.x, state.P, nameless, refused | _at_once(landmarks, memory), mapper.sensors, mapper.config
            )
            pairs = [] if loop is None else list(loop.pairs)
        if not pairs:
            break
        directions = _directions(landmarks, smoothed)
        new, new_memory = joined(landmarks, memory, pairs, mapper.config, directions)
        after = mapper.smoothed(new, new_memory, walls)
        if 2 * (after.error - smoothed.error) > chi2_beyond(1e-4, 3 * len(pairs)) + 2 * len(pairs):
            refused |= set(pairs)
            continue
        landmarks, memory, smoothed = new, new_memory, after
    return landmarks, memory, smoothed


def _at_once(landmarks: Mapping[int, Known], memory: Memory) -> set[tuple[int, int]]:
    """(newer, older) landmarks that were seen at one time: they are two."""
    by_keyframe: dict[int, set[int]] = {}
    for sighting in memory.sightings:
        if sighting.landmark in landmarks:
            by_keyframe.setdefault(sighting.keyframe, set()).add(sighting.landmark)
    return {(a, b) for keys in by_keyframe.values() for a in keys for b in keys if a > b}


def _directions(landmarks: Mapping[int, Known], smoothed: Smoothed) -> dict[int, float]:
    starts = arm_starts(list(landmarks.values()))
    arms = smoothed.estimate.arms
    return {
        key: direction_of(l, arms[starts[k] : starts[k + 1]])
        for k, (key, l) in enumerate(landmarks.items())
        if l.turn is not None
    }


def _doubles(
    landmarks: Mapping[int, Known],
    memory: Memory,
    smoothed: Smoothed,
    config: MapperConfig,
    refused: set[tuple[int, int]],
) -> list[tuple[int, int]]:
    """(newer, older) of one type that stand at one place and were never seen at once; each landmark once."""
    keys = list(landmarks)
    xy = smoothed.estimate.landmarks
    at = smoothed.landmark_rows
    directions = _directions(landmarks, smoothed)
    at_once = _at_once(landmarks, memory)
    found = []
    for i in range(len(keys)):
        for j in range(i):
            one, other = landmarks[keys[i]], landmarks[keys[j]]
            if one.type != other.type or one.name is not None or other.name is not None:
                continue
            pair = (max(keys[i], keys[j]), min(keys[i], keys[j]))
            r = xy[i] - xy[j]
            if pair in refused or float(np.hypot(*r)) > 5.0:
                continue
            rows = np.array([at + 2 * i, at + 2 * i + 1, at + 2 * j, at + 2 * j + 1])
            H = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0]])
            S = H @ smoothed.covariance[np.ix_(rows, rows)] @ H.T + _FLOOR**2 * np.eye(2)
            squared = float(r @ np.linalg.solve(S, r))
            nats = -squared / 2 - log(2 * pi) - 0.5 * log(float(np.linalg.det(S))) - log(config.landmark_density)
            nats += log(config.seen_twice / (1 - config.seen_twice))
            if one.turn is not None and other.turn is not None:
                turn = directions[keys[i]] - directions[keys[j]]
                on = overlay(other.arms, [SensedArm(a.type, a.off + turn) for a in one.arms], 0.0, config)
                nats += on.nats if on.pairs else -log(config.arm_right / (1 - config.arm_right))
            near = float(np.hypot(*r)) < LEAST_DISTANCE
            if near and squared < chi2_beyond(1e-4, 2):
                nats = max(nats, 1.0)
            if nats > 0 and squared < chi2_beyond(1e-3, 2) * (2 if near else 1) and pair not in at_once:
                found.append((-nats, pair))
    taken: set[int] = set()
    out = []
    for _, pair in sorted(found):
        if not taken & set(pair):
            out.append(pair)
            taken |= set(pair)
    return out
