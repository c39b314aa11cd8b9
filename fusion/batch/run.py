"""`run_batch`: a folder of recorded maps to groups, in steps that each go on where an earlier run stopped."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mapfuse.datasets.errors import ConfigError, OutputError
from mapfuse.datasets.files import write_whole
from mapfuse.datasets.jsondata import encode

from ..config import FuseConfig
from . import tasks
from .engine import Engine, Task
from .ledger import LEDGER, Ledger
from .steps import GROUPS, Batch, Watch, unwatched

SUMMARY = "summary.json"


@dataclass(frozen=True, slots=True)
class Summary:
    """What came of a run: ``maps`` read, ``unreadable`` files, ``pairs`` tried of ``all_pairs``, those that failed,
    ``groups`` of several maps, ``grouped`` maps in them, groups that failed; ``problems``: every failure's reason;
    ``taken``: how many files were taken for each format, by its name."""

    maps: int
    unreadable: int
    all_pairs: int
    pairs: int
    failed_pairs: int
    groups: int
    grouped: int
    failed_groups: int
    problems: tuple[str, ...] = ()
    taken: Mapping[str, int] = field(default_factory=dict, hash=False)

    @property
    def flawless(self) -> bool:
        """Whether nothing failed."""
        return not self.problems


@dataclass(frozen=True, slots=True)
class Status:
    """How far a run has come: maps and unreadable files, pairs to try, done and failed ones, seconds of work on those;
    ``finished``: its files are written."""

    maps: int
    unreadable: int
    pairs: int
    done: int
    failed: int
    seconds: float
    finished: bool


def status(run: Path) -> Status:
    """How far the run in a folder has come. Raises `InputError` where none has begun."""
    with Ledger.to_read(run / LEDGER) as ledger:
        files = ledger.files()
        pairs, done, failed, seconds = ledger.counts()
        maps, unreadable = (sum(file[k] is not None for file in files) for k in (1, 2))
        return Status(maps, unreadable, pairs, done, failed, seconds, ledger.said("finished") == "yes")


def run_batch(
    folder: Path,
    run: Path,
    config: FuseConfig,
    engine: Engine,
    *,
    without: Sequence[str] = (),
    told: Mapping[str, str] | None = None,
    watch: Watch = unwatched,
    compare: Task = tasks.compare_maps,
) -> Summary:
    """Fuse the maps of a folder into the folder ``run``; what an earlier run did is not done again.

    ``without``: names of maps to leave out. ``told``: what files of other formats don't say. ``watch``: told how far
    the work has come. ``compare``: what a worker does with a pair.

    Raises `InputError` where there is no such folder, `ConfigError` for an option that no format has and where noise is
    to be estimated, which takes a group's maps at once, `OutputError` where ``run`` can't be written; all that was done
    until then is kept. A map that can't be read and a pair that fails are part of the answer, not errors.
    """
    if config.solving.estimate_noise:
        raise ConfigError("estimate_noise: isn't done for a folder of maps; fuse a group's file with it")
    try:
        (run / GROUPS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(run, f"can't be made: {error.strerror}") from error
    with _only_one(run), Ledger(run / LEDGER) as ledger:
        ledger.say("finished", "no")
        batch = Batch(folder, run, config, engine, ledger, watch)
        batch.read(without, told or {})
        batch.compare(compare)
        batch.choose()
        if batch.look_again():
            batch.compare(compare)
            batch.choose()
        batch.note_failures()
        batch.write_groups()
        batch.write_tables()
        summary = _summary(batch)
        write_whole(run / SUMMARY, encode(asdict(summary)))
        ledger.say("finished", "yes")
        return summary


@contextmanager
def _only_one(run: Path) -> Iterator[None]:
    """Hold the run's folder; raises `OutputError` where another process has it."""
    with (run / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OutputError(run, "another batch is at work there") from None
        yield


def _summary(batch: Batch) -> Summary:
    pairs, _, failed, _ = batch.ledger.counts()
    maps = len(batch.file_from_name)
    unsolved = [group for group in batch.groups if group.error is not None]
    return Summary(
        maps=maps,
        unreadable=len(batch.unreadable),
        all_pairs=maps * (maps - 1) // 2,
        pairs=pairs,
        failed_pairs=failed,
        groups=len(batch.groups),
        grouped=sum(len(group.names) for group in batch.groups),
        failed_groups=len(unsolved),
        problems=tuple(batch.problems),
        taken=dict(sorted(batch.taken.items())),
    )
