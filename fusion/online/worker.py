"""Weighing in another process, so that no message waits for it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from multiprocessing.connection import Connection

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import LandmarkMap

from ..config import FuseConfig
from ..result import FusedMap
from .judge import Judge


class Worker:
    """A `Judge` elsewhere: one question at a time, the answer when it is asked for.

    A question is sent as soon as it is asked; `answer` waits where there is none yet. Joint covariances of merged maps
    stay there: over a thousand landmarks they are as long as everything else together.
    """

    def __init__(self, config: FuseConfig) -> None:
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, config), daemon=True, name="mapfuse-judge")
        self._process.start()
        there.close()
        self.busy = False
        self.asked_at = float("-inf")

    def ask(self, changed: Mapping[str, LandmarkMap], at: float) -> None:
        """Have these maps weighed, as of time ``at`` [s]. Raises `MapfuseError` where the process has ended."""
        assert not self.busy
        try:
            self._here.send(dict(changed))
        except OSError as error:
            raise MapfuseError("the process that weighs has ended") from error
        self.busy, self.asked_at = True, at

    @property
    def ready(self) -> bool:
        """Whether the answer is there."""
        return self._here.poll()

    def answer(self) -> tuple[float, FusedMap]:
        """The time that was asked at, and the answer. Raises what the weighing raised."""
        try:
            found = self._here.recv()
        except (EOFError, OSError) as error:
            raise MapfuseError("the process that weighs has ended") from error
        finally:
            self.busy = False
        if isinstance(found, Exception):
            raise found
        return self.asked_at, found

    def close(self) -> None:
        """End the process."""
        self._here.close()
        self._process.join(timeout=1.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()


def _serve(connection: Connection, config: FuseConfig) -> None:
    judge = Judge(config)
    while True:
        try:
            changed = connection.recv()
        except EOFError:
            return
        try:
            fused: FusedMap | Exception = judge.weigh(changed, covariances=False)
        except Exception as error:
            fused = error
        try:
            connection.send(fused)
        except BrokenPipeError:  # whoever asked has gone
            return
