"""iSAM2 with its factors by name, so that what was said can be said anew: measurements come, go, and are replaced."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Sequence
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from mapfuse.factors.axes import joint_to_axes
from mapfuse.factors.measurement import Measurement

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

#: iSAM2 linearises anew what moved by more than this [m, rad].
RELINEARISE = 0.05
#: It looks for such every so many messages; after what moves much at once.
SKIP = 10
#: Updates after what moves much, at most, until nothing moves.
SETTLING = 8

#: A name of measurements: the map, what they are, and which landmarks they are of.
Tag: TypeAlias = tuple[Hashable, ...]


class Tree:
    """Measurements by tag, and where they place the unknowns. What is `put` counts from the next `update`."""

    def __init__(self) -> None:
        self._keys: dict[Hashable, int] = {}
        self._terms: dict[Tag, tuple[Measurement, ...]] = {}
        self._indices: dict[Tag, list[int]] = {}
        self._new: dict[Tag, tuple[Measurement, ...]] = {}
        self._gone: list[int] = []
        self._isam = _isam()
        self._start: dict[Hashable, Array] = {}
        self._known: dict[Hashable, Array] = {}
        self._failed = False

    # GTSAM's keys, as `mapfuse.factors` asks for them

    def key(self, unknown: Hashable) -> int:
        """GTSAM key of an unknown, a new one where it has none."""
        found = self._keys.get(unknown)
        if found is None:
            found = self._keys[unknown] = gtsam.symbol("x", len(self._keys))
        return found

    def keys(self, unknowns: Iterable[Hashable]) -> list[int]:
        """GTSAM keys of several unknowns."""
        return [self.key(unknown) for unknown in unknowns]

    # What goes in

    def of(self, tag: Tag) -> tuple[Measurement, ...]:
        """The measurements of a name."""
        return self._new.get(tag, self._terms.get(tag, ()))

    def put(self, tag: Tag, terms: tuple[Measurement, ...]) -> None:
        """These measurements under a name, instead of those that were there."""
        if self.of(tag) == terms:
            return
        self._gone += self._indices.pop(tag, [])
        self._terms.pop(tag, None)
        self._new[tag] = terms

    def start(self, unknown: Hashable, pose: Array) -> None:
        """Where an unknown begins, from the next `rebuild` on where it is there already."""
        self._start[unknown] = pose

    def has(self, unknown: Hashable) -> bool:
        """Whether an unknown is in the tree."""
        return bool(self._isam.valueExists(self.key(unknown)))

    def update(self, *, settle: bool) -> None:
        """Take in what was put; ``settle``: until nothing moves any more."""
        if not self._new and not self._gone:
            return
        graph, tags = gtsam.NonlinearFactorGraph(), []
        used: set[Hashable] = set()
        for tag, terms in self._new.items():
            for m in terms:
                graph.add(m.factor(self))  # type: ignore[arg-type]
                tags.append(tag)
                used.update(m.unknowns)
        values = gtsam.Values()
        for unknown in used:
            key = self.key(unknown)
            if not self._isam.valueExists(key):
                self._start.setdefault(unknown, self._known.get(unknown, np.zeros(3)))
                x, y, theta = self._start[unknown].tolist()
                values.insert(key, gtsam.Pose2(x, y, theta))
        try:
            result = self._isam.update(graph, values, self._gone)
        except RuntimeError as error:
            self._again(error)
            return
        for tag, index in zip(tags, result.getNewFactorsIndices(), strict=True):
            self._indices.setdefault(tag, []).append(int(index))
        self._terms.update({tag: terms for tag, terms in self._new.items() if terms})
        self._known.update(self._start)
        self._new, self._gone, self._start = {}, [], {}
        if settle:
            for _ in range(SETTLING):
                again = self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True)
                if not again.getVariablesRelinearized():
                    break
            self._known = self.poses()

    def rebuild(self) -> None:
        """All measurements in a new tree, from the starting values."""
        poses = {**self.poses(), **self._start}
        self._terms.update(self._new)
        terms = {tag: t for tag, t in self._terms.items() if t}
        self._isam, self._indices, self._terms, self._gone = _isam(), {}, {}, []
        used = {unknown for t in terms.values() for m in t for unknown in m.unknowns}
        self._start = {unknown: pose for unknown, pose in poses.items() if unknown in used}
        self._new = terms
        self.update(settle=True)

    def _again(self, error: RuntimeError) -> None:
        """The tree is of no use after an error: all in a new one; where that fails too, with the next message."""
        poses = {u: p for u, p in self._known.items() if u not in self._start}
        self._start = {**poses, **self._start}
        self._new = {**self._terms, **self._new}
        self._isam, self._indices, self._terms, self._gone = _isam(), {}, {}, []
        if self._failed:
            log.warning("the smoother waits for more measurements: %s", str(error).strip().splitlines()[0])
            return
        self._failed = True
        try:
            self.update(settle=True)
        finally:
            self._failed = False

    # What comes out

    def about(self, unknown: Hashable) -> Array:
        """Where an unknown was when all was settled last, or where it starts: costs nothing."""
        found = self._start.get(unknown)
        return self._known[unknown] if found is None else found

    def pose(self, unknown: Hashable) -> Array:
        """Where an unknown is by now; by itself it costs as much as all of them."""
        if unknown in self._start:
            return self._start[unknown]
        pose = self._isam.calculateEstimatePose2(self.key(unknown))
        return np.array([pose.x(), pose.y(), pose.theta()])

    def poses(self) -> dict[Hashable, Array]:
        """All unknowns in the tree."""
        values = self._isam.calculateEstimate()
        unknown = {key: u for u, key in self._keys.items()}
        keys = list(values.keys())
        return dict(zip([unknown[k] for k in keys], gtsam.utilities.extractPose2(values), strict=True)) if keys else {}

    def covariance(self, unknowns: Sequence[Hashable]) -> Array:
        """Joint covariance (3k, 3k) of some unknowns, in the axes of the frame that they are in."""
        keys = self.keys(unknowns)
        marginal = self._isam.jointMarginalCovariance(keys) if len(keys) > 1 else None
        k = 3 * len(keys)
        C = np.zeros((k, k))
        for m, a in enumerate(keys):
            for n, b in enumerate(keys):
                block = self._isam.marginalCovariance(a) if marginal is None else marginal.at(a, b)
                C[3 * m : 3 * m + 3, 3 * n : 3 * n + 3] = block
        return joint_to_axes(np.array([self.pose(u)[2] for u in unknowns]), C)

    @property
    def size(self) -> int:
        """Number of factors."""
        return sum(len(indices) for indices in self._indices.values())


def _isam() -> Any:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(RELINEARISE)
    params.relinearizeSkip = SKIP
    params.findUnusedFactorSlots = True
    return gtsam.ISAM2(params)
