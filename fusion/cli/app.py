"""`main`: the commands, and the one place where errors become messages and exit codes."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from . import batch, compare, config, convert, demo, formats, fuse, map, replay, show, simulate
from .console import UsageError, complain, say, tolerate_any_text

_EPILOG = (
    "Exit codes: 0 done, whatever was decided; 2 wrong usage or bad input; "
    "3 with --require-merge, where not all maps were merged; 1 a bug."
)

app = typer.Typer(
    name="mapfuse",
    help="Fuse landmark maps of robots whose relative start is unknown into one, with its uncertainty.",
    epilog=_EPILOG,
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,  # plain help: rich alone takes as long to import as everything else together
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(name="fuse", no_args_is_help=True)(fuse.fuse_files)
app.command(name="batch", no_args_is_help=True)(batch.batch)
app.command(name="compare", no_args_is_help=True)(compare.compare)
app.command(name="map", no_args_is_help=True)(map.map_file)
app.command(name="replay", no_args_is_help=True)(replay.replay)
app.command(name="simulate")(simulate.simulate)
app.command(name="demo")(demo.demo)
app.command(name="show", no_args_is_help=True)(show.show)
app.command(name="convert", no_args_is_help=True)(convert.convert)
app.command(name="formats")(formats.formats)
app.command(name="config")(config.config)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"mapfuse {version('mapfuse')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    del version  # its callback has answered and left


def main() -> None:
    """Run ``mapfuse`` on ``sys.argv``; exits with 0, 2, 3, 130 (interrupted) or, with a traceback, 1 (a bug)."""
    tolerate_any_text()
    try:
        app(prog_name="mapfuse")
    except UsageError as mistake:
        complain(str(mistake))
        sys.exit(2)
    except Exception as error:
        from mapfuse.datasets.errors import MapfuseError

        if not isinstance(error, MapfuseError):
            raise
        complain(str(error))
        sys.exit(2)
