"""Other matchers, to measure beside ours on the same pairs: paper mode, Open3D's RANSAC on features, KISS-Matcher.

The latter two are optional (``pip install open3d kiss-matcher``) and skipped with a reason where they can't be
imported. Give them an environment of their own: they bring along a pytest plugin that our tests refuse. Neither knows
landmarks: both get each landmark's place, lifted to 3-D, and a descriptor of ours (`mapfuse.fusion.compare.clouds`).
The descriptor is worked out once per map and not timed, as our own matcher's arrays aren't. `run_within` runs one in a
process of its own, which ends when it has used its time.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TypeVar
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.fusion.compare.clouds import descriptors, ransac
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively

Array = NDArray[np.float64]

#: How many rival partners a landmark may have.
_PARTNERS = 3
_PAPER_TRIALS = 30_000_000
#: Calls of which the best one counts, unless the first takes longer than this [s, wall].
CALLS, LONG_CALL_S = 10, 5.0
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a matcher says: the T12 (3,), or None; how long it took [s]; why there is none."""

    T12: Array | None
    seconds: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Baseline:
    """A matcher by name. ``missing``: why it can't run here, or an empty string; ``run`` matches two maps."""

    name: str
    missing: str
    run: Callable[[LandmarkMap, LandmarkMap, float], Answer]


def baselines() -> Sequence[Baseline]:
    """All of them; those that aren't installed say so."""
    return (
        Baseline("paper mode", "", _paper),
        Baseline("Open3D RANSAC", _missing("open3d"), _open3d),
        Baseline("KISS-Matcher", _missing("kiss_matcher"), _kiss),
    )


def _missing(module: str) -> str:
    try:
        __import__(module)
    except ImportError as error:
        return f"not importable: {error}"
    return ""


def _lifted(recorded: LandmarkMap) -> Array:
    return np.column_stack([recorded.positions, np.zeros(len(recorded))])


def _flat(rotation: Array, translation: Array, seconds: float) -> Answer:
    """A motion in 3-D as T12; none where it turns the plane over."""
    if rotation[2, 2] < 0 or not np.isfinite(rotation).all():
        return Answer(None, seconds, "turned the map over")
    theta = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    return Answer(np.array([translation[0], translation[1], float(se2.wrap(theta))]), seconds)


def _paper(map1: LandmarkMap, map2: LandmarkMap, tolerance_m: float) -> Answer:
    if len(map1) * len(map2) ** 2 > _PAPER_TRIALS:
        return Answer(None, 0.0, "would not finish")
    begin = time.perf_counter()
    try:
        found = match_exhaustively(map1, map2, MatchingConfig(mode="paper", tolerance_m=tolerance_m)).hypotheses
    except TooLargeError:
        return Answer(None, 0.0, "would not finish")
    seconds = time.perf_counter() - begin
    return Answer(found[0].T12.array, seconds) if len(found) else Answer(None, seconds, "no proposals")


def _open3d(map1: LandmarkMap, map2: LandmarkMap, tolerance_m: float) -> Answer:
    described = descriptors(map1, map2)
    begin = time.perf_counter()
    T12 = ransac(map1, map2, tolerance_m, described)
    seconds = time.perf_counter() - begin
    return Answer(T12, seconds, "" if T12 is not None else "turned the map over")


def _kiss(map1: LandmarkMap, map2: LandmarkMap, tolerance_m: float) -> Answer:
    import kiss_matcher

    described1, described2 = descriptors(map1, map2)
    begin = time.perf_counter()
    place1 = _mutual(described1, described2)
    if len(place1[0]) < 3:
        return Answer(None, time.perf_counter() - begin, "too few partners")
    settings = kiss_matcher.KISSMatcherConfig(voxel_size=tolerance_m, use_quatro=True)
    matcher = kiss_matcher.KISSMatcher(settings)
    source = np.asfortranarray(_lifted(map2)[place1[1]].T)
    target = np.asfortranarray(_lifted(map1)[place1[0]].T)
    found = matcher.prune_and_solve(list(source.T.astype(np.float32)), list(target.T.astype(np.float32)))
    seconds = time.perf_counter() - begin
    if not found.valid:
        return Answer(None, seconds, "says that it is not valid")
    return _flat(np.asarray(found.rotation, dtype=float), np.asarray(found.translation, dtype=float), seconds)


def _mutual(described1: Array, described2: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Landmarks that are among each other's most alike ones: places in map 1 and in map 2, by these.

    With hundreds of columns trees are slower than the product of both maps' rows, some at a time; columns that say
    nothing are left out.
    """
    k = min(_PARTNERS, len(described1), len(described2))
    used = described1.any(axis=0) | described2.any(axis=0)
    those, all2 = (described[:, used].astype(np.float32) for described in (described1, described2))
    squared = np.sum(those**2, axis=1)
    of2, of1, apart1 = [], [], []
    for begin in range(0, len(all2), 500):
        rows = all2[begin : begin + 500]
        apart = squared + np.sum(rows**2, axis=1)[:, None] - 2 * rows @ those.T
        of2.append(np.argpartition(apart, k - 1, axis=1)[:, :k])
        few = min(k, len(rows))
        nearest = np.argpartition(apart, few - 1, axis=0)[:few]
        of1.append(nearest + begin)
        apart1.append(np.take_along_axis(apart, nearest, axis=0))
    nearest = np.argpartition(np.concatenate(apart1), k - 1, axis=0)[:k]
    backward = np.take_along_axis(np.concatenate(of1), nearest, axis=0)
    n2 = len(described2)
    pairs = np.intersect1d(
        np.concatenate(of2) * n2 + np.arange(n2)[:, None], np.arange(len(described1)) * n2 + backward
    )
    return pairs // n2, pairs % n2


def run_within(
    baseline: Baseline,
    map1: LandmarkMap,
    map2: LandmarkMap,
    tolerance_m: float,
    described: tuple[Array, Array],
    limit_s: int,
) -> tuple[Answer, float] | None:
    """Its answer and processor time [s], in a process of its own; None if that had more than ``limit_s`` of it."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    job = (sender, baseline.name, map1, map2, tolerance_m, described, limit_s)
    process = context.Process(target=_run_limited, args=job)
    process.start()
    sender.close()
    try:
        found: tuple[Answer, float] = receiver.recv()
    except EOFError:
        return None
    finally:
        process.join()
    return found


def best_of_calls(run: Callable[[], Found], wall_s: Callable[[Found], float]) -> tuple[Found, float]:
    """Of `CALLS` calls' answers the one that took the least processor time, and that time [s]; one call if it is long.

    Short calls are disturbed by whatever else the machine does; ours and the others' alike.
    """
    answers: list[tuple[Found, float]] = []
    while not answers or (len(answers) < CALLS and wall_s(answers[0][0]) < LONG_CALL_S):
        begin = _processor_s()
        answer = run()
        answers.append((answer, _processor_s() - begin))
    return min(answers, key=lambda found: found[1])


def _processor_s() -> float:
    """Of this process, all threads; `time.process_time` counts the scheduler's ticks only where its time is limited."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _run_limited(
    sender: Connection,
    name: str,
    map1: LandmarkMap,
    map2: LandmarkMap,
    tolerance_m: float,
    described: tuple[Array, Array],
    limit_s: int,
) -> None:
    chosen = next(baseline for baseline in baselines() if baseline.name == name)
    # what is loaded at a first call is nobody's time
    few = [m.replace(landmarks=m.landmarks[:40], joint_covariance=None, same_as={}) for m in (map1, map2)]
    with patch(f"{__name__}.descriptors", lambda *_: tuple(d[:40] for d in described)):
        chosen.run(few[0], few[1], tolerance_m)
    started = time.process_time()
    # the system ends a process that has used that much, whatever it is busy with
    resource.setrlimit(resource.RLIMIT_CPU, (int(started) + limit_s + 1, int(started) + limit_s + 2))
    with patch(f"{__name__}.descriptors", lambda *_: described):
        sender.send(best_of_calls(lambda: chosen.run(map1, map2, tolerance_m), lambda answer: answer.seconds))
