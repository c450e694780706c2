"""LTM, the Lightweight Telemetry of INAV and older radios: frames of `$T`, type, payload, XOR.

Heights are above home. The frame `O` contains home; until it is received, home is at 0 m.

INAV and Betaflight count pitch as positive with the nose down. ArduPilot counts it with the nose
up, sends its own mode numbers, and the current in place of the used charge. It is recognised by
its schedule: it never sends `O`, `N` or `X`, and once a second sends `G A G`. INAV and Betaflight
send `O` every second, and alternate `G` and `S` between their `A`.
"""

import struct
from typing import Any, Final

from msgspec.structs import replace

from gateway.records import NAN, BatteryReport, GpsFixType, NodeId, VehicleReport
from gateway.sources.flight_modes import (
    FIXED_WING,
    QUADROTOR,
    ardupilot_mode,
    wanted_sign,
    wanted_type,
)
from gateway.sources.sampling import fix_at, velocity
from gateway.sources.settings import SourceUrl
from gateway.sources.source import CheckedFrames
from gateway.units import DEG_PER_DEGE7, M_PER_CM, RAD_PER_DEG
from gateway.wire.framing import Fault, xor_of

START: Final = b"$T"
SIZES: Final = {b"G": 14, b"A": 6, b"S": 7, b"O": 14, b"N": 6, b"X": 6}
"""Payload size in bytes, by type."""
OF_ARDUPILOT, NEVER_OF_ARDUPILOT = b"GAG", b"ONX"
"""Successive types of frames that only ArduPilot sends, and types that it never sends."""
ENOUGH: Final = 2
"""Number of such successions that identifies ArduPilot: one may result from lost frames."""
FIX_TYPES: Final = (GpsFixType.NONE, GpsFixType.NONE, GpsFixType.FIX_2D, GpsFixType.FIX_3D)
MODES: Final[tuple[tuple[str, int | None, int | None], ...]] = (
    ("MANUAL", None, 0), ("RATE", 1, 4), ("ANGLE", 0, 5), ("HORIZON", 0, 2), ("ACRO", 1, 4),
    ("STABILIZED1", 0, 2), ("STABILIZED2", 0, 2), ("STABILIZED3", 0, 2), ("ALTHOLD", 2, 6),
    ("GPSHOLD", 16, 12), ("WAYPOINTS", 3, 10), ("HEADFREE", 0, None), ("CIRCLE", 7, 1),
    ("RTH", 6, 11), ("FOLLOWME", 23, None), ("LAND", 9, None), ("FLYBYWIREA", None, 5),
    ("FLYBYWIREB", None, 6), ("CRUISE", None, 7), ("UNKNOWN", None, None),
    ("LAUNCH", None, 13), ("AUTOTUNE", 15, 8),
)  # fmt: skip
"""Name, and ArduPilot's number of the mode on a copter and on an aeroplane."""


class LtmDecoder(CheckedFrames):
    """Decode a stream of LTM."""

    def __init__(self, url: SourceUrl, node: NodeId) -> None:
        super().__init__()
        self._node = node
        self._home_alt_m = 0.0
        self._course_deg = 0.0
        self._type = wanted_type(url) or QUADROTOR
        self._nose_down = wanted_sign(url)
        self._newest = b""
        """Types of the newest frames."""
        self._successions = 0
        """Successions of types that only ArduPilot sends."""

    @property
    def _is_ardupilot(self) -> bool:
        return self._successions >= ENOUGH

    def size_at(self, data: bytes, at: int) -> int:
        """Return the size of a frame that begins here, complete or not; 0 if there is none."""
        size = SIZES.get(data[at + 2 : at + 3])
        if size is None or not data.startswith(START, at):
            return 0
        end = at + 4 + size
        wrong = end <= len(data) and xor_of(data[at + 3 : end])
        return 0 if wrong else 4 + size

    def read(self, frame: bytes, time_us: int) -> list[Any]:
        """Return the records and faults in a frame."""
        kind, payload = frame[2:3], frame[3:-1]
        parts: dict[str, Any] = {}
        self._newest = (self._newest + kind)[-len(OF_ARDUPILOT) :]
        if kind in NEVER_OF_ARDUPILOT:
            self._successions = 0
        self._successions += self._newest == OF_ARDUPILOT
        if kind == b"G":
            return self._gps(payload, time_us)
        if kind == b"A":
            pitch, roll, heading = struct.unpack("<hhh", payload)
            self._course_deg = float(heading % 360)
            if not self._is_ardupilot if self._nose_down is None else self._nose_down:
                pitch = -pitch
            roll_rad, pitch_rad, yaw_rad = (v * RAD_PER_DEG for v in (roll, pitch, heading))
            parts = {"attitude_rad": (roll_rad, pitch_rad, yaw_rad)}
        elif kind == b"S":
            parts = self._state(payload)
        elif kind == b"O":
            lat, lon, alt_cm, _, fix = struct.unpack("<iiiBB", payload)
            self._home_alt_m = alt_cm * M_PER_CM
            if fix and (lat or lon):
                parts = {"home": (lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, self._home_alt_m)}
        return [VehicleReport(time_us=time_us, node=self._node, **parts)] if parts else []

    def _gps(self, payload: bytes, time_us: int) -> list[Any]:
        """Read a fix; LTM sends no course, so the heading is used instead."""
        lat, lon, speed, alt_cm, state = struct.unpack("<iiBiB", payload)
        height_m = alt_cm * M_PER_CM
        fix = fix_at(
            time_us,
            self._node,
            lat * DEG_PER_DEGE7,
            lon * DEG_PER_DEGE7,
            self._home_alt_m + height_m,
            vel_n_mps=velocity(float(speed), self._course_deg),
            satellites=state >> 2,
            fix_type=FIX_TYPES[state & 3],
        )
        if fix is None:
            return [Fault("payload", len(payload), "G has invalid coordinates")]
        return [VehicleReport(time_us=time_us, node=self._node, alt_home_m=height_m), fix]

    def _state(self, payload: bytes) -> dict[str, Any]:
        millivolts, charge, rssi, airspeed, flags = struct.unpack("<HHBBB", payload)
        number, battery = flags >> 2, BatteryReport(voltage_v=millivolts * 1e-3 or NAN)
        if self._is_ardupilot:
            name, custom_mode = ardupilot_mode(self._type, number), number
            battery = replace(battery, current_a=charge * 0.01)
        else:
            name, copter, plane = MODES[min(number, len(MODES) - 1)]
            custom_mode = plane if self._type == FIXED_WING else copter
            battery = replace(battery, used_mah=float(charge))
        parts: dict[str, Any] = {
            "armed": bool(flags & 1),
            "mode": name,
            "custom_mode": custom_mode,
            "vehicle_type": self._type,
        }
        # Zero means that it is not measured.
        parts |= {"battery": battery} if millivolts or charge else {}
        parts |= {"link_quality_percent": min(rssi / 2.54, 100.0)} if rssi else {}
        return parts | ({"airspeed_mps": float(airspeed)} if airspeed else {})
