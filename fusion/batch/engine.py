"""Worker processes of one machine: jobs in, outcomes as they come; a worker that dies takes nothing else with it.

`concurrent.futures` gives up on all jobs when one worker dies; here each worker is a process of ours with a pipe of
its own. A worker has one job in hand, so that a death says which job it was; that job is tried once more.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from time import perf_counter
from typing import Protocol

import msgspec

from mapfuse.datasets.errors import MapfuseError

from .ledger import Done

#: What a worker does, importable by name: bytes to bytes.
Task = Callable[[bytes], bytes]

#: How often a job is tried whose worker died.
TRIES = 2
#: What is recorded of a job that takes its workers with it, by whichever engine.
KILLED = "its worker process died while at work on it, and another one again"
#: Workers compute on one thread each: there are as many of them as there is to do at once.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Job:
    """Work to do: what its result is kept under, and what goes to the worker."""

    key: str
    data: bytes


class Engine(Protocol):
    """Does jobs somewhere; outcomes come in any order, every job exactly once."""

    def run(self, task: Task, jobs: Iterable[Job]) -> Generator[tuple[str, Done], None, None]:
        """Outcomes by key; ``jobs`` is read as workers get free."""

    def close(self) -> None:
        """Let go of workers that wait for more."""


def attempt(task: Task, data: bytes) -> Done:
    """Do one job; what goes wrong is the outcome."""
    begin = perf_counter()
    try:
        result, error = task(data), None
    except MapfuseError as mistake:
        result, error = None, str(mistake)
    except Exception as bug:
        result, error = None, f"{type(bug).__name__}: {bug}"
    return Done(result, error, perf_counter() - begin)


def _work(pipe: Connection) -> None:
    """A worker's life: until the pipe closes, or the client is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the client alone answers an interrupt
    try:
        while True:
            module, name, data = msgspec.msgpack.decode(pipe.recv_bytes())
            done = attempt(getattr(import_module(module), name), data)
            pipe.send_bytes(msgspec.msgpack.encode((done.result, done.error, done.seconds)))
    except (EOFError, OSError):
        return


@dataclass(eq=False, slots=True)
class _Worker:
    process: BaseProcess
    pipe: Connection
    job: Job | None = None

    def stop(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.join()
        self.process.close()


class LocalEngine:
    """Up to ``count`` worker processes on this machine; they wait for more until the engine is closed."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._workers: list[_Worker] = []

    def close(self) -> None:
        """Let all workers go."""
        while self._workers:
            self._workers.pop().stop()

    def run(self, task: Task, jobs: Iterable[Job]) -> Generator[tuple[str, Done], None, None]:
        """Outcomes by key, as they come. Left before its end, it lets all workers go."""
        coming = iter(jobs)
        again: deque[Job] = deque()
        tried: dict[str, int] = {}
        try:
            while True:
                self._give_out(task, again, coming)
                busy = {w.pipe: w for w in self._workers if w.job is not None}
                if not busy:
                    return
                for pipe in wait(list(busy)):
                    worker = busy[pipe]  # type: ignore[index]
                    job, worker.job = worker.job, None
                    assert job is not None
                    done = _answer(worker)
                    if done is None:
                        self._workers.remove(worker)
                        worker.stop()
                        tried[job.key] = tried.get(job.key, 0) + 1
                        if tried[job.key] < TRIES:
                            again.append(job)
                            continue
                        done = Done(None, KILLED, 0.0)
                    yield job.key, done
        finally:
            if any(worker.job is not None for worker in self._workers):
                self.close()

    def _give_out(self, task: Task, again: deque[Job], coming: Iterator[Job]) -> None:
        """A job to every worker that has none, and to new ones up to the count."""
        idle = [worker for worker in self._workers if worker.job is None]
        while idle or len(self._workers) < self.count:
            job = again.popleft() if again else next(coming, None)
            if job is None:
                return
            if not idle:
                self._workers.append(_started())
                idle.append(self._workers[-1])
            _give(idle.pop(), task, job)


def _give(worker: _Worker, task: Task, job: Job) -> None:
    worker.job = job
    try:
        worker.pipe.send_bytes(msgspec.msgpack.encode((task.__module__, task.__qualname__, job.data)))
    except OSError:  # it has died: its pipe says so when it is waited for
        return


def _answer(worker: _Worker) -> Done | None:
    """What a worker says, or None where it has died."""
    try:
        return Done(*msgspec.msgpack.decode(worker.pipe.recv_bytes()))
    except (EOFError, OSError):
        return None


def _started() -> _Worker:
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(there,), daemon=True)
    with _one_thread():
        process.start()
    there.close()
    return _Worker(process, here)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Environment in which a new process computes on one thread."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
