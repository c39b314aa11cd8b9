"""Maps written far from their origin, as survey coordinates are: fused around their own middles, then put back.

Over a lever of 100 km and more a rotation's last digits are metres: neither GTSAM's elimination nor a linearised T12
bears that. Around the middle of its landmarks a map is as good as any.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from .result import FusedMap, PairResult

Array = NDArray[np.float64]

#: A map whose landmarks' middle is further from the origin than this [m] is moved.
FAR_M = 10_000.0


def middle(recorded: LandmarkMap) -> Array:
    """Where a far map's landmarks are (2,) [m, whole metres]; zero for a map that isn't far."""
    if not len(recorded) or np.hypot(*np.abs(recorded.positions).max(axis=0)) <= FAR_M:  # no median is further away
        return np.zeros(2)
    at = np.round(np.median(recorded.positions, axis=0))
    return at if np.hypot(*at) > FAR_M else np.zeros(2)


def shifted(recorded: LandmarkMap, by: Array) -> LandmarkMap:
    """The map in coordinates whose origin is at ``by`` (2,) [m] of its own."""
    if not by.any():
        return recorded
    x, y = by.tolist()
    path = recorded.path
    joint = recorded.joint_covariance
    if joint is not None and joint.keyframes is not None:
        joint = replace(joint, keyframes=replace(joint.keyframes, poses=joint.keyframes.poses - np.array([x, y, 0.0])))
    return recorded.replace(
        joint_covariance=joint,
        landmarks=tuple(replace(landmark, x=landmark.x - x, y=landmark.y - y) for landmark in recorded.landmarks),
        walls=tuple(wall - by for wall in recorded.walls),
        path=None if path is None else path - np.array([0.0, x, y, 0.0]),
    )


def put_back(
    fused: FusedMap,
    maps: Sequence[LandmarkMap],
    origins: Mapping[str, Array],
    mixture: Callable[[Sequence[Transform], Array], Array],
) -> FusedMap:
    """The result for ``maps`` as they were written, given that for maps shifted by ``origins`` (2,) [m], by name.

    ``mixture``: covariance of T12 over hypotheses and their probabilities, which depends on where the origins are.
    """
    if not any(origin.any() for origin in origins.values()):
        return fused
    reference = [origins[names[0]] for names in fused.groups]
    return replace(
        fused,
        pairs=tuple(pair_put_back(pair, origins[pair.maps[0]], origins[pair.maps[1]], mixture) for pair in fused.pairs),
        frames={
            name: replace(frame, T=carried(frame.T, reference[frame.group], origins[name]))
            for name, frame in fused.frames.items()
        },
        landmarks=tuple(
            replace(l, x=l.x + float(reference[l.group][0]), y=l.y + float(reference[l.group][1]))
            for l in fused.landmarks
        ),
        sources={m.name: m for m in maps if m.name in fused.sources},
    )


def carried(T12: Transform, origin1: Array, origin2: Array) -> Transform:
    """T12 between coordinates whose origins were at ``origin1``, ``origin2``, between those that they stood in."""
    from2 = np.array([*-origin2, 0.0])
    pose = se2.compose(T12.array, from2) + np.array([*origin1, 0.0])
    if T12.covariance is None:
        return Transform.from_array(pose)
    J = se2.compose_jacobians(T12.array, from2)[0]
    return Transform.from_array(pose, se2.propagate(J, T12.covariance))


def pair_put_back(
    pair: PairResult, origin1: Array, origin2: Array, mixture: Callable[[Sequence[Transform], Array], Array]
) -> PairResult:
    """One pair's result as `put_back` gives it, the maps' origins having been ``origin1``, ``origin2`` (2,)."""
    if not pair.hypotheses:
        return pair
    hypotheses = tuple(replace(h, T12=carried(h.T12, origin1, origin2)) for h in pair.hypotheses)
    spread = mixture([h.T12 for h in hypotheses], np.array([h.probability for h in hypotheses]))
    return replace(pair, hypotheses=hypotheses, mixture_covariance=spread)
