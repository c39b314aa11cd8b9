"""``mapfuse simulate``: robots driven through a simulated building; their logs, maps, and the truth."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import Quiet, UsageError, Verbose, check_picture, teller, warn_on_stderr
from .progress import progress, watched

if TYPE_CHECKING:
    from mapfuse.datasets.logs import Event, LogHeader, LogTruth
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.datasets.simulation import Building, Robot
    from mapfuse.datasets.truth import Truth
    from mapfuse.fusion.show.log_page import Drive

#: Floors with names; other words are kinds of generated floors, and else a plan file.
NAMED = ("salvatori", "hospital")
#: The most maps that one call makes.
MAX_MAPS = 1000


class Kind(StrEnum):
    """Kinds of generated floors."""

    irregular = "irregular"
    oblique = "oblique"
    alike = "alike"
    symmetric = "symmetric"
    wings = "wings"


class RobotName(StrEnum):
    """The paper's two robots."""

    vespucci = "vespucci"
    milka = "milka"


class Policy(StrEnum):
    """Which way a robot takes where there are several."""

    unexplored = "unexplored"
    clockwise = "clockwise"
    counter_clockwise = "counter-clockwise"


@dataclass(frozen=True, slots=True)
class Mapped:
    """Whether there are maps, with joint covariances, and with what walls know."""

    at_all: bool
    joint: bool
    walls: bool


@dataclass(frozen=True, slots=True)
class Plan:
    """What each drive is to be: ``robots``, ``policies`` and ``starts`` in turn, the first for the first drive."""

    seed: int
    maps: int
    robots: Sequence[str]
    policies: Sequence[Policy]
    starts: Sequence[str | None]
    share: float
    scans: bool


@dataclass(frozen=True, slots=True)
class Made:
    """One simulated drive and what the mapper made of it."""

    header: LogHeader
    events: Sequence[Event]
    truth: LogTruth
    map: LandmarkMap | None
    map_truth: Truth | None


def simulate(
    building: Annotated[
        str,
        typer.Argument(
            help=f"A floor with a name ({', '.join(NAMED)}), a kind of generated floor ({', '.join(Kind)}), "
            "or a plan file.",
            metavar="BUILDING",
        ),
    ] = "salvatori",
    *,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="The folder to write into.")] = Path(
        "mapfuse-simulated"
    ),
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same files.")] = 0,
    maps: Annotated[int, typer.Option("--maps", min=1, max=MAX_MAPS, help="How many robots drive.")] = 2,
    robot: Annotated[
        list[RobotName] | None,
        typer.Option("--robot", help="Which robot; given several times, in turn. [default: vespucci, milka]"),
    ] = None,
    policy: Annotated[
        list[Policy] | None,
        typer.Option("--policy", help="Which way round; given several times, in turn. [default: unexplored]"),
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option("--start", metavar="PLACE", help="Where it starts; given several times, in turn. [default: any]"),
    ] = None,
    share: Annotated[
        float, typer.Option("--share", min=0.0, max=1.0, help="Share of the corridors after which a robot stops.")
    ] = 1.0,
    name: Annotated[
        str | None, typer.Option("--name", help="What the files' names begin with. [default: the building's name]")
    ] = None,
    walls: Annotated[
        bool, typer.Option("--walls", help="Maps with what walls know, as `mapfuse map --walls`; not with --no-scans.")
    ] = False,
    joint: Annotated[
        bool, typer.Option("--joint", help="Maps with the joint covariance of all landmarks, as `mapfuse map --joint`.")
    ] = False,
    corridors: Annotated[
        Path | None,
        typer.Option("--corridors", metavar="FILE", help="A second file of a plan, that has its corridors."),
    ] = None,
    no_maps: Annotated[bool, typer.Option("--no-maps", help="Logs only.")] = False,
    no_scans: Annotated[bool, typer.Option("--no-scans", help="Logs without range scans: smaller, no walls.")] = False,
    gz: Annotated[bool, typer.Option("--gz", help="Logs as NAME.log.jsonl.gz.")] = False,
    plot: Annotated[
        str, typer.Option("--plot", metavar="SUFFIX", help="Kind of the picture: .png, .svg, .pdf.")
    ] = ".png",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Drive robots through a simulated building: logs, maps, pictures, and the truth.

    For each drive NAME.log.jsonl, NAME.logtruth.json and NAME.map.json; for all of them one truth file and a picture.
    """
    check_picture("--plot", Path(f"picture{plot}"))
    warn_on_stderr(verbose=verbose)
    if name is not None and (not name or Path(name).name != name):
        raise UsageError(f"--name {name!r}: is part of file names, so it can't be empty or hold a /")
    plan = Plan(
        seed,
        maps,
        [r.value for r in robot or RobotName],
        policy or [Policy.unexplored],
        [*start] if start else [None],
        share,
        not no_scans,
    )
    site = _building(building, corridors, seed)
    unknown = [place for place in plan.starts if place is not None and place not in site.floor.place_from_id]
    if unknown:
        known = ", ".join(site.floor.place_from_id)
        raise UsageError(f"--start {unknown[0]}: is no place of {site.name}; its places are {known}")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"-o {output}: {error.strerror or error}") from error
    prefix = name or site.name
    mapped = Mapped(not no_maps, joint, walls)
    with _all_or_nothing(output) as folder:
        made = [_one(site, plan, k, prefix, mapped, quiet=quiet) for k in range(plan.maps)]
        for drive in made:
            _write(drive, folder, gz=gz)
        _write_together(site, made, folder, prefix, plot)
    tell = teller(quiet=quiet)
    for drive in made:
        tell(_summary(drive))
    tell(f"Logs, truth{'' if no_maps else ', maps'} and a picture are in {output}")


def _building(word: str, corridors: Path | None, seed: int) -> Building:
    """The named floor, the generated one, or the plan's, with walls and steel."""
    from mapfuse.datasets import simulation

    if corridors is not None and word in (*NAMED, *Kind):
        raise UsageError(f"--corridors: is for plan files, and {word} is none")
    if word in NAMED:
        floor = simulation.salvatori_like() if word == "salvatori" else simulation.hospital_like()
        return simulation.build(floor, seed=seed)
    if word in Kind.__members__:
        return simulation.make_building(Kind[word].value, seed)
    if Path(word).suffix or Path(word).exists():
        return simulation.building_from_plan(word, corridors, seed=seed)
    raise UsageError(f"{word}: is neither {', '.join((*NAMED, *Kind))} nor a plan file")


def _one(site: Building, plan: Plan, k: int, prefix: str, mapped: Mapped, *, quiet: bool) -> Made:
    """The k-th drive. Its random numbers don't depend on how many drives there are."""
    import numpy as np

    from mapfuse.datasets.simulation import simulate_log

    robot = _robot(plan.robots[k % len(plan.robots)])
    name = f"{prefix}-{k + 1}-{robot.name}"
    with progress(f"driving {name}", quiet=quiet):
        header, events, truth = simulate_log(
            site,
            robot,
            np.random.default_rng([plan.seed, k]),
            name=name,
            start=plan.starts[k % len(plan.starts)],
            policy=plan.policies[k % len(plan.policies)].value,
            share=plan.share,
            scans=plan.scans,
        )
    if not mapped.at_all:
        return Made(header, events, truth, None, None)
    from mapfuse.datasets.mapper import WITH_KEYFRAMES, Mapper, truth_of_map

    mapper = Mapper(header, WITH_KEYFRAMES if mapped.walls else None)
    for event in watched(events, f"mapping {name}", len(events), quiet=quiet):
        mapper.update(event)
    recorded = mapper.map(joint=mapped.joint, keyframes=mapped.walls)
    recorded = recorded.replace(extra={**recorded.extra, "simulated": True})
    return Made(header, events, truth, recorded, truth_of_map(recorded, mapper.sources, truth))


def _robot(name: str) -> Robot:
    from mapfuse.datasets.simulation import MILKA, VESPUCCI

    return {"vespucci": VESPUCCI, "milka": MILKA}[name]


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[Path]:
    """A folder within ``folder`` whose files move up when the block is done; gone if it fails or is interrupted."""
    inside = folder / f".mapfuse-{secrets.token_hex(8)}.tmp"
    try:
        inside.mkdir()
    except OSError as error:
        raise UsageError(f"-o {folder}: {error.strerror or error}") from error
    try:
        yield inside
        for file in sorted(inside.iterdir()):
            file.replace(folder / file.name)
    except OSError as error:
        raise UsageError(f"-o {folder}: can't be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(inside, ignore_errors=True)


def _write(made: Made, folder: Path, *, gz: bool) -> None:
    from mapfuse.datasets import write_map
    from mapfuse.datasets.logfile import write_log
    from mapfuse.datasets.logs import Log
    from mapfuse.datasets.logtruth import write_log_truth

    name = made.header.name
    write_log(Log(made.header, made.events), folder / f"{name}.log.jsonl{'.gz' if gz else ''}")
    write_log_truth(made.truth, folder / f"{name}.logtruth.json")
    if made.map is not None:
        write_map(made.map, folder / f"{name}.map.json")


def _write_together(site: Building, made: Sequence[Made], folder: Path, prefix: str, suffix: str) -> None:
    """The truth of all maps in one file, and the picture of all drives."""
    from mapfuse.datasets.truth import write_truth
    from mapfuse.fusion.show import draw_building

    truths = [drive.map_truth for drive in made if drive.map_truth is not None]
    truth = _together(truths) if truths else None
    if truth is not None:
        write_truth(truth, folder / f"{prefix}.truth.json")
    with progress("drawing"):
        draw_building(site, [_drive(drive) for drive in made], folder / f"{prefix}{suffix}", truth=truth)


def _together(truths: Sequence[Truth]) -> Truth:
    """One truth of maps of one building."""
    from mapfuse.datasets.truth import Truth

    return Truth(
        {name: frame for truth in truths for name, frame in truth.frames.items()},
        {name: ids for truth in truths for name, ids in truth.landmarks.items()},
        {place: xy for truth in truths for place, xy in truth.places.items()},
        {"simulated": True},
    )


def _drive(made: Made) -> Drive:
    from mapfuse.fusion.show.journey import journey
    from mapfuse.fusion.show.log_page import Drive

    return Drive(made.header.name, journey(made.events), made.truth, made.map)


def _summary(made: Made) -> str:
    count = f"{made.header.name}: {len(made.events)} events"
    if made.map is None or made.map_truth is None:
        return count
    from .map import accuracy

    return f"{count}, {accuracy(made.map, made.map_truth)}"
