"""ULog in any chunks, damaged in every place: what is sound is kept, the rest is counted."""

import io
import struct

import numpy as np
import pytest
from pyulog import ULog

from gateway.flightlog.autopilots.px4_log import TOPICS, Px4Log
from gateway.flightlog.autopilots.ulog import UlogReader
from tests.flights.formats.flown import FORMATS, SYNC, Ulog, ulog_message

ROWS = 60
STEP_US = 20_000


def a_log(**formats: str) -> Ulog:
    log = Ulog(FORMATS | formats, {"MAV_SYS_ID": 7})
    for number in range(ROWS):
        t = number * STEP_US
        log.add("sensor_combined", t, number, 0, 0, 20_000, 0, 0, 0, -9.8, 20_000)
        if "vehicle_attitude" not in formats:
            log.add("vehicle_attitude", t, 1, 0, 0, number)
        if number % 10 == 0:
            log.parts.append(ulog_message(b"S", SYNC))
    return log


WHOLE = b"".join(a_log().parts)
MIDDLE = WHOLE.index(ulog_message(b"S", SYNC), len(WHOLE) // 2)


def read(data: bytes, chunk: int = 1 << 20) -> UlogReader:
    log = UlogReader(TOPICS)
    for begin in range(0, len(data), chunk):
        log.feed(data[begin : begin + chunk])
    log.feed(b"", final=True)
    return log


def rows_of(log: UlogReader) -> list[float]:
    return log.topics()["sensor_combined"]["gyro_rad[0]"].tolist()


@pytest.mark.parametrize("chunk", [1, 7, 100, 1 << 20])
def test_chunks_do_not_matter(chunk: int) -> None:
    damaged = WHOLE[:MIDDLE] + b"\0\xff" * 30 + WHOLE[MIDDLE + 9 : -11]
    for data in (WHOLE, damaged):
        log, known = read(data, chunk), read(data)
        assert rows_of(log) == rows_of(known)
        assert (log.damaged_bytes, log.cut_bytes) == (known.damaged_bytes, known.cut_bytes)
    assert rows_of(read(WHOLE)) == [*range(ROWS)]
    assert read(damaged).damaged_bytes
    assert read(damaged).cut_bytes


def test_a_sound_log_is_read_as_by_pyulog() -> None:
    ours = read(WHOLE)
    theirs = ULog(io.BytesIO(WHOLE))
    assert {data.name for data in theirs.data_list} == ours.topics().keys()
    for data in theirs.data_list:
        for name, column in data.data.items():
            np.testing.assert_array_equal(ours.topics()[data.name][name], column)
    assert ours.parameters == theirs.initial_parameters
    assert not ours.damaged_bytes
    assert not ours.cut_bytes


@pytest.mark.parametrize(
    "odd",
    [
        ulog_message(b"O", b"\0"),
        ulog_message(b"I", bytes([9]) + b"int32_t x" + b"\0"),
        ulog_message(b"I", b""),
        ulog_message(b"A", b"\0"),
        ulog_message(b"A", struct.pack("<BH", 0, 99) + b"nothing"),
        ulog_message(b"D", struct.pack("<H", 77) + bytes(20)),
        ulog_message(b"F", b"sensor_combined:float x;"),
        ulog_message(b"\xee", bytes(300)),
        b"\0" * 700,
        b"\xff" * 77,
    ],
    ids=lambda odd: f"{odd[2:3]!r}{len(odd)}",
)
def test_an_odd_message_costs_only_itself(odd: bytes) -> None:
    log = read(WHOLE[:MIDDLE] + odd + WHOLE[MIDDLE:])
    assert rows_of(log) == [*range(ROWS)]
    assert log.damaged_bytes <= len(odd)


@pytest.mark.parametrize("end", [b"\0" * 40, b"\x10\x27\xee", b"\xff" * 40, b"\x01\x00"])
def test_a_log_that_ends_in_its_formats_ends(end: bytes) -> None:
    formats = WHOLE[: WHOLE.index(b"sensor_combined", WHOLE.index(b"MAV_SYS_ID"))]
    log = read(formats + end)
    assert log.topics() == {}
    assert log.damaged_bytes + log.cut_bytes >= len(end)


@pytest.mark.parametrize(
    "fields",
    ["vehicle_attitude again;", "a[3999] b;", "float[65535] x;", "nothing x;", ""],
)
def test_a_format_that_has_no_end_costs_only_its_topic(fields: str) -> None:
    log = a_log(vehicle_attitude="uint64_t timestamp;float[4] q;")
    sound = [part for part in log.parts if b"vehicle_attitude" not in part]
    nested = "".join(f"b[3999] x{n};" for n in range(50))
    odd = [
        ulog_message(b"F", f"vehicle_attitude:{fields}".encode()),
        ulog_message(b"F", f"a:{nested}".encode()),
        ulog_message(b"F", b"b:uint8_t x;"),
        ulog_message(b"A", struct.pack("<BH", 0, 55) + b"vehicle_attitude"),
    ]
    found = read(b"".join([*sound[:2], *odd, *sound[2:]]))
    assert rows_of(found) == [*range(ROWS)]
    assert "vehicle_attitude" not in found.topics()
    assert found.damaged_bytes


def test_data_that_were_appended_after_a_crash() -> None:
    flags = ulog_message(b"B", bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", MIDDLE - 8, 0, 0))
    data = WHOLE[:16] + flags + WHOLE[16 + len(flags) : MIDDLE - 8] + WHOLE[MIDDLE:]
    log = read(data)
    assert len(rows_of(log)) == ROWS
    assert not log.damaged_bytes
    assert read(WHOLE[:27] + b"\x02" + WHOLE[28:]).is_newer


def flight_of(log: Ulog) -> Px4Log:
    return Px4Log(read(b"".join(log.parts)).topics(), 1)


@pytest.mark.parametrize(
    ("fields", "size"),
    [
        ("uint64_t timestamp;float[3] q;", 20),
        ("uint64_t when;float[4] q;", 24),
        ("float timestamp;float[4] q;", 20),
    ],
)
def test_a_topic_of_other_fields_does_not_cost_the_flight(fields: str, size: int) -> None:
    log = a_log(vehicle_attitude=fields)
    number = struct.pack("<H", log.ids["vehicle_attitude"])
    log.parts.append(ulog_message(b"D", number + bytes(size)))
    flight = flight_of(log)
    assert flight.left_out == ["vehicle_attitude"]
    assert len(list(flight.records())) == ROWS


@pytest.mark.parametrize("off_us", [86_400_000_000, 31_536_000_000_000, -4_000_000, 1 << 60])
def test_a_damaged_stamp_is_no_gap(off_us: int) -> None:
    log = a_log()
    for place in (9, 30):
        part = [i for i, p in enumerate(log.parts) if p[2:5] == b"D\0\0"][place]
        data = log.parts[part]
        stamp = struct.unpack_from("<Q", data, 5)[0] + off_us
        log.parts[part] = data[:5] + struct.pack("<Q", stamp) + data[13:]
    flight = flight_of(log)
    times = [record.time_us for record in flight.records()]
    assert times[-1] - times[0] <= ROWS * STEP_US + 4_000_000
    assert flight.dropped == (2 if abs(off_us) > 60_000_000 else 0)
