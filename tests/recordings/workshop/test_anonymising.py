"""Anonymised recordings: nothing that identifies survives, and the shape of the flight stays."""

import math
import re
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.estimation.record import FloatArray
from gateway.recordings.workshop.anonymising import (
    IDENTIFIERS,
    LOCATED,
    NAMED_VALUES,
    OPAQUE,
    OTHER_COORDINATES,
    Anonymiser,
    Anonymity,
    is_plain,
)
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS, layout_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of, message_id_of, split_datagram
from gateway.wire.recorded_frames import fields_of
from tests.kit.cli import run
from tests.kit.mavlink import Sender, frame_with, packed
from tests.kit.recordings import START_US, batch_of, read_tlog, records_of, write_tlog

LAT, LON = 47.3712345, 8.5412345
TOLERANCE_DEG = 1e-5
SECRET = b"HB-SECRET-7Q"
DAY = 86_400
PRIVATE = re.compile(r"uid|serial.?n|icao|mmsi|squawk|ssid|passw|secret", re.IGNORECASE)
KNOWN = {
    "GPS_STATUS": [f"satellite_{name}" for name in ("prn", "used", "elevation", "azimuth", "snr")],
    "CAMERA_INFORMATION": ["vendor_name", "model_name"],
    "TEST_TYPES": ["u8_array", "s8_array"],
}
"""Fields of some bytes that identify nobody."""


def anonymised(frames: list[bytes], anonymity: Anonymity | None = None) -> list[bytes | None]:
    """Anonymise frames as the editor does."""
    anonymiser = Anonymiser(anonymity or Anonymity(), (LAT, LON))
    batch = batch_of(records_of(frames))
    anonymiser.shift_us(batch)
    affected = anonymiser.affects(batch).tolist()
    return [
        anonymiser.edit(frame) if may_change else frame
        for frame, may_change in zip(frames, affected, strict=True)
    ]


def edited(message: Any) -> dict[str, Any]:
    """Return the fields of an anonymised message."""
    (after,) = anonymised([packed(message)])
    assert after is not None
    return fields_of(after)


def is_latitude(name: str) -> bool:
    return (
        re.search(r"lat(?!e|ch|or)", name.lower()) is not None
        and "relat" not in name
        and "Var" not in name
    )


def is_longitude(name: str) -> bool:
    return re.search(r"lon(?!g_|gp)|lng", name.lower()) is not None and "Var" not in name


def may_identify(message: str, field: str) -> bool:
    """Return whether a field may be a coordinate or an identifier by its name, type or unit."""
    kind, code = DEFINITIONS[MESSAGE_IDS[message]], layout_of(MESSAGE_IDS[message])[field]
    if field in KNOWN.get(message, ()):
        return False
    return (
        kind.fieldunits_by_name.get(field) == "degE7"
        or (code.base.kind == "S" and not is_plain(message, field))
        or (code.base == np.uint8 and code.itemsize >= 16)
        or PRIVATE.search(field) is not None
        or ((is_latitude(field) or is_longitude(field)) and code.itemsize >= 4)
    )


def secret_frame(message_id: int, rng: np.random.Generator) -> tuple[bytes, list[float], bytes]:
    """Fill every field of a message that may hold a coordinate, a date, or an identifier."""
    layout, name = layout_of(message_id), DEFINITIONS[message_id].msgname
    fields = layout.names or ()
    values = np.zeros(1, layout)
    coordinates: list[float] = []
    secret = SECRET + f"{message_id:06d}".encode()
    for field in fields:
        code = layout[field]
        base = LAT if is_latitude(field) or field == "x" else LON
        is_place = is_latitude(field) or is_longitude(field)
        is_place |= name in LOCATED and field in "xy"
        if field in KNOWN.get(name, ()):
            continue
        if code.base.kind == "S":
            plain = is_plain(name, field) or field == "name"
            values[field] = b"NAME" if plain else secret[: code.itemsize]
        elif is_place and code.shape == () and code.kind in "if" and code.itemsize >= 4:
            here = base + float(rng.uniform(-0.05, 0.05))
            values[field] = round(here * 1e7) if code.kind == "i" else here
            coordinates.append(here)
        elif code.base == np.uint8 and code.shape and code.shape[0] >= 16:
            values[field] = [*secret.ljust(code.shape[0], b"7")[: code.shape[0]]]
        elif PRIVATE.search(field) and code.shape == ():
            values[field] = int.from_bytes(secret, "little") % (1 << 8 * code.itemsize)
    if "frame" in fields:
        values["frame"] = 6 if "INT" in name or "ORBIT" in name else 3
    if "command" in fields and name.startswith(("COMMAND", "MISSION")):
        values["command"] = 16
        if "param5" in fields:
            values["param5"], values["param6"] = LAT, LON
            coordinates += [LAT, LON]
    payload = values.tobytes().rstrip(b"\0") or b"\0"
    return frame_with(message_id, payload), coordinates, secret


def coordinates_in(frame: bytes) -> FloatArray:
    """Return every number at every byte of a payload that may be a coordinate, in degrees."""
    payload, found = frame[10:-2], [np.zeros(1)]
    for code, unit in (("<i4", 1e-7), ("<f4", 1.0), ("<f8", 1.0), ("<f4", 180 / math.pi)):
        width = np.dtype(code).itemsize
        for at in range(min(width, len(payload))):
            count = (len(payload) - at) // width
            with np.errstate(invalid="ignore"):
                found.append(np.frombuffer(payload, code, count, at).astype(float) * unit)
    left = np.concatenate(found)
    return left[np.isfinite(left)]


@pytest.mark.parametrize("seed", range(4))
def test_no_coordinate_and_no_identifier_of_any_message_survives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    with_coordinates = 0
    for message_id, kind in DEFINITIONS.items():
        frame, originals, secret = secret_frame(message_id, rng)
        (after,) = anonymised([frame])
        with_coordinates += bool(originals)
        if after is None:
            continue
        name = kind.msgname
        assert [e for e in split_datagram(after) if not isinstance(e, MavFrame)] == [], name
        left = coordinates_in(after)
        for original in originals:
            assert np.abs(left - original).min() > TOLERANCE_DEG, name
        for begin in range(len(secret) - 5):
            assert secret[begin : begin + 6] not in after[10:], name
        now = fields_of(after)
        same = [f for f, value in fields_of(frame).items() if np.array_equal(now[f], value)]
        assert name in NAMED_VALUES or not [f for f in same if may_identify(name, f)], name
    assert with_coordinates > 50


def test_search_for_coordinates_and_identifiers_finds_the_originals(
    rng: np.random.Generator,
) -> None:
    frame, originals, secret = secret_frame(MESSAGE_IDS["CAMERA_IMAGE_CAPTURED"], rng)
    left = coordinates_in(frame)
    assert all(np.abs(left - original).min() < TOLERANCE_DEG for original in originals)
    assert secret[:6] in frame


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
    fields = edited(mavlink.MAVLink_gps_raw_int_message(0, 3, lat, lon, 1, 2, 3, 4, 5, 6))
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
    fields = edited(message)
    assert abs(fields["param3"]) < 1e-5
    assert abs(fields["param4"]) < 1e-5


def test_same_identifier_gets_the_same_number_and_an_unknown_one_none() -> None:
    def aircraft(icao: int, call: bytes) -> bytes:
        at = (round(LAT * 1e7), round(LON * 1e7))
        return packed(
            mavlink.MAVLink_adsb_vehicle_message(icao, *at, 0, 1, 2, 3, 4, call, 1, 1, 1, 7000)
        )

    known = aircraft(0x4B1234, b"SWR1")
    frames = anonymised([known, aircraft(7, b"B"), known, aircraft(0, b"")])
    first, other, again, unknown = (fields_of(frame) for frame in frames if frame)
    assert first["ICAO_address"] == again["ICAO_address"] != other["ICAO_address"]
    assert first["callsign"] == again["callsign"] != other["callsign"]
    assert first["squawk"] != 7000
    assert (unknown["ICAO_address"], unknown["callsign"]) == (0, b"")


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


IDENTIFYING = (b"HOME_LAT", b"SIM_OPOS_LNG", b"ADSB_ICAO_ID", b"BATT_SERIAL_NUM")
OTHERS = (b"PLAT_MAX", b"ATC_LATENCY", b"FLIGHT_ID", b"WPNAV_SPEED")


@pytest.mark.parametrize("name", IDENTIFYING + OTHERS)
def test_parameters_that_identify_are_left_out(name: bytes) -> None:
    frame = packed(mavlink.MAVLink_param_value_message(name, 47.0, 9, 1, 0))
    assert anonymised([frame]) == [frame if name in OTHERS else None]


def test_signatures_are_dropped() -> None:
    (after,) = anonymised([Sender(signed=True).heartbeat()])
    assert after is not None
    assert not frame_of(after).signed


@pytest.mark.parametrize("keep", [False, True])
def test_unknown_messages_are_dropped_unless_they_shall_be_kept(keep: bool) -> None:
    frames = [frame_with(60_001, b"unknown"), frame_with(0, bytes(range(1, 40)))]
    anonymity = Anonymity(keep_unknown=True) if keep else Anonymity()
    assert anonymised(frames, anonymity) == (frames if keep else [None, None])


@pytest.mark.io
def test_command_moves_to_the_place_and_prints_the_changes(tmp_path: Path) -> None:
    sender, frames = Sender(), []
    for k in range(20):
        frames.append(sender.heartbeat())
        frames.append(sender.pack(moving(LAT + k * 1e-4, LON)))
        frames.append(sender.pack(mavlink.MAVLink_statustext_message(6, b"Pilot Meier, Thun")))
    path, out = write_tlog(tmp_path / "a.tlog", records_of(frames)), tmp_path / "b.tlog"
    text = run(
        "convert", path, "-o", out, "--anonymise", "--place", "-33.9,18.4", "--day", "2001-02-03"
    )
    assert "GLOBAL_POSITION_INT lat 20" in text
    assert "STATUSTEXT text 20" in text
    assert b"Meier" not in out.read_bytes()
    first = next(r for r in read_tlog(out) if message_id_of(r.frame) == 33)
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
    path = write_tlog(tmp_path / "a.tlog", records_of([Sender().heartbeat()]))
    assert text in run("convert", path, "-o", tmp_path / "b.tlog", *options, code=2)
