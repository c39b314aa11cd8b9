"""Landmarks over the mixture: where each one of a pair of maps lies, whichever hypothesis of the pair is right.

A covariance given the hypothesis says nothing of its rivals. Over the mixture a landmark has the mean and covariance
of its position when a hypothesis is drawn by its probability and a position by that hypothesis' graph: the mean of the
graphs' covariances, plus the covariance of their means (the law of total covariance). The graphs of the rivals, which
`fuse` doesn't keep, are solved when this is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError, MapfuseError
from mapfuse.datasets.transform import Transform
from mapfuse.factors import LandmarkKey, Unknown, pair_problem

from .config import SolvingConfig
from .far import carried, middle, shifted
from .merge import meant_variance
from .noisefit import scaled
from .pairresult import moments
from .prepared import PreparedMap, prepare
from .result import FusedMap, PairResult, RankedHypothesis
from .solve import Solution, solve

Array = NDArray[np.float64]
#: A recorded landmark as (map name, id).
Name = tuple[str, str]

#: A hypothesis with less of the weight than this gets no graph: map 2 is laid on map 1 as it is.
NEGLIGIBLE = 1e-4


@dataclass(frozen=True, eq=False, slots=True)
class MixtureLandmark:
    """A recorded landmark over all hypotheses of a pair, in the frame of the pair's first map.

    x, y [m], ``heading`` [rad] (None without): the mean. ``covariance`` (3, 3) over (x, y, heading), (2, 2) without
    heading: ``within`` the hypotheses, their mean, plus ``between`` them. Headings are counted from that of the first
    hypothesis, so that of two opposite ones the mean is a matter of definition.
    """

    map: str
    id: str
    x: float
    y: float
    heading: float | None
    within: Array
    between: Array

    @property
    def covariance(self) -> Array:
        """Within and between the hypotheses together."""
        return np.asarray(self.within + self.between)


@dataclass(frozen=True, eq=False)
class Placement:
    """One hypothesis: where it has all landmarks of both maps, in the frame of the first.

    ``weight``: its probability given that the maps overlap. ``places``: of each landmark the recorded ones that are
    the same under it, itself first. ``solution``: its graph, None where it got none.
    """

    weight: float
    T12: Transform
    prepared: tuple[PreparedMap, PreparedMap]
    places: tuple[tuple[LandmarkKey, ...], ...]
    solution: Solution | None

    @cached_property
    def poses(self) -> Array:
        """(n, 3) of each landmark; the position is the mean of all records that are it, the heading its own."""
        return np.array([self._pose(place) for place in self.places]).reshape(-1, 3)

    def _pose(self, place: tuple[LandmarkKey, ...]) -> Array:
        recorded = np.array([self._recorded[key] for key in place])
        return np.array([*recorded[:, :2].mean(axis=0), recorded[0, 2]])

    @cached_property
    def _recorded(self) -> dict[LandmarkKey, Array]:
        if self.solution is not None:
            keys = [key for r in (0, 1) for key in self.solution.landmark_keys(r)]
            return {key: self.solution.poses[key] for key in keys}
        own = [m.poses for m in self.prepared]
        laid = own[0], se2.compose(self.T12.array, own[1])
        return {LandmarkKey(r, name): laid[r][k] for r in (0, 1) for k, name in enumerate(self.prepared[r].map.ids)}

    @cached_property
    def covariances(self) -> Array:
        """(n, 3, 3) of each landmark, given the hypothesis."""
        out = np.zeros((len(self.places), 3, 3))
        for n in {len(place) for place in self.places}:
            rows = [k for k, place in enumerate(self.places) if len(place) == n]
            for a in range(n):
                for b in range(n):
                    keys = [(self.places[k][a], self.places[k][b]) for k in rows]
                    blocks = self._blocks([one for one, _ in keys], [other for _, other in keys])
                    if a == b:
                        blocks = blocks + np.array([np.diag(self._meant(key)) for key, _ in keys])
                    out[rows] += blocks / n**2
        return (out + np.swapaxes(out, 1, 2)) / 2

    def joint_covariance(self, places: Sequence[int]) -> Array:
        """(3k, 3k) of k landmarks by their place in ``poses``, given the hypothesis."""
        keys = list(dict.fromkeys(key for k in places for key in self.places[k]))
        joint = self._joint(keys) + np.diag(np.concatenate([self._meant(key) for key in keys]))
        column = {key: 3 * n for n, key in enumerate(keys)}
        mean = np.zeros((3 * len(places), 3 * len(keys)))
        for row, k in enumerate(places):
            for key in self.places[k]:
                mean[3 * row : 3 * row + 3, column[key] : column[key] + 3] = np.eye(3) / len(self.places[k])
        return se2.propagate(mean, joint)

    def _meant(self, key: LandmarkKey) -> Array:
        recorded = self.prepared[key.map].map
        return meant_variance(recorded, recorded[key.id])

    def _blocks(self, keys: Sequence[LandmarkKey], others: Sequence[LandmarkKey]) -> Array:
        """Covariance (k, 3, 3) of each recorded landmark with another one."""
        if self.solution is not None:
            unknowns: list[Unknown] = list(keys)
            return self.solution.covariances(unknowns, list(others))
        assert list(keys) == list(others), "without a graph no two landmarks are one"
        out = np.zeros((len(keys), 3, 3))
        for r, m in enumerate(self.prepared):
            rows = [k for k, key in enumerate(keys) if key.map == r]
            if rows and m.solution is not None:
                own = [LandmarkKey(0, keys[k].id) for k in rows]
                out[rows] = m.solution.covariances(own)
                if r == 1:
                    poses = np.array([m.solution.poses[key] for key in own])
                    out[rows] = se2.compose_covariance(self.T12.array, self._cov_12, poses, out[rows])
        return out

    def _joint(self, keys: Sequence[LandmarkKey]) -> Array:
        if self.solution is not None:
            return self.solution.joint_covariance(list(keys))
        joint = np.zeros((3 * len(keys), 3 * len(keys)))
        for r, m in enumerate(self.prepared):
            rows = [k for k, key in enumerate(keys) if key.map == r]
            if not rows or m.solution is None:
                continue
            own = [LandmarkKey(0, keys[k].id) for k in rows]
            block = m.solution.joint_covariance(own)
            if r == 1:
                poses = np.array([m.solution.poses[key] for key in own])
                by_T, by_own = se2.compose_jacobians(self.T12.array, poses)
                turn = np.zeros_like(block)
                for k, J in enumerate(by_own):
                    turn[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = J
                block = se2.propagate(turn, block) + se2.propagate(by_T.reshape(-1, 3), self._cov_12)
            index = np.concatenate([np.arange(3 * k, 3 * k + 3) for k in rows])
            joint[np.ix_(index, index)] = block
        return joint

    @property
    def _cov_12(self) -> Array:
        assert self.T12.covariance is not None
        return self.T12.covariance


@dataclass(frozen=True, eq=False)
class LandmarkMixture:
    """All landmarks of a pair of maps over its hypotheses, given that the maps overlap.

    ``maps``: their names, the frame is that of the first. ``landmarks``: (map name, id) of every recorded landmark.
    ``placements``: one per hypothesis, in their order. A landmark that a hypothesis matches lies there where the mean
    of both records does.
    """

    maps: tuple[str, str]
    landmarks: tuple[Name, ...]
    headed: tuple[bool, ...]
    placements: tuple[Placement, ...]
    origin: Array

    @property
    def weights(self) -> Array:
        """(k,) of the hypotheses; their sum is 1."""
        return np.array([placement.weight for placement in self.placements])

    def __getitem__(self, name: Name) -> MixtureLandmark:
        """The landmark ``(map name, id)``; KeyError where there is none."""
        return self.estimates[self._place[name]]

    @cached_property
    def _place(self) -> dict[Name, int]:
        return {name: k for k, name in enumerate(self.landmarks)}

    @cached_property
    def estimates(self) -> tuple[MixtureLandmark, ...]:
        """All landmarks, in the order of ``landmarks``."""
        poses = np.array([placement.poses for placement in self.placements])
        covariances = np.array([placement.covariances for placement in self.placements])
        mean, within, between = moments(self.weights, poses, covariances)
        mean[:, :2] += self.origin
        found = []
        for k, (name, identifier) in enumerate(self.landmarks):
            n = 3 if self.headed[k] else 2
            x, y, theta = mean[k].tolist()
            heading = theta if self.headed[k] else None
            found.append(MixtureLandmark(name, identifier, x, y, heading, within[k, :n, :n], between[k, :n, :n]))
        return tuple(found)

    def joint_covariance(self, landmarks: Sequence[Name]) -> Array:
        """Joint covariance (3k, 3k) of k landmarks over (x, y, heading) each; of one without heading that row is of
        no meaning.

        Raises KeyError for one that isn't there, `TooLargeError` for too many.
        """
        places = [self._place[name] for name in landmarks]
        poses = np.array([placement.poses[places] for placement in self.placements])
        off = poses - poses[0]
        off[..., 2] = se2.wrap(off[..., 2])
        off = (off - np.tensordot(self.weights, off, 1)).reshape(len(off), -1)
        joint = sum(placement.weight * placement.joint_covariance(places) for placement in self.placements)
        return np.asarray(joint + np.einsum("k,ki,kj->ij", self.weights, off, off))


def landmark_mixture(
    fused: FusedMap, maps: tuple[str, str] | None = None, config: SolvingConfig | None = None
) -> LandmarkMixture:
    """The landmarks of one pair of a result over all hypotheses of the pair.

    ``maps``: names of the pair, the first being the frame; by default those of the first pair. ``config``: how the
    result's graphs were solved, where not as by default. Each hypothesis that has weight, and whose matches the result
    tells, is solved as the graph of the two maps alone; for the others, of less than 1e-4 each, map 2 is laid on map 1
    as it is, T12's errors and the map's own taken as independent. In a group of more maps the probabilities are those
    that the group leaves to the pair.

    Raises ConfigError where the result has no such pair; MapfuseError where it holds no hypothesis for it, or where
    the recorded maps aren't embedded.

    >>> from mapfuse.datasets import read_map, recordings
    >>> from mapfuse.fusion import fuse
    >>> fused = fuse([read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"]])
    >>> mixture = landmark_mixture(fused)
    >>> name, ids = next(iter(fused.landmarks[0].sources.items()))
    >>> landmark = mixture[name, ids[0]]  # merged for sure, so the rivals add nothing
    >>> bool(np.allclose(landmark.covariance[:2, :2], fused.landmarks[0].covariance[:2, :2], atol=1e-3))
    True
    """
    pair, swapped = _pair_of(fused, maps)
    names = pair.maps[::-1] if swapped else pair.maps
    if missing := [name for name in names if name not in fused.sources]:
        raise MapfuseError(
            f"the recorded map {missing[0]} isn't embedded in this result, so its rivals can't be solved"
        )
    total = sum(h.probability for h in pair.hypotheses)
    if not total > 0:
        raise MapfuseError(f"no hypothesis lays {names[1]} on {names[0]}, so there is no mixture")
    config = config or SolvingConfig()
    recorded = fused.sources[names[0]], fused.sources[names[1]]
    origins = middle(recorded[0]), middle(recorded[1])
    near = tuple(
        prepare(scaled(shifted(m, origin), fused.noise[m.name].used if m.name in fused.noise else 1.0), config)
        for m, origin in zip(recorded, origins, strict=True)
    )
    prepared = near[0], near[1]
    return LandmarkMixture(
        names,
        tuple((m.name, identifier) for m in recorded for identifier in m.ids),
        tuple(bool(headed) for m in prepared for headed in m.headed),
        tuple(_placement(h, total, swapped, prepared, origins, config) for h in pair.hypotheses),
        origins[0],
    )


def _pair_of(fused: FusedMap, maps: tuple[str, str] | None) -> tuple[PairResult, bool]:
    """The pair of these names, and whether it has them in the other order."""
    found = [pair for pair in fused.pairs if maps is None or set(pair.maps) == set(maps)]
    if not found:
        asked = "a pair" if maps is None else f"the pair {' and '.join(maps)}"
        raise ConfigError(f"there isn't {asked} in this result; its maps are {', '.join(fused.maps)}")
    return found[0], maps is not None and found[0].maps != tuple(maps)


def _placement(
    hypothesis: RankedHypothesis,
    total: float,
    swapped: bool,
    prepared: tuple[PreparedMap, PreparedMap],
    origins: tuple[Array, Array],
    config: SolvingConfig,
) -> Placement:
    """The graph of a hypothesis solved as `fuse` does, the matches that its gate takes out being none."""
    weight = hypothesis.probability / total
    T12 = hypothesis.T12.inverse() if swapped else hypothesis.T12
    T12 = carried(T12, -origins[0], -origins[1])
    matches = [(b, a) if swapped else (a, b) for a, b in hypothesis.correspondences]
    if weight < NEGLIGIBLE or not matches:
        return Placement(weight, T12, prepared, _places(prepared, ()), None)
    maps = prepared[0].map, prepared[1].map
    starts = [m.poses for m in prepared]
    scale = max(m.noise_scale for m in prepared)
    solution = solve(pair_problem(*maps, T12, matches, starts=(starts[0], starts[1])), config, scale)
    gone = {match.pair for match in solution.rejected}
    keys = [(LandmarkKey(0, a), LandmarkKey(1, b)) for a, b in matches]
    places = _places(prepared, [pair for pair in keys if pair not in gone])
    return Placement(weight, solution.transform(1), prepared, places, solution)


def _places(
    prepared: tuple[PreparedMap, PreparedMap], matches: Sequence[tuple[LandmarkKey, LandmarkKey]]
) -> tuple[tuple[LandmarkKey, ...], ...]:
    """Of every landmark of both maps all records of it, its own first."""
    other = dict(matches) | {b: a for a, b in matches}
    keys = [LandmarkKey(r, identifier) for r, m in enumerate(prepared) for identifier in m.map.ids]
    return tuple((key, other[key]) if key in other else (key,) for key in keys)
