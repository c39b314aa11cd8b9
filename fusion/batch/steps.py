"""`Batch`: the steps of a run. Each takes from the ledger what is there, and adds to it what is not."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.files import write_whole
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.matching.index import MapIndex

from ..config import FuseConfig
from ..consistent import Choice
from ..far import middle, pair_put_back
from ..pairresult import mixture, pair_result
from ..pairwise import Comparison
from ..placing import Pair
from ..prepared import PreparedMap
from ..result import PairResult
from . import tasks
from .choosing import Solved, alone, parts, settled_part
from .engine import Engine, Job, Task
from .folder import read_folder
from .ledger import Done, Ledger, Wanted, key_of
from .packing import (
    PACKING,
    GroupAnswer,
    GroupJob,
    PairJob,
    comparison_from_bytes,
    config_bytes,
    decision_of,
    map_bytes,
    part_of,
)
from .table import MAP_COLUMNS, PAIR_COLUMNS, failed_row, pair_row, read_csv, write_csv, write_parquet
from .unpaired import unpaired

GROUPS, PAIRS, MAPS = "groups", "pairs", "maps.csv"
#: Maps that are prepared at once while groups are chosen.
PREPARED = 512
_OURS = re.compile(r"\d{4,}\.(fused\.json|png)")

#: Says how far long work has come: a label and how much there is; gives a function to call with what was done since.
Watch = Callable[[str, float | None], AbstractContextManager[Callable[[float], None]]]


def unwatched(_label: str, _total: float | None) -> AbstractContextManager[Callable[[float], None]]:
    """A `Watch` that nobody looks at."""
    return nullcontext(lambda _done: None)


class Batch:
    """One run at work: its steps, to be called in order, and what they found.

    ``taken``: files of each format; ``file_from_name``: every map; ``unreadable``: (file, reason); ``groups``: those of
    several maps; ``problems``: whatever failed, with its reason.
    """

    def __init__(
        self, folder: Path, run: Path, config: FuseConfig, engine: Engine, ledger: Ledger, watch: Watch
    ) -> None:
        self.folder, self.run, self.config, self.engine = folder, run, config, engine
        self.ledger, self.watch = ledger, watch
        self.taken: Counter[str] = Counter()
        self.file_from_name: dict[str, str] = {}
        self.unreadable: list[tuple[str, str]] = []
        self.groups: list[Solved] = []
        self.problems: list[str] = []
        self._settings, self._version = config_bytes(config), f"{version('mapfuse')}/{PACKING}"
        self._key_from_name: dict[str, str] = {}
        self._name_from_key: dict[str, str] = {}
        self._origin_from_name: dict[str, Any] = {}
        self._choice_from_name: dict[str, Choice] = {}

    # Reading ---------------------------------------------------------------------------------------------------------

    def read(self, without: Iterable[str], told: Mapping[str, str]) -> None:
        """Take the folder's maps into the ledger, and say which pairs are to be tried; ``told``: of foreign maps."""
        index, left_out = MapIndex(), dict.fromkeys(without, False)
        files: list[tuple[str, str | None, str | None]] = []
        with self.watch("reading maps", None) as advance:
            for path, read in read_folder(self.folder, self.run, told, self.taken):
                advance(1)
                if isinstance(read, LandmarkMap) and read.name in left_out:
                    left_out[read.name] = True
                    continue
                key, error = (None, read) if isinstance(read, str) else self._taken(path, read, index)
                files.append((path, key, error))
                if error is not None:
                    self.unreadable.append((path, error))
                    self.problems.append(error)
        if unknown := [name for name, found in left_out.items() if not found]:
            raise MapfuseError(f"{self.folder}: there is no map named {unknown[0]!r} to leave out")
        self.ledger.set_files(files)
        self.ledger.set_wanted(self._wanted(proposal.map1, proposal.map2) for proposal in index.pairs())

    def _taken(self, path: str, read: LandmarkMap, index: MapIndex) -> tuple[str | None, str | None]:
        """Keep a map: its key, or why it can't be one of the run's maps."""
        if read.name in self.file_from_name:
            other = self.file_from_name[read.name]
            return None, f"{path}: is named {read.name!r} as {other} is; names tell maps apart, so give it another one"
        data = map_bytes(read)
        key = key_of("map", data)
        self.file_from_name[read.name] = path
        self._key_from_name[read.name], self._name_from_key[key] = key, read.name
        if (origin := middle(read)).any():
            self._origin_from_name[read.name] = origin
        self.ledger.add_map(key, read.name, data)
        index.add(read)
        return key, None

    def _wanted(self, name1: str, name2: str) -> Wanted:
        key1, key2 = self._key_from_name[name1], self._key_from_name[name2]
        return Wanted(key_of("pair", self._version, self._settings, key1, key2), key1, key2)

    # Pairs -----------------------------------------------------------------------------------------------------------

    def compare(self, task: Task) -> None:
        """Compare what is to be compared; every answer is committed as it comes."""
        missing = self.ledger.missing()
        jobs = (Job(p.key, PairJob(self._settings, self._map(p.map1), self._map(p.map2)).to_bytes()) for p in missing)
        for _ in self._work("comparing pairs", task, jobs, len(missing)):
            pass

    def look_again(self) -> bool:
        """Want the pairs that the index left out and the solved groups ask for; whether there are any."""
        wanted = self.ledger.wanted()
        compared = {self._names(pair) for pair in wanted}
        asked = {
            pair
            for group in self.groups
            if group.error is None and (fused := GroupAnswer.from_bytes(self._answer(group)).fused) is not None
            for pair in unpaired(fused, compared)
        }
        if asked:
            self.ledger.set_wanted([*wanted, *(self._wanted(*names) for names in sorted(asked))])
        return bool(asked)

    def note_failures(self) -> None:
        """Add to ``problems`` the pairs and groups that failed."""
        for pair in self.ledger.wanted():
            if (done := self._done(pair.key)).error is not None:
                self.problems.append(f"{self._names(pair)[0]} and {self._names(pair)[1]}: {done.error}")
        self.problems += [f"group of {', '.join(g.names)}: {g.error}" for g in self.groups if g.error is not None]

    def _map(self, key: str) -> bytes:
        return self.ledger.map_data(key)

    def _names(self, pair: Wanted) -> Pair:
        return self._name_from_key[pair.map1], self._name_from_key[pair.map2]

    def _done(self, key: str) -> Done:
        done = self.ledger.done(key)
        assert done is not None
        return done

    def _work(self, label: str, task: Task, jobs: Iterable[Job], count: int) -> Iterator[str]:
        """Do jobs and commit what comes of them; their keys, as they are done."""
        if not count:
            return
        with self.watch(label, count) as advance, closing(self.engine.run(task, jobs)) as outcomes:
            for key, done in outcomes:
                self.ledger.finish(key, done)
                advance(1)
                yield key

    # Groups ----------------------------------------------------------------------------------------------------------

    def choose(self) -> None:
        """Choose what can be true together, part by part, and solve the groups."""
        self.groups, self._choice_from_name = [], {}
        pair_from_names = {self._names(pair): pair for pair in self.ledger.wanted()}
        together = [names for names, pair in pair_from_names.items() if self._may_overlap(pair)]
        inside: dict[str, list[Pair]] = {}
        found = parts(self.file_from_name, together)
        part_from_name = {name: number for number, part in enumerate(found) for name in part}
        for names in pair_from_names:
            if part_from_name[names[0]] == part_from_name[names[1]]:
                inside.setdefault(found[part_from_name[names[0]]][0], []).append(names)
        prepared = _Prepared(lambda name: self._map(self._key_from_name[name]), self._settings)
        for part in found:
            if len(part) > 1:
                self._choose_part(part, {names: pair_from_names[names] for names in inside[part[0]]}, prepared)
        self.groups.sort(key=lambda group: group.names)

    def _may_overlap(self, pair: Wanted) -> bool:
        result = self._done(pair.key).result
        return result is not None and decision_of(result) != "no_overlap"

    def _choose_part(
        self, part: tuple[str, ...], wanted: Mapping[Pair, Wanted], prepared: Mapping[str, PreparedMap]
    ) -> None:
        data = {names: done for names, p in wanted.items() if (done := self._done(p.key).result) is not None}
        comparisons = {names: comparison_from_bytes(packed) for names, packed in data.items()}

        def solve(choice: Choice, final: bool) -> list[Solved]:
            jobs = [
                self._group_job(part_of(choice, k, comparisons), data, final)
                for k, names in enumerate(choice.groups)
                if len(names) > 1
            ]
            missing = [job for _, job in jobs if self.ledger.done(job.key) is None]
            for _ in self._work("solving groups", tasks.solve_group, missing, len(missing)):
                pass
            return [self._solved(names, job.key) for names, job in jobs]

        choice, solved = settled_part(part, comparisons, prepared, self.config, solve)
        self._choice_from_name |= dict.fromkeys(part, choice)
        self.groups += solved

    def _group_job(self, choice: Choice, data: Mapping[Pair, bytes], final: bool) -> tuple[tuple[str, ...], Job]:
        (names,) = choice.groups
        among = set(names)
        compared = tuple(packed for pair, packed in sorted(data.items()) if among.issuperset(pair))
        maps = tuple(self._map(self._key_from_name[name]) for name in names)
        job = GroupJob(self._settings, maps, compared, choice, final).to_bytes()
        return names, Job(key_of("group", self._version, job), job)

    def _solved(self, names: tuple[str, ...], key: str) -> Solved:
        done = self._done(key)
        broken = GroupAnswer.from_bytes(done.result).broken if done.result is not None else ()
        return Solved(names, key, broken, done.error)

    # Files -----------------------------------------------------------------------------------------------------------

    def write_groups(self) -> None:
        """A file and a picture per group; those of an earlier run that are no groups any more are removed."""
        written = set()
        jobs = {}
        for number, group in enumerate(self.groups, start=1):
            if group.error is None:
                path = self._group_file(number, ".fused.json")
                fused = GroupAnswer.from_bytes(self._answer(group)).fused
                assert fused is not None
                write_whole(path, fused)
                jobs[key_of("picture", group.key)] = group, self._group_file(number, ".png")
                written |= {path.name, jobs[key_of("picture", group.key)][1].name}
        missing = [key for key in jobs if self.ledger.done(key) is None]
        drawing = (Job(key, self._answer(jobs[key][0])) for key in missing)
        for _ in self._work("drawing groups", tasks.draw_group, drawing, len(missing)):
            pass
        for key, (group, path) in jobs.items():
            done = self._done(key)
            if done.result is not None:
                write_whole(path, done.result)
            else:
                self.problems.append(f"picture of the group of {', '.join(group.names)}: {done.error}")
        for old in (self.run / GROUPS).iterdir():
            if _OURS.fullmatch(old.name) and old.name not in written:
                old.unlink()

    def _group_file(self, number: int, ending: str) -> Path:
        return self.run / GROUPS / f"{number:04d}{ending}"

    def _answer(self, group: Solved) -> bytes:
        result = self._done(group.key).result
        assert result is not None
        return result

    def write_tables(self) -> None:
        """The tables of pairs and of maps."""
        table, parquet = (self.run / f"{PAIRS}.{ending}" for ending in ("csv", "parquet"))
        write_csv(table, PAIR_COLUMNS, self._pair_rows())
        # a row takes the unpacking of all that was compared: once is enough
        if not write_parquet(parquet, read_csv(table)):
            parquet.unlink(missing_ok=True)
        write_csv(self.run / MAPS, MAP_COLUMNS, self._map_rows())

    def _pair_rows(self) -> Iterator[dict[str, Any]]:
        for pair in self.ledger.wanted():
            done, names = self._done(pair.key), self._names(pair)
            if done.result is None:
                yield failed_row(*names, done.error or "", done.seconds)
            else:
                yield pair_row(self._pair_result(comparison_from_bytes(done.result)), done.seconds)

    def _pair_result(self, comparison: Comparison) -> PairResult:
        """A pair's answer within its group, with its first hypothesis only: the table holds no more."""
        first, second = comparison.maps
        choice = self._choice_from_name.get(first)
        if choice is None or choice is not self._choice_from_name.get(second):
            choice = alone(comparison.maps)
        ids = [""] * len(comparison.rates1), [""] * len(comparison.rates2)
        origin1, origin2 = (self._origin_from_name.get(name, np.zeros(2)) for name in comparison.maps)
        found = pair_result(comparison, choice, ids, swapped=False)
        return pair_put_back(replace(found, hypotheses=found.hypotheses[:1]), origin1, origin2, mixture)

    def _map_rows(self) -> Iterator[dict[str, Any]]:
        """By name: file, number of the group and pose in its first map; then the files that aren't maps."""
        rows = {name: dict.fromkeys(MAP_COLUMNS) | {"map": name, "file": f} for name, f in self.file_from_name.items()}
        for number, group in enumerate(self.groups, start=1):
            frames: dict[str, Any] = {}
            if group.error is None:
                frames = msgspec.json.decode(GroupAnswer.from_bytes(self._answer(group)).fused or b"{}")["frames"]
            for name in group.names:
                rows[name] |= {"group": number, "error": group.error}
                rows[name] |= {key: frames[name][key] for key in ("x", "y", "theta") if name in frames}
        yield from (rows[name] for name in sorted(rows))
        for path, error in sorted(self.unreadable):
            yield dict.fromkeys(MAP_COLUMNS) | {"file": path, "error": error}


class _Prepared(Mapping[str, PreparedMap]):
    """Maps by name, prepared when they are asked for; the last ones are kept."""

    def __init__(self, data_from_name: Callable[[str], bytes], settings: bytes) -> None:
        self._get = lru_cache(maxsize=PREPARED)(lambda name: tasks.prepared_map(data_from_name(name), settings))

    def __getitem__(self, name: str) -> PreparedMap:
        return self._get(name)

    def __iter__(self) -> Iterator[str]:
        raise TypeError("a folder's maps are not prepared all at once")

    def __len__(self) -> int:
        raise TypeError("a folder's maps are not prepared all at once")
