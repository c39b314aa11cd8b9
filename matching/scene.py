"""Two maps as the compiled loops want them, to match, align and score candidates of T12 with."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import DOOR

from .landmark_arrays import LandmarkArrays, frozen
from .travelled import Travelled

if TYPE_CHECKING:
    from .voting import Pair

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Candidates:
    """T12s (k, 3) and where in frame 2 each is known best (k, 2)."""

    T12s: Array
    centres: Array

    def __len__(self) -> int:
        return len(self.T12s)

    def taken(self, places: Indices) -> Candidates:
        """Some of them."""
        return Candidates(self.T12s.take(places, axis=0), self.centres.take(places, axis=0))


@dataclass(frozen=True, eq=False)
class Assessed:
    """Candidates matched and scored: ``score`` (k,) [nats], ``count`` (k,), ``partner`` (k, n2) in map 1 or -1,
    ``seed`` (k,): landmark of map 2 with the surest match, or -1. ``repetition`` [nats]: what each match is worth less,
    for the building repeats; the score has it already."""

    candidates: Candidates
    score: Array
    count: NDArray[np.int32]
    partner: NDArray[np.int32]
    seed: NDArray[np.int32]
    repetition: float = 0.0

    def followed_by(self, other: Assessed) -> Assessed:
        """Both, one after the other."""
        T12s = np.concatenate([self.candidates.T12s, other.candidates.T12s])
        centres = np.concatenate([self.candidates.centres, other.candidates.centres])
        score, count, partner, seed = (
            np.concatenate([getattr(side, name) for side in (self, other)])
            for name in ("score", "count", "partner", "seed")
        )
        return Assessed(Candidates(T12s, centres), score, count, partner, seed)


@dataclass(frozen=True, eq=False)
class Part:
    """Some of map 2's landmarks, and some of the places where its robot was."""

    side: Any
    seen: Any


class Scene:
    """Both maps as the kernels want them: what a match is worth, what a miss costs, and where the robots were."""

    def __init__(self, pair: Pair) -> None:
        one, two, settings = pair.one, pair.two, pair.settings
        self.pair = pair
        k = pair.kernels
        way1, way2 = one.travelled, two.travelled
        self.linear = way1.has_links and way2.has_links
        rate1, rate2 = one.rates[self.linear], two.rates[self.linear]
        # neighbours in space are neighbours in memory
        self.sorted = max(len(one), len(two)) > settings.sorted
        self.side1 = self._side(one, pair.label1, two)
        self.side2 = self._side(two, pair.label2, one)
        self.faced2 = self._seen_by(two, one), self.linear, self.sorted
        self.by_isolation2 = two.isolation_by_place if self.sorted else two.by_isolation
        void = _void(one, two, rate1, rate2, self.linear) * settings.against
        self.seen1, self.seen2 = (self._seen(way, void) for way in (way1, way2))
        least = one.largest_variance + two.largest_variance
        most = max(least, min(settings.most_sigma_m**2, 16 * least))
        self.rules = k.Rules(
            settings.gate,
            (one.bend + two.bend) * settings.grow,
            most,
            settings.arm,
            settings.contradiction,
            settings.least_gain,
            float(np.hypot(max(one.noise.heading_sigma, 1e-3), max(two.noise.heading_sigma, 1e-3))),
        )
        reach = settings.gate * float(np.sqrt(most))
        shared = pair.label1 is one.label
        self.cells, self.crowd = one.kept(
            # codes that the other map has a say in are another index
            ("cells", reach, self.sorted) if shared else None,
            lambda: _cells(k, self.side1.values, self.side1.label, reach),
        )

    @property
    def cost(self) -> float:
        """How many landmarks are looked at to assess one candidate once."""
        return len(self.pair.two) * max(1.0, min(self.crowd, 256.0) / 3) + len(self.pair.one) / 4

    def _side(self, own: LandmarkArrays, label: NDArray[np.int32], other: LandmarkArrays) -> Any:
        faced = own.facing(self._seen_by(own, other), self.linear, self.sorted)
        values = faced.values
        if not self.pair.settings.against:
            values = frozen(np.column_stack([values[:, :-1], np.zeros(len(own))]))
        if self.sorted:
            label = label[own.by_place]
        return self.pair.kernels.Side(values, faced.arms, frozen(label), faced.linear)

    @staticmethod
    def _seen_by(own: LandmarkArrays, other: LandmarkArrays) -> tuple[float, ...]:
        return tuple(other.noise.detection(name) for name in own.labels)

    def _seen(self, way: Travelled, void: float) -> Any:
        step = way.step if self.linear else 2 * way.step * way.width if way.has_links else way.step**2
        every = -(-len(way.samples) // self.pair.settings.ways) or 1
        samples = way.samples if every == 1 else frozen(way.samples[::every])
        x, y = way.low.tolist()
        return self.pair.kernels.Seen(x, y, 1 / way.size, way.cells, samples, 0.5 * void * step * every)

    def in_map_order(self, found: Assessed, kept: Indices) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """`Assessed.partner` and `Assessed.seed` of some of what was found in the scene's order: places in the maps."""
        if not self.sorted:
            return found.partner[kept], found.seed[kept]
        order1, order2 = self.pair.one.by_place, self.pair.two.by_place
        partner = self.pair.kernels.in_map_order(found.partner, kept, order1, order2)
        return partner, order2[found.seed[kept]].astype(np.int32)

    def part(self, size: int) -> Part:
        """``size`` of map 2's landmarks, evenly by how far each is from the next: wherever, in whatever order."""
        two, ways, share = self.pair.two, self.seen2.samples, min(1.0, size / len(self.pair.two))
        every = max(1, len(ways) // size)

        def make() -> tuple[tuple[NDArray[Any], ...], Array]:
            columns = tuple(self.side2)
            if len(two) > size:
                chosen = np.sort(self.by_isolation2[np.linspace(0, len(two) - 1, size).astype(np.intp)])
                columns = tuple(frozen(values[chosen]) for values in columns)
            return columns, frozen(ways[::every])

        # codes that the other map has a say in make another part, as the measuring of misses does
        own = self.pair.label2 is two.label and self.pair.settings.against
        columns, samples = two.kept(("part", size, len(ways), *self.faced2) if own else None, make)
        void = 2 * self.seen2.void * every * share
        return Part(self.pair.kernels.Side(*columns), self.seen2._replace(samples=samples, void=void))

    def assess(self, candidates: Candidates, looseness: tuple[float, ...], part: Part | None = None) -> Assessed:
        """Candidates matched and aligned in turns, the last of which scores; see the kernel.

        With a ``part`` of map 2 only what that lacks is charged, not what map 1 has more.
        """
        side2, seen2 = (self.side2, self.seen2) if part is None else (part.side, part.seen)

        if not self.pair.settings.refine:
            looseness = (0.0,)

        def run(few: Candidates) -> Any:
            return self.pair.kernels.assess(
                few.T12s, few.centres, np.array(looseness), part is None,
                self.side1, side2, self.cells, self.seen1, seen2, self.rules,
            )  # fmt: skip

        n_parts = min(self.pair.config.threads, len(candidates))
        jobs = [candidates]
        if n_parts > 1:
            jobs = [candidates.taken(c) for c in np.array_split(np.arange(len(candidates)), n_parts)]
        T12s, centres, score, count, partner, seed = (
            np.concatenate(column) if len(column) > 1 else column[0]
            for column in zip(*self.pair.each(run, jobs), strict=True)
        )
        return Assessed(Candidates(T12s, centres), score, count, partner, seed)


def _void(one: LandmarkArrays, two: LandmarkArrays, rate1: Array, rate2: Array, linear: bool) -> float:
    """What a metre of corridor (or a square metre) says [nats] on which both have been."""
    total = 0.0
    for k1, label in enumerate(one.labels):
        if label in two.labels:
            k2 = two.labels.index(label)
            armed = label in ("corner", "junction", DOOR)
            if armed or not linear:
                both = one.noise.detection(label) * two.noise.detection(label)
                total += float(np.sqrt(rate1[k1] * rate2[k2])) * both
    return total


def _cells(k: ModuleType, xy: Array, label: NDArray[np.int32], size: float) -> tuple[Any, float]:
    """Points in cells as large as the widest gate, four million of them at most, and how many an occupied one lists."""
    low, high = xy[:, :2].min(axis=0), xy[:, :2].max(axis=0)
    extent = high - low
    size = max(size, 1e-6, float(extent.max()) / 4000, float(np.sqrt(extent.prod() / 4_000_000)))
    low = low - 2 * size
    nx, ny = (int(e / size) + 5 for e in extent.tolist())
    layers = int(max(1, min(int(label.max()) + 1, 4_000_000 // (nx * ny))))
    start, members = k.sorted_into_cells(xy, label, 1 / size, nx, ny, layers, float(low[0]), float(low[1]))
    crowd = len(members) / max(1, int(np.count_nonzero(np.diff(start))))
    return k.Cells(float(low[0]), float(low[1]), 1 / size, nx, ny, layers, start, members), crowd
