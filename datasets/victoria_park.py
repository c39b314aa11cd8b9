"""Victoria Park: two maps of trees, cut from one recorded drive.

A truck drove four kilometres through Victoria Park, Sydney, and saw trees with a laser scanner (J. Guivant and
E. Nebot, *Optimization of the simultaneous localization and map-building algorithm for real-time implementation*,
IEEE Transactions on Robotics and Automation 17, 2001). The gtsam package ships the drive as ``victoria_park.txt``:
6,969 poses, 151 trees, 3,640 sightings, with the trees' numbers. It is read from there; nothing is copied.

There was one truck. `victoria_park_halves` cuts its drive into two and takes each as if it were a robot of its own
with an unknown start: each half is solved alone (`landmark_slam`), in the frame of its own first pose, and its trees
lose their numbers. What the numbers said is the truth for evaluation; the frames and places in it are those of the
solution of the whole drive, which is an estimate, not a survey.

What the maps state, and why:

- ``joint_covariance``: of all trees of a half at its optimum, times `COVARIANCE_SCALE`. The file gives 0.01 m and
  0.002 rad per step, independently, and 0.63 m for a sighting. The sightings are five times better than that (mean
  square 0.2 of the stated), but the heading errors of the odometry last for many steps. So bends of whole wings are
  larger than stated: with a scale of 1 the trees that both halves have differ by chi2 per degree of freedom 1.2, 1.4
  and 1.8 for cuts at 0.4, 0.5 and 0.6; with 2 it is 0.6, 0.7 and 0.9.
- Trees seen less than `MINIMUM_SIGHTINGS` times are left out: of the differences at a cut of 0.5 the largest
  is 5.2 m with them and 2.4 m without.
- A few trees carry two numbers 0.1 to 0.5 m apart. Which of such twins is which is beyond the maps, so that a count of
  right matches should let a match to the twin pass.
- ``detection_rate`` 0.94: of the trees of one half that the other one passed within 12 m, it has 92 % and 97 %.

Scale, least sightings and detection rate were chosen with the trees' numbers in view.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import se2
from .errors import ConfigError, FileFormatError, MapfuseError, Problem
from .files import read_whole
from .landmark_slam import Drive, SlamSolution, solve_drive
from .maps import JointCovariance, Landmark, LandmarkMap, Noise
from .truth import Truth

Array = NDArray[np.float64]

FILE_NAME = "victoria_park.txt"
COVARIANCE_SCALE = 2.0
MINIMUM_SIGHTINGS = 2
MAXIMUM_PATH = 1000
NOISE = Noise(position_sigma=0.5, detection_rate=0.94, false_alarm_rate=0.1)
SOURCE = "Victoria Park, Sydney (Guivant and Nebot), cut from one recorded drive"

_FIELDS = {"ODOMETRY": 11, "LANDMARK": 7}


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """The whole drive as recorded; ``trees[k]`` is the file's number of landmark k of ``drive``."""

    drive: Drive
    trees: tuple[int, ...]


def victoria_park_path() -> Path:
    """The recording in the installed gtsam package, found without importing it; `MapfuseError` where it isn't."""
    spec = find_spec("gtsam")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    for folder in folders:
        path = Path(folder) / "Data" / FILE_NAME
        if path.is_file():
            return path
    where = f"the installed one in {folders[0]} has no Data/{FILE_NAME}" if folders else "gtsam isn't installed"
    raise MapfuseError(f"Victoria Park is read from the gtsam package's own data, and {where}")


def read_recording(path: str | Path) -> Recording:
    """A drive in the text format of gtsam's ``victoria_park.txt``.

    ``ODOMETRY i j x y theta`` and ``LANDMARK i j x y``, each followed by the upper triangle of its covariance; poses
    and landmarks share one numbering. Raises `FileFormatError`, which lists all lines that break the format, and
    `InputError` where the file can't be read.
    """
    path = Path(path)
    rows: dict[str, list[list[float]]] = {kind: [] for kind in _FIELDS}
    problems: list[Problem] = []
    text = read_whole(path).decode("ascii", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        kind, *words = line.split() or [""]
        if not kind:
            continue
        try:
            rows[kind].append(_numbers(kind, words))
        except KeyError:
            problems.append(Problem(f"line {number}", f"{kind!r} is neither ODOMETRY nor LANDMARK"))
        except ValueError as error:
            problems.append(Problem(f"line {number}", str(error)))
    if problems:
        raise FileFormatError(path, tuple(problems))
    motions, sightings = (np.array(rows[kind]).reshape(-1, width) for kind, width in _FIELDS.items())
    if not len(motions) or np.any(motions[1:, 0] != motions[:-1, 1]):
        raise FileFormatError(path, (Problem("", "the ODOMETRY lines don't make one chain of poses"),))
    index_from_node = {node: k for k, node in enumerate([motions[0, 0], *motions[:, 1]])}
    if unknown := set(sightings[:, 0]) - index_from_node.keys():
        raise FileFormatError(path, (Problem("", f"sightings from unknown poses {sorted(unknown)[:5]}"),))
    trees, seen = np.unique(sightings[:, 1].astype(int), return_inverse=True)
    drive = Drive(
        motions=motions[:, 2:5],
        motion_sigmas=np.sqrt(motions[:, [5, 8, 10]]),
        seen_from=np.array([index_from_node[node] for node in sightings[:, 0]], dtype=np.intp),
        seen=seen,
        sightings=sightings[:, 2:4],
        sighting_sigmas=np.sqrt(sightings[:, [4, 6]]),
    )
    return Recording(drive, tuple(trees.tolist()))


def _numbers(kind: str, words: list[str]) -> list[float]:
    """The numbers of a line; ValueError says what is wrong with them, KeyError that the kind is unknown."""
    if len(words) != _FIELDS[kind]:
        raise ValueError(f"{kind} needs {_FIELDS[kind]} numbers, not {len(words)}")
    numbers = [float(word) for word in words]
    if not np.all(np.isfinite(numbers)):
        raise ValueError("not all numbers are finite")
    variances, covariances = ((5, 8, 10), (6, 7, 9)) if kind == "ODOMETRY" else ((4, 6), (5,))
    if min(numbers[k] for k in variances) <= 0 or any(numbers[k] for k in covariances):
        raise ValueError("the covariance must be diagonal and positive")
    return numbers


def victoria_park_halves(
    rng: np.random.Generator | None = None, cut: float = 0.5, path: str | Path | None = None
) -> tuple[LandmarkMap, LandmarkMap, Truth]:
    """Two maps of trees, cut from the one recorded drive at the share ``cut`` of its poses, and what is known of them.

    The truth's ``true_pairs`` are the trees that both maps have; its frames and places are the solution of the whole
    drive, in the frame of the drive's first pose. It is for evaluation only.

    ``rng`` names and orders the trees anew and bends the starts that check each solution (default: seed 0); ``path``
    is the recording (default: that of the gtsam package). Takes some seconds. Raises `MapfuseError` where the recording
    is absent, `FileFormatError` where it is broken, `ConfigError` for a cut that leaves a half without trees.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    recording = read_recording(victoria_park_path() if path is None else path)
    at = round(cut * recording.drive.pose_count) if np.isfinite(cut) else 0
    if not 2 <= at <= recording.drive.pose_count - 2:
        raise ConfigError(f"cut is {cut!r}; it must leave poses on both sides")
    first, second = _part(recording, 0, at), _part(recording, at, recording.drive.pose_count)
    if not (first.trees and second.trees):
        raise ConfigError(f"cut is {cut!r}; it leaves a half without trees")
    solved = [solve_drive(part.drive, rng) for part in (first, second)]
    halves = [
        _half_map(f"victoria-park-{k}", part, solution, rng)
        for k, (part, solution) in enumerate(zip((first, second), solved, strict=True), start=1)
    ]
    whole = _whole_solution(recording, (first, second), solved, rng)
    (map1, place_from_id1), (map2, place_from_id2) = halves
    truth = Truth(
        frames={map1.name: se2.IDENTITY, map2.name: whole.poses[at]},
        landmarks={map1.name: place_from_id1, map2.name: place_from_id2},
        places={_place(tree): xy for tree, xy in zip(recording.trees, whole.landmarks, strict=True)},
        extra={"source": f"{SOURCE}; frames and places by the solution of the whole drive"},
    )
    return map1, map2, truth


def _place(tree: int) -> str:
    return f"tree-{tree}"


def _part(recording: Recording, first: int, last: int) -> Recording:
    """The poses ``first`` to ``last - 1`` as a recording of its own, with the trees seen from them."""
    drive = recording.drive
    kept = (drive.seen_from >= first) & (drive.seen_from < last)
    known, seen = np.unique(drive.seen[kept], return_inverse=True)
    part = Drive(
        drive.motions[first : last - 1],
        drive.motion_sigmas[first : last - 1],
        drive.seen_from[kept] - first,
        seen,
        drive.sightings[kept],
        drive.sighting_sigmas[kept],
    )
    return Recording(part, tuple(recording.trees[k] for k in known))


def _half_map(
    name: str, part: Recording, solution: SlamSolution, rng: np.random.Generator
) -> tuple[LandmarkMap, dict[str, str]]:
    """The map of one half, trees renamed in random order, and which place each id is."""
    sightings = np.bincount(part.drive.seen, minlength=len(part.trees))
    kept = rng.permutation(np.flatnonzero(sightings >= MINIMUM_SIGHTINGS))
    ids = tuple(f"t{k}" for k in range(1, len(kept) + 1))
    rows = (2 * kept[:, None] + np.arange(2)).ravel()
    covariance = COVARIANCE_SCALE * solution.covariance[np.ix_(rows, rows)]
    landmarks = tuple(
        Landmark(i, "tree", x, y, visit_counter=n, detection_counter=n)
        for i, (x, y), n in zip(ids, solution.landmarks[kept].tolist(), sightings[kept].tolist(), strict=True)
    )
    map_ = LandmarkMap(
        name,
        landmarks,
        noise=NOISE,
        joint_covariance=JointCovariance(ids, 2, covariance),
        path=_thinned_path(solution.poses),
        extra={"source": SOURCE},
    )
    return map_, {i: _place(part.trees[k]) for i, k in zip(ids, kept, strict=True)}


def _thinned_path(poses: Array) -> Array:
    """At most `MAXIMUM_PATH` poses, first and last among them, as (step, x, y, theta)."""
    steps = np.unique(np.linspace(0, len(poses) - 1, MAXIMUM_PATH).round().astype(int))
    return np.column_stack([steps, poses[steps]])


def _whole_solution(
    recording: Recording, parts: tuple[Recording, Recording], solved: list[SlamSolution], rng: np.random.Generator
) -> SlamSolution:
    """The whole drive, started from its two halves laid onto each other by their common trees."""
    first, second = (dict(zip(r.trees, s.landmarks, strict=True)) for r, s in zip(parts, solved, strict=True))
    both = sorted(first.keys() & second.keys())
    if len(both) < 2:
        return solve_drive(recording.drive, rng)
    T12 = se2.align([first[t] for t in both], [second[t] for t in both]).T12
    poses = np.concatenate([solved[0].poses, se2.compose(T12, solved[1].poses)])
    places = {t: se2.transform(T12, p) for t, p in second.items()} | first
    return solve_drive(recording.drive, rng, start=(poses, np.array([places[t] for t in recording.trees])))
