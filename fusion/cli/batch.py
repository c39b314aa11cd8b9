"""``mapfuse batch``: a folder of recorded maps into groups."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap
from .console import Quiet, UsageError, Verbose, check_outputs, check_page, note, say, warn_on_stderr

if TYPE_CHECKING:
    from mapfuse.fusion.batch.engine import Engine
    from mapfuse.fusion.batch.run import Summary

#: Failures that are shown; the run's tables name all of them.
_SHOWN = 20


def batch(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of recorded maps, in any format that `mapfuse formats` lists.",
            metavar="DIR",
            show_default=False,
        ),
    ] = None,
    *,
    run: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the run, RUN/.", show_default=False)
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, metavar="N", help="Worker processes (default: one per processor).")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Work on dask: tcp://HOST:PORT of a scheduler, or `local` for workers of its own.",
        ),
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Say how far a run has come; starts nothing.")] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit with 2 where a file, a pair or a group failed.")
    ] = False,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="MAP", help="Leave out the map of this name; repeatable.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="A page of the whole run for a browser, OUT.html.")
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Parameters; see `mapfuse config`.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fuse a folder of recorded maps: all promising pairs, then all groups.

    Start it again after any stop: what is done is not done again. Maps that were changed or added since extend the
    run. A file that can't be read or a pair that fails is reported, and everything else goes on.
    """
    if status:
        _status(run or folder)
        return
    if folder is None or run is None:
        raise UsageError("give a folder of maps and, with -o, the folder of the run")
    check_page("--report", report)
    if report is not None and report.parent.resolve() != run.resolve():  # the run's own folder is made later
        check_outputs({"--report": report})
    told = anymap.options(given or [])
    warn_on_stderr(verbose=verbose)

    from mapfuse.fusion.batch.run import run_batch
    from mapfuse.fusion.batch.steps import unwatched
    from mapfuse.fusion.config import FuseConfig

    settings = FuseConfig()
    if config is not None:
        from .parameters import config_from_toml

        settings = config_from_toml(config)
    from .progress import progress

    with closing(_engine(jobs, scheduler)) as engine:
        watch = unwatched if quiet else progress
        summary = run_batch(folder, run, settings, engine, without=without or (), told=told, watch=watch)
    if report is not None:
        from mapfuse.fusion.report import batch_report

        batch_report(run, report)
    if not quiet and set(summary.taken) - {"map"}:
        note(f"{folder}: {anymap.files_taken_for(summary.taken)}")
    _complain(summary, run)
    if not quiet:
        _say(summary, run, report)
    if strict and not summary.flawless:
        raise typer.Exit(2)


def _engine(jobs: int | None, scheduler: str | None) -> Engine:
    count = jobs or os.cpu_count() or 1
    if scheduler is None:
        from mapfuse.fusion.batch.engine import LocalEngine

        return LocalEngine(count)
    from mapfuse.fusion.batch.cluster import DaskEngine

    return DaskEngine(None if scheduler == "local" else scheduler, count)


def _status(run: Path | None) -> None:
    if run is None:
        raise UsageError("give the folder of the run")
    from mapfuse.fusion.batch.run import status

    s = status(run)
    say(f"{s.maps} maps, {s.unreadable} unreadable files")
    share = f", {100 * s.done / s.pairs:.1f} %" if s.pairs else ""
    say(f"{s.done} of {s.pairs} pairs done{share}, {s.failed} of them failed; {s.seconds:.0f} s of work")
    say("finished: its files are written" if s.finished else "not finished; the same command goes on with it")


def _complain(summary: Summary, run: Path) -> None:
    for problem in summary.problems[:_SHOWN]:
        note(f"failed: {problem}")
    if len(summary.problems) > _SHOWN:
        note(f"and {len(summary.problems) - _SHOWN} more; {run / 'pairs.csv'} and {run / 'maps.csv'} name all")


def _say(summary: Summary, run: Path, report: Path | None) -> None:
    alone = summary.maps - summary.grouped
    say(
        f"{summary.maps} maps: {summary.grouped} in {summary.groups} groups, {alone} alone; "
        f"{summary.pairs} of {summary.all_pairs} pairs compared; failed: {summary.unreadable} files, "
        f"{summary.failed_pairs} pairs, {summary.failed_groups} groups"
    )
    say(f"wrote {run / 'pairs.csv'}, {run / 'maps.csv'}, {run / 'groups'}")
    if report is not None:
        say(f"wrote {report}")
