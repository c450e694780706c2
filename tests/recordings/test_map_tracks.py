"""What a map shows of a recording: all vehicles, home, marks, events, attitude."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.config import GatewaySettings
from gateway.recordings.formats.maps import (
    PlaceKind,
    VehicleTrack,
    tracks_of_frames,
    tracks_of_table,
)
from gateway.recordings.reading import RecordedTable
from gateway.recordings.table import TableMark, block_of
from gateway.recordings.tlog import TlogRecord
from gateway.records import NavFlags
from tests.recordings.frames import START_US
from tests.recordings.test_replay import fly, make_flight, read

SECOND_US = 1_000_000
ONE, TWO, STATION, OLD_STATION = (1, 1), (7, 1), (255, 190), (42, 190)


def position(lat: int) -> Any:
    return mavlink.MAVLink_global_position_int_message(0, lat, 85_000_000, 430_000, 0, 0, 0, 0, 0)


def text(words: str, severity: int = 6, number: int = 0, chunk: int = 0) -> Any:
    return mavlink.MAVLink_statustext_message(severity, words.encode(), number, chunk)


def home(lat: int) -> Any:
    return mavlink.MAVLink_home_position_message(
        lat, 85_000_000, 400_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
    )


SAID: list[tuple[tuple[int, int], Any]] = [
    (ONE, text("Attitude valid")),
    (OLD_STATION, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)),
    (ONE, mavlink.MAVLink_attitude_message(0, 0.1, -0.2, 1.5, 0, 0, 0)),
    (ONE, mavlink.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 0)),
    (ONE, home(470_000_000)),
    (ONE, position(470_000_001)),
    (TWO, position(480_000_000)),
    (ONE, home(470_000_000)),
    (ONE, text("Mark: over the gate")),
    (ONE, text("Marked 47.500000, 8.600000")),
    (ONE, text("for programmers", severity=7)),
    (TWO, mavlink.MAVLink_attitude_quaternion_message(0, 1.0, 0, 0, 0, 0, 0, 0)),
    (TWO, position(480_000_001)),
    (ONE, text("A" * 50, number=3, chunk=0)),
    (ONE, text("B", number=3, chunk=1)),
    (STATION, text("hello")),
    (STATION, position(10)),
    (OLD_STATION, position(20)),
]


def records() -> list[TlogRecord]:
    return [
        TlogRecord(START_US + i * SECOND_US, bytes(m.pack(mavlink.MAVLink(None, *who))))
        for i, (who, m) in enumerate(SAID)
    ]


def places(track: VehicleTrack) -> list[tuple[PlaceKind, str]]:
    return [(place.kind, place.name) for place in track.places]


def test_every_vehicle_and_nobody_else() -> None:
    one, two = tracks_of_frames(records(), None)
    assert (one.name, two.name) == ("system 1", "system 7")
    assert [round(p.lat_deg * 1e7) for p in two.points] == [480_000_000, 480_000_001]
    assert [track.name for track in tracks_of_frames(records(), 7)] == ["system 7"]
    assert tracks_of_frames(records(), 9) == []


def test_attitude_stands_with_the_points() -> None:
    one, two = tracks_of_frames(records(), None)
    assert one.points[0].attitude_deg == pytest.approx(
        (math.degrees(0.1), math.degrees(-0.2), math.degrees(1.5)), abs=1e-4
    )
    assert [p.attitude_deg for p in two.points] == [None, (0.0, 0.0, 0.0)]


def test_home_marks_and_events() -> None:
    one, _ = tracks_of_frames(records(), None)
    assert places(one) == [
        (PlaceKind.HOME, "Home"),
        (PlaceKind.EVENT, "Attitude valid"),
        (PlaceKind.MARK, "over the gate"),
        (PlaceKind.MARK, "Marked 47.500000, 8.600000"),
        (PlaceKind.EVENT, "A" * 50 + "B"),
    ]
    by_name = {place.name: place.at for place in one.places}
    assert by_name["Marked 47.500000, 8.600000"].lat_deg == 47.5
    assert by_name["over the gate"].lat_deg == pytest.approx(47.0000001)
    assert by_name["Home"].alt_amsl_m == pytest.approx(400.0)


def test_a_table_tells_the_same(rng: np.random.Generator) -> None:
    settings = GatewaySettings().default_aircraft
    header, rows = read(fly(settings, make_flight(rng, 12))[0])
    rows = [
        replace(row, gps=msgspec.structs.replace(row.gps, h_acc_m=1.0, satellites=12))
        if row.gps
        else row
        for row in rows
    ]
    mark = TableMark(rows[-1].time_us, "over the gate")
    (track,) = tracks_of_table(RecordedTable(header, iter([block_of([*rows, mark])])), settings)
    assert places(track) == [(PlaceKind.HOME, "Home"), (PlaceKind.MARK, "over the gate")]
    assert len(track.points) > 10
    known = [row.state for row in rows if row.state and NavFlags.ATTITUDE_VALID in row.state.flags]
    assert any(point.attitude_deg is not None for point in track.points) == bool(known)
