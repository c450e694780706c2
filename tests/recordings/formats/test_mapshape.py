"""Tracks for maps, read back by an XML parser."""

from collections.abc import Callable, Iterator
from xml.etree import ElementTree as ET

import pytest

from gateway.recordings.formats.maps import (
    MapPlace,
    PlaceKind,
    TrackPoint,
    VehicleTrack,
    to_gpx,
    to_kml,
)

POINTS = [
    TrackPoint(1_760_000_000_123_000 + i * 100_000, 47.1 + 1e-6 * i, -8.5, 430.25) for i in range(5)
]
ATTITUDE = TrackPoint(POINTS[-1].time_us + 10**6, 47.2, -8.5, 431.0, (-10.0, 5.0, -90.0))
VEHICLES = [
    VehicleTrack("wood & <field>", [*POINTS, ATTITUDE], [
        MapPlace(PlaceKind.HOME, "Home", POINTS[0]),
        MapPlace(PlaceKind.MARK, "over <the> gate", POINTS[2]),
        MapPlace(PlaceKind.EVENT, "GPS fix lost", POINTS[3]),
    ]),
    VehicleTrack("system 7", POINTS[:2]),
]  # fmt: skip
KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
GPX = {"g": "http://www.topografix.com/GPX/1/1", "a": "urn:mavgate:attitude:1"}


def test_kml_holds_every_vehicle_with_times_and_attitude() -> None:
    root = ET.fromstring("".join(to_kml("flight", VEHICLES)))
    assert [e.text for e in root.findall(".//k:Folder/k:name", KML)] == [
        "wood & <field>", "system 7",
    ]  # fmt: skip
    first, second = root.findall(".//gx:Track", KML)
    places = [e.text for e in first.findall("gx:coord", KML)]
    assert places[1] == "-8.5000000 47.1000010 430.25"
    times = [e.text for e in first.findall("k:when", KML)]
    assert times[0] == "2025-10-09T08:53:20.123Z"
    angles = [e.text for e in first.findall("gx:angles", KML)]
    assert angles == [None] * 5 + ["270.0 5.0 -10.0"]
    assert len(times) == len(places) == len(angles) == 6
    assert len(second.findall("gx:coord", KML)) == 2
    assert second.findall("gx:angles", KML) == []
    styles = {e.get("id") for e in root.findall(".//k:Style", KML)}
    used = [e.text for e in root.findall(".//k:styleUrl", KML)]
    assert len(set(used)) == 2
    assert {(style or "#")[1:] for style in used} <= styles


def test_kml_holds_home_marks_and_events() -> None:
    root = ET.fromstring("".join(to_kml("flight", VEHICLES)))
    found = [
        (p.findtext("k:description", namespaces=KML), p.findtext("k:name", namespaces=KML),
         p.findtext("k:Point/k:coordinates", namespaces=KML))
        for p in root.findall(".//k:Placemark", KML) if p.find("k:Point", KML) is not None
    ]  # fmt: skip
    assert found == [
        ("home", "Home", "-8.5000000,47.1000000,430.25"),
        ("mark", "over <the> gate", "-8.5000000,47.1000020,430.25"),
        ("event", "GPS fix lost", "-8.5000000,47.1000030,430.25"),
    ]


def test_gpx_holds_the_same() -> None:
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


def test_no_points_is_still_a_file() -> None:
    ET.fromstring("".join(to_kml("x", [])))
    ET.fromstring("".join(to_gpx("x", [])))


@pytest.mark.parametrize("write", [to_kml, to_gpx])
def test_texts_that_xml_cannot_hold_leave_it_readable(write: Callable[..., Iterator[str]]) -> None:
    odd = "".join(map(chr, range(0x20))) + "\x7f\ud800\udcff\ufffe\uffff]]>\N{HELICOPTER}"
    vehicles = [VehicleTrack(odd, POINTS, [MapPlace(PlaceKind.MARK, odd, POINTS[0])])]
    text = "".join(write(odd, vehicles))
    names = [e.text or "" for e in ET.fromstring(text.encode()).iter() if e.tag.endswith("name")]
    assert len(names) >= 3
    assert sum("\N{HELICOPTER}" in name for name in names) >= 3
