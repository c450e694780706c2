from typing import Any

import pytest

from gateway.panel.state.alerts import Alert, AlertLevel, with_status
from gateway.units import US_PER_S

NOW_US = 100 * US_PER_S
GPS_LOST = Alert("gps", AlertLevel.CRITICAL, "GPS lost")


def status(silent_s: float = 0.0, **changed: Any) -> dict[str, Any]:
    last_us = NOW_US - round(silent_s * US_PER_S)
    node = {"vehicle_id": 1, "node_id": 2}
    report = {
        "time_us": NOW_US,
        "connected": True,
        "port": "/dev/ttyUSB0",
        "nodes": [{"node": node, "received": 9, "last_time_us": last_us}],
    }
    boards = [{"node": node, "sensors_present": 8}]
    return {
        "report": report | changed,
        "recorder": None,
        "aircraft": [{"vehicle_id": 1, "boards": boards}],
    }


def titles(reported: dict[str, Any] | None, *alerts: Alert, vehicle_id: int = 1) -> list[str]:
    return [alert.title for alert in with_status(alerts, reported, vehicle_id)]


def test_node_that_was_silent_before_the_panel_was_opened() -> None:
    [alert] = with_status([], status(silent_s=30.0), 1)
    assert (alert.title, alert.detail) == ("GPS node 2 silent", "no radio packets for 30 s")
    assert alert.level is AlertLevel.CRITICAL


def test_node_of_another_aircraft_or_with_a_short_gap_is_none() -> None:
    assert titles(status(silent_s=30.0), vehicle_id=2) == []
    assert titles(status(silent_s=1.0)) == []


def test_status_replaces_alerts_of_status_texts() -> None:
    reported = Alert("node GPS node 2", AlertLevel.CRITICAL, "GPS node 2 silent")
    assert titles(status(), reported, GPS_LOST) == ["GPS lost"]
    assert titles(status(silent_s=9.0), reported) == ["GPS node 2 silent"]
    assert titles(None, reported, GPS_LOST) == ["GPS node 2 silent", "GPS lost"]


def test_receiver_that_is_gone_hides_its_nodes() -> None:
    assert titles(status(silent_s=30.0, connected=False)) == ["Receiver lost"]


@pytest.mark.parametrize(("state", "found"), [("blocked", ["Recording failed"]), ("idle", [])])
def test_recording_that_cannot_go_on(state: str, found: list[str]) -> None:
    reported = status() | {"recorder": {"state": state, "reason": "less than 100 MB free"}}
    assert titles(reported) == found
