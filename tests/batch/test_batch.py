import json
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import fsspec
import msgspec
import pandas as pd
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.analysis.reporting.ground_track import ground_track
from gateway.batch.executors import LocalProcesses, ThisProcess, WorkFailed
from gateway.batch.storage import BatchItem, StorageError, items_of
from gateway.batch.tasks import (
    RESULTS,
    EvaluateTask,
    FlightResult,
    ResultFolder,
    read_results,
    run_batch,
    without_secrets,
)
from gateway.pipeline import PipelineSettings
from gateway.recordings.recorded_table import ReadOptions
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.cli import run
from tests.kit.mavlink import packed
from tests.kit.recordings import SECOND_US, START_US, write_tlog

pytestmark = pytest.mark.io

OPTIONS = ReadOptions(PipelineSettings(AircraftSettings()))
FLIGHTS = ("alpha_01_v1.csv", "beta_01_v1.csv", "gamma_01_v2.csv", "delta_01_v2.csv")


def report(*words: object, code: int = 0) -> str:
    return run("report", "--quick", *words, code=code)


@pytest.fixture(scope="module")
def fused(batch: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """All recordings fused by the command."""
    out = tmp_path_factory.mktemp("out")
    return out, report(batch, "-o", out, "--jobs", 2, code=1)


def test_broken_file_is_reported_and_others_are_fused(fused: tuple[Path, str]) -> None:
    out, text = fused
    assert "broken.csv" in text
    assert "1 of 5 recordings failed" in text
    flights = pd.read_csv(out / "flights.csv")
    assert flights["failed"].notna().sum() == 1
    errors = flights.dropna(subset="eskf, m")
    assert sorted(errors["recording"]) == sorted(FLIGHTS)
    assert errors["eskf, m"].between(0.01, 5.0).all()
    page = (out / "index.html").read_text()
    assert "Errors by aircraft and estimator" in page
    assert "broken.csv" in page


def test_batch_gives_states_of_fuse_command(
    batch: Path, fused: tuple[Path, str], tmp_path: Path
) -> None:
    single = tmp_path / "alone.csv"
    run("fuse", batch / FLIGHTS[0], "-o", single)
    states = pd.read_csv(fused[0] / "fused" / "alpha.csv", comment="#")
    alone = pd.read_csv(single, comment="#").dropna(subset="nav_time_us")[states.columns]
    pd.testing.assert_frame_equal(
        states, alone.reset_index(drop=True), check_dtype=False, check_exact=True
    )


def test_finished_recordings_are_not_done_again(batch: Path, fused: tuple[Path, str]) -> None:
    out, _ = fused
    before = {path: path.stat().st_mtime_ns for path in (out / RESULTS).iterdir()}
    assert len(before) == 5
    (out / "fused" / "beta.csv").unlink()
    report(batch, "-o", out, "--jobs", 1, code=1)
    changed = [path for path, time_ns in before.items() if path.stat().st_mtime_ns != time_ns]
    assert len([*(out / RESULTS).iterdir()]) == 5
    assert [json.loads(path.read_bytes())["files"] for path in changed] == [["fused/beta.csv"]]


def test_changed_settings_repeat_the_work(batch: Path, tmp_path: Path) -> None:
    items = items_of([str(batch / FLIGHTS[0])])
    seen: list[str] = []

    class Counted(LocalProcesses):
        def run(self, work, items):
            for number, outcome in super().run(work, items):
                seen.append(type(outcome).__name__)
                yield number, outcome

    folder = ResultFolder(tmp_path)
    for choice in ("recorded", "current", "recorded"):
        options = ReadOptions(OPTIONS.current, choice=choice)
        run_batch(EvaluateTask(options, pages=False), items, Counted(1), folder, lambda *_: None)
    # A digest each time, and two works.
    assert sorted(seen) == ["str", "str", "str", "tuple", "tuple"]


def test_results_of_two_versions_are_compared(
    fused: tuple[Path, str], batch: Path, tmp_path: Path
) -> None:
    out, then = fused[0], tmp_path / "then"
    shutil.copytree(out / RESULTS, then / RESULTS)
    for path in (then / RESULTS).iterdir():
        result = json.loads(path.read_bytes())
        if "held_m" in result["figures"]:
            result["figures"]["held_m"]["eskf"] /= 2.0
            path.write_text(json.dumps(result))
    text = report(batch, "-o", out, "--against", then, code=1)
    found = re.search(r"eskf: median error (\S+) m, (\S+) m in the other results", text)
    assert found is not None
    assert float(found[1]) == pytest.approx(2.0 * float(found[2]), abs=0.002)
    assert text.count("worse: ") == 4
    assert "got worse" in (out / "index.html").read_text()
    report(batch, "-o", out, "--against", tmp_path / "nowhere", code=2)


def result_of(key: str, *files: str) -> FlightResult:
    return FlightResult(location=key, digest="d", key=key, task="report", version="1", files=files)


def test_partial_result_is_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, file = ResultFolder(tmp_path), "reports/a/index.html"
    result = result_of("k", file)

    def fail(*_: object, **__: object) -> None:
        raise OSError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", fail)
        with pytest.raises(OSError, match="full"), folder.held():
            folder.keep(result, {file: b"page"})
    assert not (tmp_path / ".partial").exists()
    assert folder.find("k") is None
    assert not (tmp_path / "reports" / "a").exists()
    again = ResultFolder(tmp_path)
    with again.held():
        assert not (tmp_path / ".partial").exists()
    again.keep(result, {file: b"page"})
    assert again.find("k") == result
    (tmp_path / RESULTS / "k.json").write_bytes(b"")
    assert again.find("k") is None


def test_missing_file_is_reported_in_plain_words(batch: Path, tmp_path: Path) -> None:
    gone = tmp_path / "gone.csv"
    items = [*items_of([str(batch / FLIGHTS[0])]), BatchItem((str(gone),))]
    reported: list[tuple[str, int, int]] = []
    task = EvaluateTask(OPTIONS, pages=False)
    results = run_batch(task, items, LocalProcesses(1), None, lambda *now: reported.append(now))
    assert [done for _, done, total in reported if total == 2] == [1, 2, 2]
    assert [result.error for result in results] == [None, f"{gone}: No such file or directory"]
    assert results[0].began == "2026-05-28 20:26:40"


def test_two_batches_do_not_write_into_one_folder(batch: Path, tmp_path: Path) -> None:
    staged = tmp_path / ".partial" / "k"
    two = [batch / name for name in FLIGHTS[:2]]
    with ResultFolder(tmp_path).held():
        staged.mkdir(parents=True)
        text = report(*two, "-o", tmp_path, code=2)
        assert "another report writes its results here" in text
        assert staged.exists()
    report(*two, "-o", tmp_path)
    assert not staged.exists()


def test_results_with_equal_times_are_sorted_by_name(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path)
    for key in ("b", "z", "a", "m", "c", "y"):
        folder.keep(result_of(key), {})
        os.utime(tmp_path / RESULTS / f"{key}.json", ns=(1, 1))
    os.utime(tmp_path / RESULTS / "b.json", ns=(2, 2))
    assert [found.location for found in read_results(tmp_path)] == [*"acmyzb"]


def test_report_folder_contains_page_and_figures(
    batch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One section stands for all of them, which take ten seconds to draw."""
    monkeypatch.setattr("gateway.analysis.reporting.compose.SECTIONS", (ground_track,))
    run("report", batch / FLIGHTS[0], batch / FLIGHTS[1], "-o", tmp_path, "--jobs", 1)
    folder = tmp_path / "reports" / "alpha"
    assert "Flight report: alpha" in (folder / "index.html").read_text()
    assert (folder / "ground_track.svg").exists()
    assert "flight_map.svg" in {file.name for file in folder.iterdir()}


def test_odd_recordings_of_folders_are_reported_and_kept_apart(batch: Path, tmp_path: Path) -> None:
    """They have equal names, names that are no UTF-8, or no samples."""
    there, out = tmp_path / "there", tmp_path / "out"
    assert "contains no recording" in report(tmp_path, "-o", out, code=2)
    equal = ("x/log_01_v1.csv", "y/log_01_v1.csv")
    for name, flown in zip((*equal, os.fsdecode(b"fl\xfcg_01_v1.csv")), FLIGHTS, strict=False):
        (there / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(batch / flown, there / name)
    (there / os.fsdecode(b"bad\xff.csv")).write_text("")
    fix = mavlink.MAVLink_gps_raw_int_message(0, 3, 470_000_000, 80_000_000, *(0,) * 5, 9)
    records = [RecordedFrame(START_US + n * SECOND_US, packed(fix, 7)) for n in range(9)]
    write_tlog(there / "fixes.tlog", records)
    for _ in range(2):
        text = report(there, there / "x", there / "y", "-o", out, "--jobs", 1, code=1)
        assert "1 of 5 recordings failed" in text
    names = [Path(result.location).name for result in read_results(out)]
    odd = [r"fl\xfcg_01_v1.csv", r"bad\xff.csv", "fixes.tlog"]
    assert sorted(names) == sorted([*(Path(name).name for name in equal), *odd])
    assert len(list((out / "fused").glob("log-*.csv"))) == 2
    flights = pd.read_csv(out / "flights.csv").set_index("recording")
    fixes = flights.loc["fixes.tlog", ["aircraft", "duration, s", "distance, m"]]
    assert fixes.tolist() == [7, 8, 0]
    assert flights["failed"].notna().sum() == 1


def test_tables_are_preferred_to_tlog_of_same_recording(tmp_path: Path) -> None:
    for name in ("a_01.tlog", "a_01_v1.csv", "a_02_v1.csv", "b_01.tlog"):
        (tmp_path / name).write_text("x")
    found = items_of([str(tmp_path)])
    names = [[Path(place).name for place in item.locations] for item in found]
    assert names == [["a_01_v1.csv", "a_02_v1.csv"], ["b_01.tlog"]]


def _die_once(marker: Path) -> str:
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def _die_always(marker: Path) -> str:
    if marker.name == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def _raise(marker: Path) -> str:
    if marker.name == "bad":
        raise IndexError("no such thing")
    return marker.name


@pytest.mark.parametrize(
    ("work", "text"),
    [(_die_once, "once"), (_die_always, "its process died"), (_raise, "IndexError: no such thing")],
)
def test_death_of_process_affects_only_its_own_work(
    work: Callable[[Path], str], text: str, tmp_path: Path
) -> None:
    items = [tmp_path / name for name in ("a", "b", "bad", "c", "d", "e")]
    for item in items:
        if text != "once" or item.name != "bad":
            item.touch()
    found = dict(LocalProcesses(2).run(work, items))
    assert [found[k] for k in (0, 1, 3, 4, 5)] == ["a", "b", "c", "d", "e"]
    bad = found[2]
    assert bad == "bad" if text == "once" else isinstance(bad, WorkFailed) and text in bad.reason


@pytest.fixture
def memory(batch: Path) -> Iterator[str]:
    """Two recordings in fsspec's file system in memory."""
    storage = fsspec.filesystem("memory")
    for name in FLIGHTS[:2]:
        storage.pipe_file(f"/flights/{name}", (batch / name).read_bytes())
    yield "memory://flights"
    storage.rm("/flights", recursive=True)


@pytest.mark.parametrize(("pattern", "first"), [("", 0), ("/*.csv", 0), (f"/{FLIGHTS[1]}", 1)])
def test_url_names_a_folder_a_pattern_or_a_file(memory: str, pattern: str, first: int) -> None:
    found = [item.location for item in items_of([memory + pattern])]
    assert found == [f"{memory}/{name}" for name in FLIGHTS[first:2]]


@pytest.mark.parametrize("folder", ["{memory}", "file://{batch}"])
def test_url_gives_the_results_of_the_local_file(
    memory: str, batch: Path, fused: tuple[Path, str], tmp_path: Path, folder: str
) -> None:
    url = f"{folder.format(memory=memory, batch=batch)}/{FLIGHTS[1]}"
    report(url, "-o", tmp_path, "--jobs", 2)
    alone = (fused[0] / "fused" / "beta.csv").read_bytes()
    assert (tmp_path / "fused" / "beta.csv").read_bytes() == alone


class _Elsewhere(MemoryFileSystem):
    """A storage with marks of change, a host and an error of its own, which counts the reads."""

    protocol = "elsewhere"
    store: ClassVar[dict[str, Any]] = {}
    fetched: ClassVar[list[str]] = []

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return (
            "/" + path.rpartition("://")[2].partition("/")[2].strip("/") if "://" in path else path
        )

    def info(self, path: str, **more: Any) -> dict[str, Any]:
        about = super().info(path, **more)
        if about["type"] == "file":
            about["ETag"] = sha256(self.store[path].getvalue()).hexdigest()
        return about

    def _open(self, path: str, mode: str = "rb", **more: Any) -> Any:
        if mode == "rb":
            if "locked" in path:
                raise LookupError("no key fits elsewhere://user:secret@host")
            self.fetched.append(Path(path).name)
        return super()._open(path, mode, **more)


def test_remote_files_are_fetched_once_unless_changed(batch: Path, tmp_path: Path) -> None:
    fsspec.register_implementation("elsewhere", _Elsewhere, clobber=True)
    storage = fsspec.filesystem("elsewhere")
    for name in FLIGHTS[:2]:
        storage.pipe_file(f"/flights/{name}", (batch / name).read_bytes())
    storage.pipe_file("/flights/locked.csv", b"x")

    def fetched() -> list[str]:
        items = items_of(["elsewhere://user:secret@host/flights"])
        _Elsewhere.fetched.clear()
        task = EvaluateTask(OPTIONS, pages=False)
        results = run_batch(task, items, ThisProcess(), folder, lambda *_: None)
        digests = [sha256(storage.store[f"/flights/{name}"].getvalue()) for name in FLIGHTS[:2]]
        assert [r.digest for r in results[:2]] == [digest.hexdigest() for digest in digests]
        assert [r.location for r in results[:2]] == [
            f"elsewhere://host/flights/{n}" for n in FLIGHTS[:2]
        ]
        place = "elsewhere://host/flights/locked.csv: "
        assert (results[2].error or "").startswith(place)
        assert "secret" not in str(results)
        return _Elsewhere.fetched.copy()

    folder = ResultFolder(tmp_path)
    assert fetched() == [*FLIGHTS[:2]]
    assert fetched() == []
    storage.pipe_file(f"/flights/{FLIGHTS[1]}", (batch / FLIGHTS[2]).read_bytes())
    assert fetched() == [FLIGHTS[1]]


def test_broken_remote_file_is_reported_by_its_url(memory: str, tmp_path: Path) -> None:
    fsspec.filesystem("memory").pipe_file("/flights/broken.csv", b"x,y\n1,2\n")
    text = report(f"{memory}/broken.csv", "-o", tmp_path, code=1)
    assert "memory://flights/broken.csv: the file has no column" in text
    assert "/mavgate-" not in text


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("memory://nothing/*.csv", "contains no recording"),
        ("gopher://old/flights", "gopher"),
        ("s3://bucket/", r"(?s)s3://bucket/: needs.*pip install s3fs"),
    ],
    ids=["empty", "unknown scheme", "missing package"],
)
def test_url_that_gives_no_recording_is_reported(
    name: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(StorageError, match=text):
        items_of([name])


@pytest.mark.parametrize(
    ("words", "lacking"),
    [
        (("memory://flights",), "fsspec"),
        (("{batch}", "--scheduler", "tcp://x:1"), "distributed"),
    ],
)
def test_missing_extra_is_named(
    words: tuple[str, ...], lacking: str, batch: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, lacking, None)
    named = [word.format(batch=batch) for word in words]
    assert "needs the extra batch; to install it: " in report(*named, "-o", tmp_path, code=2)


def test_signing_passphrase_is_not_sent_to_workers() -> None:
    vehicle = msgspec.structs.replace(AircraftSettings().vehicle, signing_passphrase="secret word")
    aircraft = msgspec.structs.replace(AircraftSettings(), vehicle=vehicle)
    options = without_secrets(ReadOptions(PipelineSettings(aircraft, {2: aircraft})))
    with_pages, without = (EvaluateTask(options, pages).fingerprint for pages in (True, False))
    assert b"secret word" not in without
    assert with_pages != without
    assert options.current.aircraft[2].vehicle.signing_passphrase == ""
