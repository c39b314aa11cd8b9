"""`OnlineFuser`: robots merge their maps while they map (section 4.2 of the paper)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapfuse.datasets.errors import MapError, MapfuseError, Problem, TooLargeError
from mapfuse.datasets.maps import LandmarkMap, Noise

from ..groups import LARGEST_MAP_M, provenance_of
from ..prepared import MAX_LANDMARKS
from ..result import FusedMap
from .config import OnlineConfig
from .due import Due
from .events import Event, happened
from .judge import Judge
from .messages import Correction, LandmarkSeen, Message, check_message
from .place import Place, placed_in
from .rivals import Rival, Rivals
from .segment import Counters, Segment
from .smoother import Smoother

if TYPE_CHECKING:
    from .worker import Worker

#: Events that wait to be read; the oldest are dropped where nobody reads them.
MAX_WAITING = 10_000
#: After so many messages an answer of the worker is taken up whatever the clock says.
MOST_UNANSWERED = 500


class OnlineFuser:
    """Maps of robots that are merged while they grow.

    Robots come at any time (`add_robot`), and say what they know by `Message`, in any order and as often as they
    like (`take`). Of each two maps the rival placements are kept up as landmarks come; once enough is new, `advance`
    weighs as `mapfuse.fusion.fuse` does, merges what it finds merged, and parts what it finds so no longer. The maps
    themselves are never changed by a merge. `events` tells what happened.

    `fused` is the answer as of the last weighing, `fused_at` says of which time; `current` is where the smoother has
    every landmark by now. A robot that begins anew in another frame sends messages with a higher ``frame``: its map
    there is another one (``NAME~2``), which is compared with all others, its own former one included.

    >>> from mapfuse.datasets import read_map, recordings
    >>> from mapfuse.fusion.online import Correction
    >>> fuser = OnlineFuser()
    >>> for k, name in enumerate(recordings.SCENES["ground-floor"]):
    ...     recorded = read_map(recordings.path(name))
    ...     fuser.take(Correction(robot=name, sequence=0, t=float(k), map=recorded))
    >>> fuser.advance()
    True
    >>> [event.kind for event in fuser.events()][-1], fuser.fused().decision
    ('refuted', 'merged')
    """

    def __init__(self, config: OnlineConfig | None = None, *, worker: bool = False) -> None:
        """``worker``: weigh in another process, so that no message waits for it; `close` ends that one."""
        self.config = config or OnlineConfig()
        self.time = float("-inf")
        self.segments: dict[str, Segment] = {}
        self.noise: dict[str, Noise] = {}
        self.due_state = Due(self.config)
        self._judge = Judge(self.config.fuse)
        self._rivals = Rivals(self.config)
        self._smoother = Smoother()
        self._fused: FusedMap | None = None
        self._fused_at = float("-inf")
        self._events: deque[Event] = deque(maxlen=MAX_WAITING)
        self._worker: Worker | None = None
        self._asked: dict[str, LandmarkMap | None] = {}
        self._since_asked = 0
        if worker:
            from .worker import Worker

            self._worker = Worker(self.config.fuse)

    # What comes in

    def add_robot(self, name: str, noise: Noise | None = None) -> None:
        """A robot that will send messages, and what it is known to be; one that sends a `Correction` needs no adding.

        Raises `MapfuseError` for an empty name, and for one that another robot's later frame has.
        """
        if not name:
            raise MapfuseError("a robot needs a name")
        self._segment(name, 0)
        if noise is not None:
            self.noise[name] = noise
            for segment in self.segments.values():
                if segment.robot == name:
                    segment.known_as(noise)
        self.noise.setdefault(name, Noise())

    def take(self, message: Message) -> None:
        """Take a message in: the map it is of, its rivals' votes, and the smoother follow; nothing is weighed.

        Raises `MapError` for a landmark, link or map that breaks a rule of ``mapfuse.map/1``, and `TooLargeError` for a
        map of more landmarks than can be weighed; nothing of that message is then taken in. `MapfuseError` for a robot
        that is named as another one's later frame is.
        """
        check_message(message)
        segment = self._segment(message.robot, message.frame)
        _check_weighable(message, segment)
        touched = segment.take(message)
        self.time = max(self.time, message.t)
        self._since_asked += 1
        if touched or isinstance(message, Correction):  # which may change no landmark, but how well they are known
            self._rivals.changed(segment, touched)
            self._smoother.changed(segment, touched)
            self.due_state.changed(segment.name, len(segment.changed))

    def _segment(self, robot: str, frame: int) -> Segment:
        made = Segment(robot, frame, self.noise.get(robot, Noise()))
        segment = self.segments.setdefault(made.name, made)
        if (segment.robot, segment.frame) != (robot, frame):
            raise MapfuseError(
                f"robot {robot!r} in frame {frame} and {segment.robot!r} in frame {segment.frame} would both be named "
                f"{made.name!r}: later frames are named so, and robots must not be"
            )
        return segment

    # Weighing

    @property
    def due(self) -> bool:
        """Whether enough is new for `advance` to weigh: the moment to send corrections that are ready."""
        if len(self.segments) < 2 or (self._worker is not None and self._worker.busy):
            return False
        return self.due_state.now(self.segments, self._fused, self._rivals)

    @property
    def waiting(self) -> bool:
        """Whether an answer is under way in the worker."""
        return self._worker is not None and self._worker.busy

    def advance(self, *, force: bool = False) -> bool:
        """Weigh what is new, if enough is, or where ``force`` says so; whether there is a new answer.

        With a worker this only asks, and takes up what was asked `OnlineConfig.delay` before, waiting for it where it
        isn't done: with the same messages the same things happen at the same times. ``force`` waits for all of it.
        """
        if self._worker is None:
            if not (force or self.due):
                return False
            return self._weigh_here()
        answered = self._worker.busy and (force or self._is_time(self._worker))
        if answered:
            self._take_up(self._worker)
        if force and self._changed():
            self._ask(self._worker)
            self._take_up(self._worker)
            return True
        if self.due:
            self._ask(self._worker)
        return answered

    def _ask(self, worker: Worker) -> None:
        """Have what is new weighed."""
        changed = self._changed()
        worker.ask(changed, self.time)
        self._asked, self._since_asked = {name: self.due_state.weighed.get(name) for name in changed}, 0
        self._settle()

    def _take_up(self, worker: Worker) -> None:
        """Take up the answer. Where there is none, what was asked is as new as before."""
        try:
            asked_at, fused = worker.answer()
        except Exception:
            self.due_state.unsettle(self._asked, self.segments)
            raise
        self._adopt(fused, asked_at)

    def _is_time(self, worker: Worker) -> bool:
        """Whether to take up what the worker was asked; a clock that had jumped ahead mustn't keep it for ever."""
        if self.config.delay is None:
            return worker.ready
        return self.time >= worker.asked_at + self.config.delay or self._since_asked >= MOST_UNANSWERED

    def _changed(self) -> dict[str, LandmarkMap]:
        """Maps that are not what they were at the last weighing, by name."""
        return {name: m for name, s in self.segments.items() if (m := s.map()) is not self.due_state.weighed.get(name)}

    def _settle(self) -> None:
        self.due_state.settle(self.segments)

    def _weigh_here(self) -> bool:
        changed = self._changed()
        if not changed:
            return False
        fused = self._judge.weigh(changed)
        self._settle()
        self._adopt(fused, self.time)
        return True

    def _adopt(self, fused: FusedMap, at: float) -> None:
        before, self._fused, self._fused_at = self._fused, fused, at
        self._events.extend(happened(before, fused, at))
        self._smoother.merged(fused)

    # What comes out

    def events(self) -> Iterator[Event]:
        """What happened since it was asked last, oldest first; what is read is gone."""
        while self._events:
            yield self._events.popleft()

    def fused(self, *, fresh: bool = False) -> FusedMap:
        """The answer as of the last weighing (`fused_at`); ``fresh``: of all that is known, weighed now if need be.

        Raises `MapfuseError` where no map has come yet.
        """
        if (fresh or self._fused is None) and self._changed():
            self.advance(force=True)
        if self._fused is None:
            raise MapfuseError("there is no map yet: no robot has sent anything")
        if not self._fused.provenance:
            provenance = provenance_of(tuple(self._fused.sources.values()), self.config.fuse)
            self._fused = replace(self._fused, provenance=provenance)
        return self._fused

    @property
    def answer(self) -> FusedMap | None:
        """As `fused`, without provenance; None before the first weighing."""
        return self._fused

    @property
    def fused_at(self) -> float:
        """Time [s] of the newest message that `fused` rests on; minus infinity before the first."""
        return self._fused_at

    @property
    def current(self) -> Smoother:
        """Frames and landmarks as the smoother has them by now, with covariances on demand."""
        return self._smoother

    def rivals(self, map1: str, map2: str) -> tuple[Rival, ...]:
        """Placements of map 2 on map 1 that most landmarks vote for by now, best first."""
        return self._rivals.best(map1, map2)

    def places(self) -> dict[str, Place]:
        """Where each robot that said so is, in the frame of its group, with covariance; by map."""
        return {
            name: placed_in(segment, self._smoother)
            for name, segment in self.segments.items()
            if segment.placed is not None and self._smoother.knows(name)
        }

    @property
    def counters(self) -> dict[str, Counters]:
        """Of each map how many messages came, twice, or too late."""
        return {name: segment.counters for name, segment in self.segments.items()}

    # Files

    def save(self, path: str | Path) -> None:
        """All that is known as one file; `load` goes on from there to the same events.

        Events that wait to be read are not in it: read them (`events`) after saving, since what a worker was asked is
        answered first. Raises `OutputError` where it can't be written.
        """
        from .saved import write

        write(self, path)

    @classmethod
    def load(cls, path: str | Path, *, worker: bool = False) -> OnlineFuser:
        """A fuser as it was saved. Raises `FileFormatError` for a file that holds none, or one of another minor
        version, which it names; `InputError` where it can't be read."""
        from .saved import read

        fuser: OnlineFuser = read(cls, path, worker=worker)
        return fuser

    def restore(
        self,
        segments: Sequence[Segment],
        noise: Mapping[str, Noise],
        *,
        weighed: Mapping[str, LandmarkMap],
        new: Mapping[str, int],
        time: float,
        fused_at: float,
    ) -> None:
        """What a saved fuser knew, and what it had weighed: weighed again, which gives the same answer."""
        self.noise = dict(noise)
        self.segments = {segment.name: segment for segment in segments}
        for segment in segments:
            ids = tuple(l.id for l in segment.landmarks())
            if ids:
                self._rivals.changed(segment, ids)
                self._smoother.changed(segment, ids)
        self.due_state.weighed, self.due_state.new = dict(weighed), dict(new)
        self.time, self._fused_at = time, fused_at
        if weighed:
            if self._worker is None:
                self._fused = self._judge.weigh(weighed)
            else:
                self._worker.ask(weighed, fused_at)
                self._fused = self._worker.answer()[1]
            self._smoother.merged(self._fused)
        for name, segment in self.segments.items():
            if name in weighed and segment.map() == weighed[name]:
                self.due_state.weighed[name] = segment.map()  # the same map, which is looked at by identity

    def close(self) -> None:
        """End the worker, if there is one."""
        if self._worker is not None:
            self._worker.close()


def _check_weighable(message: Message, segment: Segment) -> None:
    """Raise `MapError`, `TooLargeError` where the map could not be weighed with what a message says."""
    if isinstance(message, Correction):
        count = len(message.map)
    elif isinstance(message, LandmarkSeen) and segment.landmark(message.landmark.id) is None:
        count = segment.size + 1
    else:
        count = 0
    if count > MAX_LANDMARKS:
        raise TooLargeError(
            f"message {message.sequence} of {message.robot!r}: its map would have {count} landmarks; maps of up to "
            f"{MAX_LANDMARKS} can be merged while they grow"
        )
    anywhere = segment.anywhere
    if isinstance(message, LandmarkSeen) and anywhere is not None:
        landmark = message.landmark
        if max(abs(landmark.x - anywhere[0]), abs(landmark.y - anywhere[1])) > LARGEST_MAP_M / 2:
            reason = f"lies more than {LARGEST_MAP_M / 2000:g} km from other landmarks of its map"
            raise MapError(message.robot, (Problem("landmarks[0]", f"{landmark.id!r} {reason}"),))
