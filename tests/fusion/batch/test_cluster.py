"""dask.distributed does the same jobs: the same bytes, and a job that kills its worker fails alone."""

from __future__ import annotations

from contextlib import closing

import pytest

from mapfuse.datasets.errors import MapfuseError
from mapfuse.fusion.batch import cluster
from mapfuse.fusion.batch.cluster import DaskEngine
from mapfuse.fusion.batch.run import run_batch
from mapfuse.fusion.config import FuseConfig

pytestmark = pytest.mark.xdist_group("batch")


def test_a_folder_gives_the_same_bytes_on_dask(folder, tmp_path, fuse_folder, files_of):
    pytest.importorskip("distributed", reason="the extra [batch] isn't installed")
    fuse_folder(folder, tmp_path / "local")
    with closing(DaskEngine(None, 1)) as engine:
        run_batch(folder, tmp_path / "dask", FuseConfig(), engine)
    assert files_of(tmp_path / "dask") == files_of(tmp_path / "local")


def test_no_scheduler_is_said(monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    pytest.importorskip("distributed", reason="the extra [batch] isn't installed")
    with closing(DaskEngine("tcp://127.0.0.1:1", 1)) as engine, pytest.raises(MapfuseError, match="no scheduler"):
        list(engine.run(len, []))
