"""The same jobs on dask.distributed (extra ``[batch]``): workers of this machine, or of a cluster by its scheduler."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from concurrent.futures import CancelledError
from contextlib import ExitStack
from importlib.metadata import version
from itertools import islice
from typing import Any

from mapfuse.datasets.errors import MapfuseError

from .engine import KILLED, TRIES, Job, Task, attempt
from .ledger import Done

#: Jobs on their way per thread of the cluster: one at work, one waiting beside it.
AHEAD = 2
#: How long [s] a scheduler may take to answer, and its first worker to come.
PATIENCE = 20


class DaskEngine:
    """Jobs on the cluster of a scheduler, or, without an address, on ``count`` dask workers of this machine.

    Raises `MapfuseError` where dask isn't installed.
    """

    def __init__(self, address: str | None, count: int) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise MapfuseError("dask.distributed isn't installed: it comes with mapfuse's extra [batch]") from None
        self.address, self.count = address, count
        self._open = ExitStack()
        self._client: Any = None

    def close(self) -> None:
        """Leave the cluster; one of our own ends."""
        self._client = None
        self._open.close()

    def run(self, task: Task, jobs: Iterable[Job]) -> Generator[tuple[str, Done], None, None]:
        """Outcomes by key, as they come.

        Raises `MapfuseError` where the scheduler can't be reached or is lost, or its workers have another mapfuse.
        """
        from distributed import as_completed

        coming = iter(jobs)
        client = self._connected()
        room = AHEAD * max(1, sum(client.nthreads().values()))
        flying = as_completed()
        try:
            for job in islice(coming, room):
                flying.add(_submitted(client, task, job))
            for future in flying:
                key, done = str(future.key), _outcome(future)
                future.release()
                for job in islice(coming, 1):
                    flying.add(_submitted(client, task, job))
                yield key, done
        except (CancelledError, OSError) as error:
            raise MapfuseError(f"the scheduler was lost: {error}; what is done is kept, start again") from error

    def _connected(self) -> Any:
        if self._client is not None:
            return self._client
        import dask
        from distributed import Client, LocalCluster

        self._open.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": TRIES - 1}))
        address = self.address
        if address is None:
            cluster = LocalCluster(n_workers=self.count, threads_per_worker=1, dashboard_address=None)
            address = self._open.enter_context(cluster).scheduler_address
        try:
            self._client = self._open.enter_context(Client(address, timeout=PATIENCE))
            self._client.wait_for_workers(1, timeout=PATIENCE)
        except (OSError, ValueError, TimeoutError) as error:
            raise MapfuseError(f"no scheduler with workers answers at {address}: {error}") from error
        _check_versions(self._client)
        return self._client


def _version() -> str:
    return version("mapfuse")


def _check_versions(client: Any) -> None:
    try:
        found = set(client.run(_version).values())
    except Exception as error:  # a worker without mapfuse can't even read what is asked of it
        raise MapfuseError(f"the workers can't run mapfuse: {type(error).__name__}: {error}") from error
    if found != {_version()}:
        raise MapfuseError(f"the workers have mapfuse {', '.join(sorted(found))}; this is {_version()}")


def _submitted(client: Any, task: Task, job: Job) -> Any:
    return client.submit(attempt, task, job.data, key=job.key, pure=False)


def _outcome(future: Any) -> Done:
    from distributed import KilledWorker

    error = future.exception()
    if error is None:
        outcome: Done = future.result()
        return outcome
    if isinstance(error, KilledWorker):
        return Done(None, KILLED, 0.0)
    raise MapfuseError(f"a dask worker failed: {type(error).__name__}: {error}") from error
