"""What can go wrong with a user's input: one root, one class per meaning.

Expected outcomes ("these maps don't overlap") are values, not errors; only mistakes raise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Problems that the text of an error shows; its ``problems`` always hold all of them.
SHOWN_PROBLEMS = 20


class MapfuseError(Exception):
    """Root of every error that mapfuse raises on purpose; its text is one clear sentence."""


class InputError(MapfuseError):
    """A file can't be read at all: missing, a folder, forbidden, too large; ``path`` is the file."""

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path = Path(path)
        self.reason = reason
        super().__init__(f"{path}: {reason}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.reason)


class OutputError(MapfuseError):
    """A result can't be written, and nothing was: ``path`` is the file that was to be."""

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path = Path(path)
        self.reason = reason
        super().__init__(f"{path}: {reason}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.reason)


@dataclass(frozen=True, slots=True)
class Problem:
    """One broken rule of a file: where it is (``landmarks[3].links[0].heading``) and what is wrong there."""

    place: str
    reason: str

    def __str__(self) -> str:
        return f"{self.place}: {self.reason}" if self.place else self.reason


def _listed(head: str, problems: tuple[Problem, ...]) -> str:
    """One problem on the line of its file or map, several on a line each, the first `SHOWN_PROBLEMS` of them."""
    if len(problems) == 1:
        return f"{head}: {problems[0]}"
    lines = [f"  {problem}" for problem in problems[:SHOWN_PROBLEMS]]
    if len(problems) > SHOWN_PROBLEMS:
        lines.append(f"  and {len(problems) - SHOWN_PROBLEMS:,} more")
    return "\n".join([f"{head}: {len(problems):,} problems", *lines])


class FileFormatError(MapfuseError):
    """A file breaks the rules of its format; ``problems`` lists all of them, ``path`` is the file."""

    def __init__(self, path: str | Path, problems: tuple[Problem, ...]) -> None:
        self.path = Path(path)
        self.problems = problems
        super().__init__(_listed(str(path), problems))

    def __reduce__(self) -> tuple[Any, ...]:
        # Exception's own way would call the class with the text alone, and fail where a worker process sends it home
        return type(self), (self.path, self.problems)


class MapError(MapfuseError):
    """A map built in memory breaks a rule of the format; ``problems`` lists all of them."""

    def __init__(self, name: str, problems: tuple[Problem, ...]) -> None:
        self.name = name
        self.problems = problems
        super().__init__(_listed(f"map {name!r}", problems))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.problems)


class ConfigError(MapfuseError):
    """A parameter has a value that makes no sense; the text names parameter, value and what is allowed."""


class TooLargeError(MapfuseError):
    """The job needs more memory than a stated bound; the text says what to use instead."""


class UndeterminedError(MapfuseError):
    """The measurements leave something undetermined; ``landmarks`` are the (map, id) concerned."""

    def __init__(self, reason: str, landmarks: tuple[tuple[str, str], ...] = ()) -> None:
        self.reason = reason
        self.landmarks = landmarks
        named = ", ".join(f"{name}:{identifier}" for name, identifier in landmarks[:10])
        more = f" and {len(landmarks) - 10} more" if len(landmarks) > 10 else ""
        super().__init__(f"{reason}: {named}{more}" if landmarks else reason)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.reason, self.landmarks)
