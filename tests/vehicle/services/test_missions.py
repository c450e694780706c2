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
from tests.kit.conversation import Step, converse
from tests.kit.ground_station import (
    ALL,
    FENCE,
    MISSION,
    RALLY,
    GroundStation,
    command,
    content,
    count,
    download,
    item,
    to_vehicle,
    upload,
)
from tests.kit.records import FIX, STATE

GLOBAL_INT, RELATIVE_INT, LOCAL_NED, MISSION_FRAME = 5, 6, 1, 2
WAYPOINT = 16
ACCEPTED, ERROR, UNSUPPORTED = 0, mavlink.MAV_MISSION_ERROR, mavlink.MAV_MISSION_UNSUPPORTED
CANCELLED, DENIED = mavlink.MAV_MISSION_OPERATION_CANCELLED, mavlink.MAV_MISSION_DENIED
NO_SPACE = mavlink.MAV_MISSION_NO_SPACE
BAD_X = mavlink.MAV_MISSION_INVALID_PARAM5_X
DONE = {"COMMAND_ACK": {"result": 0}}
ITEM = [item(seq) for seq in range(6)]


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


def put(*items: Any, kind: int = MISSION, result: int = ACCEPTED) -> Step:
    """Upload items, which end with a result."""

    def act(me: GroundStation) -> None:
        assert upload(me, list(items), kind) == result

    return (act, ...)


def has(*items: Any, kind: int = MISSION) -> Step:
    """Download the items that are stored."""

    def act(me: GroundStation) -> None:
        assert [content(m) for m in download(me, kind)] == [content(m) for m in items]

    return (act, ...)


def asks(*seqs: int, old: int = 0) -> dict[str, Any]:
    """Expect requests of items, and so many in the older form."""
    return {"MISSION_REQUEST_INT.seq": [*seqs], "MISSION_REQUEST": old, "MISSION_ACK": 0}


def ends(*results: int, kind: int = MISSION, system: int = 255) -> dict[str, Any]:
    """Expect results of a transfer of one type."""
    return {
        "MISSION_ACK.type": [*results], "MISSION_ACK.mission_type": [kind] * len(results),
        "MISSION_ACK.target_system": [system] * len(results), "MISSION_REQUEST_INT": 0,
    }  # fmt: skip


def mark(**fields: Any) -> Step:
    """Request NAV_CONTROLLER_OUTPUT; without fields there is no mark."""
    none = {"kinds": ["COMMAND_ACK"], "COMMAND_ACK": {"result": 1}}
    return (command(512, 62), DONE | {"NAV_CONTROLLER_OUTPUT": fields} if fields else none)


def roi(*location: float) -> Step:
    return (command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, *location), DONE)


HERE, OTHER = (STATE.lat_deg, STATE.lon_deg), {"B": 254}
CONVERSATIONS: dict[str, list[Step]] = {
    "items are requested in order and at once": [
        (count(3), asks(0)), (ITEM[0], asks(1)), (ITEM[1], asks(2)), (ITEM[2], ends(ACCEPTED)),
        (5.0, asks()),
    ],
    "a lost item is requested again for five seconds": [
        (count(2), asks(0)), (ITEM[0], asks(1)), (4.9, asks(*[1] * 12)), (0.4, ends(CANCELLED)),
        (4.0, asks()),
    ],
    # The right one is asked for already.
    "an item out of order is dropped, and the right one asked for": [
        (count(3), asks(0)), (ITEM[2], asks(0)), (ITEM[0], asks(1)), (ITEM[0], {}),
    ],
    "a client that went back for a late request is taken from there": [
        (count(4), asks(0)), (ITEM[0], asks(1)), (ITEM[1], asks(2)), (ITEM[2], asks(3)),
        (ITEM[0], {}), (0.4, asks(1)), (ITEM[1], asks(2)), (ITEM[2], asks(3)),
        (ITEM[3], ends(ACCEPTED)),
    ],
    # Else MAVSDK goes back to the first item for good.
    "a begin that comes twice asks once": [
        (count(2), asks(0)), (count(2), {}), (count(3), asks(0)),
    ],
    "the same count after an item begins again": [
        (count(2), asks(0)), (ITEM[0], asks(1)), (count(2), asks(0)),
    ],
    "the last item that comes again is acknowledged again, and another one is an error": [
        (count(2), asks(0)), (ITEM[0], asks(1)), (ITEM[1], ends(ACCEPTED)), (ITEM[0], {}),
        (ITEM[1], ends(ACCEPTED)), (ITEM[5], ends(ERROR)),
    ],
    # MAVSDK waits for the ACK without repeating.
    "where a request was lost the ACK may be too": [
        (count(2), asks(0)), (0.5, asks(0)), (ITEM[0], asks(1)), (0.5, asks(1)),
        (ITEM[1], ends(ACCEPTED)), (ITEM[1], {}), (0.5, asks(1)), (ITEM[1], ends(ACCEPTED)),
        (5.0, asks(1, 1)),
    ],
    "the last item is asked for though an older one came late": [
        (count(3), asks(0)), (0.5, asks(0)), (ITEM[0], asks(1)), (ITEM[1], asks(2)),
        (ITEM[0], {}), (ITEM[2], ends(ACCEPTED)), (5.0, asks(2, 2, 2)),
    ],
    "a late end of a download ends no upload": [
        (count(2), asks(0)), (ack(ACCEPTED), {}), (ITEM[0], asks(1)),
    ],
    "a cancelled upload asks for nothing": [
        (count(3), asks(0)), (ack(CANCELLED), {}), (2.0, asks()),
    ],
    # DroneKit ignores MISSION_REQUEST_INT, and reads MISSION_ITEM only; the form is stored.
    **{
        f"a client without the INT form is served in the older one{version}": [
            (f"A{version}", count(2), asks(0)), (f"A{version}", 0.9, asks(0, old=1)),
            (f"A{version}", old_item(47.1), {"MISSION_REQUEST.seq": [1]}),
            (f"A{version}", old_item(48.1, 1), ends(ACCEPTED)),
            (f"A{version}", old_request(1), {"MISSION_ITEM": {
                "frame": 3, "x": pytest.approx(48.1, abs=1e-5),
                "y": pytest.approx(-8.7, abs=1e-5), "z": 50.0,
            }}),
            (f"A{version}", count(1), {"kinds": ["MISSION_REQUEST"]}),
        ]
        for version in ("", " v1")
    },
    "a client of the INT form is never answered in the older one": [
        put(ITEM[0]), (old_request(0), {"kinds": ["MISSION_ITEM_INT"]}),
        ("A2", old_request(0), {"kinds": ["MISSION_ITEM"]}),
    ],
    # MAVSDK does.
    "a client that refuses the older form gets the INT form": [
        (count(1), asks(0)), (0.9, asks(0, old=1)), (ack(UNSUPPORTED), asks(0)),
        (ITEM[0], ends(ACCEPTED)),
    ],
    **{
        f"an item with a coordinate of {bad} is refused": [
            (count(1), asks(0)), (old_item(bad, lon=bad), ends(BAD_X)),
        ]
        for bad in (math.nan, math.inf, -1e30)
    },
    "a failed upload leaves the old mission": [
        put(*ITEM[:2]), put(ITEM[0], item(1, x=910_000_000), result=BAD_X), (count(4), asks(0)),
        (item(0, x=1), asks(1)), (6.0, ...), has(*ITEM[:2]),
    ],
    **{
        f"{number} items of type {kind} are refused": [
            (count(number, kind), ends(NO_SPACE, kind=kind)), (20.0, asks()),
            (count(MAX_ITEMS[kind], kind), asks(0)),
        ]
        for kind in (MISSION, FENCE, RALLY)
        for number in (MAX_ITEMS[kind] + 1, 65_535)
    },
    **{
        f"clear removes the items of type {kind}": [
            put(ITEM[0]), put(item(0, RALLY), kind=RALLY), (clear(kind), ends(ACCEPTED, kind=kind)),
            has(), has(*[item(0, RALLY)] * (kind == MISSION), kind=RALLY),
        ]
        for kind in (MISSION, ALL)
    },
    # Not on a slow link either.
    "a second upload is denied during the first": [
        (count(2), asks(0)),
        *((3.0, ...), ("B", count(1), ends(DENIED, system=254)),
          ("B", ITEM[0], ends(ERROR, system=254)), (ITEM[0], asks(1))),
        *((3.0, ...), ("B", count(1), ends(DENIED, system=254)), (ITEM[1], ends(ACCEPTED))),
        ("B", *put(ITEM[0])),
    ],
    # A restarted ground station is another client, and its old upload never ends.
    "an upload without progress gives way after the timeout": [
        (count(2), asks(0)), (ITEM[0], asks(1)), (5.5, ...), ("B", *put(ITEM[0])),
    ],
    "an untrusted client may only read": [
        put(ITEM[0]),
        *[("B untrusted", m, ends(DENIED, kind=kind, system=254))
          for m, kind in ((count(1), 0), (count(0), 0), (ITEM[0], 0), (clear(ALL), ALL))],
        ("B untrusted", *has(ITEM[0])),
    ],
    "the current item is set and reported": [
        (command(512, 42), {"MISSION_CURRENT": {
            "seq": 0, "total": 65535, "mission_state": mavlink.MISSION_STATE_NO_MISSION,
        }}),
        put(*ITEM[:4]),
        (set_current(2), {"kinds": ["MISSION_CURRENT"], "MISSION_CURRENT": {"seq": 2, "total": 4}}),
        (set_current(4), {"kinds": ["STATUSTEXT"]}),
        (command(224, 3), DONE | {"MISSION_CURRENT": {"seq": 3}}),
        *((to_vehicle("MISSION_REQUEST_INT", seq, MISSION),
           {"MISSION_ITEM_INT": {"current": int(seq == 3)}}) for seq in range(4)),
    ],
    # A tenth of a degree north of 47.1 is 11118 m by the ellipsoid.
    "distance and bearing to the mark are ellipsoidal": [
        mark(), roi(HERE[0] + 0.1, HERE[1], 623.456),
        mark(wp_dist=pytest.approx(11_118, abs=2), target_bearing=0, nav_bearing=0,
             alt_error=pytest.approx(100.0, abs=0.1),
             nav_roll=pytest.approx(math.nan, nan_ok=True)),
        *(step for north, east, bearing in ((0.0, 0.01, 90), (-0.01, 0.0, -180), (0.0, -0.01, -90))
          for step in (roi(HERE[0] + north, HERE[1] + east, 500.0), mark(target_bearing=bearing))),
        roi(-40.0, 170.0, math.nan),
        mark(wp_dist=65535, alt_error=pytest.approx(math.nan, nan_ok=True)),
    ],
    "an uploaded mission marks its current item": [
        put(item(0, command=177, frame=MISSION_FRAME, x=1, y=2), item(1), item(2, x=480_000_000)),
        mark(wp_dist=5597), (set_current(2), ...), mark(wp_dist=65535),
        (clear(), ...), mark(),
    ],
    # Its height is above home.
    "a rally point is marked and a fence is not": [
        put(item(0, FENCE), kind=FENCE), mark(),
        put(item(0, RALLY, frame=RELATIVE_INT, z=100.0), kind=RALLY),
        mark(alt_error=pytest.approx(620.25 - 523.456, abs=0.01)),
    ],
    "a region of interest stays marked when the mission is cleared": [
        put(ITEM[0]), (command(mavlink.MAV_CMD_DO_SET_ROI, 3, 0, 0, 0, 47.2, -8.7, 500.0), DONE),
        (clear(), ...), mark(nav_bearing=pytest.approx(30, abs=5)),
        (command(mavlink.MAV_CMD_DO_SET_ROI_NONE), DONE), mark(),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", CONVERSATIONS)
def test_missions_are_transferred_and_marked(
    located: Vehicle, clock: ManualClock, name: str
) -> None:
    converse(located, clock, CONVERSATIONS[name], OTHER)


@pytest.mark.parametrize("seed", range(10))
def test_items_are_uploaded_and_read_over_a_lossy_link(station: GroundStation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    station.loses = lambda *_: rng.random() < 0.15
    items = [item(seq) for seq in range(20)]
    assert ACCEPTED in (upload(station, items) for _ in range(10))
    assert [content(m) for m in download(station)] == [content(m) for m in items]


INVALID: dict[str, tuple[int, dict[str, Any], int]] = {
    "latitude": (MISSION, {"x": -900_000_001}, BAD_X),
    "longitude": (MISSION, {"y": 1_800_000_001}, mavlink.MAV_MISSION_INVALID_PARAM6_Y),
    "height": (MISSION, {"z": math.inf}, mavlink.MAV_MISSION_INVALID_PARAM7),
    "frame": (MISSION, {"frame": LOCAL_NED}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
    "command": (MISSION, {"command": 65_000}, UNSUPPORTED),
    "fence": (FENCE, {"command": WAYPOINT}, UNSUPPORTED),
    "rally point": (RALLY, {"command": WAYPOINT}, UNSUPPORTED),
    "no height": (MISSION, {"frame": RELATIVE_INT, "z": math.nan}, ACCEPTED),
    "no location": (
        MISSION, {"command": 178, "frame": MISSION_FRAME, "x": -1, "y": 2**31 - 1}, ACCEPTED,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", INVALID)
def test_invalid_item_is_refused_with_its_result(station: GroundStation, name: str) -> None:
    kind, changes, result = INVALID[name]
    assert upload(station, [item(0, kind, **changes)], kind) == result


def test_distance_is_found_where_the_iteration_of_vincenty_does_not_converge() -> None:
    """From Karney's article."""
    opposite = distance_and_bearing(Location(0.0, 0.0, 0.0), Location(0.5, 179.7, 0.0))
    assert opposite == pytest.approx((19_944_127.421, math.radians(15.556883)), abs=1e-3)


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
