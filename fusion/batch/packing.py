"""What goes to workers and into the ledger as bytes (msgpack, never a pickle), and back without losing a digit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.jsondata import encode
from mapfuse.datasets.mapfile import check_map, map_to_dict
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from ..config import FuseConfig
from ..consistent import Choice
from ..evidence import Terms
from ..pairwise import Candidate, Comparison
from ..placing import Pair
from ..result import PairDecision

#: Raised with every change of how answers are packed: those of a ledger packed otherwise are worked out again.
PACKING = 4

Array = NDArray[np.float64]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is never packed")


_pack = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_unpack = msgspec.msgpack.Decoder().decode


def map_bytes(recorded: LandmarkMap) -> bytes:
    """A map as its file holds it; equal maps give the same bytes."""
    return encode(map_to_dict(recorded))


def map_from_bytes(data: bytes) -> LandmarkMap:
    """The map of `map_bytes`; what its arms contradict was said when its file was read."""
    read, problems = check_map(msgspec.json.decode(data))
    assert read is not None, problems
    return read


def config_bytes(config: FuseConfig) -> bytes:
    """All parameters; equal ones give the same bytes."""
    return _pack(asdict(config))


def config_from_bytes(data: bytes) -> FuseConfig:
    """The parameters of `config_bytes`."""
    return FuseConfig.from_dict(_unpack(data))


def comparison_bytes(comparison: Comparison) -> bytes:
    """A comparison without its solved graph.

    >>> none = np.zeros(0)
    >>> one = Comparison(("A", "B"), (), none, none, 1.0, "no_overlap", ("why", "why"), np.ones(2), np.ones(1))
    >>> comparison_from_bytes(comparison_bytes(one)).rates1.tolist()
    [1.0, 1.0]
    """
    return _pack(
        {
            "maps": comparison.maps,
            "candidates": [_candidate(c) for c in comparison.candidates],
            "probabilities": comparison.probabilities.tolist(),
            "weights": comparison.weights.tolist(),
            "no_overlap": comparison.no_overlap,
            "decision": comparison.decision,
            "reasons": comparison.reasons,
            "rates1": comparison.rates1.tolist(),
            "rates2": comparison.rates2.tolist(),
        }
    )


def _candidate(candidate: Candidate) -> list[Any]:
    return [
        transform_list(candidate.T12),
        candidate.matches,
        asdict(candidate.terms),
        [candidate.missed1, candidate.missed2, candidate.through1, candidate.through2],
        candidate.alike,
    ]


def transform_list(T: Transform) -> list[Any]:
    """A transformation as plain numbers."""
    return [T.x, T.y, T.theta, None if T.covariance is None else T.covariance.tolist()]


def _transform(record: Sequence[Any]) -> Transform:
    x, y, theta, covariance = record
    return Transform(x, y, theta, None if covariance is None else np.array(covariance))


def _candidate_from(T: Any, matches: Any, terms: Any, passed: Any, alike: float) -> Candidate:
    missed1, missed2, through1, through2 = map(tuple, passed)
    pairs = tuple((i, j) for i, j in matches)
    return Candidate(_transform(T), pairs, Terms(**terms), missed1, missed2, through1, through2, alike)


def comparison_from_bytes(data: bytes) -> Comparison:
    """The comparison of `comparison_bytes`."""
    record = _unpack(data)
    candidates = tuple(_candidate_from(*candidate) for candidate in record["candidates"])
    return Comparison(
        maps=(record["maps"][0], record["maps"][1]),
        candidates=candidates,
        probabilities=np.array(record["probabilities"], dtype=float),
        weights=np.array(record["weights"], dtype=float),
        no_overlap=record["no_overlap"],
        decision=record["decision"],
        reasons=(record["reasons"][0], record["reasons"][1]),
        rates1=np.array(record["rates1"], dtype=float),
        rates2=np.array(record["rates2"], dtype=float),
    )


class _Decision(msgspec.Struct):
    decision: PairDecision


_decision = msgspec.msgpack.Decoder(_Decision).decode


def decision_of(data: bytes) -> PairDecision:
    """The decision in `comparison_bytes`, without reading all of it."""
    return _decision(data).decision


@dataclass(frozen=True, eq=False, slots=True)
class PairJob:
    """Two maps to compare, as `map_bytes`, and `config_bytes`."""

    config: bytes
    map1: bytes
    map2: bytes

    def to_bytes(self) -> bytes:
        """For `from_bytes` elsewhere."""
        return _pack([self.config, self.map1, self.map2])

    @classmethod
    def from_bytes(cls, data: bytes) -> PairJob:
        """What `to_bytes` gave."""
        return cls(*_unpack(data))


@dataclass(frozen=True, eq=False, slots=True)
class GroupJob:
    """A group to solve: its maps by name in alphabetical order, their comparisons, and what was chosen of these.

    ``final``: what its graph takes apart is reported as it is, and not chosen again.
    """

    config: bytes
    maps: tuple[bytes, ...]
    comparisons: tuple[bytes, ...]
    choice: Choice
    final: bool

    def to_bytes(self) -> bytes:
        """For `from_bytes` elsewhere."""
        choice = self.choice
        (names,) = choice.groups
        record = {
            "names": names,
            "frames": {name: transform_list(choice.frames[name]) for name in names},
            "chosen": [[*pair, k] for pair, k in sorted(choice.chosen.items())],
            "overruled": [[*pair, cycle] for pair, cycle in sorted(choice.overruled.items())],
            "probability": choice.probability[0],
        }
        return _pack([self.config, self.maps, self.comparisons, record, self.final])

    @classmethod
    def from_bytes(cls, data: bytes) -> GroupJob:
        """What `to_bytes` gave."""
        config, maps, comparisons, record, final = _unpack(data)
        choice = Choice(
            groups=(tuple(record["names"]),),
            frames={name: _transform(T) for name, T in record["frames"].items()},
            chosen={(a, b): k for a, b, k in record["chosen"]},
            overruled={(a, b): tuple(cycle) for a, b, cycle in record["overruled"]},
            probability=(record["probability"],),
        )
        return cls(config, tuple(maps), tuple(comparisons), choice, final)


@dataclass(frozen=True, eq=False, slots=True)
class GroupAnswer:
    """A solved group's file ``fused``; or, where its graph doesn't bear out what was chosen, what it takes apart."""

    fused: bytes | None
    broken: tuple[tuple[Pair, int], ...] = ()

    def to_bytes(self) -> bytes:
        """For `from_bytes` elsewhere."""
        return _pack([self.fused, [[*pair, k] for pair, k in self.broken]])

    @classmethod
    def from_bytes(cls, data: bytes) -> GroupAnswer:
        """What `to_bytes` gave."""
        fused, broken = _unpack(data)
        return cls(fused, tuple(((a, b), k) for a, b, k in broken))


def part_of(choice: Choice, number: int, comparisons: Mapping[Pair, Comparison]) -> Choice:
    """One group of a choice by itself."""
    names = choice.groups[number]
    inside = {pair for pair in comparisons if pair[0] in names and pair[1] in names}
    return Choice(
        (names,),
        {name: choice.frames[name] for name in names},
        {pair: k for pair, k in choice.chosen.items() if pair in inside},
        {pair: cycle for pair, cycle in choice.overruled.items() if pair in inside},
        (choice.probability[number],),
    )
