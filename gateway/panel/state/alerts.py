"""Alerts for the operator, from an aircraft's messages and from the gateway's own status."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.vehicle import VehicleState
from gateway.printable import receiver_state
from gateway.records import node_role
from gateway.units import US_PER_S

SILENT_S: Final = 5.0
FIX_OLD_US: Final = 5 * US_PER_S
TEXT_ALERT_US: Final = 20 * US_PER_S
"""Time for which a severe text of any vehicle is shown as an alert."""

SENSORS: Final = {
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO: "gyroscope",
    mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL: "accelerometer",
    mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG: "magnetometer",
    mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE: "barometer",
    mavlink.MAV_SYS_STATUS_AHRS: "attitude estimator",
    mavlink.MAV_SYS_STATUS_SENSOR_BATTERY: "battery",
}

_BEGINS: Final = (
    (re.compile(r"^(.+) silent$"), "node {0}", "{0} silent", "no radio packets"),
    (re.compile(r"^Receiver lost: (.+)$"), "receiver", "Receiver lost", "{0}"),
    (re.compile(r"^Source lost: (.+)$"), "source {0}", "Source lost", "{0}"),
    (re.compile(r"^(?:Recording (?:not started|stopped)|Cannot record): (.+)$"), "recording",
     "Recording failed", "{0}"),
)  # fmt: skip
"""Texts of the gateway that begin an alert, with its key, title and detail."""
_ENDS: Final = (
    (re.compile(r"^(.+) is back$"), "node {0}"),
    # Also the first text of a restarted gateway, which has not detected any node timeout.
    (re.compile(r"^(Receiver connected\b)"), "receiver|node .+"),
    (re.compile(r"^Source connected: (.+)$"), "source {0}"),
    (re.compile(r"^(Recording (?!stopped:).+)$"), "recording"),
)
"""Texts that end alerts, with a regular expression of their keys."""
NODE_SILENT_US: Final = 3 * US_PER_S
BLOCKED: Final = "blocked"
OWN_KEYS: Final = ("node ", "receiver", "source ", "recording")
"""Key prefixes of the alerts that come from the status, or from texts if there is no status."""


class AlertLevel(IntEnum):
    """Severity of an alert."""

    WARNING = 0
    CRITICAL = 1


@dataclass(frozen=True, slots=True)
class Alert:
    """One present problem."""

    key: str
    """Identifies the problem as long as it lasts."""
    level: AlertLevel
    title: str
    detail: str = ""


def alerts_of(vehicle: VehicleState, now_us: int) -> list[Alert]:
    """Return the present problems of one aircraft, the most severe first."""
    silent_s = vehicle.silent_s(now_us)
    if silent_s > SILENT_S:
        since = f"no heartbeat for {silent_s:.0f} s" if silent_s < 1e6 else "no heartbeat yet"
        # All other alerts would be outdated.
        return [Alert("silent", AlertLevel.CRITICAL, "Aircraft silent", since)]
    found = [*_gps(vehicle, now_us), *_sensors(vehicle), *_texts(vehicle, now_us)]
    return sorted(found, key=lambda alert: -alert.level)


def _gps(vehicle: VehicleState, now_us: int) -> list[Alert]:
    """Return an alert for a GPS that lost its fix; without a first fix it is still searching."""
    if not vehicle.fixes:
        return []
    age_us = vehicle.state.age_us(now_us, "GPS_RAW_INT")
    if age_us > FIX_OLD_US:
        detail = f"nothing from the GPS for {age_us // US_PER_S:.0f} s"
    elif vehicle.state.fields["GPS_RAW_INT"]["fix_type"] < mavlink.GPS_FIX_TYPE_2D_FIX:
        detail = "the GPS has no fix"
    else:
        return []
    return [Alert("gps", AlertLevel.CRITICAL, "GPS lost", detail)]


def _sensors(vehicle: VehicleState) -> list[Alert]:
    status = vehicle.state.fields.get("SYS_STATUS")
    if status is None:
        return []
    present, enabled, healthy = (
        status[f"onboard_control_sensors_{word}"] for word in ("present", "enabled", "health")
    )
    unhealthy = present & enabled & ~healthy
    names = [name for bit, name in SENSORS.items() if unhealthy & bit]
    if not names:
        return []
    return [Alert("sensors", AlertLevel.WARNING, "Sensors not healthy", ", ".join(names))]


def _texts(vehicle: VehicleState, now_us: int) -> list[Alert]:
    standing: dict[str, Alert] = {}
    for text in vehicle.texts.all:
        is_known = False
        for pattern, *parts in _BEGINS:
            if match := pattern.match(text.text):
                is_known = True
                key, title, detail = (part.format(match[1]) for part in parts)
                standing[key] = Alert(key, AlertLevel.CRITICAL, title, detail)
        for pattern, keys in _ENDS:
            if match := pattern.match(text.text):
                is_known = True
                ended = keys.format(re.escape(match[1]))
                standing = {k: v for k, v in standing.items() if not re.fullmatch(ended, k)}
        grave = text.severity <= mavlink.MAV_SEVERITY_CRITICAL
        if grave and not is_known and now_us - text.time_us < TEXT_ALERT_US:
            key = f"text {text.number}"
            standing[key] = Alert(key, AlertLevel.CRITICAL, text.text)
    return list(standing.values())


def with_status(
    alerts: Iterable[Alert], status: Mapping[str, Any] | None, vehicle_id: int
) -> list[Alert]:
    """Replace alerts from the gateway's texts by those from its status of link and recorder."""
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
    found = _sources(report, vehicle_id)
    if not report["connected"]:
        # Without the receiver all nodes time out, which needs no alert.
        if receiver_state(report["port"], False, 0, 0):
            found.append(Alert("receiver", AlertLevel.CRITICAL, "Receiver lost", report["port"]))
        return found
    for link in report["nodes"]:
        silent_us = report["time_us"] - link["last_time_us"]
        node = link["node"]
        if node["vehicle_id"] == vehicle_id and link["received"] and silent_us > NODE_SILENT_US:
            name = f"{roles.get(node['node_id'], 'Node')} {node['node_id']}"
            since = f"no radio packets for {silent_us // US_PER_S} s"
            found.append(Alert(f"node {name}", AlertLevel.CRITICAL, f"{name} silent", since))
    return found


def _sources(report: Mapping[str, Any], vehicle_id: int) -> list[Alert]:
    """Return the alerts of the sources of a vehicle other than the receiver."""
    found = []
    for source in report["sources"]:
        last_us, url = source["last_time_us"], source["url"]
        if source["node"]["vehicle_id"] != vehicle_id:
            continue
        if not source["connected"]:
            alert = Alert(f"source {url}", AlertLevel.CRITICAL, "Source lost", source["reason"])
            found.append(alert)
        elif last_us is not None and report["time_us"] - last_us > NODE_SILENT_US:
            since = f"{url}: no records for {(report['time_us'] - last_us) // US_PER_S} s"
            found.append(Alert(f"source {url}", AlertLevel.CRITICAL, "Source silent", since))
    return found


def _recorder(recorder: Mapping[str, Any] | None) -> list[Alert]:
    if recorder is None or recorder["state"] != BLOCKED:
        return []
    return [Alert("recording", AlertLevel.CRITICAL, "Recording failed", recorder["reason"])]
