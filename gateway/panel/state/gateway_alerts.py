"""Alerts from the gateway's own status.

They include problems from before the panel was opened, of which no text comes any more.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from gateway.panel.state.alerts import Alert, AlertLevel
from gateway.units import US_PER_S
from gateway.vehicle.telemetry.health import node_role

NODE_SILENT_US: Final = 3 * US_PER_S
BLOCKED: Final = "blocked"
OWN_KEYS: Final = ("node ", "receiver", "recording")
"""Key prefixes of the alerts made here, which come from texts if there is no status."""


def with_status(
    alerts: Iterable[Alert], status: Mapping[str, Any] | None, vehicle_id: int
) -> list[Alert]:
    """Replace alerts from the gateway's texts by those from its status of link and recorder.

    Parameters
    ----------
    alerts : iterable of Alert
        As `alerts_of` finds them for one aircraft.
    status : mapping or None
        Result of the control verb `status`; None without a gateway.
    vehicle_id : int
        The aircraft.

    Returns
    -------
    list of Alert
        The most severe first.
    """
    if status is None:
        return list(alerts)
    kept = [alert for alert in alerts if not alert.key.startswith(OWN_KEYS)]
    roles = {
        board["node"]["node_id"]: node_role(board["sensors_present"])
        for aircraft in status["aircraft"]
        if aircraft["vehicle_id"] == vehicle_id
        for board in aircraft["boards"]
    }
    link = _link(status["report"], vehicle_id, roles)
    found = [*kept, *link, *_recorder(status["recorder"])]
    return sorted(found, key=lambda alert: -alert.level)


def _link(report: Mapping[str, Any], vehicle_id: int, roles: Mapping[int, str]) -> list[Alert]:
    if not report["connected"]:
        # Without it every node is silent; that needs no alert.
        return [Alert("receiver", AlertLevel.CRITICAL, "Receiver lost", report["port"])]
    found = []
    for link in report["nodes"]:
        silent_us = report["time_us"] - link["last_time_us"]
        node = link["node"]
        if node["vehicle_id"] == vehicle_id and link["received"] and silent_us > NODE_SILENT_US:
            name = f"{roles.get(node['node_id'], 'Node')} {node['node_id']}"
            since = f"no radio packets for {silent_us // US_PER_S} s"
            found.append(Alert(f"node {name}", AlertLevel.CRITICAL, f"{name} silent", since))
    return found


def _recorder(recorder: Mapping[str, Any] | None) -> list[Alert]:
    if recorder is None or recorder["state"] != BLOCKED:
        return []
    return [Alert("recording", AlertLevel.CRITICAL, "Recording failed", recorder["reason"])]
