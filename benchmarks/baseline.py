"""Metrics with a direction and a tolerance, and the committed baseline that a change is compared with."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

PATH = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured number.

    ``better``: the direction that is an improvement. ``tolerance``: the relative change for the worse that is still
    noise; None where the number depends on the machine and only ``limit`` counts, a promise in the same unit that
    holds whatever the baseline says.
    """

    name: str
    value: float
    unit: str
    better: Literal["lower", "higher"] = "lower"
    tolerance: float | None = 0.02
    limit: float | None = None

    def worsening(self, before: float) -> float:
        """Relative change for the worse since ``before``; negative where it got better."""
        change = self.value - before if self.better == "lower" else before - self.value
        return change / abs(before) if before else change

    def failure(self, before: float | None) -> str | None:
        """Why this number fails the gate, or None."""
        if self.limit is not None:
            broken = self.value > self.limit if self.better == "lower" else self.value < self.limit
            if broken:
                return f"{self.name}: {self.value:.4g} {self.unit} breaks the limit of {self.limit:g}"
        if self.tolerance is None:
            return None
        if before is None:
            return f"{self.name}: is not in the baseline; run with --update-baseline"
        if self.worsening(before) > self.tolerance:
            return f"{self.name}: {self.value:.4g} {self.unit} was {before:.4g}, beyond {self.tolerance:.0%}"
        return None


def best_of(first: Iterable[Metric], second: Iterable[Metric]) -> list[Metric]:
    """The better measurement of each metric: a time is disturbed only upwards."""
    again = {metric.name: metric for metric in second}
    return [min(m, again.get(m.name, m), key=lambda x: x.value if x.better == "lower" else -x.value) for m in first]


def read(path: Path = PATH) -> dict[str, float]:
    """Values of the baseline by name; empty where there is none."""
    if not path.exists():
        return {}
    return {name: entry["value"] for name, entry in json.loads(path.read_text()).items()}


def write(metrics: Iterable[Metric], path: Path = PATH) -> None:
    """Make these metrics the baseline."""
    entries = {m.name: {**asdict(m), "value": float(f"{m.value:.4g}")} for m in metrics}
    for entry in entries.values():
        del entry["name"]
    path.write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n")


def failures(metrics: Iterable[Metric], before: Mapping[str, float]) -> list[str]:
    """What fails the gate, metrics of the baseline that were not measured included."""
    measured = list(metrics)
    found = [reason for metric in measured if (reason := metric.failure(before.get(metric.name)))]
    missing = before.keys() - {metric.name for metric in measured}
    return found + [f"{name}: is in the baseline but was not measured" for name in sorted(missing)]
