"""From all that is remembered to a `LandmarkMap`: last look for doubles, passes, links, noise, walls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import atan2, log, pi
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arms import wrap
from ..logs import SensedArm
from ..maps import JointCovariance, Keyframes, Landmark, LandmarkMap, Link, LinkType, Noise
from ..values import frozen_array
from .association import chi2_beyond, overlay, wrap_any
from .config import MapperConfig
from .joining import direction_of, joined, landmark_id
from .links import BENT, Way, ways_of
from .loops import find_doubles
from .memory import Known, Memory
from .passes import Pass, Track, existence, passes_of, track_of
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
_MAX_LINKS = 4
#: Keyframes that a map tells of are at least this far [m] of way from each other.
_KEYFRAMES_APART = 2.5
#: An arm that was sensed in a smaller share of its landmark's sightings is none, where there are enough of those.
_ARM_SHARE, _ENOUGH = 0.25, 4
#: Least standard deviations that a map claims: heading [rad], distance per metre and floor [m], position [m].
_LEAST_NOISE = (0.005, 0.001, 0.01, 0.01)


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
        rows = _Rows(self)
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


class _Rows:
    """The records of a map, each number with its derivatives by the smoothed border."""

    def __init__(self, finished: Finished) -> None:
        self.f = finished
        self.sensors = finished.mapper.sensors
        self.estimate = finished.smoothed.estimate
        self.covariance = finished.smoothed.covariance
        self.size = len(self.covariance)
        self.starts = arm_starts(list(finished.landmarks.values()))
        self.arm_row = finished.smoothed.landmark_rows + 2 * len(finished.landmarks)
        self.arms = {key: self._sensed_arms(key) for key in finished.kept}
        kept = {key: finished.landmarks[key] for key in finished.kept}
        self.places = {key: self.estimate.landmarks[finished.place[key]] for key in kept}
        directions = {
            key: [float(self.estimate.arms[self._number(key, m)]) for m in arms] for key, arms in self.arms.items()
        }
        near = finished.mapper.config.pass_distance
        self.ways = ways_of(kept, self.places, directions, finished.passes, finished.track, near)
        self.arm_sigmas: list[float] = []

    def _number(self, key: int, m: int) -> int:
        return self.starts[self.f.place[key]] + m

    def _sensed_arms(self, key: int) -> list[int]:
        """Arms worth showing, those sensed most often first; without those that were hardly ever sensed."""
        landmark = self.f.landmarks[key]
        with_arms = sum(bool(self.f.memory.sightings[i].arms) for i in landmark.sightings)
        least = _ARM_SHARE * with_arms if with_arms >= _ENOUGH else 0
        order = sorted(range(len(landmark.arms)), key=lambda m: (-landmark.arms[m].count, m))
        return [m for m in order if landmark.arms[m].count >= least]

    def landmarks(self) -> tuple[tuple[Landmark, ...], list[Array]]:
        """The records, and of each the derivatives (2 or 3, size) of x, y and heading."""
        linked = self._linked()
        out, jacobians = [], []
        for key in self.f.kept:
            links, turns = self._links(key, linked.get(key, []))
            J = self._place_rows(key)
            known = [row for link, row in zip(links, turns, strict=True) if link.type != "unknown"]
            if known:
                J = np.concatenate([J, np.mean(known, axis=0, keepdims=True)])
            passes, landmark = self.f.passes[key], self.f.landmarks[key]
            x, y = self.places[key].tolist()
            out.append(
                Landmark(
                    landmark_id(landmark),
                    landmark.type,
                    x,
                    y,
                    None,
                    tuple(links),
                    max(1, len(passes)),
                    max(1, sum(p.seen for p in passes)),
                    frozen_array(se2.propagate(J, self.covariance)),
                    self.f.existence[key],
                )
            )
            jacobians.append(J)
        return tuple(out), jacobians

    def _place_rows(self, key: int) -> Array:
        J = np.zeros((2, self.size))
        at = self.f.smoothed.landmark_rows + 2 * self.f.place[key]
        J[0, at] = J[1, at + 1] = 1.0
        return J

    def _linked(self) -> dict[int, list[tuple[int | None, Way, bool]]]:
        """Of each landmark the ways that are written at it: its arm (place among those shown), and at which end."""
        written: dict[int, list[tuple[int | None, Way, bool]]] = {}
        taken: set[tuple[int, int | None]] = set()
        joined_pairs: set[frozenset[int]] = set()
        for way in sorted(self.ways, key=lambda w: (not w.straight, -w.travels, w.distance, w.a, w.b)):
            ends = [(way.a, way.arm_a, True), (way.b, way.arm_b, False)]
            if not way.straight:
                ends = self._bent_end(way, ends)
            for key, arm, first in ends:
                if arm is not None and (key, arm) in taken:
                    continue
                taken.add((key, arm))
                written.setdefault(key, []).append((arm, way, first))
                joined_pairs.add(frozenset((way.a, way.b)))
        return written

    def _bent_end(self, way: Way, ends: list[tuple[int, int | None, bool]]) -> list[tuple[int, int | None, bool]]:
        """A bent way stands at the end whose arm is furthest from the displacement, so that it can be told from it."""
        chord = self.places[way.b] - self.places[way.a]
        best: tuple[float, tuple[int, int | None, bool]] | None = None
        for key, arm, first in ends:
            if arm is None:
                continue
            towards = atan2(chord[1], chord[0]) + (0.0 if first else np.pi)
            off = abs(wrap_any(float(self.estimate.arms[self._number(key, self.arms[key][arm])]) - towards))
            if off > BENT and (best is None or off > best[0]):
                best = (off, (key, arm, first))
        return [] if best is None else [best[1]]

    def _links(self, key: int, ways: Sequence[tuple[int | None, Way, bool]]) -> tuple[list[Link], list[Array]]:
        """At most four links of a landmark, travelled ones first, with the derivatives (size,) of their headings."""
        landmark, shown = self.f.landmarks[key], self.arms[key]
        links: list[Link] = []
        rows: list[Array] = []
        used: set[int] = set()
        for arm, way, first in ways:
            if len(links) == _MAX_LINKS:
                break
            far = way.b if first else way.a
            if way.straight:
                heading, row = self._chord(key, far)
            else:
                assert arm is not None
                heading, row = self._arm(key, shown[arm])
            if arm is not None:
                used.add(arm)
            sensed = landmark.arms[shown[arm]].type if arm is not None else "open"
            kind: LinkType = "door" if sensed == "door" else "open"
            target = landmark_id(self.f.landmarks[far])
            links.append(Link(kind, heading, self._compass(key, heading), target, way.distance, way.travels))
            rows.append(row)
        for place, m in enumerate(shown):
            if len(links) == _MAX_LINKS:
                break
            if place in used:
                continue
            heading, row = self._arm(key, m)
            if any(abs(wrap(heading - (link.heading or 0.0))) < 0.35 for link in links):
                continue
            links.append(Link(landmark.arms[m].type, heading, self._compass(key, heading)))
            rows.append(row)
        self.arm_sigmas += [float(np.sqrt(max(0.0, float(row @ self.covariance @ row)))) for row in rows]
        return links, rows

    def _chord(self, key: int, far: int) -> tuple[float, Array]:
        """Heading [rad] of the straight way from one landmark to another, with its derivatives."""
        gx, gy = self.places[far] - self.places[key]
        squared = gx * gx + gy * gy
        J = np.array([-gy / squared, gx / squared]) @ (self._place_rows(far) - self._place_rows(key))
        return wrap(atan2(gy, gx)), J

    def _arm(self, key: int, m: int) -> tuple[float, Array]:
        number = self._number(key, m)
        row = np.zeros(self.size)
        row[self.arm_row + number] = 1.0
        return wrap_any(float(self.estimate.arms[number])), row

    def _compass(self, key: int, heading: float) -> float | None:
        """What the compass says of a direction at a landmark: readings of the places near it."""
        stations = self.f.memory.stations
        if not stations:
            return None
        reach = self.sensors.compass_bend_length / 2
        poses = self.estimate.poses[[s.keyframe for s in stations]]
        near = np.hypot(*(poses[:, :2] - self.places[key]).T)
        chosen = np.flatnonzero(near < reach)
        if not len(chosen):
            chosen = np.array([int(np.argmin(near))])
            if near[chosen[0]] > 2 * reach:
                return None
        off = np.array([stations[k].heading for k in chosen]) - poses[chosen, 2]
        turn = float(np.arctan2(np.sin(off).mean(), np.cos(off).mean()))
        return wrap_any(heading + turn)

    def noise(self) -> Noise:
        """What the robot is known to be, as the rows of the measurement model mean it; docs/mapper.md derives it."""
        s = self.sensors
        heading, per_metre, floor, position = _LEAST_NOISE
        if self.arm_sigmas:
            heading = max(heading, float(np.sqrt(np.mean(np.square(self.arm_sigmas)))))
        else:
            heading = max(heading, float(np.sqrt(max(0.0, self.covariance[2, 2]))))
        per_metre = max(per_metre, float(np.sqrt(max(0.0, self.covariance[3, 3]))))
        off = [self._distance_sigma(way) - per_metre * way.distance for way in self.ways if way.straight]
        if off:
            floor = max(floor, float(np.sqrt(np.mean(np.square(np.maximum(off, 0.0))))))
        else:
            floor = max(floor, s.range_sigma)
        if self.f.kept:
            nearest = min(self.f.kept, key=lambda key: float(np.hypot(*self.places[key])))
            J = self._place_rows(nearest)
            position = max(position, float(np.sqrt(np.trace(se2.propagate(J, self.covariance)) / 2)))
        compass = s.compass_sigma or 0.0
        return Noise(
            distance_sigma_per_metre=per_metre,
            distance_sigma_floor=floor,
            heading_sigma=heading,
            position_sigma=position,
            compass_sigma=float(np.hypot(s.compass_bend_sigma, compass / 2)) or 0.2,
            compass_offset_sigma=s.compass_offset_sigma,
            detection_rate=s.detection_rate,
            false_alarm_rate=s.false_alarm_rate,
            door_detection_rate=s.door_detection_rate,
            door_false_alarm_rate=s.door_false_alarm_rate,
        )

    def _distance_sigma(self, way: Way) -> float:
        chord = self.places[way.b] - self.places[way.a]
        J = chord / np.hypot(*chord) @ (self._place_rows(way.b) - self._place_rows(way.a))
        return float(np.sqrt(max(0.0, J @ self.covariance @ J)) * np.sqrt(way.travels))
