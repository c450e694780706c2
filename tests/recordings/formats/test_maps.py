"""Tracks for maps, read back by an XML parser."""

import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.config import GatewaySettings
from gateway.recordings.formats.maps import (
    DRAWN_IDS,
    MapMarker,
    MarkerKind,
    VehicleTrack,
    to_geojson,
    to_gpx,
    to_kml,
    tracks_of_messages,
    tracks_of_table,
)
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.table import TableNote, block_of
from gateway.records import NavFlags
from gateway.vehicle_state.positions import TrackPoint
from tests.kit.mavlink import message_of
from tests.kit.messages import attitude, beat, chunks, home, text
from tests.kit.recordings import SECOND_US, START_US, Sent, messages_of, records_sent
from tests.recordings.flights import fly, make_flight, read

POINTS = [
    TrackPoint(1_760_000_000_123_000 + i * 100_000, 47.1 + 1e-6 * i, -8.5, 430.25) for i in range(5)
]
ATTITUDE = TrackPoint(POINTS[-1].time_us + 10**6, 47.2, -8.5, 431.0, (-10.0, 5.0, -90.0))
VEHICLES = [
    VehicleTrack("wood & <field>", [[*POINTS, ATTITUDE]], [
        MapMarker(MarkerKind.HOME, "Home", POINTS[0]),
        MapMarker(MarkerKind.NOTE, "over <the> gate", POINTS[2]),
        MapMarker(MarkerKind.EVENT, "GPS fix lost", POINTS[3]),
    ]),
    VehicleTrack("system 7", [POINTS[:2]]),
]  # fmt: skip
KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
GPX = {"g": "http://www.topografix.com/GPX/1/1", "a": "urn:mavgate:attitude:1"}


def test_kml_contains_every_vehicle_with_times_attitude_and_markers() -> None:
    root = ET.fromstring("".join(to_kml("flight", VEHICLES)))
    assert [e.text for e in root.findall(".//k:Folder/k:name", KML)] == [
        "wood & <field>", "system 7",
    ]  # fmt: skip
    first, turned, second = root.findall(".//gx:Track", KML)
    positions = [e.text for e in first.findall("gx:coord", KML)]
    assert positions[1] == "-8.5000000 47.1000010 430.25"
    times = [e.text for e in first.findall("k:when", KML)]
    assert times[0] == "2025-10-09T08:53:20.123Z"
    assert len(times) == len(positions) == 5
    assert first.findall("gx:angles", KML) == []
    assert [e.text for e in turned.findall("gx:angles", KML)] == ["270.0 5.0 -10.0"]
    assert len(turned.findall("gx:coord", KML)) == 1
    assert len(second.findall("gx:coord", KML)) == 2
    assert second.findall("gx:angles", KML) == []
    styles = {e.get("id") for e in root.findall(".//k:Style", KML)}
    used = [e.text for e in root.findall(".//k:styleUrl", KML)]
    assert len(set(used)) == 2
    assert {(style or "#")[1:] for style in used} <= styles
    found = [
        (p.findtext("k:description", namespaces=KML), p.findtext("k:name", namespaces=KML),
         p.findtext("k:Point/k:coordinates", namespaces=KML))
        for p in root.findall(".//k:Placemark", KML) if p.find("k:Point", KML) is not None
    ]  # fmt: skip
    assert found == [
        ("home", "Home", "-8.5000000,47.1000000,430.25"),
        ("note", "over <the> gate", "-8.5000000,47.1000020,430.25"),
        ("event", "GPS fix lost", "-8.5000000,47.1000030,430.25"),
    ]


def test_gpx_contains_tracks_and_waypoints() -> None:
    root = ET.fromstring("".join(to_gpx("flight", VEHICLES)))
    # GPX wants waypoints before tracks.
    assert [e.tag.rpartition("}")[2] for e in root] == ["metadata", *["wpt"] * 3, *["trk"] * 2]
    names = [e.findtext("g:name", namespaces=GPX) for e in root.findall("g:wpt", GPX)]
    assert names == ["Home", "over <the> gate", "GPS fix lost"]
    points = root.findall("g:trk", GPX)[0].findall(".//g:trkpt", GPX)
    assert (points[1].get("lat"), points[1].get("lon")) == ("47.1000010", "-8.5000000")
    assert points[1].findtext("g:ele", namespaces=GPX) == "430.25"
    assert points[1].findtext("g:time", namespaces=GPX) == "2025-10-09T08:53:20.223Z"
    attitude = points[5].find("g:extensions/a:attitude", GPX)
    assert attitude is not None
    assert attitude.attrib == {"roll": "-10.0", "pitch": "5.0", "yaw": "270.0"}


POINT_ORDER = "ele time magvar geoidheight name cmt desc src link sym type extensions"
ORDERS = {
    "gpx": "metadata wpt rte trk extensions", "metadata": "name desc", "wpt": POINT_ORDER,
    "trk": "name cmt desc src link number type extensions trkseg", "trkseg": "trkpt extensions",
    "trkpt": POINT_ORDER, "kml": "Document", "Document": "name Style Folder",
    "Folder": "name Placemark", "TimeStamp": "when", "Point": "altitudeMode coordinates",
    "Placemark": "name description TimeStamp styleUrl Point Track MultiTrack",
    "MultiTrack": "altitudeMode interpolate Track", "Track": "altitudeMode when coord angles",
}  # fmt: skip
"""Children in the sequence of the schemas, of GPX 1.1, KML 2.2 and its extension `gx`."""


@pytest.mark.parametrize("write", [to_kml, to_gpx])
@pytest.mark.parametrize("alt_m", [430.25, math.nan])
def test_elements_are_those_of_the_schema_in_its_sequence(
    write: Callable[..., Iterator[str]], alt_m: float
) -> None:
    at = [replace(point, alt_amsl_m=alt_m) for point in [*POINTS, ATTITUDE]]
    east = replace(at[-1], lon_deg=180.0, time_us=at[-1].time_us + 1)
    markers = [MapMarker(kind, kind.name, at[0]) for kind in MarkerKind]
    vehicles = [VehicleTrack("a", [at, [east]], markers), VehicleTrack("b", [at[:1]])]
    root = ET.fromstring("".join(write("flight", vehicles)))
    for element in root.iter():
        name, text = element.tag.rpartition("}")[2], (element.text or "").strip()
        order = ORDERS.get(name, "").split()
        children = [child.tag.rpartition("}")[2] for child in element]
        if name not in ("extensions", "Style", "LineStyle"):
            assert children == sorted(children, key=order.index), name
        assert len(element) or text or element.attrib, f"{name} is empty"
        assert "nan" not in [*re.split("[ ,]", text), *element.attrib.values()]
        assert -180.0 <= float(element.get("lon", 0.0)) < 180.0
    modes = {mode.text for mode in root.iter(f"{{{KML['k']}}}altitudeMode")}
    if write is to_kml:
        assert modes == {"absolute" if math.isfinite(alt_m) else "clampToGround"}


@pytest.mark.parametrize("write", [to_kml, to_gpx])
def test_map_without_points_is_valid_xml(write: Callable[..., Iterator[str]]) -> None:
    ET.fromstring("".join(write("x", [])))


@pytest.mark.parametrize("write", [to_kml, to_gpx])
def test_characters_not_allowed_in_xml_are_replaced(write: Callable[..., Iterator[str]]) -> None:
    odd = "".join(map(chr, range(0x20))) + "\x7f\ud800\udcff\ufffe\uffff]]>\N{HELICOPTER}"
    vehicles = [VehicleTrack(odd, [POINTS], [MapMarker(MarkerKind.MARK, odd, POINTS[0])])]
    text = "".join(write(odd, vehicles))
    names = [e.text or "" for e in ET.fromstring(text.encode()).iter() if e.tag.endswith("name")]
    assert len(names) >= 3
    assert sum("\N{HELICOPTER}" in name for name in names) >= 3


def written(vehicles: list[VehicleTrack]) -> dict:
    return json.loads("".join(to_geojson('a "flight"', vehicles)))


def test_geojson_contains_every_vehicle_with_times_and_markers() -> None:
    found = written(VEHICLES)
    assert (found["type"], found["name"]) == ("FeatureCollection", 'a "flight"')
    assert {feature["type"] for feature in found["features"]} == {"Feature"}
    kinds = [(f["geometry"]["type"], f["properties"]["kind"]) for f in found["features"]]
    assert kinds == [
        ("LineString", "track"), ("Point", "home"), ("Point", "note"), ("Point", "event"),
        ("LineString", "track"),
    ]  # fmt: skip
    line, home, mark = found["features"][:3]
    assert line["geometry"]["coordinates"][0] == [-8.5, 47.1, 430.25]
    assert len(line["geometry"]["coordinates"]) == len(line["properties"]["coordTimes"]) == 6
    assert line["properties"]["coordTimes"][0] == "2025-10-09T08:53:20.123Z"
    assert line["properties"]["name"] == "wood & <field>"
    assert home["geometry"]["coordinates"] == [-8.5, 47.1, 430.25]
    assert mark["properties"]["name"] == "over <the> gate"
    assert mark["properties"]["vehicle"] == "wood & <field>"


def test_track_is_cut_at_the_antimeridian() -> None:
    lons = (179.0, 179.8, -179.8, -179.0, 179.9)
    points = [TrackPoint(1_000_000 * k, 10.0 + k, lon, 100.0) for k, lon in enumerate(lons)]
    (track,) = written([VehicleTrack("x", [points])])["features"]
    assert track["geometry"]["type"] == "MultiLineString"
    parts = track["geometry"]["coordinates"]
    assert [len(part) for part in parts] == [3, 4, 2]
    assert parts[0][-1] == [180.0, 11.5, 100.0]
    assert parts[1][0] == [-180.0, 11.5, 100.0]
    assert parts[1][-1][0] == -180.0
    assert parts[2][0][0] == 180.0
    assert [len(times) for times in track["properties"]["coordTimes"]] == [3, 4, 2]
    for part in parts:
        assert len({math.copysign(1.0, lon) for lon, *_ in part}) == 1


@pytest.mark.parametrize(("alt_m", "length"), [(math.nan, 2), (5.0, 3)])
def test_track_of_one_point_is_a_point_without_an_unknown_height(alt_m: float, length: int) -> None:
    (track,) = written([VehicleTrack("x", [[TrackPoint(0, 47.0, 8.0, alt_m)]])])["features"]
    assert track["geometry"]["type"] == "Point"
    assert len(track["geometry"]["coordinates"]) == length


ONE, TWO, STATION, OLD_STATION = (1, 1), (7, 1), (255, 190), (42, 190)


def position(lat: int) -> Any:
    return message_of("GLOBAL_POSITION_INT", lat=lat, lon=85_000_000, alt=430_000)


HOME = home(47.0, 8.5, 400.0)
SAID: list[tuple[tuple[int, int], Any]] = [
    (ONE, text("Attitude valid", 6)),
    (OLD_STATION, beat(mavlink.MAV_TYPE_GCS, 8)),
    (ONE, attitude(0.1, -0.2, 1.5)),
    (ONE, message_of("GLOBAL_POSITION_INT")),
    (ONE, HOME),
    (ONE, position(470_000_001)),
    (TWO, position(480_000_000)),
    (ONE, HOME),
    (ONE, text("Note: over the gate", 6)),
    (ONE, text("Marked 47.500000, 8.600000", 6)),
    (ONE, text("for programmers", 7)),
    (TWO, message_of("ATTITUDE_QUATERNION", q1=1.0)),
    (TWO, position(480_000_001)),
    *((ONE, chunk) for chunk in chunks("A" * 50 + "B", 6)),
    (STATION, text("hello", 6)),
    (STATION, position(10)),
    (OLD_STATION, position(20)),
]


def drawn(sent: Sent = SAID, system_id: int | None = None) -> list[VehicleTrack]:
    return tracks_of_messages(messages_of(records_sent(sent, SECOND_US), DRAWN_IDS, system_id))


def markers(track: VehicleTrack) -> list[tuple[MarkerKind, str]]:
    return [(marker.kind, marker.name) for marker in track.markers]


def test_tracks_are_only_those_of_vehicles() -> None:
    one, two = drawn()
    assert (one.name, two.name) == ("system 1", "system 7")
    assert [round(p.lat_deg * 1e7) for p in two.points] == [480_000_000, 480_000_001]
    assert [track.name for track in drawn(system_id=7)] == ["system 7"]
    assert drawn(system_id=9) == []


def test_points_have_the_attitude_of_their_time() -> None:
    one, two = drawn()
    assert one.points[0].attitude_deg == pytest.approx(
        (math.degrees(0.1), math.degrees(-0.2), math.degrees(1.5)), abs=1e-4
    )
    assert [p.attitude_deg for p in two.points] == [None, (0.0, 0.0, 0.0)]


def test_tracks_of_frames_have_home_marks_and_events() -> None:
    one, _ = drawn()
    assert markers(one) == [
        (MarkerKind.HOME, "Home"),
        (MarkerKind.EVENT, "Attitude valid"),
        (MarkerKind.NOTE, "over the gate"),
        (MarkerKind.MARK, "Marked 47.500000, 8.600000"),
        (MarkerKind.EVENT, "A" * 50 + "B"),
    ]
    by_name = {marker.name: marker.at for marker in one.markers}
    assert by_name["Marked 47.500000, 8.600000"].lat_deg == 47.5
    assert by_name["over the gate"].lat_deg == pytest.approx(47.0000001)
    assert by_name["Home"].alt_amsl_m == pytest.approx(400.0)


def test_tracks_of_a_table_have_home_and_notes(rng: np.random.Generator) -> None:
    settings = GatewaySettings().default_aircraft
    header, rows = read(fly(settings, make_flight(rng, 12))[0])
    header = msgspec.structs.replace(header, unix_us_at_zero=START_US)
    for k, row in enumerate(rows):
        if row.gps:
            fix = msgspec.structs.replace(row.gps, h_acc_m=1.0, satellites=12)
            rows[k] = replace(row, gps=fix)
    mark = TableNote(rows[-1].time_us, "over the gate")
    (track,) = tracks_of_table(RecordedTable(header, iter([block_of([*rows, mark])])), settings)
    assert markers(track) == [(MarkerKind.HOME, "Home"), (MarkerKind.NOTE, "over the gate")]
    assert len(track.points) > 10
    times_us = [point.time_us - START_US for point in track.points]
    assert times_us == sorted(times_us)
    assert 0 <= times_us[0] <= times_us[-1] <= rows[-1].time_us
    assert 0 <= track.markers[0].at.time_us - START_US <= rows[-1].time_us
    known = [row.state for row in rows if row.state and NavFlags.ATTITUDE_VALID in row.state.flags]
    assert any(point.attitude_deg is not None for point in track.points) == bool(known)
