"""Kernels are loaded late, kept on disk where that is possible, and nothing fails where it isn't."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from types import SimpleNamespace

import numba
import pytest

from mapfuse.datasets import compiled


def test_importing_the_matcher_does_not_load_numba():
    code = "import sys, mapfuse.matching, mapfuse.fusion.cli; print('numba' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.strip() == "False"


def test_where_no_folder_can_be_written_kernels_are_compiled_all_the_same(monkeypatch):
    plain = numba.njit

    def nowhere(*args, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return plain(*args, **options)

    monkeypatch.setattr(numba, "njit", nowhere)
    double = compiled.kernel(lambda x: 2 * x)
    assert double(3) == 6


@pytest.mark.parametrize(("kept", "said"), [(True, 0), (False, 1)])
def test_a_first_compilation_is_announced_once(monkeypatch, caplog, kept, said):
    module = SimpleNamespace(__file__=__file__)
    monkeypatch.setattr(compiled, "import_module", lambda name: module)
    monkeypatch.setattr(compiled, "_is_on_disk", lambda module: kept)
    compiled.kernels.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert compiled.kernels("anything", "any", "things") is compiled.kernels("anything", "any", "things") is module
    compiled.kernels.cache_clear()
    assert len(caplog.records) == said


def test_machine_code_older_than_the_source_does_not_count(tmp_path):
    source = tmp_path / "_some_kernels.py"
    source.write_text("")
    dispatcher = SimpleNamespace(py_func=None, stats=SimpleNamespace(cache_path=str(tmp_path)))
    module = SimpleNamespace(__file__=str(source), f=dispatcher)
    assert not compiled._is_on_disk(module)
    index = tmp_path / "_some_kernels.f-1.py311.nbi"
    index.write_text("")
    assert compiled._is_on_disk(module)
    os.utime(index, (1, 1))
    assert not compiled._is_on_disk(module)
