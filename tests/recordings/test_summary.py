"""Summaries of recordings match their content."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.rows import RowBuilder, row_to_line
from gateway.recordings.summary import FileInfo, Rate, of_messages, of_rows
from gateway.recordings.table import TableHeader, TableNote, TableReader, encode_head, encode_line
from gateway.recordings.tlog import TlogScanner
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import packed
from tests.kit.recordings import SECOND_US, START_US, make_tlog, senders_of, with_jump
from tests.recordings.samples import make_baro, make_fused

M_PER_DEG_LAT = 111_132.0


def make_flight(seconds: int, system_id: int, gap_at: int | None = None) -> list[RecordedFrame]:
    """Fly north at 10 m/s, with a position once a second."""
    records = []
    for i in range(seconds):
        late_us = 30 * SECOND_US if gap_at is not None and i >= gap_at else 0
        lat = 470_000_000 + round(10 * i / M_PER_DEG_LAT * 1e7)
        for message in (
            mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3),
            mavlink.MAVLink_global_position_int_message(i, lat, 80_000_000, 0, 0, 0, 0, 0, 0),
        ):
            at_us = START_US + i * SECOND_US + late_us
            records.append(RecordedFrame(at_us, packed(message, system_id)))
    return records


def sum_up(data: bytes, chunk: int = 777) -> FileInfo:
    scanner, begins = TlogScanner(), range(0, len(data), chunk)
    batches = [scanner.feed(data[begin : begin + chunk]) for begin in begins]
    batches.append(scanner.feed(b"", final=True))
    return of_messages(senders_of(data), batches, len(data)).info


def sum_up_table(data: bytes) -> FileInfo:
    reader = TableReader()
    block = reader.feed_block(data, final=True)
    return of_rows([block], lambda: reader.header, len(data)).info


def test_tlog_is_summarised() -> None:
    data = make_tlog(make_flight(101, 7))
    info = sum_up(data)
    assert (info.kind, info.size, info.records) == ("tlog", len(data), 202)
    assert (info.first_us, info.duration_s) == (START_US, 100.0)
    (vehicle,) = info.vehicles
    assert (vehicle.system_id, vehicle.mav_type, vehicle.autopilot) == (7, 1, 3)
    assert vehicle.facts is not None
    assert vehicle.facts.distance_m == pytest.approx(1000, rel=0.01)
    assert vehicle.positions == "GLOBAL_POSITION_INT"
    assert vehicle.rates == (Rate("HEARTBEAT", 101, 1.01), Rate("GLOBAL_POSITION_INT", 101, 1.01))
    assert info.gaps == ()
    assert info.damaged_bytes == 0


@pytest.mark.parametrize("chunk", [50, 100_000])
def test_gaps_and_damage_are_reported(chunk: int) -> None:
    data = make_tlog(make_flight(20, 1, gap_at=10))
    info = sum_up(data[:300] + b"\xaa" * 40 + data[300:], chunk)
    (gap,) = info.gaps
    assert (gap.time_us, gap.duration_s) == (START_US + 9 * SECOND_US, 31.0)
    assert info.damaged_runs >= 1
    assert info.damaged_bytes >= 40


def test_incomplete_last_record_is_no_damage() -> None:
    data = make_tlog(make_flight(20, 1))
    spoilt = data[:300] + b"\xaa" * 40 + data[300:]
    info = sum_up(spoilt[:-4])
    assert info.damaged_bytes == sum_up(spoilt).damaged_bytes
    assert 0 < info.unfinished_bytes < 40
    wrong = sum_up(data + b"\xaa" * 4)
    assert (wrong.damaged_bytes, wrong.unfinished_bytes) == (4, 0)


def test_truncated_record_before_others_is_damage() -> None:
    """Also where the file ends before its length would be over."""
    flight = make_flight(20, 1)
    frame = packed(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [7] * 251))
    cut = make_tlog([RecordedFrame(flight[-1].time_us, frame)])[:100]
    info = sum_up(make_tlog(flight[:-1]) + cut + make_tlog(flight[-1:]))
    assert (info.records, info.damaged_bytes, info.unfinished_bytes) == (40, len(cut), 0)


@pytest.mark.parametrize(
    ("tail", "damaged", "unfinished"),
    [(b"1000,0,", 0, 7), (b"1000," + bytes(3), 8, 0), (b"1000,0,\n", 8, 0)],
)
def test_incomplete_last_line_is_no_damage(
    rng: np.random.Generator, tail: bytes, damaged: int, unfinished: int
) -> None:
    rows = RowBuilder().add(make_fused(rng, 0))
    text = encode_head(TableHeader()) + "".join(map(row_to_line, rows))
    info = sum_up_table(text.encode() + tail)
    assert (info.damaged_bytes, info.unfinished_bytes) == (damaged, unfinished)


@pytest.mark.parametrize("chunk", [50, 100_000])
@pytest.mark.parametrize("years", [56, -30])
def test_jump_of_the_clock_by_years_does_not_add_to_the_duration(years: int, chunk: int) -> None:
    leap_us = years * 31_556_952 * SECOND_US
    info = sum_up(make_tlog(with_jump(make_flight(101, 1), 40, leap_us)), chunk)
    assert info.duration_s == 99.0
    assert info.vehicles[0].rates[0].rate_hz == pytest.approx(1.0, abs=0.03)
    assert [gap.duration_s for gap in info.gaps] == ([leap_us / 1e6 + 1.0] if years > 0 else [])


def test_table_is_summarised(rng: np.random.Generator) -> None:
    builder = RowBuilder()
    text = encode_head(TableHeader(vehicle_id=3))
    for i in range(100):
        records = [make_fused(rng, i * 10_000)]
        for record in [make_baro(rng, i * 10_000), *records] if i % 10 == 0 else records:
            text += "".join(map(row_to_line, builder.add(record)))
    text += encode_line(TableNote(5, "here")) + "broken,line\n"
    info = sum_up_table(text.encode())
    assert (info.kind, info.records, info.duration_s) == ("table", 100, 0.99)
    rates = {rate.name: rate.count for rate in info.vehicles[0].rates}
    assert rates["imu"] == rates["state"] == 100
    assert rates["baro"] == 10
    assert (info.vehicles[0].system_id, info.vehicles[0].positions) == (3, "states")
    assert [note.text for note in info.notes] == ["here"]
    assert (info.damaged_runs, info.damaged_bytes) == (1, 12)


def test_empty_file_has_no_records() -> None:
    info = sum_up(b"")
    assert (info.records, info.duration_s, info.vehicles) == (0, 0.0, ())
