"""What can go wrong with a user's input: one root, one class per meaning.

Expected outcomes ("these maps don't overlap") are values, not errors; only mistakes raise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


class MapfuseError(Exception):
    """Root of every error that mapfuse raises on purpose; its text is one clear sentence."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One broken rule of a file: where it is (``landmarks[3].links[0].heading``) and what is wrong there."""

    place: str
    reason: str

    def __str__(self) -> str:
        return f"{self.place}: {self.reason}" if self.place else self.reason


class FileFormatError(MapfuseError):
    """A file breaks the rules of its format; ``problems`` lists all of them, ``path`` is the file."""

    def __init__(self, path: str | Path, problems: tuple[Problem, ...]) -> None:
        self.path = Path(path)
        self.problems = problems
        lines = "\n".join(f"  {problem}" for problem in problems)
        super().__init__(f"{path}: {problems[0]}" if len(problems) == 1 else f"{path}:\n{lines}")


class MapError(MapfuseError):
    """A map built in memory breaks a rule of the format; ``problems`` lists all of them."""

    def __init__(self, name: str, problems: tuple[Problem, ...]) -> None:
        self.name = name
        self.problems = problems
        super().__init__(f"map {name!r}: " + "; ".join(str(problem) for problem in problems))


class ConfigError(MapfuseError):
    """A parameter has a value that makes no sense; the text names parameter, value and what is allowed."""


class TooLargeError(MapfuseError):
    """The job needs more memory than a stated bound; the text says what to use instead."""


class UndeterminedError(MapfuseError):
    """The measurements leave something undetermined; ``landmarks`` are the (map, id) concerned."""

    def __init__(self, reason: str, landmarks: tuple[tuple[str, str], ...] = ()) -> None:
        self.landmarks = landmarks
        named = ", ".join(f"{name}:{identifier}" for name, identifier in landmarks[:10])
        more = f" and {len(landmarks) - 10} more" if len(landmarks) > 10 else ""
        super().__init__(f"{reason}: {named}{more}" if landmarks else reason)
