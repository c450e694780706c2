"""DataFlash in any chunks, damaged in every place: what is sound is kept, the rest is counted."""

from types import SimpleNamespace

import pytest

from gateway.flightlog.autopilots.ardupilot_log import BELIEVED, ArdupilotReader
from gateway.flightlog.autopilots.dataflash import DataflashReader
from gateway.records import ImuCalibrated
from tests.flights.formats.flown import DATAFLASH, dataflash_size, packed

ROWS = 60
STEP_US = 20_000
NAMES = {"IMU", "PARM"}
FORMATS = [
    ("FMT", (number, dataflash_size(form), name.encode(), form.encode(), columns.encode()))
    for name, (number, form, columns) in DATAFLASH.items()
]


def imu(number: int) -> tuple[float, ...]:
    return (number * STEP_US, 0, number, *[0.0] * 5, 0, 0, 20.0, 1, 1, 400, 400)


PARTS = [
    *(packed(name, values) for name, values in FORMATS),
    packed("PARM", (1, b"SYSID_THISMAV", 9.0, 1.0)),
    *(packed("IMU", imu(number)) for number in range(ROWS)),
]
LINES = [
    *(", ".join([n, *(str(v, "ascii") if isinstance(v, bytes) else str(v) for v in values)])
      for n, values in FORMATS),
    *(", ".join(["IMU", *map(str, imu(number))]) for number in range(ROWS)),
]  # fmt: skip


def read(data: bytes, chunk: int = 1 << 20) -> tuple[list[float], DataflashReader]:
    log = DataflashReader(NAMES, is_text=not data.startswith(b"\xa3"))
    found = []
    for begin in range(0, len(data), chunk):
        found += log.feed(data[begin : begin + chunk])
    found += log.feed(b"", final=True)
    return [message.GyrX for name, message in found if name == "IMU"], log


def counted(log: DataflashReader) -> tuple[int, int, int]:
    return log.damaged_bytes, log.cut_bytes, log.broken


@pytest.mark.parametrize("chunk", [1, 7, 100, 1 << 20])
def test_chunks_do_not_matter(chunk: int) -> None:
    whole = b"".join(PARTS)
    text = "\n".join(LINES).encode()
    damaged = whole[:2500] + b"\0\xff" * 30 + whole[2577:-11]
    for data in (whole, text, damaged, whole + b"\xff" * 200):
        rows, log = read(data, chunk)
        assert (rows, counted(log)) == (read(data)[0], counted(read(data)[1]))
    assert read(whole + b"\xff" * 200)[0] == read(whole)[0] == read(text)[0] == [*range(ROWS)]
    assert counted(read(whole + b"\xff" * 200)[1]) == counted(read(text)[1]) == (0, 0, 0)
    assert read(damaged)[1].damaged_bytes
    assert read(damaged)[1].cut_bytes


def redefined(number: int, size: int, name: bytes, letters: bytes, columns: bytes) -> bytes:
    return packed("FMT", (number, size, name, letters, columns))


@pytest.mark.parametrize(
    "odd",
    [
        redefined(200, 12, b"NEW", b"Q?", b"TimeUS,X"),
        redefined(130, 99, b"IMU", b"QB", b"TimeUS,I"),
        redefined(128, 5, b"FMT", b"BB", b"Type,Length"),
        redefined(201, 0, b"", b"", b""),
        redefined(202, 3, b"\xff\xff", b"\xff", b"\xff"),
        b"\xa3\x95\xee" + bytes(40),
        b"\0" * 700,
        b"\xa3" * 77,
    ],
    ids=lambda odd: f"{odd[2]}-{len(odd)}",
)
@pytest.mark.parametrize("place", [10, 11, 40])
def test_an_odd_message_costs_at_most_the_one_before(odd: bytes, place: int) -> None:
    rows, log = read(b"".join([*PARTS[:place], odd, *PARTS[place:]]))
    assert len(rows) >= ROWS - 1
    assert log.damaged_bytes <= len(odd) + len(PARTS[place - 1])


@pytest.mark.parametrize(
    "odd", ["IMU, 1", "FMT, x", "FMT", "\xff\xfe", "IMU" + ", nan" * 20, "x" * 100_000, "XYZ, 1"]
)
def test_an_odd_line_costs_only_itself(odd: str) -> None:
    rows, log = read("\n".join([*LINES[:40], odd, *LINES[40:]]).encode("latin-1"), chunk=4096)
    assert rows == [*range(ROWS)]
    assert log.broken <= 1


def records_at(*times_us: int) -> tuple[list[int], ArdupilotReader]:
    reader = ArdupilotReader(1)
    columns = DATAFLASH["IMU"][2].split(",")
    found = []
    for time_us in times_us:
        message = SimpleNamespace(**dict(zip(columns, (time_us, *imu(0)[1:]), strict=True)))
        found += [r.time_us for r in reader.feed("IMU", message) if isinstance(r, ImuCalibrated)]
    return found, reader


SECOND = [number * STEP_US for number in range(100)]


@pytest.mark.parametrize("off_us", [86_400_000_000, -31_536_000_000_000, (1 << 63) - 1])
def test_a_damaged_stamp_costs_only_its_message(off_us: int) -> None:
    found, reader = records_at(*SECOND[:50], off_us, *SECOND[50:])
    assert found == SECOND
    assert (reader.dropped, reader.leaps) == (1, 0)


@pytest.mark.parametrize("leap_us", [7_200_000_000, -5_000_000_000])
def test_a_clock_that_leaps_is_followed(leap_us: int) -> None:
    begin_us = 6_000_000_000
    found, reader = records_at(
        *(begin_us + t for t in SECOND), *(begin_us + leap_us + t for t in SECOND)
    )
    assert reader.leaps == 1
    assert reader.dropped == BELIEVED - 1
    assert len(found) == 2 * len(SECOND) - reader.dropped
    assert found == sorted(found)
    assert found[-1] - found[len(SECOND)] == SECOND[-1] - SECOND[BELIEVED - 1]
