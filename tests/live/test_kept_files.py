"""Kept files: written completely or not at all, failures reported, broken ones left alone."""

import asyncio
import errno
import os
import stat
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import CodeType, FrameType, SimpleNamespace
from typing import Any

import pytest

from gateway.live import kept_files
from gateway.live.kept_files import TIMESTAMPS_NAME, PlanFiles, TimestampFile
from gateway.vehicle.plan import Location, StoredPlan

pytestmark = pytest.mark.io

FIRST = StoredPlan(mark=Location(1.0, 2.0, 3.0))
SECOND = StoredPlan(mark=Location(4.0, 5.0, 6.0))


class Bench:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reports: list[tuple[int, str | None]] = []
        self.files = PlanFiles(folder, lambda *report: self.reports.append(report))

    async def save(self, vehicle_id: int, plan: StoredPlan) -> None:
        self.files.save(vehicle_id, plan)
        await self.files.settle()

    def read(self) -> dict[int, StoredPlan]:
        return PlanFiles(self.folder, lambda *_: None).load()


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    made = Bench(tmp_path / "aircraft")
    yield made
    made.files.close()


async def test_saved_plans_are_loaded(bench: Bench) -> None:
    assert bench.files.load() == {}
    await bench.save(1, FIRST)
    await bench.save(31, SECOND)
    assert bench.read() == {1: FIRST, 31: SECOND}
    await bench.save(1, SECOND)
    assert bench.read() == {1: SECOND, 31: SECOND}
    assert sorted(f.name for f in bench.folder.iterdir()) == ["1.plan.json", "31.plan.json"]


async def test_only_the_newest_of_many_plans_is_written(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = counted(monkeypatch)
    for _ in range(100):
        bench.files.save(1, FIRST)
    bench.files.save(1, SECOND)
    await bench.files.settle()
    assert bench.read() == {1: SECOND}
    assert len(written) <= 2


async def test_closing_writes_pending_plans(bench: Bench) -> None:
    bench.files.save(1, FIRST)
    bench.files.save(2, SECOND)
    bench.files.close()
    assert bench.read() == {1: FIRST, 2: SECOND}


async def test_failed_write_is_counted_and_reported_with_its_end(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bench.save(1, FIRST)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        await bench.save(1, SECOND)
    assert bench.reports == [(1, "No space left on device")]
    assert bench.files.failures == 1
    assert bench.read() == {1: FIRST}, "the old file is whole"
    await bench.save(1, SECOND)
    assert bench.read() == {1: SECOND}
    assert bench.reports[1:] == [(1, None)]


async def test_failed_write_is_retried_and_reported_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = []
    fsync: Callable[[int], None] = os.fsync

    def ill(fd: int) -> None:
        attempts.append(fd)
        if len(attempts) < 5:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        fsync(fd)

    monkeypatch.setattr(os, "fsync", ill)
    monkeypatch.setattr(kept_files, "RETRY_S", 0)
    await bench.save(1, FIRST)
    assert len(attempts) == 1, "the next attempt is not made at once"
    async with asyncio.timeout(60):
        while bench.reports[-1:] != [(1, None)]:
            await asyncio.sleep(0)
    assert bench.reports == [(1, "Input/output error"), (1, None)]
    assert bench.files.failures == 1
    assert bench.read() == {1: FIRST}
    assert bench.files._retry is None


async def test_unwritable_plan_does_not_delay_others(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bench.save(2, FIRST)
    file = bench.folder / "1.plan.json"
    file.write_text("{")
    bench.files.load()
    bench.files.save(1, FIRST)
    await bench.save(2, SECOND)
    assert bench.files.broken == {1: "1.plan.json is broken: repair or remove it"}
    file.unlink()
    assert bench.read() == {2: SECOND}
    await bench.save(2, FIRST)
    assert bench.read() == {1: FIRST, 2: FIRST}, "the pending plan was written with it"


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b'{"version": 7}'])
async def test_broken_plan_is_reported_and_not_overwritten(
    bench: Bench, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    await bench.save(2, SECOND)
    file = bench.folder / "1.plan.json"
    file.write_bytes(content)
    assert bench.files.load() == {2: SECOND}
    assert f"{file} cannot be read and is left alone: " in caplog.text
    await bench.save(1, FIRST)
    assert file.read_bytes() == content
    assert bench.reports == [(1, "1.plan.json is broken: repair or remove it")]
    file.unlink()
    await bench.save(1, FIRST)
    assert bench.read() == {1: FIRST, 2: SECOND}


async def test_files_with_other_names_are_ignored(bench: Bench) -> None:
    await bench.save(1, FIRST)
    for name in ("x.plan.json", "1.plan.json.bak", "12345.plan.json", "1.plan.new"):
        (bench.folder / name).write_text("nonsense")
    assert bench.files.load() == {1: FIRST}
    assert bench.reports == []


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the writes."""
    calls: list[int] = []
    fsync: Callable[[int], None] = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append(fd), fsync(fd))[1])
    return calls


TIMESTAMPS = {1: {"0123456789abcdef": {"0.255.190": 36_000_000_000_000}}, 31: {"ff": {"1.2.3": 7}}}


def test_saved_timestamps_are_loaded(tmp_path: Path) -> None:
    file = TimestampFile(tmp_path / "new")
    assert file.load() == {}
    file.save({1: {}})
    file.close(TIMESTAMPS)
    assert TimestampFile(tmp_path / "new").load() == TIMESTAMPS
    assert stat.S_IMODE((tmp_path / "new" / TIMESTAMPS_NAME).stat().st_mode) == 0o600


def is_switched(
    action: Callable[[], None], code: CodeType, at: int, other: Callable[[], None]
) -> bool:
    """Call `other` before instruction `at` of a function; return whether it has so many."""
    left = at

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal left
        if frame.f_code is not code:
            return None
        frame.f_trace_opcodes = True
        left -= event == "opcode"
        if event == "opcode" and left == 0:
            other()
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    finally:
        sys.settrace(before)
    return left <= 0


@pytest.mark.parametrize("is_saving", [True, False], ids=["save", "write"])
def test_thread_switch_at_any_instruction_loses_no_timestamps(
    tmp_path: Path, is_saving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: deque[Callable[[], None]] = deque()
    file, number, at, is_inside = TimestampFile(tmp_path), 0, 0, True
    monkeypatch.setattr(file, "_worker", SimpleNamespace(submit=jobs.append))

    def save() -> None:
        nonlocal number
        number += 1
        file.save({1: {"ff": {"0.255.190": number}}})

    def work() -> None:
        while jobs:
            jobs.popleft()()

    while is_inside:
        at += 1
        save()
        if is_saving:
            is_inside = is_switched(save, TimestampFile.save.__code__, at, work)
        else:
            is_inside = is_switched(work, TimestampFile._write.__code__, at, save)
        work()
        assert file.load() == {1: {"ff": {"0.255.190": number}}}, at


def test_closing_without_timestamps_leaves_the_file_unchanged(tmp_path: Path) -> None:
    TimestampFile(tmp_path).close(TIMESTAMPS)
    TimestampFile(tmp_path).close({})
    assert TimestampFile(tmp_path).load() == TIMESTAMPS


@pytest.mark.parametrize("text", ["", "[]", '{"1":{"k":{"0.1":3}}}', '{"1":{"k":{"0.1.1":-3}}}'])
def test_broken_file_of_timestamps_is_reported(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / TIMESTAMPS_NAME).write_text(text)
    assert TimestampFile(tmp_path).load() == {}
    assert "cannot be read" in caplog.text


def test_unwritable_timestamps_are_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / TIMESTAMPS_NAME).mkdir()
    file = TimestampFile(tmp_path)
    file._write()
    file._write()
    file.close({})
    assert caplog.text.count("cannot be written") == 1
