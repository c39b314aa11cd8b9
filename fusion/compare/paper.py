"""Table 1 of Dedeoglu and Sukhatme (2000), with our paper mode and the optimised merge on the **reconstruction**."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mapfuse.datasets import read_map, recordings
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.paper import TABLE_1, Combination
from mapfuse.datasets.truth import Truth, read_truth

from ..config import DecisionConfig, FuseConfig
from .evaluation import Evaluation
from .method import Method
from .methods import HEURISTIC, OPTIMISED
from .methods import methods as all_methods
from .run import compare_pair

#: Both maps of each row are of one floor, and that is told.
OVERLAP_PRIOR = 0.99
#: Rows whose maps both have that many landmarks can be decided; of smaller maps honest evidence often can't.
LARGE = 6


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A row of Table 1 with what our methods make of the reconstructed maps, by method's name."""

    paper: Combination
    sizes: tuple[int, int]
    ours: Mapping[str, Evaluation]

    @property
    def large(self) -> bool:
        """Whether both maps have `LARGE` landmarks or more."""
        return min(self.sizes) >= LARGE


def paper_config() -> FuseConfig:
    """The parameters of the comparison: all by default, but that both maps are known to be of one floor."""
    return FuseConfig(decision=DecisionConfig(overlap_prior=OVERLAP_PRIOR))


def paper_maps() -> tuple[dict[str, LandmarkMap], Truth]:
    """The reconstruction of D1 to D19 by name, and its truth."""
    maps = {name: read_map(recordings.path(name)) for name in recordings.PAPER_MAPS}
    return maps, read_truth(recordings.truth_path("paper"))


def paper_rows(
    methods: Sequence[Method] | None = None, advance: Callable[[float], None] = lambda _: None
) -> tuple[PaperRow, ...]:
    """All rows of Table 1; by default of the heuristic and the optimised merge. ``advance``: told of each row."""
    methods = all_methods((HEURISTIC, OPTIMISED), paper_config()) if methods is None else methods
    maps, truth = paper_maps()
    rows = []
    for combination in TABLE_1:
        map1, map2 = (maps[name] for name in combination.pair)
        found = compare_pair(map1, map2, methods, truth)
        rows.append(PaperRow(combination, (len(map1), len(map2)), {e.method: e for e in found}))
        advance(1)
    return tuple(rows)
