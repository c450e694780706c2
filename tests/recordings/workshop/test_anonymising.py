"""Anonymised recordings: nothing that identifies survives, and the shape of the flight stays."""

import math
import re
import struct
import tomllib
from datetime import UTC, date, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from gateway.estimation.record import FloatArray
from gateway.recordings.workshop.anonymising import (
    PARAMETERS,
    Anonymiser,
    Anonymity,
    parameters_of,
    treatment_of,
    unlisted_fields,
)
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS, layout_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of, message_id_of, split_datagram
from gateway.wire.recorded_frames import fields_of
from tests.kit.cli import run
from tests.kit.mavlink import Sender, frame_with, packed
from tests.kit.recordings import START_US, batch_of, read_tlog, records_of, write_tlog

MAV_CMD = mavlink.enums["MAV_CMD"]
MAX_COMMAND = 65_535
LOCAL_COMMANDS = (mavlink.MAV_CMD_NAV_LAND_LOCAL, mavlink.MAV_CMD_NAV_TAKEOFF_LOCAL)
UNUSED = re.compile(r"empty|reserved|user defined|$", re.IGNORECASE)
TABLE = files("gateway.recordings.workshop") / "private_fields.toml"
LAT, LON = 47.3712345, 8.5412345
TOLERANCE_DEG = 1e-5
SECRET = b"HB-SECRET-7Q"
DAY = 86_400
PRIVATE = re.compile(r"uid|serial.?n|icao|mmsi|squawk|ssid|passw|secret", re.IGNORECASE)
KEPT_TEXTS = {
    "CAMERA_INFORMATION": ["vendor_name", "model_name"],
    "GIMBAL_DEVICE_INFORMATION": ["vendor_name", "model_name"],
    "AVAILABLE_MODES": ["mode_name"],
    "PLAY_TUNE": ["tune", "tune2"],
    "DEVICE_OP_READ": ["busname"],
    "MLRS_RADIO_LINK_INFORMATION": ["mode_str", "band_str"],
}
"""Texts that name a product or a mode."""
LOCATED = ("MISSION_ITEM", "MISSION_ITEM_INT", "COMMAND_INT", "COMMAND_INT_STAMPED",
           "ORBIT_EXECUTION_STATUS")  # fmt: skip
"""Messages with coordinates x and y."""


def anonymised(frames: list[bytes], anonymity: Anonymity | None = None) -> list[bytes | None]:
    """Anonymise frames as the editor does."""
    anonymiser = Anonymiser(anonymity or Anonymity())
    anonymiser.edit(position(LAT, LON))
    batch = batch_of(records_of(frames))
    anonymiser.retimed(batch)
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
    if field in KEPT_TEXTS.get(message, ()):
        return False
    return (
        kind.fieldunits_by_name.get(field) == "degE7"
        or (code.base.kind == "S" and field not in ("param_id", "name"))
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
        if field in KEPT_TEXTS.get(name, ()):
            continue
        if code.base.kind == "S":
            is_label = field in ("param_id", "name")
            values[field] = b"GAIN" if is_label else secret[: code.itemsize]
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
        before = coordinates_in(frame)
        assert all(np.abs(before - one).min() < TOLERANCE_DEG for one in originals), "none missed"
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
        assert not [f for f in same if may_identify(name, f)], name
    assert with_coordinates > 50


def test_every_message_field_and_command_of_the_dialect_is_listed() -> None:
    missing = {kind.msgname: unlisted_fields(number) for number, kind in DEFINITIONS.items()}
    assert {name: fields for name, fields in missing.items() if fields} == {}
    table = tomllib.loads(TABLE.read_text())
    commands = {entry.name.removeprefix("MAV_CMD_") for entry in MAV_CMD.values()}
    assert {*table["commands"]} - {"DO_MOUNT_CONTROL.GPS_POINT"} == commands - {"ENUM_END"}
    assert {*table["messages"]} == {kind.msgname for kind in DEFINITIONS.values()}
    for letters in table["commands"].values():
        assert letters == "out" or re.fullmatch(r"(AO|[.0aT])+", letters)
        assert letters == "out" or len(letters) == len(PARAMETERS)


def test_message_with_a_field_that_is_not_listed_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind = DEFINITIONS[MESSAGE_IDS["ATTITUDE"]]
    monkeypatch.setattr(kind, "fieldnames", [*kind.fieldnames, "new"])
    treatment_of.cache_clear()
    assert treatment_of(MESSAGE_IDS["ATTITUDE"]) is None
    treatment_of.cache_clear()
    assert parameters_of(MAX_COMMAND, 0.0) is None


WORDS_OF_LOCATIONS = re.compile(r"latitude|longitude|declination|inclination", re.IGNORECASE)


@pytest.mark.parametrize("carrier", ["COMMAND_LONG", "COMMAND_INT", "MISSION_ITEM_INT"])
def test_no_parameter_that_may_be_a_coordinate_survives(carrier: str) -> None:
    layout = layout_of(MESSAGE_IDS[carrier])
    names = PARAMETERS if carrier == "COMMAND_LONG" else (*PARAMETERS[:4], "x", "y", "z")
    for number, entry in MAV_CMD.items():
        located = [n for n, text in entry.param.items() if WORDS_OF_LOCATIONS.search(text)]
        located += [5, 6] if entry.has_location and number not in LOCAL_COMMANDS else []
        unused = [n for n, text in entry.param.items() if UNUSED.match(text.strip())]
        for frame_type in (0, 3, 6, 10, 2, 99) if located or unused else ():
            values = np.zeros(1, layout)
            values["command"] = number
            if "frame" in (layout.names or ()):
                values["frame"] = frame_type
            for n in {*located, *unused}:
                here = LON if n % 2 == 0 else LAT
                is_scaled = layout[names[n - 1]].kind == "i"
                values[names[n - 1]] = round(here * 1e7) if is_scaled else here
            (after,) = anonymised([frame_with(MESSAGE_IDS[carrier], values.tobytes())])
            left = np.zeros(1) if after is None else coordinates_in(after)
            for here in (LAT, LON):
                assert np.abs(left - here).min() > TOLERANCE_DEG, (entry.name, frame_type)
                # A constant moved by the offset would reveal it.
                assert np.abs(left + here).min() > TOLERANCE_DEG, (entry.name, frame_type)


def moving(lat: float, lon: float) -> Any:
    at = (round(lat * 1e7), round(lon * 1e7))
    return mavlink.MAVLink_global_position_int_message(1, *at, 500_000, 60_000, 1, 2, 3, 4)


def position(lat: float, lon: float) -> bytes:
    return packed(moving(lat, lon))


AWAY = st.floats(-0.9, 0.9)
"""Distance from the first position, deg."""


@given(
    place=st.tuples(st.floats(-80.0, 80.0), st.floats(-180.0, 180.0)),
    offsets=st.lists(st.tuples(AWAY, AWAY), min_size=1, max_size=5),
)
def test_distances_and_heights_stay(
    place: tuple[float, float], offsets: list[tuple[float, float]]
) -> None:
    points = [(LAT, LON), *((LAT + north, LON + east) for north, east in offsets)]
    moved = anonymised([position(*p) for p in points], Anonymity(*place))
    fields = [fields_of(frame) for frame in moved if frame]
    for (lat, lon), field in zip(points, fields, strict=True):
        new_lat, new_lon = field["lat"] / 1e7, field["lon"] / 1e7
        assert new_lat - place[0] == pytest.approx(lat - LAT, abs=3e-7)
        east = math.remainder(new_lon - place[1], 360.0) * math.cos(math.radians(place[0]))
        assert east == pytest.approx((lon - LON) * math.cos(math.radians(LAT)), abs=3e-7)
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


E7 = (round(LAT * 1e7), round(LON * 1e7))
FLOAT_E7 = (float(E7[0]), float(E7[1]))
ZERO = pytest.approx((0.0, 0.0), abs=1e-5)
INT_ZERO = pytest.approx((0, 0), abs=64)


def named(value: Any) -> str:
    """Name a message in the id of a case."""
    name = value.get_type() if hasattr(value, "get_type") else str(value)
    return f"{name} {value.command}" if hasattr(value, "command") else name


def long(command: int, *params: float) -> Any:
    return mavlink.MAVLink_command_long_message(1, 1, command, 0, *params)


def integer(command: int, frame: int, *params: float) -> Any:
    return mavlink.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *params)


@pytest.mark.parametrize(
    ("message", "names", "expected"),
    [
        (long(16, 0, 0, 0, 0, LAT, LON, 9), "param5 param6", ZERO),
        (long(201, 3, 0, 0, 0, LAT, LON, 9), "param5 param6", ZERO),
        (long(80, 3, 0, 0, 0, LAT, LON, 9), "param5 param6", ZERO),
        (long(192, -1, 0, 0, 0, *FLOAT_E7, 9), "param5 param6", INT_ZERO),
        (long(205, 0, 0, 0, 90, *FLOAT_E7, 4), "param5 param6", INT_ZERO),
        (long(205, *FLOAT_E7, 90, 0, 0, 0, 4), "param1 param2", INT_ZERO),
        (long(205, -45, 12, 170, 0, 0, 0, 2), "param1 param2", (-45, 12)),
        (long(42006, 90, 0, LAT, LON, 0, 0, 0), "param3 param4", ZERO),
        (long(16, 0, 0, 0, 0, math.nan, LON, 9), "param6", (0,)),
        (long(16, 0, 0, 0, 0, 0, 0, 9), "param5 param6", (0, 0)),
        (long(183, 5, 1500, 0, 0, 47.3, 8.5, 9), "param1 param2 param5 param6", (5, 1500, 0, 0)),
        (integer(203, 0, 0, 0, 0, 0, 1, 0, 0), "x y", (1, 0)),
        (integer(203, 6, 1, 0, 0, 0, 1, 7, 0), "x y", (1, 7)),
        (integer(201, 6, 3, 0, 0, 0, *E7, 0), "x y", INT_ZERO),
        (integer(201, 6, 3, 0, 0, 0, 1, 1, 0), "x y", INT_ZERO),
        (integer(201, 99, 3, 0, 0, 0, *E7, 0), "x y", INT_ZERO),
        (integer(16, 2, 3, 0, 0, 0, 2**31 - 1, E7[1], 0), "x y", (2**31 - 1, 0)),
        (integer(16, 1, 0, 0, 0, 0, 250_000, 380_000, 0), "x y", (250_000, 380_000)),
        (integer(192, 1, 0, 0, 0, 0, *E7, 0), "x y", (0, 0)),
        (long(203, 1, 0, LAT, LON, 0, 0, 0), "param1 param3 param4", (1, 0, 0)),
        (mavlink.MAVLink_mission_item_message(1, 1, 0, 3, 16, 0, 1, 0, 0, 0, 0, LAT, LON, 9),
         "x y", ZERO),
        (mavlink.MAVLink_safety_allowed_area_message(3, LAT, LON, 0, LAT, LON, 99),
         "p1x p1y", ZERO),
        (mavlink.MAVLink_safety_allowed_area_message(1, 47.3, 8.5, 0, 50, 60, 99),
         "p1x p1y", (pytest.approx(47.3), 8.5)),
    ],
    ids=named,
)  # fmt: skip
def test_coordinates_of_commands_are_moved_by_their_meaning(
    message: Any, names: str, expected: Any
) -> None:
    fields = edited(message)
    found = tuple(fields[name] for name in names.split())
    assert found == expected


@pytest.mark.parametrize("command", [42004, 217, 180, 31010, 65_535])
def test_commands_that_reveal_or_are_unknown_are_left_out(command: int) -> None:
    assert anonymised([packed(long(command, 2.5, 63.1, 0, 0, 0, 0, 0))]) == [None]


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


PRIVATE_NAMES = (b"HOME_LAT", b"SIM_OPOS_LNG", b"ADSB_ICAO_ID", b"BATT_SERIAL_NUM", b"gpslat",
                 b"HOMELAT", b"EKF2_MAG_DECL", b"NET_MACADDR0", b"COMPASS_DEC", b"NAV_AH_LON",
                 b"BRD_RTC_TZ_MIN", b"WIFI_PASSWORD1", b"STAT_RESET", b"lonE7",
                 b"GPSDATE", b"ddmmyy", b"TZ_OFFSET")  # fmt: skip
OTHERS = (b"PLAT_MAX", b"ATC_LATENCY", b"FLIGHT_ID", b"WPNAV_SPEED", b"COMPASS_OFS_X",
          b"COMPASS_USE", b"RC_PASSTHRU", b"SERIAL_PASS1", b"OSD1_GPSLAT_X", b"FS_LONG_ACTN",
          b"GUID_TIMEOUT", b"BATT_CAPACITY", b"EKF2_DECL_TYPE",
          b"UPDATE_RATE")  # fmt: skip


@pytest.mark.parametrize("name", PRIVATE_NAMES + OTHERS)
def test_values_with_private_names_are_left_out(name: bytes) -> None:
    frames = [
        packed(mavlink.MAVLink_param_value_message(name, 12.5, 9, 1, 0)),
        packed(mavlink.MAVLink_named_value_int_message(0, name[:10], 12)),
    ]
    is_other = name in OTHERS
    kept = [frames[0], frames[1] if name[:10] == name else ANY]
    assert anonymised(frames) == (kept if is_other else [None, ANY if name[10:] else None])


@pytest.mark.parametrize(
    ("value", "is_kept"),
    [(LAT, False), (LON + 0.001, False), (math.radians(LAT), False), (8.5, True), (0.0, True),
     (struct.unpack("<f", struct.pack("<i", E7[0]))[0], False), (math.nan, True)],
)  # fmt: skip
def test_values_equal_to_a_coordinate_are_left_out_under_any_name(
    value: float, is_kept: bool
) -> None:
    frame = packed(mavlink.MAVLink_param_value_message(b"SCR_USER1", value, 9, 1, 0))
    assert (anonymised([frame])[0] is not None) is is_kept


@pytest.mark.parametrize("keep", [False, True], ids=["dropped", "kept"])
def test_signatures_and_unknown_messages_and_fields_are_dropped(keep: bool) -> None:
    unknown = frame_with(60_001, b"unknown")
    signed_unknown = unknown[:2] + b"\1" + unknown[3:] + bytes(13)
    known = position(LAT, LON)
    longer = frame_with(MESSAGE_IDS["GLOBAL_POSITION_INT"], known[10:-2] + b"hidden")
    cut = frame_with(MESSAGE_IDS["GLOBAL_POSITION_INT"], known[10:16], version=1)
    signed = Sender(signed=True).heartbeat()
    *dropped, beat, shorter = anonymised(
        [unknown, signed_unknown, cut, signed, longer], Anonymity(keep_unknown=keep)
    )
    assert dropped == [unknown if keep else None, None, None]
    assert beat is not None
    assert not frame_of(beat).signed
    assert shorter is not None
    assert (shorter[1], b"hidden" in shorter) == (28, False)
    assert [type(event) for event in split_datagram(shorter)] == [MavFrame]


def test_first_date_in_messages_is_moved_to_the_day_whatever_the_clock_of_the_records() -> None:
    start_us, rtc_us = START_US + 400 * DAY * 1_000_000, 946_684_900_000_000
    times = [start_us, start_us + 3 * DAY * 1_000_000, rtc_us, start_us]
    frames = [packed(mavlink.MAVLink_system_time_message(time_us, 1234)) for time_us in times]
    moved = [fields_of(frame)["time_unix_usec"] for frame in anonymised(frames) if frame]
    days = [datetime.fromtimestamp(time_us / 1e6, UTC).date() for time_us in moved]
    first = date(2020, 1, 1)
    assert days == [first, date(2020, 1, 4), first, first]


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (mavlink.MAVLink_log_entry_message(1, 1, 1, 2**32 - 1, 99), "time_utc"),
        (mavlink.MAVLink_system_time_message(2**64 - 1, 0), "time_unix_usec"),
        (mavlink.MAVLink_timesync_message(-(2**63), 2**63 - 1), "tc1"),
        (mavlink.MAVLink_uavcan_node_status_message(0, 2**32 - 1, 0, 0, 0, 0), "uptime_sec"),
    ],
)
def test_times_at_the_ends_of_their_types_are_no_dates(message: Any, field: str) -> None:
    assert edited(message)[field] == getattr(message, field)


def test_dates_in_another_unit_or_of_any_name_are_of_the_same_clock() -> None:
    ms, s = START_US // 1000, START_US // 1_000_000
    image = mavlink.MAVLink_camera_image_captured_message(
        9, ms, 1, 0, 0, 0, 0, [1, 0, 0, 0], 1, 1, b""
    )
    named = mavlink.MAVLink_named_value_int_message(0, b"X", s)
    first, moved, left_out = anonymised(
        [packed(mavlink.MAVLink_system_time_message(START_US, 9)), *map(packed, (image, named))]
    )
    assert first is not None
    assert moved is not None
    assert fields_of(moved)["time_utc"] == fields_of(first)["time_unix_usec"] // 1000
    assert left_out is None


def test_dates_that_no_longer_fit_their_field_become_unknown() -> None:
    last_s = 2_145_000_000
    message = mavlink.MAVLink_log_entry_message(1, 1, 1, last_s, 99)
    frames = [
        packed(mavlink.MAVLink_log_entry_message(1, 1, 1, last_s - 300 * DAY, 99)),
        packed(message),
    ]
    last = anonymised(frames, Anonymity(day=date(2099, 12, 31)))[-1]
    assert last is not None
    assert 0 <= fields_of(last)["time_utc"] < 2**32


def test_locations_far_from_the_flight_do_not_reveal_its_offset() -> None:
    far = [(1e-7, 1e-7), (-35.363261, 149.165230), (47.397742, 8.545594)]
    found = [fields_of(frame) for frame in anonymised([position(*at) for at in far]) if frame]
    default, canberra, near = ((one["lat"], one["lon"]) for one in found)
    assert default == canberra == (1, 1)
    assert near == pytest.approx(((47.397742 - LAT) * 1e7, (8.545594 - LON) * 6.772e6), rel=1e-3)


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
