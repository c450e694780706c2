"""Tracks for maps, read back by an XML parser."""

from xml.etree import ElementTree as ET

from gateway.flightlog.mapshape import TrackPoint, thin_out, to_gpx, to_kml

POINTS = [
    TrackPoint(1_760_000_000_123_000 + i * 100_000, 47.1 + 1e-6 * i, -8.5, 430.25) for i in range(5)
]
KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
GPX = {"g": "http://www.topografix.com/GPX/1/1"}


def test_kml_holds_every_point_with_its_time() -> None:
    root = ET.fromstring("".join(to_kml("wood & <field>", POINTS)))
    assert root.findtext(".//k:Placemark/k:name", namespaces=KML) == "wood & <field>"
    places = [e.text for e in root.findall(".//gx:coord", KML)]
    assert places[1] == "-8.5000000 47.1000010 430.25"
    times = [e.text for e in root.findall(".//k:when", KML)]
    assert len(times) == len(places) == 5
    assert times[0] == "2025-10-09T08:53:20.123Z"


def test_gpx_holds_every_point_with_its_time() -> None:
    root = ET.fromstring("".join(to_gpx("flight", POINTS)))
    points = root.findall(".//g:trkpt", GPX)
    assert len(points) == 5
    assert (points[1].get("lat"), points[1].get("lon")) == ("47.1000010", "-8.5000000")
    assert points[1].findtext("g:ele", namespaces=GPX) == "430.25"
    assert points[1].findtext("g:time", namespaces=GPX) == "2025-10-09T08:53:20.223Z"


def test_points_too_near_in_time_are_left_out() -> None:
    assert list(thin_out(POINTS, 200_000)) == POINTS[::2]
    back = TrackPoint(5, 0.0, 0.0, 0.0)
    assert list(thin_out([*POINTS[:1], back], 200_000)) == [POINTS[0], back]


def test_no_points_is_still_a_file() -> None:
    ET.fromstring("".join(to_kml("x", [])))
    ET.fromstring("".join(to_gpx("x", [])))
