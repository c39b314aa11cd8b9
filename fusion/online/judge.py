"""`Judge`: maps to a `FusedMap`, again and again while they grow; what didn't change isn't compared again.

It is the way of `mapfuse.fusion.fuse`, so that for the same maps the answer is the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

from mapfuse.datasets.maps import LandmarkMap

from ..assemble import assembled
from ..config import FuseConfig
from ..far import middle, put_back, shifted
from ..groups import check_maps, prepared_for
from ..members import Emptiness
from ..pairresult import mixture
from ..pairwise import Comparison, compare
from ..prepared import PreparedMap
from ..result import FusedMap
from ..settle import settled


class Judge:
    """Compares the maps that it is given with all it has, and answers for all of them.

    >>> from mapfuse.datasets import read_map, recordings
    >>> names = ("ground-floor-vespucci", "ground-floor-milka")
    >>> judge = Judge(FuseConfig())
    >>> judge.weigh({name: read_map(recordings.path(name)) for name in names}).decision
    'merged'
    """

    def __init__(self, config: FuseConfig) -> None:
        self.config = config
        self.maps: dict[str, LandmarkMap] = {}
        self._prepared: dict[str, PreparedMap] = {}
        self._comparisons: dict[tuple[str, str], Comparison] = {}

    def weigh(self, changed: Mapping[str, LandmarkMap], *, covariances: bool = True) -> FusedMap:
        """The answer, given these maps, by name, instead of what it had of them; names keep the order they came in.

        ``covariances``: with the joint covariance of each group's landmarks.

        Raises `MapError` for a map that breaks a rule of the format, and then keeps all as it was.
        """
        check_maps(tuple(changed.values()))
        near = {name: shifted(m, middle(m)) for name, m in changed.items()}
        prepared = {name: prepared_for(m, self.config) for name, m in near.items()}
        self.maps |= changed
        self._prepared |= prepared
        pairs = list(combinations(sorted(self.maps), 2))
        for a, b in pairs:
            if a in changed or b in changed:
                kept = len(pairs) == 1
                found = compare(self._prepared[a], self._prepared[b], self.config, keep_solution=kept)
                self._comparisons[a, b] = found
        emptiness = Emptiness(self._prepared, self.config.evidence)
        in_order = {name: self._prepared[name] for name in self.maps}
        comparisons = {pair: self._comparisons[pair] for pair in pairs}
        choice, joints = settled(in_order, comparisons, self.config, emptiness.against)
        provenance: dict[str, Any] = {}
        fused = assembled(in_order, comparisons, choice, joints, emptiness, self.config.solving, provenance)
        maps = tuple(self.maps.values())
        fused = replace(fused, sources=dict(self.maps))
        if not covariances:
            fused = replace(fused, joint_covariances=(None,) * len(fused.groups))
        return put_back(fused, maps, {name: middle(m) for name, m in self.maps.items()}, mixture)
