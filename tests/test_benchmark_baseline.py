"""The benchmarks' gate: what fails it and what doesn't."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def baseline() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "baseline.py"
    spec = importlib.util.spec_from_file_location("benchmark_baseline", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_a_change_within_the_tolerance_passes_and_beyond_it_fails(baseline: ModuleType) -> None:
    metric = baseline.Metric("time", 1.2, "x", tolerance=0.25)
    assert metric.failure(1.0) is None
    assert "was 0.9" in metric.failure(0.9)


def test_direction_decides_what_is_worse(baseline: ModuleType) -> None:
    merged = baseline.Metric("merged", 0.90, "share", better="higher", tolerance=0.02)
    assert merged.failure(0.95) is not None
    assert merged.failure(0.80) is None
    assert baseline.Metric("off", 0.5, "m").failure(0.0) is not None


def test_a_limit_holds_whatever_the_baseline_says(baseline: ModuleType) -> None:
    metric = baseline.Metric("help", 0.31, "s", tolerance=None, limit=0.3)
    assert "limit" in metric.failure(0.5)
    assert baseline.Metric("help", 0.29, "s", tolerance=None, limit=0.3).failure(0.01) is None


def test_new_and_vanished_metrics_fail(baseline: ModuleType) -> None:
    found = baseline.failures([baseline.Metric("new", 1.0, "m")], {"gone": 1.0})
    assert len(found) == 2
    assert {reason.partition(":")[0] for reason in found} == {"new", "gone"}


def test_the_better_measurement_of_each_metric_is_kept(baseline: ModuleType) -> None:
    def measured(time: float, share: float) -> list[object]:
        return [baseline.Metric("time", time, "x"), baseline.Metric("share", share, "", better="higher")]

    best = baseline.best_of(measured(1.0, 0.5), measured(2.0, 0.7))
    assert [metric.value for metric in best] == [1.0, 0.7]


def test_written_and_read_back(baseline: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "b.json"
    assert baseline.read(path) == {}
    baseline.write(
        [baseline.Metric("a", 1.23456, "m"), baseline.Metric("b", 2.0, "s", tolerance=None, limit=3.0)], path
    )
    assert baseline.read(path) == {"a": 1.235, "b": 2.0}
