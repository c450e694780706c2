"""Kept files: written completely or not at all, failures reported, broken ones left alone."""

import stat
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gateway.live import kept_files
from gateway.live.kept_files import TIMESTAMPS_NAME, PlanFiles, TimestampFile
from gateway.vehicle.plan import Location, StoredPlan
from tests.kit.faults import SlowDisk
from tests.kit.process import until

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


@pytest.fixture
def syncs(disk: SlowDisk) -> SlowDisk:
    disk.may_end.set()
    return disk


async def test_only_the_newest_of_many_plans_is_written(bench: Bench, syncs: SlowDisk) -> None:
    for _ in range(100):
        bench.files.save(1, FIRST)
    await bench.save(1, SECOND)
    assert bench.read() == {1: SECOND}
    assert syncs.count <= 2 * 2, "of the file and of its folder"


async def test_closing_writes_pending_plans(bench: Bench) -> None:
    bench.files.save(1, FIRST)
    bench.files.save(2, SECOND)
    bench.files.close()
    assert bench.read() == {1: FIRST, 2: SECOND}


async def test_failed_write_is_counted_and_reported_with_its_end(
    bench: Bench, syncs: SlowDisk
) -> None:
    await bench.save(1, FIRST)
    syncs.failures = 1
    await bench.save(1, SECOND)
    assert bench.reports == [(1, "Input/output error")]
    assert bench.files.failures == 1
    assert bench.read() == {1: FIRST}, "the old file is whole"
    await bench.save(1, SECOND)
    assert bench.read() == {1: SECOND}
    assert bench.reports[1:] == [(1, None)]


async def test_failed_write_is_retried_and_reported_once(
    bench: Bench, syncs: SlowDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_files, "RETRY_S", 0)
    syncs.failures = 4
    await bench.save(1, FIRST)
    assert syncs.count == 1, "the next attempt is not made at once"
    await until(lambda: bench.reports[-1:] == [(1, None)])
    assert bench.reports == [(1, "Input/output error"), (1, None)]
    assert bench.files.failures == 1
    assert bench.read() == {1: FIRST}


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b'{"version": 7}'])
async def test_broken_plan_is_reported_and_neither_overwritten_nor_delays_others(
    bench: Bench, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    await bench.save(2, FIRST)
    file = bench.folder / "1.plan.json"
    file.write_bytes(content)
    assert bench.files.load() == {2: FIRST}
    assert f"{file} cannot be read and is left alone: " in caplog.text
    bench.files.save(1, FIRST)
    await bench.save(2, SECOND)
    assert bench.reports == [(1, "1.plan.json is broken: repair or remove it")]
    assert file.read_bytes() == content
    file.unlink()
    assert bench.read() == {2: SECOND}
    await bench.save(2, FIRST)
    assert bench.read() == {1: FIRST, 2: FIRST}, "the pending plan was written with it"


async def test_files_with_other_names_are_ignored(bench: Bench) -> None:
    await bench.save(1, FIRST)
    for name in ("x.plan.json", "1.plan.json.bak", "12345.plan.json", "1.plan.new"):
        (bench.folder / name).write_text("nonsense")
    assert bench.files.load() == {1: FIRST}
    assert bench.reports == []


TIMESTAMPS = {1: {"0123456789abcdef": {"0.255.190": 36_000_000_000_000}}, 31: {"ff": {"1.2.3": 7}}}


@pytest.mark.parametrize("is_settled", [True, False], ids=["settled", "closed"])
async def test_saved_timestamps_are_loaded(tmp_path: Path, is_settled: bool) -> None:
    file = TimestampFile(tmp_path / "new")
    assert file.load() == {}
    file.save(0, {1: {}})
    file.save(0, TIMESTAMPS)
    if is_settled:
        await file.settle()
    else:
        file.close()
    assert TimestampFile(tmp_path / "new").load() == TIMESTAMPS
    assert stat.S_IMODE((tmp_path / "new" / TIMESTAMPS_NAME).stat().st_mode) == 0o600


@pytest.mark.parametrize("text", ["", "[]", '{"1":{"k":{"0.1":3}}}', '{"1":{"k":{"0.1.1":-3}}}'])
async def test_broken_timestamps_and_their_unwritable_file_are_reported_once(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / TIMESTAMPS_NAME
    path.write_text(text)
    file = TimestampFile(tmp_path)
    assert file.load() == {}
    assert "cannot be read" in caplog.text
    path.unlink()
    path.mkdir()
    for number in range(3):
        file.save(0, {number: {}})
        await file.settle()
    assert caplog.text.count("cannot be written") == 1
    file.close()
