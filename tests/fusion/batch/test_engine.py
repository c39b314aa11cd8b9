"""Workers: what they answer, and that the death of one costs one job."""

from __future__ import annotations

import os
from contextlib import closing

import pytest

from mapfuse.fusion.batch.engine import KILLED, Job, LocalEngine

JOBS = [Job(f"job {k}", str(k).encode()) for k in range(8)]
TASKS = """
    import os, signal
    from pathlib import Path
    from mapfuse.datasets.errors import MapfuseError

    def square(data):
        return str(int(data) ** 2).encode()

    def deadly(data):
        if data == b"3":
            os.kill(os.getpid(), signal.SIGKILL)
        return square(data)

    def deadly_once(data):
        if data == b"3":
            marker = Path(__file__).with_name("died")
            if not marker.exists():
                marker.touch()
                os.abort()
        return square(data)

    def failing(data):
        if data == b"2":
            raise MapfuseError("two is not liked")
        if data == b"5":
            raise ZeroDivisionError("five")
        return square(data)
"""


@pytest.fixture
def tasks(helper):
    helper("batch_tasks", TASKS)
    import batch_tasks  # type: ignore[import-not-found]

    return batch_tasks


def outcomes(task, count=2):
    with closing(LocalEngine(count)) as engine:
        found = list(engine.run(task, JOBS))
    assert sorted(key for key, _ in found) == [job.key for job in JOBS], "every job once"
    return dict(found)


def test_a_worker_that_always_dies_fails_its_job_alone(tasks):
    found = outcomes(tasks.deadly)
    assert found["job 3"].error == KILLED
    assert {key: done.result for key, done in found.items() if key != "job 3"} == {
        f"job {k}": str(k * k).encode() for k in range(8) if k != 3
    }


def test_a_worker_that_dies_once_costs_nothing(tasks):
    found = outcomes(tasks.deadly_once, count=1)
    assert all(done.error is None for done in found.values())
    assert found["job 3"].result == b"9"


def test_what_a_job_raises_is_its_outcome(tasks):
    found = outcomes(tasks.failing, count=1)
    assert found["job 2"].error == "two is not liked"
    assert found["job 5"].error == "ZeroDivisionError: five"
    assert sum(done.error is None for done in found.values()) == 6


def test_workers_are_gone_when_a_run_is_left(tasks):
    engine = LocalEngine(1)
    coming = engine.run(tasks.square, JOBS)
    next(coming)
    workers = [worker.process for worker in engine._workers]
    (pid,) = (process.pid for process in workers)
    assert pid is not None
    coming.close()
    engine.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
