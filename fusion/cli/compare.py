"""``mapfuse compare``: heuristic and optimised merges side by side, on a folder of maps or on the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap
from .console import Quiet, UsageError, Verbose, note, say, warn_on_stderr

if TYPE_CHECKING:
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.datasets.truth import Truth
    from mapfuse.fusion.compare import Method
    from mapfuse.fusion.config import FuseConfig

Pair = tuple[str, str]
#: Rows of pairs that are shown on the terminal; the table's file holds all of them.
_SHOWN = 60


def compare(
    folder: Annotated[
        Path | None,
        typer.Argument(help="Folder of recorded maps, in any format.", metavar="DIR", show_default=False),
    ] = None,
    *,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="What is really so: mapfuse.truth/1.")
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option("--pairs", metavar="FILE", help="The pairs to compare, two maps' names a line (default: all)."),
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Table 1 and the figures of Dedeoglu and Sukhatme, on a reconstruction.")
    ] = False,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="The folder to write into.")] = Path(
        "mapfuse-compare"
    ),
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="heuristic, kalman, ransac, icp or optimised; repeatable (default: all). The first one is what"
            " matches are gained and lost against.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Seed of the bootstrap.")] = 0,
    overlap_prior: Annotated[
        float | None,
        typer.Option("--overlap-prior", metavar="P", help="Probability of overlap before looking."),
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Parameters; see `mapfuse config`.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Merge pairs of maps by the paper's heuristic, by others, and optimised, and say which is better by how much.

    Writes pairs.csv, pairs.parquet, summary.csv and compare.html; with --paper table-1.csv, the paper's figures as PNG
    and SVG, and compare.html.
    """
    if paper and (folder is not None or truth is not None or pairs is not None or method or config is not None
                  or overlap_prior is not None or given):  # fmt: skip
        raise UsageError(
            "--paper brings its own maps, truth, pairs, methods and parameters; only -o and --seed go with it"
        )
    if not paper and folder is None:
        raise UsageError("give a folder of maps, or --paper")
    warn_on_stderr(verbose=verbose)
    if paper or folder is None:
        from .compare_paper import compare_paper

        _make(output)
        compare_paper(output, seed, quiet=quiet)
        return
    settings = _settings(config, overlap_prior)
    from mapfuse.fusion.compare import METHODS, all_pairs, methods

    chosen = methods(method or METHODS, settings)
    maps = _maps(folder, anymap.options(given or []))
    wanted = all_pairs(maps) if pairs is None else _pairs(pairs, maps)
    known = None if truth is None else _truth(truth, {name for pair in wanted for name in pair}, maps)
    _make(output)
    _compare(maps, wanted, chosen, known, output, folder, seed, quiet=quiet)


def _settings(config: Path | None, overlap_prior: float | None) -> FuseConfig:
    from dataclasses import replace

    from mapfuse.fusion.config import FuseConfig

    settings = FuseConfig()
    if config is not None:
        from .parameters import config_from_toml

        settings = config_from_toml(config)
    if overlap_prior is None:
        return settings
    return replace(settings, decision=replace(settings.decision, overlap_prior=overlap_prior))


def _make(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"-o {output}: {error.strerror or error}") from error


def _maps(folder: Path, told: dict[str, str]) -> dict[str, LandmarkMap]:
    """All maps of a folder by name; what can't be read is said, and left out."""
    from mapfuse.fusion.batch.folder import read_folder

    maps: dict[str, LandmarkMap] = {}
    where: dict[str, str] = {}
    for path, found in read_folder(folder, told=told):
        if isinstance(found, str):
            note(f"mapfuse: warning: left out: {found}")
        elif found.name in maps:
            raise UsageError(f"{folder}: {where[found.name]} and {path} are both named {found.name!r}")
        else:
            maps[found.name], where[found.name] = found, path
    if len(maps) < 2:
        raise UsageError(f"{folder}: holds {len(maps)} maps that can be read; two are needed to compare")
    return maps


def _pairs(path: Path, maps: dict[str, LandmarkMap]) -> tuple[Pair, ...]:
    """Two names a line, separated by a comma or white space; empty lines and those that begin with # say nothing."""
    from mapfuse.datasets.errors import FileFormatError, Problem
    from mapfuse.datasets.files import read_whole

    try:
        lines = read_whole(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(path, (Problem(f"byte {error.start}", "is not UTF-8"),)) from None
    found: list[Pair] = []
    problems = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        names = [name.strip() for name in line.split(",")] if "," in line else line.split()
        unknown = [name for name in names if name not in maps]
        if len(names) != 2:
            problems.append(Problem(f"line {number}", f"must hold two maps' names, not {len(names)}"))
        elif unknown:
            problems.append(Problem(f"line {number}", f"names {unknown[0]!r}, which is none of the maps"))
        elif names[0] == names[1]:
            problems.append(Problem(f"line {number}", f"names {names[0]!r} twice"))
        else:
            found.append((names[0], names[1]))
    if not found and not problems:
        problems.append(Problem("", "names no pair"))
    if problems:
        raise FileFormatError(path, tuple(problems))
    return tuple(found)


def _truth(path: Path, names: set[str], maps: dict[str, LandmarkMap]) -> Truth:
    """The truth in a file, which must know the maps that are compared and all their landmarks."""
    from mapfuse.datasets.errors import FileFormatError, Problem
    from mapfuse.datasets.truth import read_truth

    truth = read_truth(path)
    problems = []
    for name in sorted(names):
        if name not in truth.frames or name not in truth.landmarks:
            problems.append(Problem("frames", f"doesn't know the map {name!r}"))
            continue
        missing = [i for i in maps[name].ids if i not in truth.landmarks[name]]
        if missing:
            problems.append(Problem(f"landmarks.{name}", f"doesn't say what {missing[0]!r} is"))
    if problems:
        raise FileFormatError(path, tuple(problems))
    return truth


def _compare(
    maps: dict[str, LandmarkMap],
    pairs: Sequence[Pair],
    methods: Sequence[Method],
    truth: Truth | None,
    output: Path,
    folder: Path,
    seed: int,
    *,
    quiet: bool,
) -> None:
    from mapfuse.fusion.batch.table import write_csv, write_parquet
    from mapfuse.fusion.compare import compare as compared
    from mapfuse.fusion.compare import paired, sheets, summaries, table
    from mapfuse.fusion.report import compare_report

    from .progress import progress

    for m in methods:
        if m.missing and not quiet:
            note(f"mapfuse: {m.title} is left out: {m.missing}")
    able = [m for m in methods if not m.missing]
    if not able:
        raise UsageError("none of these methods can run here")
    if quiet:
        found = compared(maps, pairs, able, truth)
    else:
        with progress("pairs compared", len(pairs)) as advance:
            found = compared(maps, pairs, able, truth, advance)
    sums = summaries(found, seed)
    shown = [sheets.summary_sheet(sums)]
    if truth is not None:
        shown.append(sheets.paired_sheet([t for m in able[1:] for t in paired(found, able[0].name, m.name, seed)]))
    every = sheets.pair_sheet(found)
    write_csv(output / "pairs.csv", table.PAIR_COLUMNS, table.pair_rows(found))
    written = ["pairs.csv"]
    if write_parquet(output / "pairs.parquet", table.pair_rows(found), table.PAIR_COLUMNS, table.kind_of):
        written.append("pairs.parquet")
    else:
        note("mapfuse: pairs.parquet is left out: pyarrow isn't installed; it comes with mapfuse[parquet]")
    write_csv(output / "summary.csv", table.SUMMARY_COLUMNS, table.summary_rows(sums))
    sentence = f"{len(pairs)} pair{'' if len(pairs) == 1 else 's'} of maps, merged by {len(able)} methods."
    compare_report(f"Comparison of {folder.resolve().name}", sentence, [*shown, every], output / "compare.html")
    if quiet:
        return
    if len(every.rows) <= _SHOWN:
        say(every.text() + "\n")
    for sheet in shown:
        say(sheet.text() + "\n")
    say(f"wrote {', '.join(str(output / name) for name in (*written, 'summary.csv', 'compare.html'))}")
