"""The mission protocol as its page has it, both directions, with and without loss."""

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import MAX_ITEMS, Location, distance_and_bearing
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import Autopilot, VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import (
    ALL,
    FENCE,
    MISSION,
    RALLY,
    GroundStation,
    content,
    count,
    download,
    item,
    kinds,
    of_kind,
    to_vehicle,
    upload,
)
from tests.kit.records import FIX, STATE

GLOBAL_INT, RELATIVE_INT, LOCAL_NED, MISSION_FRAME = 5, 6, 1, 2
WAYPOINT = 16
ACCEPTED, CANCELLED = mavlink.MAV_MISSION_ACCEPTED, mavlink.MAV_MISSION_OPERATION_CANCELLED
REQUESTS = ("MISSION_REQUEST_INT", "MISSION_REQUEST")


def ack(result: int) -> Any:
    return to_vehicle("MISSION_ACK", result, MISSION)


def old_request(seq: int) -> Any:
    return to_vehicle("MISSION_REQUEST", seq, MISSION)


def old_item(lat: float, seq: int = 0, lon: float = -8.7) -> Any:
    return mavlink.MAVLink_mission_item_message(
        1, 1, seq, 3, WAYPOINT, 0, 1, 1.5, 0.0, 0.0, math.nan, lat, lon, 50.0, MISSION
    )


def clear(kind: int = MISSION) -> Any:
    return to_vehicle("MISSION_CLEAR_ALL", kind)


def set_current(seq: int) -> Any:
    return to_vehicle("MISSION_SET_CURRENT", seq)


@pytest.mark.parametrize("seed", range(10))
def test_items_are_uploaded_and_read_over_a_lossy_link(station: GroundStation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    station.loses = lambda *_: rng.random() < 0.15
    items = [item(seq) for seq in range(20)]
    assert ACCEPTED in (upload(station, items) for _ in range(10))
    assert [content(m) for m in download(station)] == [content(m) for m in items]


@pytest.mark.parametrize("version", [1, 2])
def test_client_without_the_int_form_is_served_in_the_older_one(
    station: GroundStation, version: int
) -> None:
    """DroneKit ignores MISSION_REQUEST_INT, and reads MISSION_ITEM only."""
    station.version = version
    station.send(count(2))
    station.wait(0.9)
    assert kinds(of_kind(station.inbox, *REQUESTS)) == [REQUESTS[0], REQUESTS[0], REQUESTS[1]]
    [second] = station.send(old_item(47.1))
    assert (second.get_type(), second.seq) == ("MISSION_REQUEST", 1)
    assert kinds(station.send(old_item(48.1, 1)))[0] == "MISSION_ACK"
    [found] = station.send(old_request(1))
    assert (found.get_type(), found.frame) == ("MISSION_ITEM", 3)
    assert (found.x, found.y, found.z) == pytest.approx((48.1, -8.7, 50.0), abs=1e-5)
    assert kinds(station.send(count(1))) == ["MISSION_REQUEST"], "the form is stored"


def test_client_of_the_int_form_is_never_answered_in_the_older_one(station: GroundStation) -> None:
    upload(station, [item(0)])
    assert kinds(station.send(old_request(0))) == ["MISSION_ITEM_INT"]
    assert kinds(station.other(9).send(old_request(0))) == ["MISSION_ITEM"]


def test_client_that_refuses_the_older_form_gets_the_int_form(station: GroundStation) -> None:
    """MAVSDK answers MISSION_REQUEST by MISSION_ACK unsupported."""
    station.send(count(1))
    station.wait(0.9)
    assert kinds(station.send(ack(mavlink.MAV_MISSION_UNSUPPORTED))) == ["MISSION_REQUEST_INT"]
    assert kinds(station.send(item(0)))[0] == "MISSION_ACK"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e30])
def test_item_with_invalid_float_coordinates_is_refused(station: GroundStation, bad: float) -> None:
    station.send(count(1))
    assert station.send(old_item(bad, lon=bad))[0].type == mavlink.MAV_MISSION_INVALID_PARAM5_X


ITEM = [item(seq) for seq in range(6)]


@pytest.mark.parametrize(
    "steps",
    [
        # Items are requested in order and at once.
        [(count(3), [0]), (ITEM[0], [1]), (ITEM[1], [2]), (ITEM[2], "accepted"), (5.0, [])],
        # A lost item is requested again for five seconds.
        [(count(2), [0]), (ITEM[0], [1]), (4.9, [1] * 12), (0.4, "cancelled"), (4.0, [])],
        # One out of order is dropped, and the right one asked for; it is asked for already.
        [(count(3), [0]), (ITEM[2], [0]), (ITEM[0], [1]), (ITEM[0], [])],
        # A client that went back for a late request is taken from there.
        [
            *((count(4), [0]), (ITEM[0], [1]), (ITEM[1], [2]), (ITEM[2], [3]), (ITEM[0], [])),
            *((0.4, [1]), (ITEM[1], [2]), (ITEM[2], [3]), (ITEM[3], "accepted")),
        ],
        # A begin that comes twice asks once: else MAVSDK goes back to the first item for good.
        [(count(2), [0]), (count(2), []), (count(3), [0])],
        # The same count again after an item begins again.
        [(count(2), [0]), (ITEM[0], [1]), (count(2), [0])],
        # The last item that comes again is acknowledged again; another one is an error.
        [
            *((count(2), [0]), (ITEM[0], [1]), (ITEM[1], "accepted"), (ITEM[0], [])),
            *((ITEM[1], "accepted"), (ITEM[5], "error")),
        ],
        # Where a request was lost the ACK may be too, for which MAVSDK waits without repeating.
        [
            *((count(2), [0]), (0.5, [0]), (ITEM[0], [1]), (0.5, [1]), (ITEM[1], "accepted")),
            *((ITEM[1], []), (0.5, [1]), (ITEM[1], "accepted"), (5.0, [1, 1])),
        ],
        # The last item is asked for though an older one came late.
        [
            *((count(3), [0]), (0.5, [0]), (ITEM[0], [1]), (ITEM[1], [2]), (ITEM[0], [])),
            *((ITEM[2], "accepted"), (5.0, [2, 2, 2])),
        ],
        # A late end of a download ends no upload; a cancelled upload asks for nothing.
        [(count(2), [0]), (ack(ACCEPTED), []), (ITEM[0], [1])],
        [(count(3), [0]), (ack(CANCELLED), []), (2.0, [])],
    ],
)  # fmt: skip
def test_upload_continues_after_lost_late_or_repeated_messages(
    station: GroundStation, steps: list[tuple[Any, list[int] | str]]
) -> None:
    """Each step is a message or a time in s, and the items asked for then, or its ACK."""
    results = {ACCEPTED: "accepted", mavlink.MAV_MISSION_ERROR: "error", CANCELLED: "cancelled"}
    for number, (step, expected) in enumerate(steps):
        found = station.wait(step) if isinstance(step, float) else station.send(step)
        acks = of_kind(found, "MISSION_ACK")
        ended = [results[m.type] for m in acks]
        assert {m.mission_type for m in acks} <= {MISSION}
        assert {(m.target_system, m.target_component) for m in acks} <= {(255, 190)}
        asked = [m.seq for m in of_kind(found, *REQUESTS)]
        assert (ended or asked) == ([expected] if isinstance(expected, str) else expected), number


def test_failed_upload_leaves_the_old_mission(station: GroundStation) -> None:
    upload(station, [item(0), item(1)])
    broken = [item(0), item(1, x=910_000_000)]
    assert upload(station, broken) == mavlink.MAV_MISSION_INVALID_PARAM5_X
    station.send(count(4))
    station.send(item(0, x=1))
    station.wait(6.0)
    assert [m.x for m in download(station)] == [471_000_000, 471_001_000]


@pytest.mark.parametrize(
    ("kind", "changes", "result"),
    [
        (MISSION, {"x": -900_000_001}, mavlink.MAV_MISSION_INVALID_PARAM5_X),
        (MISSION, {"y": 1_800_000_001}, mavlink.MAV_MISSION_INVALID_PARAM6_Y),
        (MISSION, {"z": math.inf}, mavlink.MAV_MISSION_INVALID_PARAM7),
        (MISSION, {"frame": LOCAL_NED}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (MISSION, {"command": 65_000}, mavlink.MAV_MISSION_UNSUPPORTED),
        (FENCE, {"command": WAYPOINT}, mavlink.MAV_MISSION_UNSUPPORTED),
        (RALLY, {"command": WAYPOINT}, mavlink.MAV_MISSION_UNSUPPORTED),
        (MISSION, {"frame": RELATIVE_INT, "z": math.nan}, ACCEPTED),
        (MISSION, {"command": 178, "frame": MISSION_FRAME, "x": -1, "y": 2**31 - 1}, ACCEPTED),
    ],
)
def test_invalid_item_is_refused_with_its_result(
    station: GroundStation, kind: int, changes: dict[str, Any], result: int
) -> None:
    assert upload(station, [item(0, kind, **changes)], kind) == result


@pytest.mark.parametrize("kind", [MISSION, FENCE, RALLY])
@pytest.mark.parametrize("number", [0, 65_535])
def test_too_many_items_are_refused(station: GroundStation, kind: int, number: int) -> None:
    [end] = station.send(count(number or MAX_ITEMS[kind] + 1, kind))
    assert (end.type, end.mission_type) == (mavlink.MAV_MISSION_NO_SPACE, kind)
    assert of_kind(station.wait(20.0), *REQUESTS) == []
    assert kinds(station.send(count(MAX_ITEMS[kind], kind))) == ["MISSION_REQUEST_INT"]


@pytest.mark.parametrize("kind", [MISSION, ALL])
def test_clear_removes_the_items_of_one_type_or_all(station: GroundStation, kind: int) -> None:
    upload(station, [item(0)])
    upload(station, [item(0, RALLY)], RALLY)
    [end] = station.send(clear(kind))
    assert (end.type, end.mission_type) == (ACCEPTED, kind)
    assert download(station) == []
    assert len(download(station, RALLY)) == (kind == MISSION)


def test_second_upload_is_denied_during_the_first(station: GroundStation) -> None:
    """Not on a slow link either."""
    other = station.other(system_id=254)
    station.send(count(2))
    for seq in range(2):
        station.wait(3.0)
        [denied] = other.send(count(1))
        assert (denied.type, denied.target_system) == (mavlink.MAV_MISSION_DENIED, 254)
        assert other.send(item(0))[0].type == mavlink.MAV_MISSION_ERROR
        answers = station.send(item(seq))
    assert answers[0].type == ACCEPTED
    assert upload(other, [item(0)]) == ACCEPTED


def test_upload_without_progress_gives_way_after_the_timeout(station: GroundStation) -> None:
    """A restarted ground station is another client, and its old upload never ends."""
    station.send(count(2))
    station.send(item(0))
    station.wait(5.5)
    assert upload(station.other(system_id=254), [item(0)]) == ACCEPTED


def test_untrusted_client_may_only_read(station: GroundStation) -> None:
    upload(station, [item(0)])
    station.trusted = False
    for message in (count(1), count(0), item(0), clear(ALL)):
        assert station.send(message)[0].type == mavlink.MAV_MISSION_DENIED
    assert len(download(station)) == 1


def test_current_item_is_set_and_reported(station: GroundStation) -> None:
    _, current = station.request(42)
    assert (current.seq, current.total) == (0, 65535)
    assert current.mission_state == mavlink.MISSION_STATE_NO_MISSION
    upload(station, [item(seq) for seq in range(4)])
    [current] = station.send(set_current(2))
    assert (current.get_type(), current.seq, current.total) == ("MISSION_CURRENT", 2, 4)
    assert kinds(station.send(set_current(4))) == ["STATUSTEXT"]
    done, current = station.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 3)
    assert (done.result, current.seq) == (0, 3)
    assert [m.current for m in download(station)] == [0, 0, 0, 1]


def to_mark(station: GroundStation) -> Any:
    """Return NAV_CONTROLLER_OUTPUT; None without a mark."""
    done, *found = station.request(62)
    assert (done.result == 0) == bool(found)
    return found[0] if found else None


def mark(station: GroundStation, *location: float) -> Any:
    station.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, *location)
    return to_mark(station)


def test_distance_and_bearing_to_the_mark_are_ellipsoidal(station: GroundStation) -> None:
    """A tenth of a degree north of 47.1 is 11118 m by the ellipsoid."""
    assert to_mark(station) is None
    found = mark(station, STATE.lat_deg + 0.1, STATE.lon_deg, 623.456)
    assert found.wp_dist == pytest.approx(11_118, abs=2)
    assert found.target_bearing == found.nav_bearing == 0
    assert found.alt_error == pytest.approx(100.0, abs=0.1)
    assert math.isnan(found.nav_roll)
    for north, east, bearing in ((0.0, 0.01, 90), (-0.01, 0.0, -180), (0.0, -0.01, -90)):
        found = mark(station, STATE.lat_deg + north, STATE.lon_deg + east, 500.0)
        assert found.target_bearing == bearing
    far = mark(station, -40.0, 170.0, math.nan)
    assert far.wp_dist == 65535
    assert math.isnan(far.alt_error)
    # From Karney's article, where Vincenty's iteration does not converge.
    opposite = distance_and_bearing(Location(0.0, 0.0, 0.0), Location(0.5, 179.7, 0.0))
    assert opposite == pytest.approx((19_944_127.421, math.radians(15.556883)), abs=1e-3)


def test_uploaded_mission_marks_its_current_item(station: GroundStation) -> None:
    jump = item(0, command=177, frame=MISSION_FRAME, x=1, y=2)
    upload(station, [jump, item(1), item(2, x=480_000_000)])
    near = to_mark(station).wp_dist
    station.send(set_current(2))
    assert to_mark(station).wp_dist > near + 50_000
    station.send(clear())
    assert to_mark(station) is None


def test_rally_point_is_marked_and_a_fence_is_not(station: GroundStation) -> None:
    upload(station, [item(0, FENCE)], FENCE)
    assert to_mark(station) is None
    upload(station, [item(0, RALLY, frame=RELATIVE_INT, z=100.0)], RALLY)
    assert to_mark(station).alt_error == pytest.approx(620.25 - 523.456, abs=0.01), "above home"


def test_roi_stays_marked_when_the_mission_is_cleared(station: GroundStation) -> None:
    upload(station, [item(0)])
    station.command(mavlink.MAV_CMD_DO_SET_ROI, 3, 0, 0, 0, 47.2, -8.7, 500.0)
    station.send(clear())
    assert to_mark(station) is not None
    station.command(mavlink.MAV_CMD_DO_SET_ROI_NONE)
    assert to_mark(station) is None


@pytest.mark.parametrize(("autopilot", "size"), [("generic", 0), ("ardupilotmega", 1)])
def test_empty_mission_of_ardupilot_is_home(
    clock: ManualClock, autopilot: Autopilot, size: int
) -> None:
    """DroneKit requests item 0 of every mission."""
    station = GroundStation(Vehicle(VehicleSettings(autopilot=autopilot), 1), clock)
    assert download(station) == [], "home is not known yet"
    station.vehicle.on_gps(FIX, clock.now_us)
    found = [(m.seq, m.command, m.frame, m.x, m.y) for m in download(station)]
    assert found == [(0, WAYPOINT, 0, FIX.lat_dege7, FIX.lon_dege7)] * size
    assert station.vehicle.plan.missions.items[MISSION] == ()
    assert upload(station, [item(0)]) == ACCEPTED
    assert [content(each) for each in download(station)] == [content(item(0))]
