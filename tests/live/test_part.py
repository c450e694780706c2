"""Quotas of what is recorded, and the true times of finished files."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.live.recorded_traffic import BURST_S, TRUSTED_RATE, UNTRUSTED_RATE, RecordedTraffic
from gateway.live.restamper import STEP, clear_copies, shift_times
from gateway.recordings.table import TableHeader, TableReader, encode_head, encode_line
from gateway.recordings.tlog import TlogScanner
from gateway.records import Incoming, Outgoing
from tests.kit.faults import SlowDisk
from tests.kit.mavlink import packed
from tests.kit.recordings import make_records, make_tlog

if TYPE_CHECKING:
    from gateway.live.recorder import Recorder

pytestmark = pytest.mark.io


SECOND_US = 1_000_000


class Bytes:
    """A recorder that counts the bytes of the frames that it gets."""

    count = 0

    def frame(self, frame: bytes) -> None:
        self.count += len(frame)


def taken(traffic: RecordedTraffic, recorder: Bytes, clients: dict[int, bool], seconds: int) -> int:
    """Let clients, trusted or not, send 2 MB/s each; return the bytes that are recorded."""
    before = recorder.count
    frame = packed(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [1] * 251))
    for step in range(seconds * 100):
        for client_id, trusted in clients.items():
            incoming = Incoming(client_id, frame, trusted)
            for _ in range(20_000 // len(frame)):
                traffic.received(incoming, step * SECOND_US // 100, had_effect=True)
    return recorder.count - before


@pytest.fixture
def recorder() -> Bytes:
    return Bytes()


@pytest.fixture
def traffic(recorder: Bytes) -> RecordedTraffic:
    return RecordedTraffic(cast("Recorder", recorder))


@pytest.mark.parametrize("clients", [[1], [1, 2, 3]], ids=["one", "three"])
def test_untrusted_clients_share_one_small_budget_and_a_trusted_one_has_its_own(
    traffic: RecordedTraffic, recorder: Bytes, clients: list[int]
) -> None:
    untrusted = dict.fromkeys(clients, False)
    assert taken(traffic, recorder, untrusted, 10) <= UNTRUSTED_RATE * (BURST_S + 10)
    found = taken(traffic, recorder, {7: True}, 5)
    assert TRUSTED_RATE * (BURST_S - 1) <= found <= TRUSTED_RATE * (BURST_S + 5)


def test_ground_station_at_its_usual_rate_is_recorded_completely(
    traffic: RecordedTraffic, recorder: Bytes
) -> None:
    frame = bytes(280)
    for n in range(20_000):
        traffic.received(Incoming(1, frame, True), n * SECOND_US // 200, had_effect=False)
    assert recorder.count == 20_000 * len(frame)


def test_client_that_loses_trust_or_leaves_loses_its_own_budget(
    traffic: RecordedTraffic, recorder: Bytes
) -> None:
    traffic.quotas.of(1, 0, trusted=True)
    assert taken(traffic, recorder, {1: False}, 1) <= UNTRUSTED_RATE * (BURST_S + 1)
    traffic.quotas.of(2, 0, trusted=True)
    traffic.quotas.remove_client(2)
    before = recorder.count
    traffic.sent(Outgoing(bytes(60_000), 1, 2), SECOND_US)
    assert recorder.count == before


def test_key_of_signing_is_not_recorded(traffic: RecordedTraffic, recorder: Bytes) -> None:
    secret = packed(mavlink.MAVLink_setup_signing_message(1, 1, [*range(32)], 1))
    traffic.received(Incoming(1, secret, True), 0, had_effect=True)
    traffic.forwarded((secret,))
    assert recorder.count == 0


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
