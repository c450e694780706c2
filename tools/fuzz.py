"""Feed random and damaged bytes, frames, commands, settings and files to readers; none may raise.

    python -m tools.fuzz                     # five minutes, all targets in turn
    python -m tools.fuzz --minutes 30 table  # one of them for longer

Each target is a property: a function that Hypothesis calls with generated values. The tests run
them shortly, always with the same values; here the values are new each time. A failing value is
shrunk, printed and stored in `.hypothesis`, so that the next run begins with it.
"""

import argparse
import gzip
import itertools
import json
import math
import re
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import msgspec
import tomlkit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as all_messages
from pymavlink.dialects.v20 import common as mavlink
from typer.testing import CliRunner

from gateway.aircraft import AircraftSettings
from gateway.config import ConfigError, GatewaySettings, load
from gateway.live.control_socket import ControlServer, Verbs
from gateway.live.control_verbs import mark_verbs
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.autopilot_record import RecordTranslator
from gateway.recordings.columns import COLUMNS
from gateway.recordings.files import FlightError
from gateway.recordings.formats.maps import (
    DRAWN_IDS,
    to_geojson,
    to_gpx,
    to_kml,
    tracks_of_messages,
)
from gateway.recordings.formats.ulog_record import table as ulog_table
from gateway.recordings.moment import parse_moment
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recording
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableHeader, TableReader, encode_head, encode_line
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.recordings.vehicle_reader import VehicleReader
from gateway.recordings.workshop.anonymising import Anonymiser, Anonymity
from gateway.records import BaroRaw, Incoming, NodeId
from gateway.settings import Field, Settings, fields_of
from gateway.simulator.source_bytes import crsf_frame
from gateway.sources.kinds import SOURCE_KINDS, make_sources
from gateway.sources.lines import KEYS as LINE_KEYS
from gateway.sources.phone import BUFFERS, LOGGED
from gateway.sources.settings import SourceSettings
from gateway.vehicle.plan import Location
from gateway.vehicle_state.positions import ORIGIN_ID, POSITION_SOURCES
from gateway.vehicle_state.senders import ATTITUDE_ID, ATTITUDE_QUATERNION_ID, Senders
from gateway.vehicle_state.status_texts import STATUSTEXT_ID
from gateway.wire import payloads
from gateway.wire.framing import encode_frame
from gateway.wire.link import Link
from gateway.wire.mavlink_messages import CRC_EXTRA, HEARTBEAT_ID
from gateway.wire.mavlink_splitter import MavFrame, MavlinkSplitter, message_id_of

NUMBERS: Final = (
    *("0", "-1", "1", "47.0", "99999", "-99999", "inf", "-inf", "nan", "1e308", "5e-324", "1e999"),
    *("9223372036854775808", "99999999999999999999", "0x10", "1_0", "٣", "", " ", "x", '"', "\0"),
    *("null", "N/A", "-", '"1,5"', "23:59:59.5", "0:00:01", "2026-06-11 14:25:30", "9999-12-31Z"),
)
MESSAGES: Final = tuple(mavlink.mavlink_map.values())
HEAD: Final = encode_head(TableHeader(vehicle_id=1, unix_us_at_zero=1_780_000_000_000_000))
ULOG_HEAD: Final = b"ULog\x01\x12\x35\x01" + bytes(8)
HEADING: Final = "time_s,ax,ay,az,gx,gy,gz,mx,my,mz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"

Property = Callable[[], None]


def chunks_of(data: bytes, cuts: list[int]) -> list[bytes]:
    """Cut bytes at some positions."""
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(places)]


CUTS: Final = st.lists(st.integers(0, 1 << 16), max_size=8)


@st.composite
def messages(draw: st.DrawFn) -> bytes:
    """Make a well-formed frame of any message, with any bytes for its fields, signed or not."""
    kind = draw(st.sampled_from(MESSAGES))
    size = struct.calcsize(kind.unpacker.format)
    body = draw(st.binary(min_size=size, max_size=size) | st.just(bytes(size)))
    mav = mavlink.MAVLink(None, draw(st.integers(1, 255)), draw(st.integers(0, 255)))
    if draw(st.booleans()):
        mav.signing.secret_key, mav.signing.sign_outgoing = bytes(32), True
    message = mavlink.MAVLink_message(kind.id, kind.msgname)
    force_version_1 = kind.id < 256 and draw(st.booleans())
    frame = message._pack(mav, kind.crc_extra, body, force_version_1)  # noqa: SLF001
    return bytes(frame)


@st.composite
def damaged(draw: st.DrawFn, whole: st.SearchStrategy[bytes]) -> bytes:
    """Make complete pieces, with some bytes changed, omitted, doubled or inserted."""
    data = bytearray(b"".join(draw(st.lists(whole | st.binary(max_size=40), max_size=12))))
    for _ in range(draw(st.integers(0, 4))):
        place = draw(st.integers(0, len(data)))
        data[place : place + draw(st.integers(0, 3))] = draw(st.binary(max_size=3))
    return bytes(data)


@st.composite
def radio_frames(draw: st.DrawFn) -> bytes:
    """Make a frame of the receiver with a payload, intact or with a changed byte."""
    node = NodeId(draw(st.integers(1, 31)), draw(st.integers(0, 1)))
    header = payloads.Header(node, draw(st.integers(0, 65535)), draw(st.integers(0, 2**32 - 1)))
    baro = payloads.BaroPayload(draw(st.integers(0, 2**32 - 1)), draw(st.integers(-999, 999)))
    packet = bytearray(payloads.encode_payload(header, baro))
    if draw(st.booleans()):
        packet[draw(st.integers(0, len(packet) - 1))] ^= draw(st.integers(1, 255))
    content = payloads.encode_radio(
        draw(st.integers(0, 255)), draw(st.integers(0, 5)), header.node_time_us, bytes(packet)
    )
    return encode_frame(content)


@given(damaged(messages()), CUTS)
def splitter(data: bytes, cuts: list[int]) -> None:
    """Check any bytes in any chunks: the same complete frames, and no error.

    The checksum of an unknown message cannot be checked: it passes if another frame begins at its
    end or the chunk ends there, so the result may depend on the chunks.
    """
    whole = [event.data for event in MavlinkSplitter().feed(data) if isinstance(event, MavFrame)]
    split = MavlinkSplitter()
    events = [event for chunk in chunks_of(data, cuts) for event in split.feed(chunk)]
    frames = [event.data for event in events if isinstance(event, MavFrame)]
    if all(message_id_of(frame) in CRC_EXTRA for frame in whole + frames):
        assert frames == whole
    assert all(frame in data for frame in whole + frames)


@given(st.lists(messages(), min_size=1, max_size=8), CUTS)
def whole_frames(frames: list[bytes], cuts: list[int]) -> None:
    """Check that every good frame is found with any chunks."""
    split = MavlinkSplitter()
    data = b"".join(frames)
    events = [event for chunk in chunks_of(data, cuts) for event in split.feed(chunk)]
    assert [event.data for event in events if isinstance(event, MavFrame)] == frames


@given(damaged(radio_frames()), CUTS, st.integers(-1, 10_000_000))
def receiver(data: bytes, cuts: list[int], step_us: int) -> None:
    """Check any bytes of the serial line: no record may have a time in the future."""
    link, now_us = Link(), 0
    for chunk in chunks_of(data, cuts):
        now_us += max(step_us, 0)
        for record in link.feed(chunk, now_us):
            assert isinstance(record.time_us, int)
    link.report(now_us, connected=True, port="")


@cache
def _vehicles() -> Pipeline:
    pipeline = Pipeline(PipelineSettings(AircraftSettings()))
    pipeline.feed_record(BaroRaw(0, NodeId(1, 0), 0, 100_000.0, 20.0), 0)
    return pipeline


@given(messages(), st.booleans(), st.integers(0, 1 << 50))
def vehicle(frame: bytes, trusted: bool, now_us: int) -> None:
    """Check any message to a vehicle: answers or none."""
    _vehicles().handle(Incoming(7, frame, trusted), now_us)
    _vehicles().poll(now_us)
    _vehicles().remove_client(7)


JSON: Final = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)
VERBS: Final = ("mark", "verbs", "text", "to", "none", "record.list", "")
KEYS: Final = ("lat_deg", "lon_deg", "alt_amsl_m", "vehicle_id", "number", "text", "to", "url")


def _control() -> ControlServer:
    def mark(place: Location | None, vehicle_id: int | None) -> None:
        _vehicles().mark(place, vehicle_id, 0)

    def echo(text: str, number: int = 1) -> str:
        return text * number

    def moment(to: str) -> str:
        return str(parse_moment(to))

    verbs: Verbs = {"text": echo, "to": moment, "none": lambda: None}
    return ControlServer(Path("unused.sock"), mark_verbs(mark), verbs)


def _run(awaitable: Any) -> Any:
    """Run a coroutine that waits for nothing."""
    try:
        awaitable.send(None)
    except StopIteration as stop:
        return stop.value
    raise AssertionError("it waits")


@given(
    st.binary(max_size=60)
    | st.builds(
        lambda verb, params: msgspec.json.encode({"verb": verb, "params": params}),
        st.sampled_from(VERBS) | st.text(max_size=8),
        st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=8), JSON, max_size=4),
    )
)
def control(line: bytes) -> None:
    """Check any line to the control socket: the answer is one line of JSON with the outcome."""
    answer = _run(_control().answer(line))
    assert answer.endswith(b"\n")
    assert answer.count(b"\n") == 1
    assert isinstance(msgspec.json.decode(answer)["ok"], bool)


def values_of(field: Field) -> st.SearchStrategy[Any]:
    """Return values that a user could write for a setting, valid and invalid."""
    if field.section is not None:
        return trees_of(field.section)
    odd = st.sampled_from(["", "x", "~nobody-here/x", -1, 0, 1, 2**62, 1e308, 5e-324, True, []])
    odd |= st.floats() | st.sampled_from([msgspec.to_builtins(field.default)])
    low, high = field.bounds
    if low is not None and high is not None:
        odd |= st.sampled_from([low, high, math.nextafter(low, high), math.nextafter(high, low)])
    return odd | st.sampled_from(field.choices or ("x",))


def trees_of(kind: type[Settings]) -> st.SearchStrategy[dict[str, Any]]:
    """Return sections with some of their keys, and sometimes an unknown one."""
    known = {field.name: values_of(field) for field in fields_of(kind)}
    return st.fixed_dictionaries({}, optional={**known, "no_such_key": st.just(1)})


@cache
def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="mavgate-fuzz-"))


@given(trees_of(GatewaySettings) | st.binary(max_size=60))
def settings_file(tree: dict[str, Any] | bytes) -> None:
    """Check any settings file: settings, or an error that names the file."""
    file = _folder() / "gateway.toml"
    text = tree if isinstance(tree, bytes) else tomlkit.dumps(_writable(tree)).encode()
    file.write_bytes(text)
    try:
        load(file)
    except ConfigError as error:
        assert all(str(file) in line for line in str(error).splitlines()[:1])  # noqa: PT017


def _writable(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _writable(value) for key, value in tree.items() if value is not None}
    if isinstance(tree, list | tuple):
        return [_writable(value) for value in tree if value is not None]
    return tree


@st.composite
def tables(draw: st.DrawFn) -> bytes:
    """Make a table with unusual cells, comment lines, and damage."""
    lines = [HEAD] if draw(st.booleans()) else [",".join(COLUMNS) + "\n"]
    for number in range(draw(st.integers(0, 6))):
        cells = [""] * len(COLUMNS)
        cells[0], cells[1], cells[2] = str(number * 10_000), "0", str(number)
        for place in draw(st.lists(st.integers(0, len(COLUMNS) - 1), max_size=12)):
            cells[place] = draw(st.sampled_from(NUMBERS))
        lines.append(",".join(cells) + "\n")
    lines += draw(st.lists(st.sampled_from(["# note: {", "# node: 3\n", "# header: {}\n", "\n"])))
    data = "".join(lines).encode(errors="replace")
    return draw(st.sampled_from([b"", b"\xef\xbb\xbf"])) + data + draw(st.binary(max_size=5))


@given(tables() | st.binary(max_size=200), CUTS)
def table(data: bytes, cuts: list[int]) -> None:
    """Check any table: the same events in any chunks, and rows that can be written and read."""
    whole = TableReader().feed(data, final=True)
    reader = TableReader()
    found = [event for chunk in chunks_of(data, cuts) for event in reader.feed(chunk)]
    found += reader.feed(b"", final=True)
    assert repr(found) == repr(whole)
    rows = [event for event in whole if isinstance(event, TableRow)]
    again = TableReader().feed((HEAD + "".join(map(encode_line, rows))).encode())
    assert len([event for event in again if isinstance(event, TableRow)]) == len(rows)


@given(
    damaged(st.builds(encode_record, st.integers(0, 2**64 - 1), messages())), CUTS, st.booleans()
)
def tlog(data: bytes, cuts: list[int], strict: bool) -> None:
    """Check any tlog: no invented record, and all records of an intact one in any chunks."""
    whole = TlogScanner(strict=strict).feed(data, final=True)
    scanner = TlogScanner(strict=strict)
    found = [r for chunk in chunks_of(data, cuts) for r in scanner.feed(chunk).records()]
    found += scanner.feed(b"", final=True).records()
    # Damaged times are detected from neighbouring records, also of the previous chunk.
    assert [record.frame for record in found] == [record.frame for record in whole.records()]
    assert whole.damage or found == list(whole.records())
    assert all(record.frame in data for record in found)


VEHICLE_IDS: Final = sorted(
    {*POSITION_SOURCES, *DRAWN_IDS, HEARTBEAT_ID, STATUSTEXT_ID, ORIGIN_ID}
    | {ATTITUDE_ID, ATTITUDE_QUATERNION_ID}
)


@st.composite
def vehicle_records(draw: st.DrawFn) -> bytes:
    """Make a record with a message that the reader of vehicles uses."""
    kind = all_messages.mavlink_map[draw(st.sampled_from(VEHICLE_IDS))]
    size = kind.unpacker.size
    body = draw(st.binary(min_size=size, max_size=size) | st.just(bytes(size)))
    mav = mavlink.MAVLink(None, draw(st.sampled_from((1, 2, 255))), draw(st.sampled_from((1, 100))))
    message = mavlink.MAVLink_message(kind.id, kind.msgname)
    frame = bytes(message._pack(mav, kind.crc_extra, body))  # noqa: SLF001
    near_us = st.integers(10**15, 10**15 + 10**8)
    return encode_record(draw(st.integers(0, 2**56 - 1) | near_us), frame)


@given(st.lists(vehicle_records(), max_size=30))
def vehicles(records: list[bytes]) -> None:
    """Check any messages of vehicles: same result in batches, valid positions and maps."""
    batch, senders = TlogScanner().feed(b"".join(records), final=True), Senders()
    senders.add(batch)
    reader = VehicleReader(senders, DRAWN_IDS)
    singly = [message for record in batch.records() for message in reader.feed(record)]
    singly += reader.flush()
    reader = VehicleReader(senders, DRAWN_IDS)
    assert sorted(map(repr, singly)) == sorted(
        map(repr, [*reader.feed_batch(batch), *reader.flush()])
    )
    places = [message.position for message in singly if message.position is not None]
    assert all(abs(at.lat_deg) <= 90.0 and abs(at.lon_deg) <= 180.0 for at in places)
    tracks = tracks_of_messages(singly)
    for write in (to_kml, to_gpx):
        text = "".join(write("x", tracks))
        assert ">nan" not in text
        ElementTree.fromstring(text)
    json.loads("".join(to_geojson("x", tracks)))


RECORD_TIMES: Final = st.just(7) | st.integers(10**15, 10**15 + 10**8) | st.integers(0, 2**56 - 1)
"""Times of the records of a tlog: equal, of one flight, or any."""


@given(st.lists(st.builds(encode_record, RECORD_TIMES, messages()), max_size=20))
def anonymised(records: list[bytes]) -> None:
    """Check any messages: they are left out, or become intact frames."""
    anonymiser = Anonymiser(Anonymity())
    batch = TlogScanner().feed(b"".join(records), final=True)
    moved = anonymiser.retimed(batch)
    assert not len(batch) or moved.time_us.min() >= 0
    for record in batch.records():
        frame = anonymiser.edit(record.frame)
        if frame is not None:
            (event,) = MavlinkSplitter().feed(frame)
            assert isinstance(event, MavFrame) and not event.signed  # noqa: PT018
            assert anonymiser.edit(frame) is not None


TOPIC_FIELDS: Final = (
    *("uint64_t timestamp", "float[3] gyro_rad", "float[3] accelerometer_m_s2", "float[4] q"),
    *("float[3] magnetometer_ga", "int32_t lat", "double latitude_deg", "uint8_t fix_type"),
    *("uint64_t time_utc_usec", "sensor_combined x", "float[65535] y", "uint8_t[5] _padding0"),
)
TIMES: Final = st.integers(0, 2**64 - 1) | st.integers(10**6, 10**6 + 10**5)


@st.composite
def ulog_messages(draw: st.DrawFn) -> bytes:
    """Make a format, a subscription, a row, or any other message of a ULog."""
    name = draw(st.sampled_from(sorted(ulog_table().sampled))).encode()
    number = struct.pack("<H", draw(st.integers(0, 3)))
    instance = bytes([draw(st.integers(0, 2))])
    time_us = struct.pack("<Q", draw(TIMES))
    fields = ";".join(draw(st.lists(st.sampled_from(TOPIC_FIELDS), max_size=6)))
    kind, content = draw(
        st.sampled_from(
            [(b"F", name + b":" + fields.encode() + b";"), (b"A", instance + number + name)]
        )
        | st.tuples(st.just(b"D"), st.binary(max_size=40).map(lambda row: number + time_us + row))
        | st.tuples(st.sampled_from([b"B", b"P", b"I", b"O", b"S", b"\0"]), st.binary(max_size=50))
    )
    return struct.pack("<Hc", len(content), kind) + content


@st.composite
def dataflash_messages(draw: st.DrawFn) -> bytes:
    """Make a format, or a message of any type, of a DataFlash log."""
    number = draw(st.integers(126, 132))
    if draw(st.booleans()):
        return b"\xa3\x95" + bytes([number]) + draw(st.binary(max_size=60))
    name = draw(st.sampled_from([b"IMU", b"GPS", b"BARO", b"MAG", b"ATT", b"FMT", b"X"]))
    letters = draw(st.text("QBfIeLcNZ?", max_size=8)).encode()
    names = draw(st.lists(st.sampled_from(["TimeUS", "I", "GyrX", "Lat"]), max_size=8))
    size = draw(st.integers(0, 255))
    columns = ",".join(names).encode()
    layout = struct.pack("<BB4s16s64s", number, size, name, letters, columns)
    return b"\xa3\x95\x80" + layout


@st.composite
def files(draw: st.DrawFn) -> tuple[str, bytes]:
    """Make a file as users may have, and the ending of its name."""
    rows = [HEADING]
    for number in range(draw(st.integers(0, 30))):
        cells = [f"{number / 100}", "0", "0", "-9.8", "0", "0", "0", "20", "0", "40", "100"]
        cells += [f"{number / 100}", "47", "8", "500"]
        if draw(st.integers(0, 3)) == 0:
            cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(NUMBERS))
        rows.append(",".join(cells))
    text = "\n".join(rows).encode(errors="replace")
    ending, data = draw(
        st.sampled_from([(".csv", text), (".csv", b"# gps_latency_s=9.9.9\n" + text)])
        | st.tuples(st.just(".csv"), tables())
        | st.tuples(st.just(".tlog"), damaged(st.builds(encode_record, RECORD_TIMES, messages())))
        | st.tuples(st.just(".ulg"), damaged(ulog_messages()).map(lambda log: ULOG_HEAD + log))
        | st.tuples(st.just(".bin"), damaged(dataflash_messages()))
        | st.tuples(st.sampled_from([".csv", ".tlog"]), st.binary(max_size=200))
    )
    data = draw(st.sampled_from([b"", bytes(90), b"\xff" * 3000, b"text, of a console\n"])) + data
    packed = draw(st.sampled_from(["", "gzip", "cut", "false"]))
    if not packed:
        return ending, data
    whole = gzip.compress(data)
    return f"{ending}.gz", {"gzip": whole, "cut": whole[: len(whole) // 2], "false": data}[packed]


MERGES: Final = ((), ("--merge",), ("--join",))
COMMANDS: Final = (
    ("info",),
    ("info", "--json"),
    ("recover", "--force", "-o", "OUT.csv"),
    *(("convert", "--force", "-o", f"OUT{end}") for end in (".csv", ".tlog", ".kml", ".gpx")),
    ("fuse", "--force", "--from", "1", "-o", "OUT.csv"),
    ("fuse", "--force", "--estimator", "paper", "-o", "OUT.csv"),
    *(("convert", "OTHER", *how, "--force", "-o", "OUT.tlog") for how in MERGES),
    ("convert", "--anonymise", "--as", "1:9", "--force", "-o", "OUT.tlog"),
    ("convert", "OTHER", "--merge", "--anonymise", "--day", "2099-12-31", "--force", "-o",
     "OUT.tlog"),
    ("extract", "--force", "--params", "OUT.param", "--mission", "OUT.plan", "--texts", "OUT.csv"),
    ("extract", "--force", "--subtitles", "OUT.srt", "--events", "OUT.csv"),
    ("diff", "OTHER", "--json"),
    ("doctor",),
)  # fmt: skip


@given(files(), files(), st.sampled_from(COMMANDS))
def command(file: tuple[str, bytes], other: tuple[str, bytes], words: tuple[str, ...]) -> None:
    """Check any files with any command: it succeeds, or prints the reason."""
    from gateway.cli.app import app

    places = {"OUT": str(_folder() / "out")}
    for name, (ending, data) in {"FILE": file, "OTHER": other}.items():
        path = _folder() / f"odd-{name}{ending}"
        path.write_bytes(data)
        places[name] = str(path)
    out = [re.sub("OUT|OTHER", lambda found: places[found[0]], word) for word in words[1:]]
    empty = _folder() / "empty.toml"
    empty.touch()
    result = CliRunner().invoke(app, [words[0], places["FILE"], *out])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code in (0, 1, 2), result.output
    assert result.exit_code == 0 or result.output.strip()


SOURCE_NUMBER: Final = (
    st.floats() | st.integers(-(2**70), 2**70) | st.lists(st.floats(), max_size=4) | st.text()
)
READING: Final = st.fixed_dictionaries(
    {
        "name": st.sampled_from([*LOGGED]),
        "time": st.integers(0, 10**10) | SOURCE_NUMBER,
        "values": st.dictionaries(
            st.sampled_from([key for _, keys in LOGGED.values() for key in keys]), SOURCE_NUMBER
        ),
    }
)
"""A reading in the format of Sensor Logger's posts."""
ANSWER: Final = st.dictionaries(
    st.sampled_from([name for names in BUFFERS.values() for name in names]),
    st.builds(lambda values: {"buffer": values}, st.lists(st.floats() | st.none(), max_size=3)),
)
"""Buffers in the format of phyphox' answers."""
PHONE: Final = st.one_of(
    st.builds(lambda readings: {"payload": readings}, st.lists(READING, max_size=4)),
    st.builds(lambda buffers: {"buffer": buffers, "status": {}}, ANSWER),
)
SOURCE_TEXT: Final = st.one_of(
    PHONE.map(lambda content: json.dumps(content).encode() + b"\n"),
    st.lists(st.floats(), min_size=13, max_size=13).map(
        lambda values: ",".join(map(str, values)).encode() + b"\n"
    ),
    st.dictionaries(
        st.sampled_from(LINE_KEYS), SOURCE_NUMBER | st.text(max_size=9) | st.booleans()
    ).map(lambda content: json.dumps(content).encode() + b"\n"),
    st.builds(crsf_frame, st.integers(0, 0x80), st.binary(min_size=1, max_size=60)),
    st.tuples(
        st.sampled_from(["GGA", "RMC", "VTG", "GSA", "GST", "HDT"]),
        st.lists(st.sampled_from(["", "1", "A", "N", "9999.9", "inf", "nan", "-1", "230326"])),
    ).map(lambda parts: f"$GP{parts[0]},{','.join(parts[1])}\n".encode()),
)
"""Pieces of valid input, of which a decoder reads more than of noise."""


@given(st.sampled_from([*SOURCE_KINDS]), st.lists(st.binary(max_size=80) | SOURCE_TEXT, max_size=8))
def source(kind: str, chunks: list[bytes]) -> None:
    """Check any bytes of any source: records, faults, and frames of a vehicle."""
    (found,) = make_sources((SourceSettings(url=f"{kind}:stdin"),), str)
    pipeline = Pipeline(PipelineSettings(AircraftSettings(), sources=[found]))
    for number, chunk in enumerate(chunks):
        pipeline.feed_source(found, chunk, number * 400_000)
        pipeline.poll(number * 400_000)


@given(
    st.tuples(st.just("ulg"), damaged(ulog_messages()).map(lambda log: ULOG_HEAD + log))
    | st.tuples(st.just("bin"), damaged(dataflash_messages()))
)
def record(file: tuple[str, bytes]) -> None:
    """Check any log of an autopilot: frames with growing times, or an error text."""
    ending, data = file
    path = _folder() / f"record.{ending}"
    path.write_bytes(data)
    current = PipelineSettings(AircraftSettings())
    recording = open_recording(path)
    if not recording.is_log:
        return
    try:
        log = recording.log(ReadOptions(current))
    except FlightError:
        return
    frames = list(RecordTranslator(log).frames())
    assert all(a.time_us < b.time_us for a, b in itertools.pairwise(frames))


TARGETS: Final[dict[str, Any]] = {
    target.__name__: target
    for target in (
        *(splitter, whole_frames, receiver, source, vehicle, control),
        *(settings_file, table, tlog, vehicles, anonymised, record, command),
    )
}
"""Targets by name."""


def bounded(name: str, examples: int, *, always_the_same: bool) -> Property:
    """Return a property that runs with a number of values."""
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    chosen = settings(
        max_examples=examples,
        deadline=None,
        derandomize=always_the_same,
        suppress_health_check=checks,
        database=None if always_the_same else settings().database,
    )
    ready: Property = chosen(TARGETS[name])
    return ready


def main() -> int:
    """Run the targets in turn until the time has elapsed; print those that failed at the end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}")
    parser.add_argument("--minutes", type=float, default=5.0, help="in all (5)")
    parser.add_argument("--examples", type=int, default=300, help="in a row of one target (300)")
    options = parser.parse_args()
    wanted = options.targets or list(TARGETS)
    if unknown := set(wanted) - set(TARGETS):
        parser.error(f"no such target: {', '.join(sorted(unknown))}")
    failed: set[str] = set()
    # A property may be prepared only once.
    ready = {name: bounded(name, options.examples, always_the_same=False) for name in wanted}
    end_s, runs = time.monotonic() + 60.0 * options.minutes, dict.fromkeys(wanted, 0)
    for name in itertools.cycle(wanted):
        if time.monotonic() > end_s or failed >= set(wanted):
            break
        if name in failed:
            continue
        try:
            ready[name]()
        except Exception as error:  # noqa: BLE001
            failed.add(name)
            print(f"{name}: {type(error).__name__}: {error}")
            print(*getattr(error, "__notes__", ()), sep="\n")
        runs[name] += options.examples
    for name, count in runs.items():
        print(f"{name:13} {'FAILED' if name in failed else 'held'} after {count} values or fewer")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
