"""Cursor on Target for TAK servers, ATAK and WinTAK: one event for each vehicle.

    cot:udp-multicast:239.2.3.1:6969  cot:udp:HOST:PORT  cot:tcp:HOST:8087  cot:tls:HOST:8089

Only vehicles with a valid position produce events; the last event becomes stale.

References
----------
.. [1] MITRE, "Cursor on Target Message Router User's Guide", 2009: event version 2.0.
"""

import math
import socket
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Final
from xml.etree import ElementTree

from gateway.hub.endpoint import Endpoint, EndpointKind
from gateway.outputs.output import Output
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position
from gateway.wire.vehicle_types import CLASSES

HEADER: Final = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
UNKNOWN: Final = 9_999_999.0
"""Value for an unknown height or error, defined by the specification."""
UNMANNED_PLANE, UNMANNED_ROTOR = "a-f-A-M-F-Q", "a-f-A-M-H-Q"
TYPES: Final = {
    "copter": UNMANNED_ROTOR, "balloon": "a-f-A-M-L", "rover": "a-f-G-E-V", "boat": "a-f-S",
    "sub": "a-f-U",
}  # fmt: skip
"""CoT types (friendly) by class of vehicle; all others are unmanned fixed-wing aircraft."""
LEAST_STALE_S: Final = 10.0
STALE_INTERVALS: Final = 3.0
"""Intervals without a new event after which one is stale, but at least the time above."""
MAX_CALLSIGN: Final = 64


class CotOutput(Output):
    """Events of all vehicles, or of the selected one."""

    carriers = (
        EndpointKind.UDP,
        EndpointKind.UDP_BROADCAST,
        EndpointKind.UDP_MULTICAST,
        EndpointKind.TCP,
        "tls",
    )

    @classmethod
    def check(cls, endpoint: Endpoint) -> None:
        """Raise ValueError if the endpoint is invalid."""
        super().check(endpoint)
        callsign = endpoint.added.get("callsign", "x")
        if not callsign.strip() or not callsign.isprintable() or len(callsign) > MAX_CALLSIGN:
            raise ValueError(f"callsign {callsign!r} is not 1 to {MAX_CALLSIGN} printable letters")

    def compose(self, now_us: int) -> Iterator[bytes]:
        """Yield one event for each vehicle."""
        stale_s = max(LEAST_STALE_S, STALE_INTERVALS * self.interval_s)
        for system_id, state in self.heard(now_us).items():
            if position := state.valid_position(now_us):
                unix_us = self.position_unix_us(state, now_us)
                callsign = self._callsign(system_id)
                yield event_of(system_id, callsign, state, position, unix_us, stale_s)

    def _callsign(self, system_id: int) -> str:
        given = self.endpoint.added.get("callsign")
        if given is not None and self.vehicle_id:
            return given
        return f"{given or 'Vehicle'} {system_id}"


def event_of(
    system_id: int,
    callsign: str,
    state: NewestState,
    position: Position,
    unix_us: int,
    stale_s: float,
) -> bytes:
    """Return the event for a position at a civil time, as XML."""
    report, at = state.fix(), datetime.fromtimestamp(unix_us / US_PER_S, UTC)
    separation_m = report.separation_m if report else math.nan
    accuracies = (report.h_acc_m, report.v_acc_m) if report else (math.nan, math.nan)
    event = ElementTree.Element("event", version="2.0")
    event.set("uid", f"mavgate.{socket.gethostname()}.{system_id}")
    event.set("type", TYPES.get(CLASSES.get(state.kind(), ""), UNMANNED_PLANE))
    event.set("how", "m-g")
    times = {"time": at, "start": at, "stale": at + timedelta(seconds=stale_s)}
    event.attrib.update({name: _written(time) for name, time in times.items()})
    point = ElementTree.SubElement(event, "point")
    point.set("lat", f"{position.lat_deg:.7f}")
    point.set("lon", f"{position.lon_deg:.7f}")
    point.set("hae", _known(position.alt_amsl_m + separation_m))
    for name, value_m in zip(("ce", "le"), accuracies, strict=True):
        point.set(name, _known(value_m))
    detail = ElementTree.SubElement(event, "detail")
    ElementTree.SubElement(detail, "contact", callsign=callsign)
    speed_mps, course_deg = position.groundspeed_mps, state.course_deg(position)
    if math.isfinite(speed_mps):
        track = ElementTree.SubElement(detail, "track", speed=f"{speed_mps:.2f}")
        # A course is required; the course of a vehicle at rest is unknown.
        track.set("course", f"{course_deg if math.isfinite(course_deg) else 0.0:.1f}")
    percent = state.battery()[1]
    if math.isfinite(percent):
        ElementTree.SubElement(detail, "status", battery=f"{percent:.0f}")
    ElementTree.SubElement(detail, "remarks").text = remarks_of(state, position)
    return (HEADER + ElementTree.tostring(event, encoding="unicode") + "\n").encode()


def remarks_of(state: NewestState, position: Position) -> str:
    """Describe mode, arming state, battery and height."""
    volts, percent = state.battery()
    figures = (
        (volts, "{:.2f} V"),
        (percent, "{:.0f} %"),
        (position.alt_amsl_m, "{:.0f} m AMSL"),
        (position.alt_home_m, "{:.0f} m above home"),
    )
    words = [state.mode(), "armed" if state.is_armed() else "disarmed"]
    words += [form.format(value) for value, form in figures if math.isfinite(value)]
    return ", ".join(filter(None, words))


def _known(value_m: float) -> str:
    return f"{value_m if math.isfinite(value_m) else UNKNOWN:.1f}"


def _written(at: datetime) -> str:
    return f"{at:%Y-%m-%dT%H:%M:%S}.{at.microsecond // 1000:03d}Z"
