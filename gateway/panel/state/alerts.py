"""Alerts for the operator, from an aircraft's messages and from the gateway's own status."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.vehicle import VehicleState
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
LINK: Final = "link"
"""Topic of the receiver or source among the troubles of an aircraft."""
BLOCKED: Final = "blocked"


class AlertLevel(IntEnum):
    """Severity of an alert."""

    WARNING = 0
    CRITICAL = 1


@dataclass(frozen=True, slots=True)
class Alert:
    """One present problem."""

    level: AlertLevel
    title: str
    detail: str = ""


def alerts_of(vehicle: VehicleState, status: Mapping[str, Any] | None, now_us: int) -> list[Alert]:
    """Return the present problems of one aircraft, the most severe first.

    The status is that of the gateway on this machine, if there is one. It contains the states that
    its own aircraft announce, so their texts are no alerts.
    """
    silent_s = vehicle.silent_s(now_us)
    if silent_s > SILENT_S:
        since = f"no heartbeat for {silent_s:.0f} s" if silent_s < 1e6 else "no heartbeat yet"
        # All other alerts of the vehicle would be outdated.
        found = [Alert(AlertLevel.CRITICAL, "Aircraft silent", since)]
    else:
        found = [*_gps(vehicle, now_us), *_sensors(vehicle)]
        troubles = _troubles(vehicle.system_id, status or {"aircraft": ()})
        lasting = _texts(vehicle, now_us) if troubles is None else troubles
        found += [Alert(AlertLevel.CRITICAL, text) for text in lasting]
    recorder = status and status["recorder"]
    if recorder and recorder["state"] == BLOCKED:
        found.append(Alert(AlertLevel.CRITICAL, "Recording failed", recorder["reason"]))
    return sorted(found, key=lambda alert: -alert.level)


def _gps(vehicle: VehicleState, now_us: int) -> Iterator[Alert]:
    """Yield an alert for a GPS that lost its fix; without a first fix it is still searching."""
    if not vehicle.fixes:
        return
    age_us = vehicle.state.age_us(now_us, "GPS_RAW_INT")
    if age_us > FIX_OLD_US:
        silent_s = age_us // US_PER_S
        yield Alert(AlertLevel.CRITICAL, "GPS lost", f"nothing from the GPS for {silent_s:.0f} s")
    elif vehicle.state.fields["GPS_RAW_INT"]["fix_type"] < mavlink.GPS_FIX_TYPE_2D_FIX:
        yield Alert(AlertLevel.CRITICAL, "GPS lost", "the GPS has no fix")


def _sensors(vehicle: VehicleState) -> Iterator[Alert]:
    if (status := vehicle.state.fields.get("SYS_STATUS")) is None:
        return
    present, enabled, healthy = (
        status[f"onboard_control_sensors_{word}"] for word in ("present", "enabled", "health")
    )
    unhealthy = present & enabled & ~healthy
    names = [name for bit, name in SENSORS.items() if unhealthy & bit]
    if names:
        yield Alert(AlertLevel.WARNING, "Sensors not healthy", ", ".join(names))


def _troubles(vehicle_id: int, status: Mapping[str, Any]) -> Iterable[str] | None:
    """Return the lasting troubles of an aircraft of the gateway; None for any other vehicle."""
    for aircraft in status["aircraft"]:
        if aircraft["vehicle_id"] == vehicle_id:
            troubles: dict[str, str] = aircraft["troubles"]
            # Without the receiver all nodes time out, which needs no alert.
            return [troubles[LINK]] if LINK in troubles else troubles.values()
    return None


def _texts(vehicle: VehicleState, now_us: int) -> list[str]:
    return [
        text.text
        for text in vehicle.texts.all
        if text.severity <= mavlink.MAV_SEVERITY_CRITICAL and now_us - text.time_us < TEXT_ALERT_US
    ]
