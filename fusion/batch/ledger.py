"""`Ledger`: one SQLite file that stores maps and finished work, so that a run goes on where it stopped.

Finished work is kept by a key that says what it was made of; what is in the ledger is never done again, and a changed
map, parameter or version has other keys. Every result is committed as it arrives. The file may be torn at any moment:
what can still be read of it is taken over when it is opened, and the rest is done again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from mapfuse.datasets.errors import InputError, OutputError

#: Name of the file in the run's folder.
LEDGER = "ledger.sqlite"
_KEPT = {
    "map": ("key", "name", "data", "digest"),
    "done": ("key", "result", "error", "seconds", "digest"),
}
_SCHEMA = """
CREATE TABLE IF NOT EXISTS map (key TEXT PRIMARY KEY, name TEXT, data BLOB, digest BLOB);
CREATE TABLE IF NOT EXISTS done (key TEXT PRIMARY KEY, result BLOB, error TEXT, seconds REAL, digest BLOB);
CREATE TABLE IF NOT EXISTS file (path TEXT PRIMARY KEY, key TEXT, error TEXT);
CREATE TABLE IF NOT EXISTS wanted (place INTEGER PRIMARY KEY, key TEXT, map1 TEXT, map2 TEXT);
CREATE TABLE IF NOT EXISTS said (name TEXT PRIMARY KEY, value TEXT);
"""


def key_of(*parts: bytes | str) -> str:
    """What something is kept under that was made of these parts.

    >>> key_of("a", "bc") == key_of("ab", "c")
    False
    """
    whole = sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        whole.update(len(data).to_bytes(8) + data)
    return whole.hexdigest()


@dataclass(frozen=True, slots=True)
class Done:
    """Finished work: its ``result``, or the ``error`` why there is none; ``seconds`` that it took."""

    result: bytes | None
    error: str | None
    seconds: float


@dataclass(frozen=True, slots=True)
class Wanted:
    """A pair of the present run: its key, and the keys of its maps, the first name first."""

    key: str
    map1: str
    map2: str


class Ledger:
    """The open ledger of a run. Closing it, or leaving its ``with`` block, ends the work on it."""

    def __init__(self, path: Path) -> None:
        """Open it to be written, new, whole or torn; raises `OutputError` where it can't be."""
        self.path = path
        with self._explained():
            self._db = _opened(path)

    @classmethod
    def to_read(cls, path: Path) -> Ledger:
        """Open it as it is, while a run may be at work on it; raises `InputError` where it can't be read."""
        ledger = cls.__new__(cls)
        ledger.path = path
        if not path.exists():
            raise InputError(path, "there is no ledger; no batch has run here")
        try:
            ledger._db = sqlite3.connect(path, timeout=60)
            ledger._db.execute("PRAGMA query_only = ON")
            ledger.counts()
        except sqlite3.Error as error:
            raise InputError(path, f"can't be read: {error}; the next run mends what can be mended") from error
        return ledger

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
            raise OutputError(self.path, f"can't be written: {reason}; what it holds is kept") from error

    @contextmanager
    def _change(self) -> Iterator[sqlite3.Connection]:
        with self._explained(), self._db:
            yield self._db

    def set_files(self, files: Iterable[tuple[str, str | None, str | None]]) -> None:
        """What the folder holds now: (path in it, key of its map or None, why it can't be read or None)."""
        with self._change() as db:
            db.execute("DELETE FROM file")
            db.executemany("INSERT INTO file VALUES (?, ?, ?)", files)

    def files(self) -> list[tuple[str, str | None, str | None]]:
        """What `set_files` was told, by path."""
        return list(self._db.execute("SELECT path, key, error FROM file ORDER BY path"))

    def add_map(self, key: str, name: str, data: bytes) -> None:
        """Keep a map, unless it is kept already."""
        with self._change() as db:
            row = (key, name, data, sha256(data).digest())
            db.execute("INSERT OR IGNORE INTO map VALUES (?, ?, ?, ?)", row)

    def map_data(self, key: str) -> bytes:
        """The map of that key; KeyError where it was never kept."""
        row = self._db.execute("SELECT data FROM map WHERE key = ?", (key,)).fetchone()
        if row is None:
            raise KeyError(key)
        return bytes(row[0])

    def set_wanted(self, pairs: Iterable[Wanted]) -> None:
        """Which pairs the present run is about, in order."""
        with self._change() as db:
            db.execute("DELETE FROM wanted")
            rows = ((place, pair.key, pair.map1, pair.map2) for place, pair in enumerate(pairs))
            db.executemany("INSERT INTO wanted VALUES (?, ?, ?, ?)", rows)

    def wanted(self) -> list[Wanted]:
        """All pairs of the present run, in order."""
        return [Wanted(*row) for row in self._db.execute("SELECT key, map1, map2 FROM wanted ORDER BY place")]

    def missing(self) -> list[Wanted]:
        """The pairs of the present run that are not done."""
        found = self._db.execute(
            "SELECT wanted.key, map1, map2 FROM wanted LEFT JOIN done USING (key) WHERE done.key IS NULL ORDER BY place"
        )
        return [Wanted(*row) for row in found]

    def finish(self, key: str, done: Done) -> None:
        """Commit finished work."""
        with self._change() as db:
            row = (key, done.result, done.error, done.seconds, _digest(done.result, done.error))
            db.execute("INSERT OR REPLACE INTO done VALUES (?, ?, ?, ?, ?)", row)

    def done(self, key: str) -> Done | None:
        """Finished work, or None."""
        row = self._db.execute("SELECT result, error, seconds FROM done WHERE key = ?", (key,)).fetchone()
        return None if row is None else Done(*row)

    def counts(self) -> tuple[int, int, int, float]:
        """Of the present run's pairs: all, done, failed, and the seconds that the done ones took."""
        (every,) = self._db.execute("SELECT COUNT(*) FROM wanted").fetchone()
        done, failed, seconds = self._db.execute(
            "SELECT COUNT(*), COUNT(error), TOTAL(seconds) FROM wanted JOIN done USING (key)"
        ).fetchone()
        return every, done, failed, seconds

    def say(self, name: str, value: str) -> None:
        """Note something about the run, in place of what was noted under that name."""
        with self._change() as db:
            db.execute("INSERT OR REPLACE INTO said VALUES (?, ?)", (name, value))

    def said(self, name: str) -> str | None:
        """What was noted under a name."""
        row = self._db.execute("SELECT value FROM said WHERE name = ?", (name,)).fetchone()
        return None if row is None else str(row[0])


def _digest(result: bytes | None, error: str | None) -> bytes:
    return sha256((result or b"") + b"|" + (error or "").encode()).digest()


def _opened(path: Path) -> sqlite3.Connection:
    """The ledger, with what could be saved of it where it was torn."""
    if path.exists() and not _whole(path):
        torn = path.with_name(f"{path.name}.torn")
        for end in ("", "-wal", "-shm"):
            if (part := path.with_name(path.name + end)).exists():
                part.replace(torn.with_name(torn.name + end))
        db = _connected(path)
        _take_over(db, torn)
        for end in ("", "-wal", "-shm"):
            torn.with_name(torn.name + end).unlink(missing_ok=True)
        return db
    return _connected(path)


def _connected(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=60)
    # the log is checked sum by sum when it is read again: a commit that was torn did not happen
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = NORMAL")
    db.executescript(_SCHEMA)
    return db


def _whole(path: Path) -> bool:
    db = sqlite3.connect(path, timeout=60)
    try:
        sound = db.execute("PRAGMA quick_check(1)").fetchone() == ("ok",)
        return sound and all(_right(table, row) for table in _KEPT for row in _rows(db, table, "ASC", strict=True))
    except sqlite3.OperationalError as error:
        if "no such" in str(error):
            return not db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]
        raise
    except sqlite3.DatabaseError:
        return False
    finally:
        db.close()


def _rows(db: sqlite3.Connection, table: str, order: str, *, strict: bool) -> Iterator[tuple[object, ...]]:
    """The rows of a table up to the first that can't be read, which raises where ``strict``."""
    try:
        yield from db.execute(f"SELECT {', '.join(_KEPT[table])} FROM {table} ORDER BY rowid {order}")
    except sqlite3.DatabaseError:
        if strict:
            raise


def _right(table: str, row: tuple[object, ...]) -> bool:
    """Whether a row holds what was written."""
    if table == "map":
        data = row[2]
        return isinstance(data, bytes) and sha256(data).digest() == row[3]
    result, error = row[1], row[2]
    if not isinstance(result, bytes | None) or not isinstance(error, str | None):
        return False
    return _digest(result, error) == row[4]


def _take_over(db: sqlite3.Connection, torn: Path) -> None:
    """Copy what can be read, from the front and from the back."""
    _fill_up(torn)
    try:
        old = sqlite3.connect(torn)
        with db:
            for table, columns in _KEPT.items():
                marks = ", ".join("?" * len(columns))
                for order in ("ASC", "DESC"):
                    rows = (row for row in _rows(old, table, order, strict=False) if _right(table, row))
                    db.executemany(f"INSERT OR IGNORE INTO {table} VALUES ({marks})", rows)
        old.close()
    except sqlite3.DatabaseError:  # nothing of it is a database any more
        return


def _fill_up(torn: Path) -> None:
    """Empty pages for those that a shortened file lacks: without them SQLite reads none of the others."""
    with torn.open("r+b") as file:
        head = file.read(100)
        size, pages = int.from_bytes(head[16:18]), int.from_bytes(head[28:32])
        if head.startswith(b"SQLite format 3\0") and file.seek(0, 2) < size * pages:
            file.truncate(size * pages)
