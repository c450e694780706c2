"""Alerts from an aircraft's messages and from the gateway's status."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.alerts import Alert, AlertLevel, alerts_of, with_status
from gateway.panel.state.vehicle import VehicleState
from gateway.units import US_PER_S
from tests.panel.messages import decoded

HEARTBEAT = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)
MAG, GYRO = 4, 1
NOW_US = 100 * US_PER_S
GPS_LOST = Alert("gps", AlertLevel.CRITICAL, "GPS lost")


def gps(fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        0, fix_type, 480000000, 110000000, 500000, 100, 100, 0, 0, 9
    )


def text(words: str, severity: int = 2) -> Any:
    return mavlink.MAVLink_statustext_message(severity, words.encode())


RECORDING = "Recording 2026-11-22_001122"
CASES: dict[str, tuple[list[tuple[float, Any]], float, list[tuple[str, str]]]] = {
    "all is well": ([(0, gps(3))], 1, []),
    "GPS that was never there": ([(0, gps(0))], 0, []),
    "GPS lost": ([(0, gps(3)), (1, gps(0))], 2, [("GPS lost", "the GPS has no fix")]),
    "GPS found again": ([(0, gps(3)), (1, gps(0)), (2, gps(3))], 3, []),
    "GPS in an outage": (
        [(0, gps(3)), (6, HEARTBEAT)], 6, [("GPS lost", "nothing from the GPS for 6 s")]
    ),
    "two nodes silent": (
        [(0, text("IMU node 1 silent")), (0, text("GPS node 12 silent"))], 1,
        [("IMU node 1 silent", "no radio packets"), ("GPS node 12 silent", "no radio packets")],
    ),
    "one node back": (
        [(0, text("IMU node 1 silent")), (0, text("IMU node 12 silent")),
         (2, text("IMU node 1 is back", 6))], 3, [("IMU node 12 silent", "no radio packets")],
    ),
    "receiver connected": (
        [(0, text("IMU node 1 silent")), (1, text("Receiver lost: /dev/ttyUSB0")),
         (4, text("Receiver connected: /dev/ttyUSB0", 6))], 5, [],
    ),
    "receiver lost": (
        [(0, text("Receiver lost: /dev/ttyUSB0"))], 1, [("Receiver lost", "/dev/ttyUSB0")]
    ),
    "recording stopped": (
        [(0, text("Recording stopped: less than 100 MB free", 4))], 1,
        [("Recording failed", "less than 100 MB free")],
    ),
    "recording impossible": (
        [(0, text("Cannot record: No space left", 4))], 1, [("Recording failed", "No space left")]
    ),
    "recording again": (
        [(0, text("Recording stopped: less than 100 MB free", 4)), (2, text(RECORDING, 5))], 3, []
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
        [(0, text("IMU node 1 silent"))], 10, [("Aircraft silent", "no heartbeat for 10 s")]
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
    found = alerts_of(vehicle, round(at_s * US_PER_S))
    assert [(alert.title, alert.detail) for alert in found] == expected
    assert all(each.level is AlertLevel.CRITICAL for each in found if "Sensors" not in each.title)


def status(silent_s: float = 0.0, **changed: Any) -> dict[str, Any]:
    last_us = NOW_US - round(silent_s * US_PER_S)
    node = {"vehicle_id": 1, "node_id": 2}
    report = {
        "time_us": NOW_US,
        "connected": True,
        "port": "/dev/ttyUSB0",
        "nodes": [{"node": node, "received": 9, "last_time_us": last_us}],
        "sources": [],
    }
    boards = [{"node": node, "sensors_present": 8}]
    return {
        "report": report | changed,
        "recorder": None,
        "aircraft": [{"vehicle_id": 1, "boards": boards}],
    }


def titles(reported: dict[str, Any] | None, *alerts: Alert, vehicle_id: int = 1) -> list[str]:
    return [alert.title for alert in with_status(alerts, reported, vehicle_id)]


def test_node_without_packets_in_the_status_is_an_alert() -> None:
    [alert] = with_status([], status(silent_s=30.0), 1)
    assert (alert.title, alert.detail) == ("GPS node 2 silent", "no radio packets for 30 s")
    assert alert.level is AlertLevel.CRITICAL


def test_node_of_another_aircraft_or_with_a_short_gap_is_no_alert() -> None:
    assert titles(status(silent_s=30.0), vehicle_id=2) == []
    assert titles(status(silent_s=1.0)) == []


def test_status_replaces_alerts_of_status_texts() -> None:
    reported = Alert("node GPS node 2", AlertLevel.CRITICAL, "GPS node 2 silent")
    assert titles(status(), reported, GPS_LOST) == ["GPS lost"]
    assert titles(status(silent_s=9.0), reported) == ["GPS node 2 silent"]
    assert titles(None, reported, GPS_LOST) == ["GPS node 2 silent", "GPS lost"]


def test_lost_receiver_replaces_the_alerts_of_its_nodes() -> None:
    assert titles(status(silent_s=30.0, connected=False)) == ["Receiver lost"]


@pytest.mark.parametrize(
    ("connected", "silent_s", "vehicle_id", "found"),
    [
        (True, 1, 1, []),
        (True, 9, 1, ["Source silent"]),
        (False, 9, 1, ["Source lost"]),
        (False, 9, 2, []),
    ],
)
def test_sources_of_a_gateway_without_a_receiver_are_alerts(
    connected: bool, silent_s: int, vehicle_id: int, found: list[str]
) -> None:
    source = {
        "url": "crsf:/dev/ttyACM0",
        "node": {"vehicle_id": 1, "node_id": 8},
        "connected": connected,
        "reason": "unplugged",
        "last_time_us": NOW_US - silent_s * US_PER_S,
    }
    reported = status(connected=False, port="none", sources=[source])
    text = Alert("source crsf:/dev/ttyACM0", AlertLevel.CRITICAL, "Source lost")
    assert titles(reported, text, vehicle_id=vehicle_id) == found


@pytest.mark.parametrize(("state", "found"), [("blocked", ["Recording failed"]), ("idle", [])])
def test_blocked_recording_is_an_alert(state: str, found: list[str]) -> None:
    reported = status() | {"recorder": {"state": state, "reason": "less than 100 MB free"}}
    assert titles(reported) == found
