"""``mapfuse replay``: logs replayed together on their own clocks, their maps merged while they grow."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import Quiet, UsageError, Verbose, check_folder, check_outputs, note, say, warn_on_stderr
from .map import remarks
from .names import NamePoints, NoIds, named
from .progress import progress

if TYPE_CHECKING:
    from mapfuse.datasets.logs import Log
    from mapfuse.fusion.online.events import Event
    from mapfuse.fusion.online.place import Place
    from mapfuse.fusion.online.replay import Replay
    from mapfuse.fusion.show.film import Film, Shot

#: A film of a replay without --speed lasts about so long [s].
FILM_SECONDS = 15.0
#: Frames per second of a film or a window.
FRAMES = 8


def replay(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs (NAME.log.jsonl, .gz too), two or more; or one MRCLAM folder, whose robots all drive.",
            metavar="LOG...",
        ),
    ],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The fused map at the end, OUT.fused.json.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option("--speed", metavar="X", help="X times as fast as it was recorded. [default: as fast as possible]"),
    ] = None,
    events: Annotated[
        Path | None, typer.Option("--events", metavar="FILE", help="What happened, as lines of JSON.")
    ] = None,
    snapshots: Annotated[
        Path | None,
        typer.Option("--snapshots", metavar="DIR", help="A result file each time when a merge was made or taken back."),
    ] = None,
    video: Annotated[
        Path | None, typer.Option("--video", metavar="OUT", help="A film: .gif, or .mp4 where ffmpeg is.")
    ] = None,
    window: Annotated[bool, typer.Option("--window", help="The film in a window while it goes on.")] = False,
    no_ids: NoIds = False,
    name_points: NamePoints = False,
    strict: Annotated[bool, typer.Option("--strict", help="Refuse a log with anything wrong in it.")] = False,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="STATE", help="Go on from a saved state; LOGs are what came after."),
    ] = None,
    save_state: Annotated[
        Path | None, typer.Option("--save-state", metavar="STATE", help="Keep the state at the end for --resume.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Replay robots' logs together and merge their maps while they map."""
    if speed is not None and not 0 < speed <= 1e6:
        raise UsageError(f"--speed: {speed} must be above 0 and at most 1,000,000")
    outputs = {"-o": output, "--events": events, "--video": video, "--save-state": save_state}
    inputs = [path for path in (*logs, resume) if path is not None and path != save_state and not path.is_dir()]
    check_outputs(outputs, inputs)
    if name_points and (resume is not None or save_state is not None):
        raise UsageError("--name-points: needs whole logs, so it can't be used with --resume or --save-state")
    check_folder("--snapshots", snapshots, outputs)
    warn_on_stderr(verbose=verbose)
    recorded = [
        named(log, no_ids=no_ids, name_points=name_points, quiet=quiet).log for log in _logs(logs, strict=strict)
    ]
    if len(recorded) < 2 and resume is None:
        raise UsageError("replay needs the logs of at least two robots")
    if video is not None:
        from mapfuse.fusion.show.film import check_film

        check_film(video)

    from mapfuse.fusion.online.replay import Replay

    run = Replay(recorded) if resume is None else Replay.resume(resume, recorded)
    simulated = all(bool(log.header.extra.get("simulated")) for log in recorded)
    happened = _run(run, speed, snapshots, video, window=window, simulated=simulated, quiet=quiet)
    fused = run.fuser.fused()
    if not quiet:
        from .summary import summarise

        say(summarise(fused))
        for name, place in sorted(run.fuser.places().items()):
            say(f"{name} is at {_where(place)}")
        for name, feed in run.feeds.items():
            for line in remarks(feed.mapper.counters, run.fuser.segments[name].map(), named=name_points):
                note(f"mapfuse: {name}: {line}")
    if events is not None:
        from mapfuse.fusion.online.events import write_events

        write_events(happened, list(run.feeds), events)
    if output is not None:
        from mapfuse.fusion import write_fused

        write_fused(fused, output)
    if save_state is not None:
        run.save(save_state)
    if not quiet:
        for path in (output, events, video, save_state, snapshots):
            if path is not None:
                say(f"wrote {path}")


def _logs(paths: Iterable[Path], *, strict: bool) -> list[Log]:
    from mapfuse.datasets.logfile import read_log

    found: list[Log] = []
    for path in paths:
        if path.is_dir():
            from mapfuse.datasets.mrclam import ROBOTS, read_mrclam_log

            found += [read_mrclam_log(path, robot) for robot in ROBOTS]
        else:
            found.append(read_log(path, strict=strict))
    return found


def _run(
    run: Replay,
    speed: float | None,
    snapshots: Path | None,
    video: Path | None,
    *,
    window: bool,
    simulated: bool,
    quiet: bool,
) -> list[Event]:
    """The replay itself: what happened, told, filmed and kept as it goes on."""
    happened: list[Event] = []
    drawn = video is not None or window
    with ExitStack() as stack:
        advance = stack.enter_context(progress("replaying")) if not quiet else (lambda _: None)
        film: Film | None = None
        if video is not None:
            from mapfuse.fusion.show.film import Film

            film = stack.enter_context(Film(video, simulated=simulated))
        show = _window(simulated) if window else None
        every = None
        if drawn or speed is not None:
            every = (speed / FRAMES) if speed is not None else _length(run) / (FILM_SECONDS * FRAMES)

        def draw(t: float) -> None:
            shot = shot_of(run, t)
            if film is not None:
                film.add(shot)
            if show is not None:
                show(shot)

        shown = False
        start: float | None = None
        begun = 0.0
        for moment in run.run(every=every):
            advance(1)
            fresh = list(run.fuser.events())
            happened += fresh
            if not quiet:
                for event in fresh:
                    if event.kind != "proposed":
                        say(f"{moment.t:8.1f} s  {told(event)}")
            if snapshots is not None and any(e.kind in ("merged", "revised", "un-merged") for e in fresh):
                _snapshot(run, snapshots, moment.t)
            shown = not moment.weighed or bool(fresh)
            if drawn and shown:
                draw(moment.t)
            if speed is not None:
                if start is None:
                    start, begun = moment.t, time.monotonic()
                ahead = (moment.t - start) / speed - (time.monotonic() - begun)
                if ahead > 0:
                    time.sleep(ahead)
        if drawn and not shown:
            draw(run.t)
    if snapshots is not None:
        _snapshot(run, snapshots, run.t)
    return happened


def _where(place: Place) -> str:
    import numpy as np

    sigma_x, sigma_y, _ = np.sqrt(np.diag(np.asarray(place.pose.covariance)))
    return (
        f"x {place.pose.x:.2f} ± {sigma_x:.2f} m, y {place.pose.y:.2f} ± {sigma_y:.2f} m, "
        f"{np.degrees(place.pose.theta):.1f}°, in the frame of {place.frame_of}"
    )


def _length(run: Replay) -> float:
    """How long the logs are together [s], a second at least, which reads them once."""
    first = last = None
    for last, _, _ in run.events():
        first = last if first is None else first
    return 1.0 if first is None or last is None else max(last - first, 1.0)


def _snapshot(run: Replay, folder: Path, t: float) -> None:
    """The answer by now as a result file, named by its time in seconds."""
    from mapfuse.fusion import write_fused

    write_fused(run.fuser.fused(), folder / f"{t:09.1f}.fused.json")


def told(event: Event) -> str:
    """An event in a line."""
    from mapfuse.fusion.online import Refuted, Unmerged

    if isinstance(event, Refuted):
        return f"{event.landmark} of {event.map} is doubtful: {event.reason}"
    if isinstance(event, Unmerged):
        return f"un-merged {' and '.join(event.maps)}: {event.reason}"
    verb = {"merged": "merged", "revised": "revised"}.get(event.kind, "proposed")
    return f"{verb} {' and '.join(event.maps)}, {event.count} common landmarks, probability {event.probability:.4f}"


def shot_of(run: Replay, t: float) -> Shot:
    """What a frame of the film shows."""
    from mapfuse.fusion.show.film import Shot

    fuser = run.fuser
    maps = {name: s.map() for name, s in fuser.segments.items()}
    fused = fuser.answer
    robots = {name: feed.mapper.pose for name, feed in run.feeds.items() if name in maps}
    shared = {}
    if fused is not None and any(len(group) > 1 for group in fused.groups):
        first = {name: group[0] for group in fused.groups for name in group}
        shared = {n: place.pose.array for n, place in fuser.places().items() if place.frame_of == first.get(n)}
    return Shot(t, maps, fused, robots, shared)


def _window(simulated: bool) -> Callable[[Shot], None]:
    """A function that shows a shot in a window."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    if mpl.get_backend().lower() in ("agg", "pdf", "svg", "ps", "template"):
        raise UsageError("--window: there is no display here that a window could open on; --video makes a film")
    from mapfuse.fusion.show.film import HEIGHT, WIDTH, draw_shot

    figure = plt.figure(figsize=(WIDTH, HEIGHT))
    plt.show(block=False)

    def show(shot: Shot) -> None:
        draw_shot(figure, shot, simulated=simulated)
        figure.canvas.draw_idle()
        plt.pause(0.001)

    return show
