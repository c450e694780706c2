"""Alerts from an aircraft's messages and from the gateway's status."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.alerts import AlertLevel, alerts_of
from gateway.panel.state.vehicle import VehicleState
from gateway.units import US_PER_S
from tests.panel.messages import decoded

HEARTBEAT = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)
MAG, GYRO = 4, 1
NOW_US = 100 * US_PER_S


def gps(fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        0, fix_type, 480000000, 110000000, 500000, 100, 100, 0, 0, 9
    )


def text(words: str, severity: int = 2) -> Any:
    return mavlink.MAVLink_statustext_message(severity, words.encode())


CASES: dict[str, tuple[list[tuple[float, Any]], float, list[tuple[str, str]]]] = {
    "all is well": ([(0, gps(3))], 1, []),
    "GPS that was never there": ([(0, gps(0))], 0, []),
    "GPS lost": ([(0, gps(3)), (1, gps(0))], 2, [("GPS lost", "the GPS has no fix")]),
    "GPS found again": ([(0, gps(3)), (1, gps(0)), (2, gps(3))], 3, []),
    "GPS in an outage": (
        [(0, gps(3)), (6, HEARTBEAT)], 6, [("GPS lost", "nothing from the GPS for 6 s")]
    ),
    "sensor not healthy": (
        [(0, mavlink.MAVLink_sys_status_message(MAG | GYRO, MAG | GYRO, GYRO, *[0] * 10))], 1,
        [("Sensors not healthy", "magnetometer")],
    ),
    "severe text of any vehicle": (
        [(0, text("Crash: Disarming"))], 1, [("Crash: Disarming", "")]
    ),
    "severe text of half a minute ago": (
        [(0, text("Crash: Disarming")), (30, HEARTBEAT)], 30, []
    ),
    "blank texts": ([(0, text("")), (0, text("  "))], 1, []),
    "aircraft silent, which hides all others": (
        [(0, text("Crash: Disarming"))], 10, [("Aircraft silent", "no heartbeat for 10 s")]
    ),
}  # fmt: skip
"""Messages with their times in s, a time, and titles and details of the alerts then."""


@pytest.mark.parametrize("name", CASES)
def test_messages_begin_and_end_alerts(name: str) -> None:
    messages, at_s, expected = CASES[name]
    vehicle = VehicleState(1)
    vehicle.update(HEARTBEAT, 0)
    for time_s, message in messages:
        vehicle.update(decoded(message), round(time_s * US_PER_S))
    found = alerts_of(vehicle, None, round(at_s * US_PER_S))
    assert [(alert.title, alert.detail) for alert in found] == expected
    assert all(each.level is AlertLevel.CRITICAL for each in found if "Sensors" not in each.title)


def status(recorder: str = "idle", **troubles: str) -> dict[str, Any]:
    aircraft = [{"vehicle_id": 2, "troubles": {}}, {"vehicle_id": 1, "troubles": troubles}]
    return {"aircraft": aircraft, "recorder": {"state": recorder, "reason": "disk is full"}}


@pytest.mark.parametrize(
    ("reported", "vehicle_id", "titles"),
    [
        (status(node_1="GPS node 1 silent", fault="Sensor fault"), 1,
         ["GPS node 1 silent", "Sensor fault"]),
        (status(node_1="GPS node 1 silent", link="Receiver lost: /dev/ttyUSB0"), 1,
         ["Receiver lost: /dev/ttyUSB0"]),
        (status(node_1="GPS node 1 silent"), 2, []),
        (status(), 1, []),
        (status(), 3, ["GPS node 1 silent"]),
        (None, 1, ["GPS node 1 silent"]),
        (status("blocked"), 1, ["Recording failed"]),
    ],
    ids=["two troubles", "receiver", "another aircraft", "trouble that has ended",
         "foreign vehicle", "no gateway here", "recorder"],
)  # fmt: skip
def test_troubles_of_the_gateways_aircraft_stand_in_its_status(
    reported: dict[str, Any] | None, vehicle_id: int, titles: list[str]
) -> None:
    vehicle = VehicleState(vehicle_id)
    for message in (HEARTBEAT, text("GPS node 1 silent")):
        vehicle.update(decoded(message), NOW_US)
    assert [alert.title for alert in alerts_of(vehicle, reported, NOW_US)] == titles
