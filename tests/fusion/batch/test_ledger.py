"""The ledger: what was committed is there again, whatever happened to the file."""

from __future__ import annotations

import sqlite3

import pytest

from mapfuse.datasets.errors import InputError, OutputError
from mapfuse.fusion.batch.ledger import LEDGER, Done, Ledger, Wanted, key_of


@pytest.fixture
def path(tmp_path):
    return tmp_path / LEDGER


def filled(path, count=200):
    """A closed ledger with so much finished work that it has many pages."""
    with Ledger(path) as ledger:
        ledger.set_wanted(Wanted(f"pair {k}", "a", "b") for k in range(count))
        for k in range(count):
            ledger.finish(f"pair {k}", Done(str(k).encode() * 300, None, 0.5))


def test_finished_work_is_there_again(path):
    with Ledger(path) as ledger:
        ledger.add_map("k", "name", b"data")
        ledger.set_wanted([Wanted("p", "k", "k"), Wanted("q", "k", "k")])
        ledger.finish("p", Done(b"result", None, 1.5))
        ledger.finish("q", Done(None, "because", 0.5))
    with Ledger(path) as ledger:
        assert ledger.map_data("k") == b"data"
        assert ledger.done("p") == Done(b"result", None, 1.5)
        assert ledger.done("q") == Done(None, "because", 0.5)
        assert ledger.missing() == []
        assert ledger.counts() == (2, 2, 1, 2.0)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9, 1.0])
def test_a_file_that_ends_early_keeps_what_can_be_read(path, kept):
    filled(path)
    whole = path.read_bytes()
    page = 4096
    path.write_bytes(whole[: int(len(whole) * kept) // page * page + (page // 2 if kept < 1 else 0)])
    with Ledger(path) as ledger:
        missing = {wanted.key for wanted in ledger.missing()}
        found = [k for k in range(200) if (done := ledger.done(f"pair {k}")) and done.result == str(k).encode() * 300]
        assert len(found) + sum(ledger.done(f"pair {k}") is None for k in range(200)) == 200
        assert len(found) >= 200 * (kept - 0.2)
        assert all(f"pair {k}" not in missing for k in found)
        ledger.finish("new", Done(b"x", None, 0.0))


def test_a_torn_last_page_costs_no_other_page(path):
    filled(path)
    whole = bytearray(path.read_bytes())
    whole[-4096:] = b"\xa5" * 4096
    path.write_bytes(bytes(whole))
    with Ledger(path) as ledger:
        lost = [k for k in range(200) if ledger.done(f"pair {k}") is None]
        assert len(lost) < 20
        assert not list(path.parent.glob("*.torn*")), "what was saved is in the new file"


def test_a_changed_byte_of_a_result_is_seen(path):
    filled(path, 3)
    db = sqlite3.connect(path)
    with db:
        db.execute("UPDATE done SET result = X'00' WHERE key = 'pair 1'")
    db.close()
    with Ledger(path) as ledger:
        assert ledger.done("pair 1") is None
        assert ledger.done("pair 2") is not None


def test_a_log_that_was_torn_in_a_commit_keeps_all_commits_before(path):
    """Killed while writing: the last frames of the write-ahead log are cut off."""
    ledger = Ledger(path)
    for k in range(20):
        ledger.finish(f"pair {k}", Done(b"x" * 3000, None, 0.0))
    log = path.with_name(path.name + "-wal")
    copy = path.with_name("copy.sqlite")
    copy.write_bytes(path.read_bytes())
    copy.with_name(copy.name + "-wal").write_bytes(log.read_bytes()[:-2000])
    ledger._db.close()
    with Ledger(copy) as ledger:
        assert [k for k in range(20) if ledger.done(f"pair {k}") is None] == [19]


def test_a_file_that_is_no_database_is_replaced(path):
    path.write_text("this is no ledger at all, and long enough not to be taken for an empty one" * 20)
    with Ledger(path) as ledger:
        assert ledger.counts() == (0, 0, 0, 0.0)


def test_reading_needs_a_ledger_that_can_be_read(tmp_path, path):
    with pytest.raises(InputError, match="no batch has run here"):
        Ledger.to_read(path)
    path.write_text("no ledger" * 2000)
    with pytest.raises(InputError, match="the next run mends"):
        Ledger.to_read(path)
    with pytest.raises(OutputError, match="can't be written"):
        Ledger(tmp_path / "no such folder" / LEDGER)


def test_a_key_tells_apart_what_differs():
    assert len({key_of("ab", "c"), key_of("a", "bc"), key_of("abc"), key_of(b"ab", "c", "")}) == 4
