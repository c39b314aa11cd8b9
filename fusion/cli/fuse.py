"""``mapfuse fuse``: recorded maps into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import UsageError, check_outputs, check_picture, note, say, say_bytes, warn_on_stderr, writing

if TYPE_CHECKING:
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.fusion import FuseConfig, FusedMap


class Mode(StrEnum):
    """How hypotheses are proposed."""

    default = "default"
    paper = "paper"


def fuse_files(
    maps: Annotated[
        list[Path],
        typer.Argument(
            help="Recorded maps (NAME.map.json), or results (NAME.fused.json), for the maps in them.", metavar="MAP"
        ),
    ],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The result, OUT.fused.json.", show_default=False)
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="A picture of the result: .png, .svg, .pdf.")] = None,
    merged_map: Annotated[
        Path | None, typer.Option("--map", help="The merged map as a map again, OUT.map.json.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The result file on standard output.")] = False,
    no_embed: Annotated[bool, typer.Option("--no-embed", help="Leave the input maps out of the result file.")] = False,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="NAME", help="Leave out the map of this name; repeatable.")
    ] = None,
    require_merge: Annotated[
        bool, typer.Option("--require-merge", help="Exit with 3 where not all maps were merged.")
    ] = False,
    accept: Annotated[
        float | None,
        typer.Option("--accept", metavar="P", help="Merge from this probability on (default 0.99)."),
    ] = None,
    overlap_prior: Annotated[
        float | None,
        typer.Option("--overlap-prior", metavar="P", help="Probability, before looking, of overlap (0.5)."),
    ] = None,
    mode: Annotated[Mode | None, typer.Option("--mode", help="How hypotheses are proposed.")] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Parameters; see `mapfuse config`.")
    ] = None,
) -> None:
    """Fuse recorded maps, whose relative start is unknown, and say how sure the answer is.

    Exit code 0 whatever was decided: "no overlap" is an answer.
    """
    if len(maps) < 2 and not _is_result(maps[0]):
        raise UsageError("give at least two maps to fuse")
    check_picture("--plot", plot)
    check_outputs({"-o": output, "--plot": plot, "--map": merged_map}, [*maps, *([config] if config else [])])
    warn_on_stderr()
    settings = _settings(config, accept, overlap_prior, mode)
    recorded = _left(read_maps(maps), without or ())

    from mapfuse.fusion import fuse

    fused = fuse(recorded, settings)
    _write(fused, output, plot, merged_map, as_json=as_json, embed=not no_embed)
    if require_merge and fused.decision != "merged":
        raise typer.Exit(3)


def _settings(config: Path | None, accept: float | None, overlap_prior: float | None, mode: Mode | None) -> FuseConfig:
    from mapfuse.fusion.config import FuseConfig

    settings = FuseConfig()
    if config is not None:
        from .parameters import config_from_toml

        settings = config_from_toml(config)
    if accept is not None:
        settings = replace(settings, decision=replace(settings.decision, accept=accept))
    if overlap_prior is not None:
        settings = replace(settings, decision=replace(settings.decision, overlap_prior=overlap_prior))
    if mode is not None:
        settings = replace(settings, matching=replace(settings.matching, mode=mode.value))
    return settings


def _left(maps: Sequence[LandmarkMap], without: Sequence[str]) -> list[LandmarkMap]:
    """The maps that are not left out; raises `UsageError` for a name that none has, and where none is left."""
    names = [m.name for m in maps]
    if unknown := [name for name in without if name not in names]:
        raise UsageError(f"--without {unknown[0]}: there is no such map; there are {', '.join(names)}")
    left = [m for m in maps if m.name not in without]
    if not left:
        raise UsageError("--without leaves no map")
    return left


def _is_result(path: Path) -> bool:
    return path.name.endswith(".fused.json")


def _maps_in(path: Path) -> list[LandmarkMap]:
    """The map of a file, or all maps that were fused into a result."""
    from mapfuse.datasets import read_map
    from mapfuse.datasets.errors import InputError

    if not _is_result(path):
        return [read_map(path)]
    from mapfuse.fusion import read_fused

    fused = read_fused(path)
    if missing := [name for name in fused.maps if name not in fused.sources]:
        raise InputError(path, f"doesn't carry the map {missing[0]!r} (it was written with --no-embed)")
    return [fused.sources[name] for name in fused.maps]


def read_maps(paths: Sequence[Path]) -> list[LandmarkMap]:
    """Read maps; raises `UsageError` with the errors of all files, or where two maps have one name."""
    from mapfuse.datasets.errors import MapfuseError

    maps: list[tuple[Path, LandmarkMap]] = []
    wrong: list[str] = []
    for path in paths:
        try:
            maps += [(path, m) for m in _maps_in(path)]
        except MapfuseError as error:
            wrong.append(str(error))
    if wrong:
        raise UsageError("\n".join(wrong))
    path_from_name: dict[str, Path] = {}
    for path, map_ in maps:
        if map_.name in path_from_name:
            raise UsageError(
                f"{path_from_name[map_.name]} and {path}: both maps are named {map_.name!r}; "
                "names tell maps apart, so give them different ones"
            )
        path_from_name[map_.name] = path
    return [m for _, m in maps]


def _write(
    fused: FusedMap, output: Path | None, plot: Path | None, merged_map: Path | None, *, as_json: bool, embed: bool
) -> None:
    from mapfuse.datasets import write_map
    from mapfuse.fusion import write_fused

    one_frame = fused.decision == "merged"
    if output is not None:
        write_fused(fused, output, embed)
    if plot is not None:
        from mapfuse.fusion.show import draw_fused

        with writing(plot):
            draw_fused(fused, plot)
    if merged_map is not None and one_frame:
        write_map(fused.to_map(), merged_map)
    if as_json:
        from mapfuse.datasets.jsondata import encode
        from mapfuse.fusion.fusedfile import fused_to_dict

        say_bytes(encode(fused_to_dict(fused, embed)))
    else:
        from .summary import summarise

        say(summarise(fused))
        for path in (output, plot, merged_map if one_frame else None):
            if path is not None:
                say(f"wrote {path}")
    if merged_map is not None and not one_frame:
        note(f"{merged_map} was not written: the maps were not merged")
