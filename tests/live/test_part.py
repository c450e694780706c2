"""Quotas of what is recorded, and the true times of finished files."""

import os
from pathlib import Path

import pytest

from gateway.live.recording_budget import BURST_S, TRUSTED_RATE, UNTRUSTED_RATE, RecordingBudget
from gateway.live.restamper import STEP, clear_copies, shift_times
from gateway.recordings.table import TableHeader, TableReader, encode_head, encode_line
from gateway.recordings.tlog import TlogScanner
from tests.kit.faults import SlowDisk
from tests.kit.recordings import make_records, make_tlog

pytestmark = pytest.mark.io


SECOND_US = 1_000_000


def taken(budget: RecordingBudget, clients: list[int], seconds: int, size: int = 500) -> int:
    """Let clients send 2 MB/s each; return the bytes that are recorded."""
    total = 0
    for step in range(seconds * 100):
        for client_id in clients:
            for _ in range(20_000 // size):
                total += size * budget.allows(client_id, size, step * SECOND_US // 100)
    return total


def test_untrusted_clients_share_one_small_budget_and_a_trusted_one_has_its_own() -> None:
    for clients in ([1], [1, 2, 3]):
        budget = RecordingBudget()
        budget.note(7, 0, trusted=True)
        for client_id in clients:
            budget.note(client_id, 0, trusted=False)
        assert taken(budget, clients, 10) <= UNTRUSTED_RATE * (BURST_S + 10), clients
        assert TRUSTED_RATE * BURST_S <= taken(budget, [7], 5) <= TRUSTED_RATE * (BURST_S + 5)


def test_ground_station_at_its_usual_rate_is_recorded_completely() -> None:
    budget = RecordingBudget()
    budget.note(1, 0, trusted=True)
    assert all(budget.allows(1, 280, n * SECOND_US // 200) for n in range(20_000))


def test_client_that_loses_trust_or_leaves_loses_its_own_budget() -> None:
    budget = RecordingBudget()
    for trusted in (True, False):
        budget.note(1, 0, trusted=trusted)
    assert taken(budget, [1], 1) <= UNTRUSTED_RATE * (BURST_S + 1)
    budget.note(2, 0, trusted=True)
    budget.remove_client(2)
    assert not budget.allows(2, 60_000, SECOND_US)


SHIFT_US = 5_000_000
RECORDS = make_records(10_000)


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    path = tmp_path / "a_01.tlog"
    path.write_bytes(make_tlog(RECORDS))
    return path


def test_tlog_is_shifted_and_replaced(tlog: Path) -> None:
    assert tlog.stat().st_size > 5 * STEP
    shift_times(tlog, SHIFT_US, 0)
    after = list(TlogScanner(strict=True).feed(tlog.read_bytes(), final=True).records())
    assert [record.frame for record in after] == [record.frame for record in RECORDS]
    assert [r.time_us for r in after] == [r.time_us + SHIFT_US for r in RECORDS]
    assert list(tlog.parent.iterdir()) == [tlog]


def test_table_contains_its_corrected_time(tmp_path: Path) -> None:
    path = tmp_path / "a_01_v1.csv"
    header = TableHeader(unix_us_at_zero=7)
    rest = "1,2\n" * STEP + encode_line(header) + "# header: {\n5"
    path.write_text(encode_head(header) + rest)
    shift_times(path, SHIFT_US, 0)
    moved = TableHeader(unix_us_at_zero=7 + SHIFT_US)
    assert path.read_text() == encode_head(moved) + rest.replace(
        encode_line(header), encode_line(moved)
    )
    reader = TableReader()
    reader.feed(path.read_bytes()[:10_000])
    assert reader.header == moved


def test_deleted_file_is_not_restored_and_copies_of_a_power_cut_are_removed(
    tlog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: tlog.unlink())
    shift_times(tlog, SHIFT_US, 0)
    assert list(tlog.parent.iterdir()) == []
    tlog.with_name("a_01.tlog.new").touch()
    clear_copies(tlog.parent)
    assert list(tlog.parent.iterdir()) == []


def test_failing_or_full_disk_leaves_the_file_unchanged(tlog: Path, disk: SlowDisk) -> None:
    before = tlog.read_bytes()
    disk.may_end.set()
    disk.failures = 1
    shift_times(tlog, SHIFT_US, 0)
    shift_times(tlog, SHIFT_US, 1 << 60)
    assert tlog.read_bytes() == before
    assert list(tlog.parent.iterdir()) == [tlog]
