"""A real cluster of Dask: a scheduler and worker processes on this machine."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from gateway.batch.executors import ClusterError, DaskCluster, WorkFailed
from tests.kit.cli import run

pytestmark = pytest.mark.io


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1",
        dashboard_address="127.0.0.1:0", silence_logs=50,
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


def _kill_one_worker(marker: Path) -> int:
    """Kill the worker process at the first attempt, as a failing machine would."""
    if marker.name == "deadly" and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.01)
    return len(marker.name)


def _fail(marker: Path) -> int:
    raise KeyError(marker.name)


def test_cluster_gives_the_results_of_this_machine(
    address: str, batch: Path, tmp_path: Path
) -> None:
    files = [batch / name for name in ("alpha_01_v1.csv", "gamma_01_v2.csv", "broken.csv")]
    for out, options in (("cluster", ("--scheduler", address)), ("here", ("--jobs", 1))):
        words = ("report", "--quick", *files, "-o", tmp_path / out, *options)
        assert "1 of 3 recordings failed" in run(*words, code=1)
    for part in ("results", "fused"):
        here, there = (
            {path.name: path.read_bytes() for path in (tmp_path / side / part).iterdir()}
            for side in ("here", "cluster")
        )
        assert here == there
        assert len(here) >= 2


def test_work_of_killed_worker_is_repeated(address: str, tmp_path: Path) -> None:
    names = ["a", "bb", "deadly", "ccc", *(f"more {k}" for k in range(20))]
    with closing(DaskCluster(address)) as cluster:
        found = dict(cluster.run(_kill_one_worker, [tmp_path / name for name in names]))
    assert (tmp_path / "deadly").exists()
    assert found == {k: len(name) for k, name in enumerate(names)}


def test_failed_work_is_returned_with_reason(address: str, tmp_path: Path) -> None:
    with closing(DaskCluster(address)) as cluster:
        ((_, outcome),) = cluster.run(_fail, [tmp_path / "x"])
    assert outcome == WorkFailed("KeyError: 'x'")


def test_missing_scheduler_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.batch.executors.CONNECT_S", 0.3)
    with pytest.raises(ClusterError, match="no Dask scheduler responds"):
        DaskCluster("tcp://127.0.0.1:9")


def test_workers_of_another_version_are_rejected(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.batch.executors.__version__", "0.0.1")
    with pytest.raises(ClusterError, match=r"this is mavgate 0\.0\.1, but"):
        DaskCluster(address)
