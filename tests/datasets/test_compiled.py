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
def test_a_first_compilation_is_announced_once(monkeypatch, caplog, tmp_path, kept, said):
    module = SimpleNamespace(__file__=__file__)
    monkeypatch.setattr(compiled, "import_module", lambda name: module)
    monkeypatch.setattr(compiled, "_on_disk", lambda module: ([tmp_path] if kept else [], []))
    compiled.kernels.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert compiled.kernels("anything", "any", "things") is compiled.kernels("anything", "any", "things") is module
    compiled.kernels.cache_clear()
    assert len(caplog.records) == said


def test_machine_code_older_than_the_source_does_not_count_and_is_removed(monkeypatch, tmp_path):
    # of an earlier version it may name classes that are gone, and numba fails at reading it
    source = tmp_path / "_some_kernels.py"
    source.write_text("")
    dispatcher = SimpleNamespace(py_func=None, stats=SimpleNamespace(cache_path=str(tmp_path)))
    module = SimpleNamespace(__file__=str(source), f=dispatcher)
    assert compiled._on_disk(module) == ([], [])
    old, new = tmp_path / "_some_kernels.f-1.py311.nbi", tmp_path / "_some_kernels.g-9.py311.nbi"
    other = tmp_path / "_other_kernels.f-1.py311.nbi"
    for index in (old, new, other):
        index.write_text("")
    for index in (old, other):
        os.utime(index, (1, 1))
    assert compiled._on_disk(module) == ([new], [old])
    monkeypatch.setattr(compiled, "import_module", lambda name: module)
    compiled.kernels.cache_clear()
    compiled.kernels("_some_kernels", "any", "things")
    compiled.kernels.cache_clear()
    assert new.exists()
    assert other.exists()
    assert not old.exists()


def test_machine_code_that_names_a_class_which_is_gone_is_compiled_anew(tmp_path):
    # as after an update: the same function at the same line, called with another named tuple before
    kernel = "from mapfuse.datasets.compiled import kernel\n\n\n@kernel\ndef f(x):\n    return x[0]\n"
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "_some_kernels.py").write_text(kernel)
    (tmp_path / "named.py").write_text("from typing import NamedTuple\n\n\nclass Gone(NamedTuple):\n    a: int\n")
    load = f"import sys; sys.path.insert(0, {str(tmp_path.parent)!r}); from mapfuse.datasets.compiled import kernels\n"
    load += f"module = kernels('_some_kernels', {tmp_path.name!r}, 'some')\n"
    first = load + f"from {tmp_path.name}.named import Gone\nprint(module.f(Gone(3)))"
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    assert _printed(first, environment) == "3"
    assert list((tmp_path / "__pycache__").glob("*.nbi"))
    (tmp_path / "named.py").write_text("")
    (tmp_path / "_some_kernels.py").write_text(kernel)
    assert _printed(load + "print(module.f((4, 5)))", environment) == "4"


def _printed(code: str, environment: dict[str, str]) -> str:
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
    return run.stdout.strip()
