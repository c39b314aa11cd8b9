"""``mapfuse map``: one robot's log to its map."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import Quiet, UsageError, Verbose, check_outputs, check_picture, note, teller, warn_on_stderr, writing
from .names import NamePoints, NoIds, check_count, named
from .progress import stages, watched

if TYPE_CHECKING:
    from mapfuse.datasets.logs import Log, LogTruth
    from mapfuse.datasets.mapper import Mapper
    from mapfuse.datasets.mapper.saved import Counters
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.datasets.truth import Truth

#: The word for the drive that gtsam ships.
VICTORIA_PARK = "victoria-park"


def map_file(
    log: Annotated[
        Path,
        typer.Argument(
            help="A log (NAME.log.jsonl, .gz too), an MRCLAM folder with --robot, or the word victoria-park: the real "
            "drive that comes with GTSAM.",
            metavar="LOG",
        ),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="The map, OUT.map.json.", show_default=False)],
    joint: Annotated[
        bool, typer.Option("--joint", help="With the joint covariance of all landmarks, which then is the evidence.")
    ] = False,
    walls: Annotated[
        bool,
        typer.Option(
            "--walls", help="With what each part of the way saw of walls, for `mapfuse fuse --walls`; --joint."
        ),
    ] = False,
    plot: Annotated[Path | None, typer.Option("--plot", help="A picture of log and map: .png, .svg, .pdf.")] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            metavar="NAME.logtruth.json",
            help="What was true: says how far the map is off, and writes OUT.truth.json.",
        ),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Refuse a log with anything wrong in it.")] = False,
    robot: Annotated[int | None, typer.Option("--robot", min=1, help="Which robot of an MRCLAM folder.")] = None,
    no_ids: NoIds = False,
    name_points: NamePoints = False,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="STATE", help="Go on from a saved state; LOG is what came after.")
    ] = None,
    save_state: Annotated[
        Path | None, typer.Option("--save-state", metavar="STATE", help="Keep the mapper's state for --resume.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make the map of one robot's log."""
    check_picture("--plot", plot)
    truth_output = _truth_output(output) if truth is not None else None
    inputs = [path for path in (log, truth, resume) if path is not None and path != save_state]
    outputs = {"-o": output, "--plot": plot, "--truth": truth_output, "--save-state": save_state}
    check_outputs(outputs, inputs)
    if plot is not None and log.is_fifo():
        raise UsageError(f"--plot: reads the log a second time, and {log} is a pipe")
    if truth is not None and resume is not None:
        raise UsageError("--truth: can't be used with --resume: the truth of the earlier part isn't in it")
    if name_points and (resume is not None or save_state is not None):
        raise UsageError("--name-points: needs the whole log, so it can't be used with --resume or --save-state")
    warn_on_stderr(verbose=verbose)

    recorded = _log(log, robot, strict=strict)
    names = named(recorded, no_ids=no_ids, name_points=name_points, quiet=quiet)
    known = _log_truth(truth)

    from mapfuse.datasets import write_map
    from mapfuse.datasets.mapper import WITH_KEYFRAMES, Mapper

    tell = teller(quiet=quiet)
    mapper = Mapper(recorded.header, WITH_KEYFRAMES if walls else None) if resume is None else Mapper.load(resume)
    if walls and mapper.config.scan_stretch > WITH_KEYFRAMES.scan_stretch:
        raise UsageError(
            f"--walls: {resume} was saved by a mapper without --walls, whose keyframes are too far apart to say what "
            "was seen from each; map the log from its beginning with --walls"
        )
    for event in watched(names.log.events, f"mapping {recorded.header.name}", quiet=quiet):
        mapper.update(event)
    with stages(f"solving {recorded.header.name}", quiet=quiet):
        made = mapper.map(joint=joint, keyframes=walls)
    if recorded.header.extra.get("simulated"):
        made = made.replace(extra={**made.extra, "simulated": True})
    map_truth = None if known is None else _truth(mapper, made, names.truth(known))
    write_map(made, output)
    tell(f"{made.name}: {_counted(made)}, {mapper.length:.0f} m driven")
    if map_truth is not None and truth_output is not None:
        from mapfuse.datasets.truth import write_truth

        write_truth(map_truth, truth_output)
        tell(f"  {accuracy(made, map_truth)}")
    if save_state is not None:
        mapper.save(save_state)
    if plot is not None:
        _draw(recorded, made, known, plot)
    if walls and not _walls_known(made):
        note("mapfuse: --walls: no walls were seen, so the map is as one without --walls")
    for line in () if quiet else remarks(mapper.counters, made, named=name_points):
        note(f"mapfuse: {line}")
    for path in (output, truth_output, plot, save_state):
        if path is not None:
            tell(f"wrote {path}")


def _truth_output(output: Path) -> Path:
    name = output.name
    for ending in (".map.json", ".json"):
        if name.endswith(ending):
            return output.with_name(name.removesuffix(ending) + ".truth.json")
    return output.with_name(name + ".truth.json")


def _log(path: Path, robot: int | None, *, strict: bool) -> Log:
    """The log in a file, of one robot in an MRCLAM folder, or the recorded drive that gtsam ships."""
    if path.is_dir():
        from mapfuse.datasets.mrclam import read_mrclam_log

        if robot is None:
            raise UsageError(f"{path}: is a folder; of an MRCLAM folder say which robot with --robot")
        return read_mrclam_log(path, robot)
    if robot is not None:
        raise UsageError(f"--robot: is for MRCLAM folders, and {path} is none")
    if str(path) == VICTORIA_PARK and not path.exists():
        from mapfuse.datasets.victoria_park_log import victoria_park_log

        return victoria_park_log()
    from mapfuse.datasets.logfile import read_log

    return read_log(path, strict=strict)


def _log_truth(path: Path | None) -> LogTruth | None:
    if path is None:
        return None
    from mapfuse.datasets.logtruth import read_log_truth

    return read_log_truth(path)


def _truth(mapper: Mapper, made: LandmarkMap, known: LogTruth) -> Truth:
    from mapfuse.datasets.mapper import truth_of_map

    if not len(known.path):
        raise UsageError("--truth: has no path, so where the map's frame is can't be told")
    check_count(known, mapper.counters.detections)
    return truth_of_map(made, mapper.sources, known)


def _counted(map_: LandmarkMap) -> str:
    """How many landmarks of which type.

    >>> from mapfuse.datasets.maps import Landmark, LandmarkMap
    >>> _counted(LandmarkMap("D1", (Landmark("a", "door", 0.0, 0.0), Landmark("b", "door", 3.0, 0.0))))
    '2 landmarks (2 door)'
    """
    types = Counter(landmark.type for landmark in map_.landmarks)
    listed = ", ".join(f"{count} {type_}" for type_, count in types.most_common(5))
    more = len(types) - 5
    return (
        f"{len(map_)} landmark{'' if len(map_) == 1 else 's'}"
        + (f" ({listed}" if listed else "")
        + (f", and {more} more types" if more > 0 else "")
        + (")" if listed else "")
    )


def accuracy(map_: LandmarkMap, truth: Truth) -> str:
    """How right a map is, in words."""
    import numpy as np

    from mapfuse.fusion.show.log_page import position_errors

    apart = position_errors(map_, truth)
    there = f"{len(apart)} of {len(map_)} landmarks are there"
    if not len(apart):
        return there
    return f"{there}, {np.median(apart):.2f} m (median) and {apart.max():.2f} m (largest) from their true places"


def _walls_known(made: LandmarkMap) -> bool:
    joint = made.joint_covariance
    return joint is not None and joint.keyframes is not None


def remarks(counters: Counters, made: LandmarkMap, *, named: bool) -> list[str]:
    """What the mapper could not use as it was; ``named``: points had been given names before."""
    said = {
        "late": "events came late",
        "doubled": "detections came twice and count once",
        "broken": "events were left out as broken",
        "unclear": "detections lay between two landmarks and were left out",
    }
    if not named and not all(landmark.links for landmark in made.landmarks):
        said["unclear"] += " (--name-points tells points without names and arms apart)"
    return [f"{getattr(counters, name)} {words}" for name, words in said.items() if getattr(counters, name, 0)]


def _draw(log: Log, made: LandmarkMap, truth: LogTruth | None, path: Path) -> None:
    from mapfuse.fusion.show import draw_log
    from mapfuse.fusion.show.journey import journey
    from mapfuse.fusion.show.log_page import Drive

    drive = Drive(made.name, journey(watched(log.events, "drawing")), truth, made)
    with writing(path):
        draw_log(log.header, drive, path, simulated=bool(log.header.extra.get("simulated")))
