"""The records of a map: landmarks, links and noise of what a mapper has finished, and what each number follows from."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arms import wrap
from ..maps import Landmark, Link, LinkType, Noise
from ..values import frozen_array
from .association import wrap_any
from .joining import landmark_id
from .links import BENT, Way, ways_of
from .smooth import arm_starts

if TYPE_CHECKING:
    from .finish import Finished

Array = NDArray[np.float64]

_MAX_LINKS = 4
#: An arm that was sensed in a smaller share of its landmark's sightings is none, where there are enough of those.
_ARM_SHARE, _ENOUGH = 0.25, 4
#: Least standard deviations that a map claims: heading [rad], distance per metre and floor [m], position [m].
_LEAST_NOISE = (0.005, 0.001, 0.01, 0.01)


class Rows:
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
