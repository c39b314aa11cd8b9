"""What a worker does, from bytes to bytes: compare two maps, solve a group. No state but what saves doing it twice."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from mapfuse.datasets.jsondata import encode
from mapfuse.datasets.maps import LandmarkMap

from ..assemble import assembled
from ..far import middle, put_back, shifted
from ..fusedfile import fused_from_dict, fused_to_dict
from ..groups import check_maps, prepared_for, provenance_of
from ..members import Emptiness
from ..pairresult import mixture
from ..pairwise import compare
from ..prepared import PreparedMap
from ..settle import broken_candidates, joint_of
from .packing import (
    GroupAnswer,
    GroupJob,
    PairJob,
    comparison_bytes,
    comparison_from_bytes,
    config_from_bytes,
    map_from_bytes,
)

#: Prepared maps that a worker keeps: jobs come in an order in which one map is compared with many.
KEPT_MAPS = 256


def compare_maps(job: bytes) -> bytes:
    """`PairJob` to `comparison_bytes`."""
    pair = PairJob.from_bytes(job)
    config = config_from_bytes(pair.config)
    return comparison_bytes(compare(prepared_map(pair.map1, pair.config), prepared_map(pair.map2, pair.config), config))


def solve_group(job: bytes) -> bytes:
    """`GroupJob` to `GroupAnswer`."""
    group = GroupJob.from_bytes(job)
    config = config_from_bytes(group.config)
    recorded = [map_from_bytes(data) for data in group.maps]
    prepared = {m.name: prepared_map(data, group.config) for m, data in zip(recorded, group.maps, strict=True)}
    comparisons = {c.maps: c for c in map(comparison_from_bytes, group.comparisons)}
    (names,) = group.choice.groups
    joints = {}
    if len(names) > 1:
        joints[names] = joint_of(names, prepared, comparisons, group.choice, config)
        broken = broken_candidates(names, joints[names], comparisons, group.choice)
        if broken and not group.final:
            return GroupAnswer(None, tuple(broken)).to_bytes()
    emptiness = Emptiness(prepared, config.evidence)
    provenance = provenance_of(recorded, config)
    near = assembled(prepared, comparisons, group.choice, joints, emptiness, config.solving, provenance)
    fused = put_back(near, recorded, {m.name: middle(m) for m in recorded}, mixture)
    return GroupAnswer(encode(fused_to_dict(fused))).to_bytes()


def draw_group(answer: bytes) -> bytes:
    """`GroupAnswer` to a picture (PNG)."""
    from ..show import draw_fused

    fused = GroupAnswer.from_bytes(answer).fused
    assert fused is not None
    with TemporaryDirectory() as folder:
        picture = Path(folder) / "group.png"
        draw_fused(fused_from_dict(msgspec.json.decode(fused)), picture)
        return picture.read_bytes()


@lru_cache(maxsize=KEPT_MAPS)
def prepared_map(data: bytes, config: bytes) -> PreparedMap:
    """A map of `map_bytes` prepared around its middle, once for many comparisons."""
    return prepared_for(_checked(map_from_bytes(data)), config_from_bytes(config))


def _checked(recorded: LandmarkMap) -> LandmarkMap:
    check_maps([recorded])
    return shifted(recorded, middle(recorded))
