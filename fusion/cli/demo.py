"""``mapfuse demo``: the built-in recordings fused, with pictures, in one go."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import Quiet, UsageError, log_levels, teller, writing
from .progress import stages

if TYPE_CHECKING:
    from mapfuse.datasets.maps import LandmarkMap


@dataclass(frozen=True, slots=True)
class Case:
    """One pair of maps: its name in the folder, what it is, and how to get it."""

    name: str
    about: str
    load: Callable[[], Sequence[LandmarkMap]]


def _built_in(scene: str) -> Callable[[], Sequence[LandmarkMap]]:
    def load() -> Sequence[LandmarkMap]:
        from mapfuse.datasets import read_map, recordings

        return [read_map(recordings.path(name)) for name in recordings.SCENES[scene]]

    return load


def _victoria_park() -> Sequence[LandmarkMap]:
    from mapfuse.datasets.victoria_park import victoria_park_halves

    return victoria_park_halves()[:2]


CASES = (
    Case(
        "ground-floor",
        "simulated: one corridor floor that two robots explored, the second one half of it",
        _built_in("ground-floor"),
    ),
    Case(
        "two-buildings",
        "simulated: two different buildings of one style, which must not be merged",
        _built_in("two-buildings"),
    ),
    Case(
        "victoria-park",
        "cut from one real drive (Victoria Park, from GTSAM's examples): its halves as two robots",
        _victoria_park,
    ),
)


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="The folder to write into.")] = Path(
        "mapfuse-demo"
    ),
    *,
    quiet: Quiet = False,
) -> None:
    """Fuse the built-in recordings; write maps, results and pictures into a folder, and say what each is."""
    import logging

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"-o {output}: {error.strerror or error}") from error
    # what is odd in these maps is known and meant; that the first run compiles isn't
    with log_levels(mapfuse=logging.ERROR, matching=logging.WARNING):
        for case in CASES:
            _run(case, output, quiet=quiet)
    teller(quiet=quiet)(f"Pictures, results and maps are in {output}")


def _run(case: Case, folder: Path, *, quiet: bool) -> None:
    from mapfuse.datasets import write_map
    from mapfuse.fusion import fuse, write_fused
    from mapfuse.fusion.show import draw_fused

    from .summary import summarise

    maps = case.load()
    with stages(f"fusing {case.name}", quiet=quiet):
        fused = fuse(maps)
    recorded = [folder / f"{map_.name}.map.json" for map_ in maps]
    result, picture = folder / f"{case.name}.fused.json", folder / f"{case.name}.png"
    for path, map_ in zip(recorded, maps, strict=True):
        write_map(map_, path)
    write_fused(fused, result)
    with writing(picture):
        draw_fused(fused, picture)
    teller(quiet=quiet)(f"{case.name} ({case.about})\n{summarise(fused)}\n  wrote {result}, {picture}\n")
