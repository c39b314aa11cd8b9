"""`fuse`: recorded maps to a `FusedMap`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.jsondata import encode
from mapfuse.datasets.mapfile import map_to_dict, validate
from mapfuse.datasets.maps import JointCovariance, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.factors import pair_problem

from .config import FuseConfig
from .evidence import Weighed
from .existence import existence
from .far import middle, put_back, shifted
from .merge import Place, merged_landmarks
from .pair import PairOutcome, fuse_pair
from .prepared import PreparedMap, prepare
from .reason import reason
from .result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from .solve import Solution, solve

Array = NDArray[np.float64]

#: A map that reaches further than this [m] from its middle is refused.
LARGEST_MAP_M = 1e6

AT_HOME = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))


def fuse(maps: Sequence[LandmarkMap], config: FuseConfig | None = None) -> FusedMap:
    """Fuse one or two recorded maps, whose relative pose is unknown, into one with its uncertainty.

    The result does not depend on the order of the maps, up to the choice of reference: the merged map is in the frame
    of the first one. Maps that are not merged stand each in its own frame. Overlap need not exist: ``decision`` says
    what the evidence suffices for.

    Raises `MapfuseError` for no map or more than two, and for two maps of one name; `MapError` for a map that breaks a
    rule of the format; `TooLargeError` where joint covariances would not fit.

    >>> from mapfuse.datasets import read_map, recordings
    >>> names = ("ground-floor-vespucci", "ground-floor-milka")
    >>> fused = fuse([read_map(recordings.path(name)) for name in names])
    >>> fused.decision, fused.probability > 0.99
    ('merged', True)
    """
    config = config or FuseConfig()
    maps = tuple(maps)
    _check(maps)
    origins = {m.name: middle(m) for m in maps}
    near = tuple(shifted(m, origins[m.name]) for m in maps)
    return put_back(_fuse(near, _provenance(maps, config), config), maps, origins, _mixture)


def _fuse(maps: tuple[LandmarkMap, ...], provenance: dict[str, Any], config: FuseConfig) -> FusedMap:
    prepared = {m.name: prepare(m, config.solving, np.deg2rad(config.evidence.corridor_angle_deg)) for m in maps}
    if len(maps) == 1:
        only = prepared[maps[0].name]
        return _result(maps, "merged", 1.0, (), [_alone(only, 0, 0)], {maps[0].name: Frame(0, AT_HOME)}, provenance)
    # one order of work whatever the order of input, so that the answer is the same to the last digit
    first, second = sorted(maps, key=lambda m: m.name)
    outcome = fuse_pair(prepared[first.name], prepared[second.name], config)
    swapped = maps[0].name != first.name
    pair = _pair_result(outcome, swapped)
    if pair.decision == "merged":
        group = _merged(outcome, swapped, config)
        T12 = pair.hypotheses[0].T12
        frames = {maps[0].name: Frame(0, AT_HOME), maps[1].name: Frame(0, T12)}
        return _result(maps, "merged", pair.probability, (pair,), [group], frames, provenance)
    ones = [_alone(prepared[m.name], k, sum(len(other) for other in maps[:k])) for k, m in enumerate(maps)]
    frames = {m.name: Frame(k, AT_HOME) for k, m in enumerate(maps)}
    return _result(maps, pair.decision, pair.probability, (pair,), ones, frames, provenance)


def _check(maps: tuple[LandmarkMap, ...]) -> None:
    if not 1 <= len(maps) <= 2:
        raise MapfuseError(f"fuse takes one or two maps in this version, not {len(maps)}")
    if len({m.name for m in maps}) < len(maps):
        raise MapfuseError(f"both maps are named {maps[0].name!r}; names must differ, since results refer to them")
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
    decision: Any,
    probability: float,
    pairs: tuple[PairResult, ...],
    groups: Sequence[_Group],
    frames: dict[str, Frame],
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


def _transform(outcome: PairOutcome, rank: int) -> Transform:
    """T12 of a hypothesis with its covariance: from its graph where it was solved, else from the elastic match."""
    if rank in outcome.solutions:
        return outcome.solutions[rank].transform(1)
    joined = outcome.verdict.ranked[rank].growth.joined
    return Transform.from_array(joined.T12, joined.T12_covariance)


def _mixture(transforms: Sequence[Transform], probabilities: Array) -> Array:
    """Covariance of T12 over all hypotheses, given that the maps overlap: within them and between them."""
    weight = probabilities / probabilities.sum()
    means = np.array([T.array for T in transforms])
    off = means - means[0]
    off[:, 2] = se2.wrap(off[:, 2])
    off -= weight @ off
    within = np.einsum("k,kij->ij", weight, np.array([T.covariance for T in transforms]))
    return np.asarray(within + np.einsum("k,ki,kj->ij", weight, off, off))


def _pair_result(outcome: PairOutcome, swapped: bool) -> PairResult:
    verdict = outcome.verdict
    transforms = [_transform(outcome, rank) for rank in range(len(verdict.ranked))]
    names = (outcome.m1.map.name, outcome.m2.map.name)
    if swapped:
        transforms = [T.inverse() for T in transforms]
        names = (names[1], names[0])
    hypotheses = tuple(
        RankedHypothesis(T, len(w.growth.i), w.log_odds, float(p), {"evidence": asdict(w.terms)})
        for T, w, p in zip(transforms, verdict.ranked, verdict.probabilities, strict=True)
    )
    return PairResult(
        maps=names,
        decision=verdict.decision,
        probability=float(verdict.probabilities[0]) if hypotheses else 0.0,
        no_overlap_probability=verdict.no_overlap,
        hypotheses=hypotheses,
        correspondences=_correspondences(verdict.ranked[0], swapped) if hypotheses else (),
        reason=reason(verdict, swapped),
        mixture_covariance=_mixture(transforms, verdict.probabilities) if hypotheses else None,
    )


def _correspondences(w: Weighed, swapped: bool) -> tuple[tuple[str, str], ...]:
    ids1, ids2 = w.growth.joined.m1.map.ids, w.growth.joined.m2.map.ids
    pairs = [(ids1[i], ids2[j]) for i, j in zip(w.growth.i, w.growth.j, strict=True)]
    return tuple(sorted((b, a) if swapped else (a, b) for a, b in pairs))


def _merged(outcome: PairOutcome, swapped: bool, config: FuseConfig) -> _Group:
    """The best hypothesis' landmarks in the frame of the input's first map."""
    best = outcome.verdict.ranked[0]
    joined = best.growth.joined
    prepared = [outcome.m1, outcome.m2]
    matched = list(zip(joined.i.tolist(), joined.j.tolist(), strict=True))
    missed = [set(best.missed1), set(best.missed2)]
    solution = outcome.solutions[0]
    if swapped:
        prepared, missed = prepared[::-1], missed[::-1]
        matched = [(j, i) for i, j in matched]
        solution = _from_second(outcome, solution, config)
    maps = [m.map for m in prepared]
    partner = {(0, i): (1, j) for i, j in matched}
    taken = set(partner.values())
    places = []
    for r, m in enumerate(prepared):
        for k in range(len(m)):
            if (r, k) in taken:
                continue
            members = ((r, k), partner[(r, k)]) if (r, k) in partner else ((r, k),)
            passed_by = [prepared[1 - r]] if k in missed[r] else []
            rate = outcome.background.rate_of(m, k)
            places.append(Place(members, existence([(prepared[s], n) for s, n in members], passed_by, rate)))
    places.sort(key=lambda place: min((maps[r].name, maps[r].ids[k]) for r, k in place.members))
    keys = [key for r in (0, 1) for key in solution.landmark_keys(r)]
    block = {(key.map, maps[key.map].index_from_id[key.id]): n for n, key in enumerate(keys)}
    names = [f"m{k + 1}" for k in range(len(places))]
    poses = [solution.landmark_poses(0), solution.landmark_poses(1)]
    landmarks, joint = merged_landmarks(maps, places, poses, block, solution.joint_covariance(keys), 0, names)
    return _Group((maps[0].name, maps[1].name), landmarks, joint)


def _from_second(outcome: PairOutcome, solution: Solution, config: FuseConfig) -> Solution:
    """The same matches solved in the frame of the other map."""
    m1, m2 = outcome.m1.map, outcome.m2.map
    joined = outcome.verdict.ranked[0].growth.joined
    matches = [(m2.ids[j], m1.ids[i]) for i, j in zip(joined.i, joined.j, strict=True)]
    T21 = solution.transform(1).inverse().array
    starts = (se2.compose(T21, solution.landmark_poses(1)), solution.landmark_poses(0))
    return solve(pair_problem(m2, m1, T21, matches, robust=False, starts=starts), config.solving)
