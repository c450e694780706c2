"""GeoJSON by RFC 7946, with the times where other programs look for them."""

import json
import math

import pytest

from gateway.recordings.formats.maps import TrackPoint, VehicleTrack, to_geojson
from tests.recordings.formats.test_mapshape import VEHICLES


def written(vehicles: list[VehicleTrack]) -> dict:
    return json.loads("".join(to_geojson('a "flight"', vehicles)))


def test_it_holds_every_vehicle_with_times_home_marks_and_events() -> None:
    found = written(VEHICLES)
    assert (found["type"], found["name"]) == ("FeatureCollection", 'a "flight"')
    assert {feature["type"] for feature in found["features"]} == {"Feature"}
    kinds = [(f["geometry"]["type"], f["properties"]["kind"]) for f in found["features"]]
    assert kinds == [
        ("LineString", "track"), ("Point", "home"), ("Point", "mark"), ("Point", "event"),
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


def test_a_track_is_cut_at_the_antimeridian() -> None:
    lons = (179.0, 179.8, -179.8, -179.0, 179.9)
    points = [TrackPoint(1_000_000 * k, 10.0 + k, lon, 100.0) for k, lon in enumerate(lons)]
    (track,) = written([VehicleTrack("x", points)])["features"]
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
def test_one_point_is_a_point_and_an_unknown_height_is_left_out(alt_m: float, length: int) -> None:
    (track,) = written([VehicleTrack("x", [TrackPoint(0, 47.0, 8.0, alt_m)])])["features"]
    assert track["geometry"]["type"] == "Point"
    assert len(track["geometry"]["coordinates"]) == length
