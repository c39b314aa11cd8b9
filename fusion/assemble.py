"""`assembled`: maps, their comparisons and what was chosen of these to a `FusedMap`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import JointCovariance, LandmarkMap
from mapfuse.datasets.transform import Transform

from .config import SolvingConfig
from .consistent import Choice
from .existence import existence
from .joint import Joint, referred_to
from .members import Emptiness, Members
from .merge import Place, merged_landmarks
from .noisefit import noise_fits
from .pairresult import NEGLIGIBLE, pair_result
from .pairwise import Comparison
from .placing import Pair
from .prepared import PreparedMap
from .result import Decision, Frame, FusedLandmark, FusedMap, NoiseFit, PairResult

Array = NDArray[np.float64]

AT_HOME = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))


def assembled(
    prepared: Mapping[str, PreparedMap],
    comparisons: Mapping[Pair, Comparison],
    choice: Choice,
    joints: Mapping[tuple[str, ...], Joint],
    emptiness: Emptiness,
    config: SolvingConfig,
    provenance: dict[str, Any],
    scales: Mapping[str, float] | None = None,
) -> FusedMap:
    """The result for all maps of ``prepared``, in that order, the choice being made.

    ``comparisons``: of the pairs that were compared, by their names in alphabetical order; ``joints``: the solved
    graph of every group that has more than one map; ``scales``: by what the stated noise of each map was multiplied,
    None: by nothing.
    """
    scales = dict.fromkeys(prepared, 1.0) if scales is None else scales
    rank = {name: k for k, name in enumerate(prepared)}
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
            noise[listed[0]] = replace(prepared[listed[0]].noise_fit, used=scales[listed[0]])
            continue
        joint = referred_to(joint, members.index(listed[0]), config)
        fits = noise_fits(joint.solution, [scales[name] for name in members])
        noise |= dict(zip(members, fits, strict=True))
        group = Members(members, joint, comparisons, choice, emptiness)
        groups.append(_merged(group, listed, len(groups), before))
        for name in listed:
            T = AT_HOME if name == listed[0] else joint.solution.transform(members.index(name))
            frames[name] = Frame(len(groups) - 1, T)
    least = NEGLIGIBLE if len(prepared) > 2 else 0.0
    results = tuple(
        pair_result(comparisons[a, b], choice, (prepared[a].map.ids, prepared[b].map.ids), rank[b] < rank[a], least)
        for a, b in sorted(comparisons, key=lambda pair: sorted(rank[name] for name in pair))
    )
    decision, probability = _overall(results, choice)
    frames = {name: frames[name] for name in prepared}
    noise = {name: noise[name] for name in prepared}
    maps = [m.map for m in prepared.values()]
    return _result(maps, decision, probability, results, groups, frames, noise, provenance)


def _overall(pairs: Sequence[PairResult], choice: Choice) -> tuple[Decision, float]:
    """Decision of the whole, and the probability that all its merges are right; of two maps that of their pair."""
    if len(choice.groups) == 1:
        return "merged", choice.probability[0]
    if any(len(names) > 1 for names in choice.groups):
        return "partial", float(np.prod(choice.probability))
    decision: Decision = "ambiguous" if any(pair.decision == "ambiguous" for pair in pairs) else "no_overlap"
    return decision, pairs[0].probability if len(pairs) == 1 else 1.0


@dataclass(frozen=True, eq=False)
class _Group:
    """Landmarks that share a frame, with their joint covariance."""

    names: tuple[str, ...]
    landmarks: tuple[FusedLandmark, ...]
    joint: JointCovariance


def _result(
    maps: Sequence[LandmarkMap],
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
    block = {(0, k): k for k in range(len(m))}
    landmarks, joint = merged_landmarks([m.map], places, [m.poses], block, m.covariance, group, names)
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
