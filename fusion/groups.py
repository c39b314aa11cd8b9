"""`fuse`: recorded maps to a `FusedMap`."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.jsondata import encode
from mapfuse.datasets.mapfile import map_to_dict, validate
from mapfuse.datasets.maps import JointCovariance, LandmarkMap
from mapfuse.datasets.transform import Transform

from .config import FuseConfig
from .consistent import Choice
from .existence import existence
from .far import carried, middle, put_back, shifted
from .joint import referred_to
from .known import KnownTransform, check_known_maps
from .members import Emptiness, Members
from .merge import Place, merged_landmarks
from .noisefit import noise_fits, scaled
from .pairresult import mixture, pair_result
from .pairwise import compare
from .prepared import PreparedMap, prepare
from .result import Decision, Frame, FusedLandmark, FusedMap, NoiseFit, PairResult
from .settle import settled
from .solve import Solution
from .told import told

Array = NDArray[np.float64]

#: A map that reaches further than this [m] from its middle is refused.
LARGEST_MAP_M = 1e6

#: How often maps are fused again with the noise that their residuals speak for, and by how much [log] two scales may
#: differ and be the same.
NOISE_ROUNDS, SAME_SCALE = 3, 0.03

AT_HOME = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))


def fuse(
    maps: Sequence[LandmarkMap], config: FuseConfig | None = None, known: Sequence[KnownTransform] = ()
) -> FusedMap:
    """Fuse recorded maps, whose relative poses are unknown, into one with its uncertainty.

    Every pair is compared; what can be true together is merged into groups, each solved as one graph of landmarks. The
    result does not depend on the order of the maps, up to the choice of reference: a group is in the frame of its
    first map. Maps that are merged with none stand in their own frames. Overlap need not exist: ``decision`` says what
    the evidence suffices for. ``known``: about where some maps lie in others.

    Raises `MapfuseError` for no map, and for two maps of one name; `MapError` for a map that breaks a rule of the
    format; `TooLargeError` where joint covariances would not fit.

    >>> from mapfuse.datasets import read_map, recordings
    >>> names = ("ground-floor-vespucci", "ground-floor-milka")
    >>> fused = fuse([read_map(recordings.path(name)) for name in names])
    >>> fused.decision, fused.probability > 0.99
    ('merged', True)
    """
    config = config or FuseConfig()
    maps = tuple(maps)
    _check(maps)
    check_known_maps(known, {m.name for m in maps})
    origins = {m.name: middle(m) for m in maps}
    known = [replace(k, T12=carried(k.T12, *(-origins[name] for name in k.maps))) for k in known]
    near = tuple(shifted(m, origins[m.name]) for m in maps)
    provenance = _provenance(maps, config)
    scales = dict.fromkeys(origins, 1.0)
    fused = _fuse(near, scales, known, provenance, config)
    for _ in range(NOISE_ROUNDS if config.solving.estimate_noise else 0):
        before, scales = scales, {name: fit.estimate for name, fit in fused.noise.items()}
        if all(abs(np.log(scales[name] / before[name])) < SAME_SCALE for name in scales):
            break
        fused = _fuse(near, scales, known, provenance, config)
    return put_back(fused, maps, origins, mixture)


def _fuse(
    maps: tuple[LandmarkMap, ...],
    scales: Mapping[str, float],
    known: Sequence[KnownTransform],
    provenance: dict[str, Any],
    config: FuseConfig,
) -> FusedMap:
    """Fuse maps whose stated standard deviations are multiplied by ``scales``, by name."""
    angle = np.deg2rad(config.evidence.corridor_angle_deg)
    prepared = {m.name: prepare(scaled(m, scales[m.name]), config.solving, angle) for m in maps}
    # one order of work whatever the order of input, so that the answer is the same to the last digit
    pairs = list(combinations(sorted(prepared), 2))
    comparisons = {
        (a, b): compare(prepared[a], prepared[b], config, known=known, keep_solution=len(pairs) == 1)
        for a, b in told(pairs, "pairs of maps compared")
    }
    emptiness = Emptiness(prepared, config.evidence)
    choice, joints = settled(prepared, comparisons, config, emptiness.against)
    names = [m.name for m in maps]
    rank = {name: k for k, name in enumerate(names)}
    groups: list[_Group] = []
    frames: dict[str, Frame] = {}
    noise: dict[str, NoiseFit] = {}
    for members in sorted(choice.groups, key=lambda group: min(rank[name] for name in group)):
        listed = tuple(sorted(members, key=rank.__getitem__))
        before = sum(len(group.landmarks) for group in groups)
        joint = joints.get(members)
        if joint is None:
            groups.append(_alone(prepared[listed[0]], len(groups), before))
            frames[listed[0]] = Frame(len(groups) - 1, AT_HOME)
            noise |= _noise(listed, prepared[listed[0]].solution, scales)
            continue
        joint = referred_to(joint, members.index(listed[0]), config.solving)
        noise |= _noise(members, joint.solution, scales)
        group = Members(members, joint, comparisons, choice, emptiness)
        groups.append(_merged(group, listed, len(groups), before))
        for name in listed:
            T = AT_HOME if name == listed[0] else joint.solution.transform(members.index(name))
            frames[name] = Frame(len(groups) - 1, T)
    results = tuple(
        pair_result(comparisons[a, b], choice, (prepared[a].map.ids, prepared[b].map.ids), rank[b] < rank[a])
        for a, b in sorted(pairs, key=lambda pair: sorted(rank[name] for name in pair))
    )
    decision, probability = _overall(results, choice)
    frames = {name: frames[name] for name in names}
    noise = {name: noise[name] for name in names}
    return _result(maps, decision, probability, results, groups, frames, noise, provenance)


def _noise(names: Sequence[str], solution: Solution | None, scales: Mapping[str, float]) -> dict[str, NoiseFit]:
    """How the maps of a solution fit the noise that they state; an empty map has none."""
    if solution is None:
        return {name: NoiseFit(0.0, 0.0) for name in names}
    return dict(zip(names, noise_fits(solution, [scales[name] for name in names]), strict=True))


def _overall(pairs: Sequence[PairResult], choice: Choice) -> tuple[Decision, float]:
    """Decision of the whole, and the probability that all its merges are right; of two maps that of their pair."""
    if len(choice.groups) == 1:
        return "merged", choice.probability[0]
    if any(len(names) > 1 for names in choice.groups):
        return "partial", float(np.prod(choice.probability))
    decision: Decision = "ambiguous" if any(pair.decision == "ambiguous" for pair in pairs) else "no_overlap"
    return decision, pairs[0].probability if len(pairs) == 1 else 1.0


def _check(maps: tuple[LandmarkMap, ...]) -> None:
    if not maps:
        raise MapfuseError("there is nothing to fuse: give at least one map")
    twice = next((name for name, count in Counter(m.name for m in maps).items() if count > 1), None)
    if twice is not None:
        raise MapfuseError(f"two maps are named {twice!r}; names must differ, since results refer to them")
    for m in maps:
        if problems := validate(m) or _strays(m):
            raise MapError(m.name, problems)


def _strays(m: LandmarkMap) -> tuple[Problem, ...]:
    """Landmarks so far from all others that nothing can be computed with them."""
    if not len(m):
        return ()
    off = np.abs(m.positions - np.median(m.positions, axis=0)).max(axis=1)
    reason = f"lies more than {LARGEST_MAP_M / 1000:g} km from the middle of the map"
    return tuple(Problem(f"landmarks[{k}]", f"{m.ids[k]!r} {reason}") for k in np.flatnonzero(off > LARGEST_MAP_M))


def _provenance(maps: tuple[LandmarkMap, ...], config: FuseConfig) -> dict[str, Any]:
    inputs = {m.name: hashlib.sha256(encode(map_to_dict(m))).hexdigest() for m in maps}
    return {"mapfuse": version("mapfuse"), "inputs": inputs, "config": asdict(config)}


@dataclass(frozen=True, eq=False)
class _Group:
    """Landmarks that share a frame, with their joint covariance."""

    names: tuple[str, ...]
    landmarks: tuple[FusedLandmark, ...]
    joint: JointCovariance


def _result(
    maps: tuple[LandmarkMap, ...],
    decision: Decision,
    probability: float,
    pairs: tuple[PairResult, ...],
    groups: Sequence[_Group],
    frames: dict[str, Frame],
    noise: dict[str, NoiseFit],
    provenance: dict[str, Any],
) -> FusedMap:
    return FusedMap(
        decision=decision,
        probability=probability,
        maps=tuple(m.name for m in maps),
        groups=tuple(group.names for group in groups),
        frames=frames,
        pairs=pairs,
        landmarks=tuple(landmark for group in groups for landmark in group.landmarks),
        provenance=provenance,
        sources={m.name: m for m in maps},
        noise=noise,
        joint_covariances=tuple(group.joint for group in groups),
    )


def _alone(m: PreparedMap, group: int, before: int) -> _Group:
    """A map that was merged with none, straightened, in its own frame."""
    order = sorted(range(len(m)), key=lambda k: m.map.ids[k])
    places = [Place(((0, k),), existence([(m, k)], [], 1.0)) for k in order]
    names = [f"m{before + k + 1}" for k in range(len(order))]
    poses = np.column_stack([m.positions, np.nan_to_num(m.headings)])
    block = {(0, k): k for k in range(len(m))}
    landmarks, joint = merged_landmarks([m.map], places, [poses], block, m.covariance, group, names)
    return _Group((m.map.name,), landmarks, joint)


def _merged(group: Members, listed: tuple[str, ...], number: int, before: int) -> _Group:
    """A group's landmarks in the frame of its reference; ``listed``: its maps in the order of the input."""
    maps = [m.map for m in group.joint.maps]
    solution = group.joint.solution
    places = sorted(
        (Place(members, group.existence(members)) for members in group.places),
        key=lambda place: min((maps[r].name, maps[r].ids[k]) for r, k in place.members),
    )
    keys = [key for r in range(len(maps)) for key in solution.landmark_keys(r)]
    block = {(key.map, maps[key.map].index_from_id[key.id]): n for n, key in enumerate(keys)}
    names = [f"m{before + k + 1}" for k in range(len(places))]
    poses = [solution.landmark_poses(r) for r in range(len(maps))]
    landmarks, joint = merged_landmarks(maps, places, poses, block, solution.joint_covariance(keys), number, names)
    return _Group(listed, landmarks, joint)
