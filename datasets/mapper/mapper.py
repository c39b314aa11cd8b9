"""`Mapper`: one robot's log to its map, one event at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, hypot, isfinite, sin
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import Compass, Detection, Event, Gyro, Log, LogHeader, Odometry, Scan
from ..maps import LandmarkMap
from . import finish, joining, saved
from .association import Candidate, candidates, chi2_beyond, expected, heading_variance, judge
from .changes import Change, Corrected, LandmarkAdded, LandmarkRemoved, LandmarkUpdated, LoopClosed
from .compass import conditional
from .config import MapperConfig
from .filter import JointFilter
from .linear import Estimate
from .loops import Loop, find_loop
from .memory import Arm, Hit, Keyframe, Known, Memory, Piece, Pose, Sighting, Station, Waypoint
from .odometry import DeadReckoning, Motion, seen_now
from .saved import Counters, State
from .smooth import Smoothed, drive_of, smooth
from .state import joint_state
from .walls import BEAMS, scan_hits, wall_pieces
from .walltracks import Walls

Array = NDArray[np.float64]

#: Rows of the filter's state before nodes and landmarks: pose (3), systematic errors (4), north.
POSE, SYSTEMATIC, NORTH = np.arange(3), np.arange(3, 7), 7
_ROWS = np.arange(7)
_NORTH_SIGMA = 100.0
#: Keyframes before the first smoothing.
_FIRST_SMOOTHING = 30
#: Odometry that is remembered for detections that come late.
_RECENT = 64
#: A named landmark that was rejected so often in a row is believed again.
_REJECTIONS = 5
#: A fresh landmark is tested for loops at these numbers of sightings.
_LOOP_TESTS = (1, 2, 4, 8, 16)
#: Scans are looked at every so many metres, or after so much turning [rad].
_SCAN_STEP, _SCAN_TURN = 0.3, 0.35
#: A closed loop may raise the error by the chi-square quantile of this tail.
_LOOP_TAIL = 1e-4


class Mapper:
    """A landmark map that grows with each event of a log.

    Events count in the order in which they come. Odometry that is older than what came before is left out (a pose and
    not a step, it loses nothing); a detection that comes late by a few odometry steps is carried to the present pose,
    one from before the oldest remembered step is taken as of that step; a jump in time is a long step; an odometry
    pose that jumps further than a robot drives begins anew, with the uncertainty of the time between. Events with
    numbers that aren't finite are left out, and so is an exact double of the event before. `counters` counts all of
    that. A detection before any odometry is seen from the start.

    >>> mapper = Mapper(LogHeader("D7"))
    >>> _ = mapper.update(Detection(0.0, "tree", 2.0, 0.0))
    >>> landmark = mapper.map().landmarks[0]
    >>> landmark.type, round(landmark.x, 6), round(landmark.y, 6)
    ('tree', 2.0, 0.0)
    """

    def __init__(self, header: LogHeader, config: MapperConfig | None = None) -> None:
        self.header = header
        self.config = config or MapperConfig()
        self.sensors = header.sensors
        self.filter = JointFilter(np.zeros(8), np.diag([*[1e-10] * 3, *self._systematic_sigma() ** 2, _NORTH_SIGMA**2]))
        nothing = Motion((0.0, 0.0, 0.0), (0.0,) * 4, (0.0,) * 9, (0.0,) * 6, 0.0)
        self.state = State(
            DeadReckoning.of(header.sensors, self.config.max_speed),
            Memory(keyframes=[Keyframe(0.0, 0.0, nothing)], poses=[(0.0, 0.0, 0.0)]),
            stop=self.config.path_step,
        )
        self._version = 0
        self._cache: dict[bool, tuple[int, finish.Finished]] = {}
        self._asked = False

    def _systematic_sigma(self) -> Array:
        s = self.sensors
        sigmas = (s.odometry_scale_sigma, s.odometry_turn_scale_sigma, s.odometry_curve_sigma, s.gyro_bias_sigma)
        return np.array([max(sigma, 1e-9) for sigma in sigmas])

    # What is known

    @property
    def counters(self) -> Counters:
        """What could not be used."""
        return self.state.counters

    @property
    def pose(self) -> Array:
        """Where the robot is (3,) in the map's frame, theta not wrapped."""
        x, r = self.filter.x, self.state.reckoning
        c, s = cos(x[2]), sin(x[2])
        return np.array([x[0] + c * r.x - s * r.y, x[1] + s * r.x + c * r.y, x[2] + r.theta])

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) of `pose`, in the map's axes."""
        motion = self.state.reckoning.motion()
        _, F, Q = self._prediction(motion, self.filter.x)
        return np.asarray(F @ self.filter.P[np.ix_(_ROWS, _ROWS)] @ F.T + Q, dtype=float)

    def pose_among(self, landmarks: Sequence[Known]) -> tuple[Array, Array]:
        """The pose (3,), and its covariance with n landmarks together (3 + 2n, 3 + 2n), in that order.

        What is systematic in the motion since the last keyframe is in the landmarks, too: their covariance with the
        pose comes from all of the state that the motion is reckoned by.
        """
        P = self.filter.P
        pose, F, Q = self._prediction(self.state.reckoning.motion(), self.filter.x)
        columns = [column for landmark in landmarks for column in (landmark.at, landmark.at + 1)]
        rows = np.array([*_ROWS, *columns], dtype=np.intp)
        J = np.eye(3 + len(columns), len(rows), k=4)
        J[:3] = 0.0
        J[:3, :7] = F
        joint = se2.propagate(J, P[np.ix_(rows, rows)])
        joint[:3, :3] += Q
        return pose, joint

    def final_pose(self) -> tuple[Array, Array]:
        """`pose` and its covariance from all that is remembered, as `map` is, instead of from the filter."""
        finished = self._finished()
        state = joint_state(finished.smoothed, list(finished.landmarks.values()))
        pose, F, Q = self._prediction(self.state.reckoning.motion(), state.x)
        return pose, np.asarray(F @ state.P[:7, :7] @ F.T + Q, dtype=float)

    @property
    def sources(self) -> Mapping[str, tuple[int, ...]]:
        """Of each landmark of the map that was asked for last its detections, as their numbers in the log, from 0."""
        return self._finished(self._asked).sources

    @property
    def length(self) -> float:
        """Way travelled [m]."""
        return self.state.memory.keyframes[-1].way + self.state.reckoning.length

    def map(self, *, joint: bool = False, keyframes: bool = False) -> LandmarkMap:
        """The map so far, computed from all that is remembered; with its ``joint_covariance`` if asked.

        ``keyframes``: walls that scans saw from several keyframes hold the map straight, and that covariance holds
        poses of the way too, and the walls seen from each (`Keyframes`). The mapper then wants to be made with
        `WITH_KEYFRAMES`.

        Asking changes nothing of what comes later.
        """
        self._asked = keyframes
        return self._finished(keyframes).map(joint or keyframes, keyframes)

    def _finished(self, walls: bool = False) -> finish.Finished:
        version, finished = self._cache.get(walls, (-1, None))
        if finished is None or version != self._version:
            finished = finish.finish(self, walls)
            self._cache[walls] = self._version, finished
        return finished

    @property
    def landmarks(self) -> Mapping[int, Known]:
        """The landmarks so far, by number."""
        return self.state.landmarks

    @property
    def memory(self) -> Memory:
        """What is remembered of the drive."""
        return self.state.memory

    def reckoned(self) -> tuple[float, float, Pose]:
        """Time [s], way [m], and the pose of the robot seen from the last keyframe."""
        r = self.state.reckoning
        return self.state.t, self.length, (r.x, r.y, r.theta)

    # Events

    def update(self, event: Event) -> tuple[Change, ...]:
        """Take one event in; what it changed."""
        if isinstance(event, Odometry):
            self._odometry(event)
        elif isinstance(event, Gyro):
            self.state.reckoning.gyro(event.t, event.rate)
        elif isinstance(event, Compass):
            self._compass(event)
        elif isinstance(event, Detection):
            return self._detection(event)
        else:
            self._scan(event)
        return ()

    def _odometry(self, event: Odometry) -> None:
        reckoning = self.state.reckoning
        last = reckoning.last
        if last is not None and event.t < last.t:
            self.state.counters.late += 1
            return
        if not isfinite(event.x + event.y + event.theta + event.t):
            self.state.counters.broken += 1
            return
        if last is None:
            # the pose that all begins with is that of the first odometry, whenever the clock began
            start = self.state.memory.keyframes[0]
            self.state.memory.keyframes[0] = msgspec.structs.replace(start, t=event.t)
        reckoning.odometry(event)
        self.state.recent.append(event)
        if len(self.state.recent) > 2 * _RECENT:
            del self.state.recent[:_RECENT]
        self.state.t = event.t
        if reckoning.length >= self.state.stop:
            self._waypoint()
        self._version += 1

    def _waypoint(self) -> None:
        """The robot has come a step further: remember the place, and read the compass where that is due."""
        if self._station_due() or self.state.reckoning.length >= self.config.stretch:
            self._keyframe()
            if self._station_due():
                self._station()
        r = self.state.reckoning
        path = self.state.memory.path
        path.append(Waypoint(self.state.t, self.length, len(self.state.memory.keyframes) - 1, r.x, r.y, r.theta))
        self.state.stop = r.length + self.config.path_step

    def _station_due(self) -> bool:
        stretch = self.config.compass_stretch * self.sensors.compass_bend_length
        return bool(self.state.window.readings) and self.length - self.state.way_of_station >= stretch

    def _keyframe(self) -> int:
        """A keyframe here and now; the last one, where the robot hasn't moved since."""
        r, memory = self.state.reckoning, self.state.memory
        if r.length == 0 and r.theta == 0 and r.ctt == 0:
            return len(memory.keyframes) - 1
        motion = r.motion()
        pose, F, Q = self._prediction(motion, self.filter.x)
        self.filter.predict_rows(POSE, pose, F, _ROWS, Q)
        memory.keyframes.append(Keyframe(self.state.t, memory.keyframes[-1].way + motion.length, motion))
        memory.poses.append((float(pose[0]), float(pose[1]), float(pose[2])))
        self.state.window.turned(motion.pose[2])
        self.state.turn_of_scan -= motion.pose[2]
        r.restart(*(float(v) for v in self.filter.x[3:7]))
        self.state.stop = max(self.state.stop - motion.length, 0.0)
        return len(memory.keyframes) - 1

    def _prediction(self, motion: Motion, x: Array) -> tuple[Array, Array, Array]:
        """The pose after a motion, its derivatives (3, 7) by pose and systematic errors, and the noise."""
        by = motion.by_systematic()
        dx, dy, turn = np.array(motion.pose) + by @ (x[3:7] - np.array(motion.at))
        c, s = np.cos(x[2]), np.sin(x[2])
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        gx, gy = c * dx - s * dy, s * dx + c * dy
        F = np.zeros((3, 7))
        F[:, :3] = np.eye(3)
        F[0, 2], F[1, 2] = -gy, gx
        F[:, 3:] = R @ by
        return np.array([x[0] + gx, x[1] + gy, x[2] + turn]), F, R @ motion.covariance_matrix() @ R.T

    # Compass

    def _compass(self, event: Compass) -> None:
        if self.sensors.compass_sigma is None or not isfinite(event.heading):
            self.state.counters.broken += 1
            return
        self.state.window.add(self.length, event.heading - self.state.reckoning.theta, self.config.compass_window)
        if self.state.way_of_station < 0:
            self._keyframe()
            self._station()

    def _station(self) -> None:
        """The window's mean as one reading of the bend's node here."""
        assert self.sensors.compass_sigma is not None
        self.state.way_of_station = self.length
        heading, count = self.state.window.mean()
        keyframe = len(self.state.memory.keyframes) - 1
        node, apart = self._node()
        variance = self.sensors.compass_sigma**2 / count + apart
        self.state.memory.stations.append(Station(keyframe, node, heading, variance))
        x, row = self.filter.x, self.state.node_rows[node]
        residual = float(np.remainder(heading - (x[2] - x[NORTH] - x[row]) + np.pi, 2 * np.pi) - np.pi)
        columns = np.array([2, NORTH, row])
        self.filter.update_rows(columns, np.array([[1.0, -1.0, -1.0]]), np.array([residual]), np.array([[variance]]))

    def _node(self) -> tuple[int, float]:
        """The bend's node for the place here, a known one or a new one, and the variance [rad^2] between them."""
        sigma, length = self.sensors.compass_bend_sigma, self.sensors.compass_bend_length
        here = self.filter.x[:2]
        nodes = np.array(self.state.memory.nodes).reshape(-1, 2)
        spread = float(self.filter.P[0, 0] + self.filter.P[1, 1])
        if len(nodes):
            squared = np.sum((nodes - here) ** 2, axis=1)
            nearest = int(np.argmin(squared))
            if squared[nearest] + spread < (0.2 * length) ** 2:
                # how far the bend differs over that distance
                return nearest, 2 * sigma**2 * (1 - float(np.exp(-(squared[nearest] + spread) / (2 * length**2))))
        weights, variance = conditional(nodes, here, sigma, length)
        columns = np.array(self.state.node_rows, dtype=np.intp)
        mean = float(weights @ self.filter.x[columns]) if len(nodes) else 0.0
        row = self.filter.augment(np.array([mean]), weights[None], columns, np.array([[variance]]))
        self.state.node_rows.append(row)
        self.state.memory.nodes.append((float(here[0]), float(here[1])))
        return len(self.state.node_rows) - 1, 0.0

    # Detections

    def _detection(self, event: Detection) -> tuple[Change, ...]:
        number = self.state.counters.detections
        self.state.counters.detections += 1
        if not (isfinite(event.range + event.bearing + event.t) and event.range >= 0):
            self.state.counters.broken += 1
            return ()
        if event == self.state.last_detection:
            self.state.counters.doubled += 1
            return ()
        if event.id in self.state.by_name and self._same_reading(self.state.landmarks[self.state.by_name[event.id]]):
            self.state.counters.repeated += 1
            return ()
        before = len(self.state.memory.keyframes)
        keyframe = self._keyframe()
        if (
            len(self.state.memory.keyframes) != before
            or self.state.last_detection is None
            or event.t != self.state.last_detection.t
        ):
            self.state.taken = []
        self.state.last_detection = event
        self._version += 1
        event = self._carried(event)
        z, R = self._point(event)
        landmark, change = self._associate(event, z, R)
        if landmark is None:
            if isinstance(change, LandmarkUpdated):
                self.state.counters.repeated += 1
            else:
                self.state.counters.unclear += 1
            return ()
        self.state.taken.append(landmark.key)
        self._remember(landmark, event, keyframe, z, R, number)
        changes: list[Change] = [change]
        loop = self._closed() if len(landmark.sightings) in _LOOP_TESTS else None
        if loop is not None:
            changes += self._close(loop)
        elif len(self.state.memory.keyframes) >= max(
            _FIRST_SMOOTHING, (1 + self.config.smooth_every) * self.state.smoothed_at
        ):
            changes.append(self._relinearise())
        return tuple(changes)

    def _same_reading(self, landmark: Known) -> bool:
        """Whether the robot has hardly moved since it saw this landmark last: the errors then are the same, too."""
        turned = abs(self.filter.x[2] + self.state.reckoning.theta - landmark.heading)
        return self.length - landmark.way < self.config.sighting_step and turned < self.config.sighting_turn

    def _carried(self, event: Detection) -> Detection:
        """A detection that came late, as seen from the present pose."""
        last = self.state.reckoning.last
        if last is None or event.t >= last.t or not self.state.recent:
            return event
        self.state.counters.late += 1
        then = min(self.state.recent, key=lambda o: abs(o.t - event.t))
        u, v, turn = seen_now(then, last, event.range * cos(event.bearing), event.range * sin(event.bearing))
        arms = tuple(msgspec.structs.replace(arm, bearing=arm.bearing + turn) for arm in event.arms)
        return msgspec.structs.replace(event, range=hypot(u, v), bearing=float(np.arctan2(v, u)), arms=arms)

    def _point(self, event: Detection) -> tuple[Array, Array]:
        """What was seen, ahead and left of the robot (2,) [m], and its covariance (2, 2)."""
        c, s = cos(event.bearing), sin(event.bearing)
        along = self.sensors.detection_sigma(event.range) ** 2
        # right before the robot, the bearing says nothing of where a thing is: the robot's own extent does
        across = (max(event.range, 0.1) * self.sensors.bearing_sigma) ** 2 + 1e-8
        R = np.array(
            [[along * c * c + across * s * s, (along - across) * c * s], [0.0, along * s * s + across * c * c]]
        )
        R[1, 0] = R[0, 1]
        return np.array([event.range * c, event.range * s]), R

    def _associate(self, event: Detection, z: Array, R: Array) -> tuple[Known | None, Change]:
        """The landmark of a detection, the filter corrected by it or a new one in it; None where that is unclear."""
        if event.id is not None and event.id in self.state.by_name:
            landmark = self.state.landmarks[self.state.by_name[event.id]]
            self._correct_named(landmark, event, z, R)
            return landmark, LandmarkUpdated(self._id(landmark))
        if event.id is None:
            nameless = {key: l for key, l in self.state.landmarks.items() if l.name is None}
            found = candidates(
                self.filter,
                nameless,
                event.type,
                z,
                R,
                event.arms,
                self.sensors.arm_sigma,
                self.config,
                self.state.taken,
            )
            verdict = judge(found, R, self.config)
            if verdict.candidate is not None:
                landmark = self.state.landmarks[verdict.candidate.key]
                if self._same_reading(landmark):
                    return None, LandmarkUpdated(self._id(landmark))
                self._correct(landmark, verdict.candidate, event, R)
                return landmark, LandmarkUpdated(self._id(landmark))
            if not verdict.new:
                return None, LandmarkAdded("")
        landmark = self._begin(event, z, R)
        return landmark, LandmarkAdded(self._id(landmark))

    def _id(self, landmark: Known) -> str:
        return joining.landmark_id(landmark)

    def _begin(self, event: Detection, z: Array, R: Array) -> Known:
        """A new landmark."""
        x = self.filter.x
        c, s = np.cos(x[2]), np.sin(x[2])
        turn = np.array([[c, -s], [s, c]])
        offset = turn @ z
        F = np.array([[1.0, 0.0, -offset[1]], [0.0, 1.0, offset[0]]])
        at = self.filter.augment(x[:2] + offset, F, POSE, turn @ R @ turn.T)
        landmark = Known(self.state.next_key, event.type, at, None, self.length, self.length, event.id)
        self.state.next_key += 1
        self.state.landmarks[landmark.key] = landmark
        if event.id is not None:
            self.state.by_name[event.id] = landmark.key
        self._begin_arms(landmark, event)
        return landmark

    def _begin_arms(self, landmark: Known, event: Detection) -> None:
        """The direction of a landmark whose arms were never sensed: that of the first one, with all their errors."""
        if landmark.turn is not None or not event.arms:
            return
        x, sigma = self.filter.x, self.sensors.arm_sigma
        first = event.arms[0].bearing
        variance = np.array([[sigma**2 / len(event.arms)]])
        landmark.turn = self.filter.augment(np.array([x[2] + first]), np.ones((1, 1)), np.array([2]), variance)
        landmark.arms = [Arm(arm.bearing - first, 0, {}) for arm in event.arms]

    def _correct_named(self, landmark: Known, event: Detection, z: Array, R: Array) -> None:
        """A named landmark is what its name says; one that is far off is an outlier and has little weight."""
        found = expected(self.filter, landmark, z, R, event.arms, self.sensors.arm_sigma, self.config)
        if found.squared < chi2_beyond(self.config.gate, 2):
            landmark.rejected = 0
            self._correct(landmark, found, event, R)
            return
        landmark.rejected += 1
        self.state.counters.outlying += 1
        if landmark.rejected >= _REJECTIONS:
            # so often isn't by chance: the robot itself is elsewhere, and less sure of it than it thought
            landmark.rejected = 0
            self.filter.P[np.ix_(POSE, POSE)] += np.diag([0.25, 0.25, 0.04])

    def _correct(self, landmark: Known, candidate: Candidate, event: Detection, R: Array) -> None:
        """The filter's update by a sighting of a known landmark."""
        x, at = self.filter.x, landmark.at
        c, s = np.cos(x[2]), np.sin(x[2])
        gx, gy = x[at] - x[0], x[at + 1] - x[1]
        u, v = c * gx + s * gy, c * gy - s * gx
        H = np.array([[-c, -s, v, c, s], [s, -c, -u, -s, c]])
        columns = [0, 1, 2, at, at + 1]
        residual, noise = candidate.residual, R
        if candidate.overlaid.pairs and landmark.turn is not None:
            H = np.vstack([np.column_stack([H, np.zeros(2)]), [0.0, 0.0, -1.0, 0.0, 0.0, 1.0]])
            columns.append(landmark.turn)
            residual = np.append(residual, candidate.overlaid.residual)
            noise = np.zeros((3, 3))
            noise[:2, :2] = R
            noise[2, 2] = heading_variance(landmark.arms, candidate.overlaid, self.sensors.arm_sigma)
        self.filter.update_rows(np.array(columns), H, residual, noise)
        self._begin_arms(landmark, event)

    def _remember(self, landmark: Known, event: Detection, keyframe: int, z: Array, R: Array, number: int) -> None:
        """The sighting, and what its arms add to the landmark's."""
        landmark.last = landmark.way = self.length
        landmark.heading = float(self.filter.x[2])
        arms: list[tuple[int, float]] = []
        if landmark.turn is not None:
            direction = float(self.filter.x[landmark.turn] - self.filter.x[2])
            arms = joining.add_arms(landmark, event.arms, direction, self.config)
        landmark.sightings.append(len(self.state.memory.sightings))
        self.state.memory.sightings.append(
            Sighting(
                keyframe,
                landmark.key,
                float(z[0]),
                float(z[1]),
                float(R[0, 0]),
                float(R[0, 1]),
                float(R[1, 1]),
                arms,
                number,
            )
        )

    # Loops and smoothing

    def _closed(self) -> Loop | None:
        nameless = {key: l for key, l in self.state.landmarks.items() if l.name is None}
        loop = find_loop(self.filter.x, self.filter.P, nameless, self.length, self.sensors, self.config)
        return None if loop is None or list(loop.pairs) in self.state.refused else loop

    def _close(self, loop: Loop) -> list[Change]:
        """Join the landmarks of a loop, if the smoothed map bears it."""
        before = self.smoothed(self.state.landmarks, self.state.memory)
        x = self.filter.x
        directions = {key: float(x[l.turn]) for key, l in self.state.landmarks.items() if l.turn is not None}
        landmarks, memory = joining.joined(self.state.landmarks, self.state.memory, loop.pairs, self.config, directions)
        after = self.smoothed(landmarks, memory)
        dof = 3 * len(loop.pairs)
        if not after.converged or 2 * (after.error - before.error) > chi2_beyond(_LOOP_TAIL, dof) + 2 * dof:
            self.state.refused.append(list(loop.pairs))
            return [Corrected(self._adopt(before))]
        ids = {key: joining.landmark_id(l) for key, l in self.state.landmarks.items()}
        pairs = tuple((ids[a], ids[b]) for a, b in loop.pairs)
        self.state.landmarks, self.state.memory = landmarks, memory
        shift = self._adopt(after)
        gone = [LandmarkRemoved(a, b) for a, b in pairs]
        return [LoopClosed(pairs, loop.nats), *gone, Corrected(shift)]

    def _relinearise(self) -> Change:
        return Corrected(self._adopt(self.smoothed(self.state.landmarks, self.state.memory)))

    def start_estimate(self, landmarks: Mapping[int, Known], memory: Memory) -> Estimate:
        """What the filter and the last smoothing say, to begin the next one with."""
        x = self.filter.x
        known = list(landmarks.values())
        return Estimate(
            np.array(memory.poses, dtype=float),
            x[3:7].copy(),
            float(x[NORTH]),
            x[np.array(self.state.node_rows, dtype=np.intp)],
            np.array([x[[l.at, l.at + 1]] for l in known]).reshape(-1, 2),
            np.array([x[l.turn] + arm.off for l in known if l.turn is not None for arm in l.arms], dtype=float),
        )

    def smoothed(self, landmarks: Mapping[int, Known], memory: Memory, walls: Walls | None = None) -> Smoothed:
        """All that is remembered, solved at once, with ``walls`` if they are given."""
        s = self.sensors
        bend = (max(s.compass_bend_sigma, 1e-6), s.compass_bend_length)
        drive = drive_of(memory, list(landmarks.values()), self._systematic_sigma(), s.arm_sigma, bend)
        start = self.start_estimate(landmarks, memory)
        if walls is not None:
            drive = replace(drive, walls=walls.points)
            start = replace(start, poses=walls.poses, lines=walls.lines)
        return smooth(drive, start, self.config.robust_gate)

    def _adopt(self, smoothed: Smoothed) -> float:
        """The filter goes on from a smoothed estimate; how far the robot moved by that [m]."""
        memory = self.state.memory
        memory.poses = [(x, y, theta) for x, y, theta in smoothed.estimate.poses.tolist()]
        memory.nodes = [memory.poses[k][:2] for k in self._first_stations()]
        state = joint_state(smoothed, list(self.state.landmarks.values()))
        before = self.filter.x[:2]
        self.filter = JointFilter(state.x, state.P)
        self.state.landmarks, self.state.node_rows = state.landmarks, state.node_rows
        self.state.smoothed_at = len(memory.keyframes)
        return float(np.hypot(*(self.filter.x[:2] - before)))

    def _first_stations(self) -> list[int]:
        """The keyframe of each node's first station."""
        first: dict[int, int] = {}
        for station in self.state.memory.stations:
            first.setdefault(station.node, station.keyframe)
        return [first[k] for k in range(len(self.state.memory.nodes))]

    # Scans

    def _scan(self, event: Scan) -> None:
        r = self.state.reckoning
        if self.length - self.state.way_of_scan < _SCAN_STEP and abs(r.theta - self.state.turn_of_scan) < _SCAN_TURN:
            return
        dense = abs(event.step) <= BEAMS
        often = dense and self.config.scan_stretch < self.config.stretch
        if abs(r.theta) > self.config.scan_turn or (often and r.length >= self.config.scan_stretch):
            self._keyframe()
            r = self.state.reckoning
        self.state.way_of_scan, self.state.turn_of_scan = self.length, r.theta
        keyframe = len(self.state.memory.keyframes) - 1
        memory, here = self.state.memory, (r.x, r.y, r.theta)
        memory.scans += 1
        self._version += 1
        if dense:
            at_it = here == (0.0, 0.0, 0.0)
            found = wall_pieces(event, here, self.sensors, self.config)
            memory.pieces += [Piece(keyframe, *piece, at_it) for piece in found]
        else:
            memory.hits += [Hit(keyframe, memory.scans, *hit) for hit in scan_hits(event, here)]

    # Files

    def save(self, path: str | Path) -> None:
        """The mapper's whole state as one JSON file; `load` goes on from there to the same bits."""
        saved.write(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Mapper:
        """A mapper as it was saved. Raises `FileFormatError` for a file that holds none, `InputError` for none."""
        return cls._of(*saved.read(path))

    def to_json(self) -> bytes:
        """As `save`, as a JSON document."""
        return saved.encode(self)

    @classmethod
    def from_json(cls, data: bytes | msgspec.Raw, path: str | Path, place: str = "") -> Mapper:
        """A mapper out of the document of `to_json` that stands in the file ``path`` at ``place``. Raises as `load`."""
        return cls._of(*saved.decode(data, path, place))

    @classmethod
    def _of(cls, header: LogHeader, config: MapperConfig, state: State, kalman: JointFilter) -> Mapper:
        mapper = cls(header, config)
        mapper.state, mapper.filter = state, kalman
        return mapper


def map_log(log: Log, config: MapperConfig | None = None, *, joint: bool = False) -> LandmarkMap:
    """The map of a whole log.

    >>> map_log(Log(LogHeader("D7"), [Detection(0.0, "tree", 2.0, 0.0)])).ids
    ('tree-1',)
    """
    mapper = Mapper(log.header, config)
    update = mapper.update
    for event in log.events:
        update(event)
    return mapper.map(joint=joint)
