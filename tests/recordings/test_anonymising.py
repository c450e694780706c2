"""Anonymised recordings: nothing that identifies survives, and the shape of the flight stays."""

import math
import re
import struct
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.anonymising import (
    IDENTIFIERS,
    LOCATED,
    NAMED_VALUES,
    OPAQUE,
    OTHER_COORDINATES,
    Anonymiser,
    Anonymity,
    _plan_of,
    is_plain,
)
from gateway.recordings.tlog import Batch, TlogRecord, TlogScanner, fields_of
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS, layout_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of, message_id_of, split_datagram
from tests.kit.cli import run
from tests.kit.mavlink import Sender, packed
from tests.kit.recordings import START_US, make_tlog

LAT, LON = 47.3712345, 8.5412345
TOLERANCE_DEG = 1e-5
SECRET = b"HB-SECRET-7Q"
DAY = 86_400
KNOWN = {
    "GPS_STATUS": [f"satellite_{name}" for name in ("prn", "used", "elevation", "azimuth", "snr")],
    "CAMERA_INFORMATION": ["vendor_name", "model_name"],
    "TEST_TYPES": ["u8_array", "s8_array"],
}
"""Fields of some bytes that identify nobody."""


def batch_of(frames: list[bytes]) -> Batch:
    records = [TlogRecord(START_US + k * 1000, frame) for k, frame in enumerate(frames)]
    return TlogScanner().feed(make_tlog(records), final=True)


def anonymised(frames: list[bytes], anonymity: Anonymity | None = None) -> list[bytes | None]:
    """Anonymise frames as the editor does."""
    anonymiser, batch = Anonymiser(anonymity or Anonymity(), (LAT, LON)), batch_of(frames)
    anonymiser.shift_us(batch)
    affected = anonymiser.affects(batch).tolist()
    return [
        anonymiser.edit(frame) if may_change else frame
        for frame, may_change in zip(frames, affected, strict=True)
    ]


def is_latitude(name: str) -> bool:
    return (
        re.search(r"lat(?!e|ch|or)", name.lower()) is not None
        and "relat" not in name
        and "Var" not in name
    )


def is_longitude(name: str) -> bool:
    return re.search(r"lon(?!g_|gp)|lng", name.lower()) is not None and "Var" not in name


def secret_frame(message_id: int, rng: np.random.Generator) -> tuple[bytes, list[float], bytes]:
    """Fill every field of a message that may hold a coordinate, a date, or an identifier."""
    layout, kind = layout_of(message_id), DEFINITIONS[message_id]
    values = np.zeros(1, layout)
    coordinates: list[float] = []
    secret = SECRET + f"{message_id:06d}".encode()
    for field in layout.names or ():
        code = layout[field]
        base = LAT if is_latitude(field) or field == "x" else LON
        is_place = is_latitude(field) or is_longitude(field)
        is_place |= kind.msgname in LOCATED and field in "xy"
        if field in KNOWN.get(kind.msgname, ()):
            continue
        if code.base.kind == "S":
            plain = is_plain(kind.msgname, field) or field == "name"
            values[field] = b"NAME" if plain else secret[: code.itemsize]
        elif is_place and code.shape == () and code.kind in "if" and code.itemsize >= 4:
            here = base + float(rng.uniform(-0.05, 0.05))
            values[field] = round(here * 1e7) if code.kind == "i" else here
            coordinates.append(here)
        elif code.base == np.uint8 and code.shape and code.shape[0] >= 16:
            values[field] = np.frombuffer(
                secret.ljust(code.shape[0], b"7"), np.uint8, code.shape[0]
            )
        elif re.search(r"uid|serial|ICAO|MMSI", field) and code.shape == ():
            values[field] = int.from_bytes(secret, "little") % (1 << 8 * code.itemsize)
    if "frame" in (layout.names or ()):
        values["frame"] = 6 if "INT" in kind.msgname or "ORBIT" in kind.msgname else 3
    if "command" in (layout.names or ()) and kind.msgname.startswith(("COMMAND", "MISSION")):
        values["command"] = 16
        if "param5" in (layout.names or ()):
            values["param5"], values["param6"] = LAT, LON
            coordinates += [LAT, LON]
    return _framed(message_id, values.tobytes()), coordinates, secret


def _framed(message_id: int, payload: bytes) -> bytes:
    from fastcrc.crc16 import mcrf4xx

    payload = payload.rstrip(b"\0") or b"\0"
    head = struct.pack("<BBBBBBB", 0xFD, len(payload), 0, 0, 9, 1, 1)
    body = head + message_id.to_bytes(3, "little") + payload
    extra = bytes((DEFINITIONS[message_id].crc_extra,))
    return body + mcrf4xx(body[1:] + extra).to_bytes(2, "little")


def coordinates_in(frame: bytes) -> list[float]:
    """Return every number at every byte of a payload that may be a coordinate, in degrees."""
    payload = frame[10:-2]
    found: list[float] = []
    for code, unit in (("<i", 1e7), ("<f", 1.0), ("<d", 1.0), ("<f", 180 / math.pi)):
        width = struct.calcsize(code)
        for at in range(len(payload) - width + 1):
            value = struct.unpack_from(code, payload, at)[0]
            scaled = value * unit if code != "<i" else value / unit
            if math.isfinite(scaled):
                found.append(scaled)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_no_coordinate_and_no_identifier_of_any_message_survives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    with_coordinates = 0
    for message_id in DEFINITIONS:
        frame, originals, secret = secret_frame(message_id, rng)
        (after,) = anonymised([frame])
        with_coordinates += bool(originals)
        if after is None:
            continue
        name = DEFINITIONS[message_id].msgname
        assert [e for e in split_datagram(after) if not isinstance(e, MavFrame)] == [], name
        left = np.array(coordinates_in(after) or [0.0])
        for original in originals:
            assert np.abs(left - original).min() > TOLERANCE_DEG, name
        for begin in range(len(secret) - 5):
            assert secret[begin : begin + 6] not in after[10:], name
    assert with_coordinates > 50


@pytest.mark.parametrize("seed", range(4))
def test_unsplit_check_finds_the_originals_before(seed: int) -> None:
    """The property above is not met by frames that are not anonymised."""
    rng = np.random.default_rng(seed)
    frame, originals, secret = secret_frame(MESSAGE_IDS["CAMERA_IMAGE_CAPTURED"], rng)
    left = np.array(coordinates_in(frame))
    assert all(np.abs(left - original).min() < TOLERANCE_DEG for original in originals)
    assert secret[:6] in frame


def test_every_field_of_the_dialect_that_may_identify_is_on_a_list() -> None:
    unlisted = []
    for kind in DEFINITIONS.values():
        if kind.msgname in OPAQUE or kind.msgname in NAMED_VALUES:
            continue
        plan = _plan_of(MESSAGE_IDS[kind.msgname])
        known = {field for pair in plan.coordinates for field in pair[:2]}
        known |= {*plan.identifiers, *KNOWN.get(kind.msgname, ())}
        for field, code in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            layout = layout_of(MESSAGE_IDS[kind.msgname])[field]
            may_identify = (
                kind.fieldunits_by_name.get(field) == "degE7"
                or (code == "char" and not is_plain(kind.msgname, field))
                or (code == "uint8_t" and layout.itemsize >= 16)
                or re.search(
                    r"\buid|uuid|serial.?n|icao|mmsi|squawk|ssid|passw|secret", field, re.I
                )
                or ((is_latitude(field) or is_longitude(field)) and layout.itemsize >= 4)
            )
            if may_identify and field not in known:
                unlisted.append(f"{kind.msgname}.{field}")
    assert unlisted == []


def test_lists_name_fields_that_exist() -> None:
    for message, fields in IDENTIFIERS.items():
        assert set(fields) <= set(layout_of(MESSAGE_IDS[message]).names or ()), message
    for message, pairs in OTHER_COORDINATES.items():
        assert {f for pair in pairs for f in pair[:2]} <= set(
            layout_of(MESSAGE_IDS[message]).names or ()
        )
    assert {*OPAQUE, *LOCATED, *NAMED_VALUES} <= set(MESSAGE_IDS)


def moving(lat: float, lon: float) -> Any:
    at = (round(lat * 1e7), round(lon * 1e7))
    return mavlink.MAVLink_global_position_int_message(1, *at, 500_000, 60_000, 1, 2, 3, 4)


def position(lat: float, lon: float) -> bytes:
    return packed(moving(lat, lon))


@pytest.mark.parametrize("place", [(0.0, 0.0), (-33.9, 18.4), (60.0, 179.9999)])
def test_distances_and_heights_stay(place: tuple[float, float]) -> None:
    points = [(LAT, LON), (LAT + 0.01, LON), (LAT, LON + 0.01), (LAT - 0.02, LON - 0.03)]
    moved = anonymised([position(*p) for p in points], Anonymity(*place))
    fields = [fields_of(frame) for frame in moved if frame]
    for (lat, lon), field in zip(points, fields, strict=True):
        new_lat, new_lon = field["lat"] / 1e7, field["lon"] / 1e7
        assert new_lat - place[0] == pytest.approx(lat - LAT, abs=2e-7)
        east = math.remainder(new_lon - place[1], 360.0) * math.cos(math.radians(place[0]))
        assert east == pytest.approx((lon - LON) * math.cos(math.radians(LAT)), abs=2e-7)
        assert (field["alt"], field["relative_alt"]) == (500_000, 60_000)
        assert abs(new_lon) <= 180.0


@pytest.mark.parametrize(
    ("lat", "lon", "expected"),
    [
        (0, 0, (0, 0)),
        (2**31 - 1, 2**31 - 1, (2**31 - 1, 2**31 - 1)),
        (round(LAT * 1e7), round(LON * 1e7), (1, 1)),
    ],
    ids=["unknown", "invalid", "at the place"],
)
def test_unknown_coordinates_stay_unknown_and_known_ones_known(
    lat: int, lon: int, expected: tuple[int, int]
) -> None:
    (moved,) = anonymised(
        [packed(mavlink.MAVLink_gps_raw_int_message(0, 3, lat, lon, 1, 2, 3, 4, 5, 6))]
    )
    assert moved is not None
    fields = fields_of(moved)
    assert (fields["lat"], fields["lon"]) == expected


@pytest.mark.parametrize(
    ("message", "is_moved"),
    [
        (mavlink.MAVLink_command_long_message(1, 1, 16, 0, 0, 0, 0, 0, LAT, LON, 9), True),
        (mavlink.MAVLink_command_long_message(1, 1, 183, 0, 5, 1500, 0, 0, 47.0, 8.5, 9), False),
        (mavlink.MAVLink_mission_item_message(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, LAT, LON, 9), True),
        (mavlink.MAVLink_mission_item_int_message(
            1, 1, 0, 6, 16, 0, 1, 0, 0, 0, 0, round(LAT * 1e7), round(LON * 1e7), 9), True),
        (mavlink.MAVLink_mission_item_int_message(
            1, 1, 0, 1, 178, 0, 1, 0, 0, 0, 0, 473_000_000, 85_000_000, 9), False),
    ],
    ids=["waypoint", "servo", "item", "item int", "local frame"],
)  # fmt: skip
def test_coordinates_of_commands_are_moved_by_their_meaning(message: Any, is_moved: bool) -> None:
    before = packed(message)
    (after,) = anonymised([before])
    assert (after != before) is is_moved


def test_fixed_yaw_calibration_has_its_location_in_other_parameters() -> None:
    message = mavlink.MAVLink_command_long_message(1, 1, 42006, 0, 90, 0, LAT, LON, 0, 0, 0)
    (after,) = anonymised([packed(message)])
    assert after is not None
    fields = fields_of(after)
    assert abs(fields["param3"]) < 1e-5
    assert abs(fields["param4"]) < 1e-5


def test_same_identifier_gets_the_same_number() -> None:
    def aircraft(icao: int, call: bytes) -> bytes:
        at = (round(LAT * 1e7), round(LON * 1e7))
        return packed(
            mavlink.MAVLink_adsb_vehicle_message(icao, *at, 0, 1, 2, 3, 4, call, 1, 1, 1, 7000)
        )

    frames = anonymised(
        [aircraft(0x4B1234, b"SWR1"), aircraft(7, b"B"), aircraft(0x4B1234, b"SWR1")]
    )
    first, other, again = (fields_of(frame) for frame in frames if frame)
    assert first["ICAO_address"] == again["ICAO_address"] != other["ICAO_address"]
    assert first["callsign"] == again["callsign"] != other["callsign"]
    assert first["squawk"] != 7000


def test_dates_are_moved_by_whole_days_and_times_since_boot_stay() -> None:
    start_s = START_US // 1_000_000
    frames = [
        packed(mavlink.MAVLink_system_time_message(START_US, 1234)),
        packed(mavlink.MAVLink_gps_raw_int_message(99_000_000, 3, 1, 1, 1, 2, 3, 4, 5, 6)),
        packed(mavlink.MAVLink_log_entry_message(1, 1, 1, start_s, 99)),
    ]
    new, boot, entry = (
        fields_of(f) for f in anonymised(frames, Anonymity(day=date(2001, 2, 3))) if f
    )
    moment = datetime.fromtimestamp(new["time_unix_usec"] / 1e6, UTC)
    assert moment.date() == date(2001, 2, 3)
    assert (new["time_unix_usec"] - START_US) % (DAY * 1_000_000) == 0
    assert new["time_boot_ms"] == 1234
    assert boot["time_usec"] == 99_000_000
    assert (entry["time_utc"] - start_s) % DAY == 0


@pytest.mark.parametrize(
    "name", [b"HOME_LAT", b"SIM_OPOS_LNG", b"ADSB_ICAO_ID", b"BATT_SERIAL_NUM"]
)
def test_parameters_that_identify_are_left_out(name: bytes) -> None:
    (after,) = anonymised([packed(mavlink.MAVLink_param_value_message(name, 47.0, 9, 1, 0))])
    assert after is None


@pytest.mark.parametrize("name", [b"PLAT_MAX", b"ATC_LATENCY", b"FLIGHT_ID", b"WPNAV_SPEED"])
def test_other_parameters_stay(name: bytes) -> None:
    frame = packed(mavlink.MAVLink_param_value_message(name, 47.0, 9, 1, 0))
    assert anonymised([frame]) == [frame]


def test_signatures_are_dropped() -> None:
    (after,) = anonymised([Sender(signed=True).heartbeat()])
    assert after is not None
    assert not frame_of(after).signed


@pytest.mark.parametrize("keep", [False, True])
def test_unknown_messages_are_dropped_unless_they_shall_be_kept(keep: bool) -> None:
    unknown = bytearray(packed(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 1.0)))
    unknown[7:10] = (60_001).to_bytes(3, "little")
    longer = bytearray(_framed(0, bytes(range(1, 40))))
    frames = [bytes(unknown), bytes(longer)]
    assert anonymised(frames, Anonymity(keep_unknown=keep)) == (frames if keep else [None, None])


@pytest.mark.io
def test_command_moves_to_the_place_and_prints_the_changes(tmp_path: Path) -> None:
    sender, frames = Sender(), []
    for k in range(20):
        frames.append(sender.heartbeat())
        frames.append(sender.pack(moving(LAT + k * 1e-4, LON)))
        frames.append(sender.pack(mavlink.MAVLink_statustext_message(6, b"Pilot Meier, Thun")))
    path, out = tmp_path / "a.tlog", tmp_path / "b.tlog"
    records = [TlogRecord(START_US + k * 1000, frame) for k, frame in enumerate(frames)]
    path.write_bytes(make_tlog(records))
    text = run(
        "convert", path, "-o", out, "--anonymise", "--place", "-33.9,18.4", "--day", "2001-02-03"
    )
    assert "GLOBAL_POSITION_INT lat 20" in text
    assert "STATUSTEXT text 20" in text
    data = out.read_bytes()
    assert b"Meier" not in data
    batch = TlogScanner(strict=True).feed(data, final=True)
    assert batch.damage == ()
    first = next(r for r in batch.records() if message_id_of(r.frame) == 33)
    assert fields_of(first.frame)["lat"] == -339_000_000
    assert datetime.fromtimestamp(first.time_us / 1e6, UTC).date() == date(2001, 2, 3)


@pytest.mark.io
@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--place", "1,2"), "--anonymise"),
        (("--anonymise", "--place", "89,2"), "80"),
        (("--anonymise", "--place", "x"), "LAT,LON"),
        (("--anonymise", "--day", "2001-13-01"), "2020-01-31"),
    ],
)
def test_invalid_options_of_anonymising_are_refused(
    tmp_path: Path, options: tuple[str, ...], text: str
) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(make_tlog([TlogRecord(START_US, Sender().heartbeat())]))
    assert text in run("convert", path, "-o", tmp_path / "b.tlog", *options, code=2)
