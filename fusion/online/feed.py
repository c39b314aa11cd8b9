"""A robot's log to what it says of its map: the mapper at work, and messages of what it finds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Event, LogHeader
from mapfuse.datasets.mapper import Mapper
from mapfuse.datasets.mapper.changes import LandmarkAdded
from mapfuse.datasets.mapper.config import MapperConfig
from mapfuse.datasets.mapper.joining import landmark_id
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise

from .messages import Correction, LandmarkSeen, Message, Placed

#: Landmarks that a robot knows its place by: the nearest ones.
MOST_NEAR = 12


class Feed:
    """One robot: events of its log in, messages out.

    A new landmark is told at once, as the filter has it; the whole map with its joint covariance, which takes the
    mapper longer, when it is asked for (`correction`).
    """

    def __init__(self, header: LogHeader, config: MapperConfig | None = None, *, name: str | None = None) -> None:
        self.mapper = Mapper(header, config)
        self.name = name or header.name
        self.sequence = 0
        self.t = float("-inf")
        self.stale = False

    def update(self, event: Event) -> Iterator[Message]:
        """Take an event in; what there is to say of it."""
        changes = self.mapper.update(event)
        self.t = max(self.t, event.t)
        if not changes:
            return
        self.stale = True
        for change in changes:
            if isinstance(change, LandmarkAdded) and change.id:
                landmark = self._landmark(change.id)
                if landmark is not None:
                    yield LandmarkSeen(robot=self.name, sequence=self._next(), t=self.t, landmark=landmark)

    def correction(self) -> Correction:
        """The whole map by now."""
        self.stale = False
        return Correction(robot=self.name, sequence=self._next(), t=self.t, map=self.map())

    def placed(self) -> Placed:
        """Where the robot is by now, and how that goes together with where the landmarks near it are."""
        x = self.mapper.filter.x
        pose = self.mapper.pose
        near = sorted(
            self.mapper.landmarks.values(),
            key=lambda l: (float(np.hypot(x[l.at] - pose[0], x[l.at + 1] - pose[1])), l.key),
        )[:MOST_NEAR]
        place, covariance = self.mapper.pose_among(near)
        place[2] = se2.wrap(place[2])
        return Placed(
            robot=self.name,
            sequence=self._next(),
            t=self.t,
            pose=place,
            covariance=covariance,
            order=tuple(landmark_id(l) for l in near),
            positions=np.array([x[l.at : l.at + 2] for l in near]).reshape(-1, 2),
        )

    def noise(self) -> Noise:
        """What the robot is known to be, before there is a map."""
        s = self.mapper.sensors
        return Noise(
            compass_offset_sigma=s.compass_offset_sigma,
            detection_rate=s.detection_rate,
            false_alarm_rate=s.false_alarm_rate,
            door_detection_rate=s.door_detection_rate,
            door_false_alarm_rate=s.door_false_alarm_rate,
        )

    def map(self) -> LandmarkMap:
        """The map by now, with its joint covariance."""
        return self.mapper.map(joint=True).replace(name=self.name)

    def _next(self) -> int:
        self.sequence += 1
        return self.sequence - 1

    def _landmark(self, identifier: str) -> Landmark | None:
        """A landmark as the filter has it."""
        x, P = self.mapper.filter.x, self.mapper.filter.P
        known = next((l for l in reversed(list(self.mapper.landmarks.values())) if landmark_id(l) == identifier), None)
        if known is None:
            return None
        at = [known.at, known.at + 1]
        links: tuple[Link, ...] = ()
        if known.turn is not None:
            turn = float(x[known.turn])
            shown = sorted(known.arms, key=lambda arm: -arm.count)[:4]
            links = tuple(
                Link(arm.type, float(np.remainder(turn + arm.off + np.pi, 2 * np.pi) - np.pi)) for arm in shown
            )
        covariance = P[np.ix_(at, at)]
        return Landmark(
            identifier,
            known.type,
            float(x[at[0]]),
            float(x[at[1]]),
            links=links,
            covariance=(covariance + covariance.T) / 2,
        )
