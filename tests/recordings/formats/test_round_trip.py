"""Every reader with every writer: a recording keeps its content on the way through any two formats.

A reader and its writer have no test of their own for this: a format added to `SOURCES` or to
`WRITERS` is tested here.
"""

import gzip
import io
import itertools
import json
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from mcap.reader import make_reader

from gateway.config import GatewaySettings
from gateway.recordings.files import FlightError
from gateway.recordings.formats import parquet
from gateway.recordings.formats.maps import tracks_of_messages, tracks_of_table
from gateway.recordings.recorded_table import aircraft_of
from gateway.recordings.recording import open_recording
from gateway.recordings.rows import TableRow, row_to_line
from gateway.recordings.workshop.convert import WRITERS, FlightToWrite
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.recordings import make_tlog
from tests.recordings.flights import OPTIONS, commented_table
from tests.recordings.formats import flown

pytestmark = pytest.mark.io

AIRCRAFT = GatewaySettings().default_aircraft
SECONDS = 8
"""Of the autopilots' logs."""


def tracker() -> bytes:
    """Write the CSV of another program."""
    lines = ["time_s,ax,ay,az,gx,gy,gz,mx,my,mz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"]
    for n in range(400):
        fix = f"{n / 50},47.1,{8.5 + n * 1e-7:.7f},430" if n % 10 == 0 else ",,,"
        lines.append(f"{n / 50},0,0.1,-9.81,0,0,0.01,20,{n % 7},40,430,{fix}")
    return "\n".join([*lines, ""]).encode()


SOURCES: dict[str, Callable[[], bytes]] = {
    "flight.csv": commented_table,
    "flight.parquet": lambda: convert("flight.csv", commented_table(), ".parquet"),
    "flight.tlog": lambda: convert("flight.csv", commented_table(), ".tlog"),
    "tracker.csv": tracker,
    "new.ulg": lambda: flown.make_ulog(seconds=SECONDS),
    "old.ulg": lambda: flown.make_ulog(old=True, seconds=SECONDS),
    "flight.bin": lambda: flown.make_dataflash(SECONDS),
    "flight.log": lambda: flown.make_dataflash_text(SECONDS),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write every source, plain, and packed under a name without an ending."""
    folder = tmp_path_factory.mktemp("sources")
    for name in SOURCES:
        (folder / name).write_bytes(content(name))
        packed(folder / name).write_bytes(gzip.compress(content(name)))
    return folder


def packed(path: Path) -> Path:
    return path.with_name(path.name.replace(".", "_"))


@cache
def content(name: str) -> bytes:
    return SOURCES[name]()


def written(path: Path, ending: str) -> bytes:
    return b"".join(WRITERS[ending](FlightToWrite([open_recording(path)], OPTIONS)))


def convert(name: str, data: bytes, ending: str) -> bytes:
    """Convert the content of a file."""
    with TemporaryDirectory() as folder:
        path = Path(folder, name)
        path.write_bytes(data)
        return written(path, ending)


@cache
def frames_of(path: Path) -> list[RecordedFrame]:
    return list(FlightToWrite([open_recording(path)], OPTIONS).frames())


@cache
def table_of(path: Path) -> list[TableRow]:
    return list(FlightToWrite([open_recording(path)], OPTIONS).table().plain_rows)


def points_of(path: Path) -> int:
    """Count the points of the tracks that a map has to show."""
    flight = FlightToWrite([open_recording(path)], OPTIONS)
    if flight.has_messages:
        tracks = tracks_of_messages(flight.vehicle_messages())
    else:
        table = flight.table()
        tracks = tracks_of_table(table, aircraft_of(table, OPTIONS))
    return sum(len(track.points) for track in tracks)


def tagged(data: bytes, tag: str) -> int:
    return sum(element.tag.endswith(f"}}{tag}") for element in ET.fromstring(data).iter())


def coordinates(data: bytes) -> int:
    shapes = [feature["geometry"] for feature in json.loads(data)["features"]]
    return sum(len(s["coordinates"]) for s in shapes if s["type"] == "LineString")


POINTS: dict[str, Callable[[bytes], int]] = {
    ".kml": lambda data: tagged(data, "coord"),
    ".gpx": lambda data: tagged(data, "trkpt"),
    ".geojson": coordinates,
}


def of_mcap(data: bytes) -> list[tuple[int, str]]:
    """List the times and topics of the MAVLink messages."""
    messages = make_reader(io.BytesIO(data)).iter_messages()
    return [
        (message.log_time // 1000, channel.topic)
        for _, channel, message in messages
        if channel.topic.startswith("/mavlink")
    ]


def of_frames(records: Iterable[RecordedFrame]) -> list[tuple[int, str]]:
    found = []
    for record in records:
        system, component = origin_of(record.frame)
        name = MESSAGE_NAMES[message_id_of(record.frame)]
        found.append((record.time_us, f"/mavlink/{system}/{component}/{name}"))
    return found


CHECKS: dict[str, Callable[[Path, bytes, Path], None]] = {}
"""Of each ending: that the written bytes hold the content of the source."""


def checks(*endings: str) -> Callable[[Callable[[Path, bytes, Path], None]], Any]:
    return lambda check: CHECKS.update(dict.fromkeys(endings, check))


@checks(".csv", ".parquet")
def same_rows(source: Path, data: bytes, out: Path) -> None:
    rows = open_recording(out).rows(OPTIONS).plain_rows
    assert [*map(row_to_line, rows)] == [*map(row_to_line, table_of(source))]
    # A table is read as it was written, and written as it was read.
    assert written(out, out.suffix) == data
    assert written(out, ".csv") == (data if out.suffix == ".csv" else written(source, ".csv"))


@checks(".tlog")
def same_frames(source: Path, data: bytes, out: Path) -> None:
    records = frames_of(source)
    times_us = [record.time_us for record in records]
    assert len(times_us) > 100
    assert times_us == sorted(set(times_us))
    assert data == make_tlog(records)
    assert written(out, ".tlog") == data


@checks(".mcap")
def same_messages(source: Path, data: bytes, out: Path) -> None:
    assert of_mcap(data) == of_frames(frames_of(source))


@checks(*POINTS)
def same_points(source: Path, data: bytes, out: Path) -> None:
    assert POINTS[out.suffix](data) == points_of(source) > 20


def test_every_writer_has_a_check() -> None:
    assert set(CHECKS) == set(WRITERS)


PAIRS = [
    (name, ending)
    for name, ending in itertools.product(SOURCES, WRITERS)
    # The vehicle's own MAVLink has no raw samples to make a table of.
    if not (name == "flight.tlog" and ending in (".csv", ".parquet"))
]


@pytest.mark.parametrize(("name", "ending"), PAIRS)
def test_written_file_contains_the_content_of_its_source(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, ending: str
) -> None:
    monkeypatch.setattr(parquet, "ROWS", 100)
    data = written(folder / name, ending)
    out = tmp_path / f"out{ending}"
    out.write_bytes(data)
    CHECKS[ending](folder / name, data, out)


@pytest.mark.parametrize("name", SOURCES)
def test_packed_source_gives_the_same_content(folder: Path, name: str) -> None:
    ending = ".tlog" if name == "flight.tlog" else ".csv"
    assert written(packed(folder / name), ending) == written(folder / name, ending)


def test_table_survives_parquet_to_the_byte(folder: Path) -> None:
    assert written(folder / "flight.parquet", ".csv") == commented_table()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", SOURCES)
def test_damaged_source_is_read_in_part_or_refused(
    folder: Path, tmp_path: Path, name: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(content(name)[:60_000])
    for offset in rng.integers(0 if seed % 2 else 2000, len(data), 40).tolist():
        data[offset] = int(rng.integers(256))
    path = tmp_path / name
    path.write_bytes(bytes(data[: int(rng.integers(3000, len(data)))]))
    try:
        found = open_recording(path).rows(OPTIONS)
        rows = list(found.plain_rows)
    except (FlightError, OSError):
        return
    assert len(rows) <= len(table_of(folder / name))
    assert all(isinstance(remark, str) for remark in found.remarks)
