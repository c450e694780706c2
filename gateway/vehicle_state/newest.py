"""The newest state of live vehicles from their MAVLink, for pages, outputs and metrics.

The newest message of each name is kept for each vehicle. The position is that of the best source
(see `positions`), unless a better one is interrupted. It is valid for outputs unless it is old, or
the vehicle's estimator reports that it has no absolute position. Pure: time is an argument.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.records import NAN, UNKNOWN_QUAT, UNKNOWN_VEC3, Quat, Vec3
from gateway.units import DEG_PER_CDEG, FIX_2D, M_PER_CM, M_PER_MM, MV_PER_V, US_PER_S
from gateway.vehicle_state.positions import (
    RANKS,
    UNKNOWN_U16,
    Position,
    named_position,
    position_of,
)
from gateway.vehicle_state.senders import AUTOPILOT, FIRST_GROUND_STATION
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_IDS, MESSAGE_NAMES, ids_of
from gateway.wire.mavlink_splitter import MavFrame
from gateway.wire.recorded_frames import fields_of
from gateway.wire.vehicle_types import mode_name

Fields = Mapping[str, Any]

HEARD_US: Final = 60 * US_PER_S
"""Time after its last message at which a vehicle is removed."""
HEARTBEAT_TIMEOUT_US: Final = 5 * US_PER_S
"""Time after the last heartbeat, sent once a second, from which a vehicle counts as lost."""
POSITION_FRESH_US: Final = 3 * US_PER_S
"""Time after a position of a better source for which inferior sources are ignored."""
POSITION_OLD_US: Final = 5 * US_PER_S
"""Maximum age of a valid position: five times the usual interval of a radio."""
QUALITY_OLD_US: Final = 15 * US_PER_S
"""Maximum age of an estimator's report that applies to the present position."""
ATTITUDE_FRESH_US: Final = US_PER_S
"""Maximum age of a quaternion that is preferred to the angles."""
MAX_MODES: Final = 256
"""Maximum number of modes of one vehicle; their number in AVAILABLE_MODES is one byte."""
UNKNOWN_SATELLITES: Final = 255
UNKNOWN_U32: Final = 0xFFFFFFFF
LEAST_SPEED_MPS: Final = 0.2
"""Minimum speed at which a velocity has a direction."""
_PRESENT: Final = ("GLOBAL_POSITION_INT", "GLOBAL_POSITION_INT_COV", "LOCAL_POSITION_NED")
_ABSOLUTE, _CONSTANT = mavlink.ESTIMATOR_POS_HORIZ_ABS, mavlink.ESTIMATOR_CONST_POS_MODE
"""Bits of ESTIMATOR_STATUS; they are the same in ArduPilot's EKF_STATUS_REPORT."""
STATE_IDS: Final = frozenset(RANKS) | ids_of(
    *("HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "VFR_HUD", "BATTERY_STATUS", "SYS_STATUS"),
    *("HOME_POSITION", "GPS_GLOBAL_ORIGIN", "ESTIMATOR_STATUS", "EKF_STATUS_REPORT"),
    *("RADIO_STATUS", "AVAILABLE_MODES"),
)
"""Messages from which the state is derived."""


class VehicleComponents:
    """The component of each live system that is its vehicle.

    It is component 1, or the first one that sends an autopilot's heartbeat. So the attitude of a
    gimbal or the position of a camera is not taken for the aircraft's.
    """

    def __init__(self) -> None:
        self._components: dict[int, int] = {}

    def includes(self, system_id: int, component_id: int, autopilot: int | None) -> bool:
        """Return whether a message is a vehicle's; `autopilot` is the one in a heartbeat."""
        if not 0 < system_id < FIRST_GROUND_STATION:
            return False
        if component_id == AUTOPILOT:
            self._components[system_id] = AUTOPILOT
        elif autopilot not in (None, mavlink.MAV_AUTOPILOT_INVALID):
            self._components.setdefault(system_id, component_id)
        return self.is_known(system_id, component_id)

    def is_known(self, system_id: int, component_id: int) -> bool:
        """Return whether a component is known to be the vehicle of its system."""
        return component_id == self._components.get(system_id)


@dataclass(slots=True)
class GpsReport:
    """The newest report of the first GPS receiver that sent one; NaN is unknown."""

    fix_type: int
    """A GPS_FIX_TYPE."""
    satellites: float
    hdop: float
    separation_m: float
    """Height of the geoid above the ellipsoid, m."""
    course_deg: float
    h_acc_m: float
    v_acc_m: float


class NewestState:
    """The newest state of one vehicle."""

    def __init__(self) -> None:
        self.fields: dict[str, Fields] = {}
        """Fields of the newest message of each name."""
        self.modes: dict[int, str] = {}
        """Names of the custom modes from AVAILABLE_MODES, by number."""
        self.heard_us: dict[str, int] = {}
        """When each of these messages arrived."""
        self.position: Position | None = None
        """The newest position of the best source."""
        self.position_us = -POSITION_FRESH_US
        self._source = ""
        self._origin: Position | None = None

    def update(self, name: str, fields: Fields, now_us: int) -> bool:
        """Process a message; return whether it contained a new position."""
        self.fields[name] = fields
        self.heard_us[name] = now_us
        if name == "GPS_GLOBAL_ORIGIN":
            self._origin = named_position(fields)
        elif name == "AVAILABLE_MODES" and len(self.modes) < MAX_MODES:
            text = fields["mode_name"]
            self.modes[fields["custom_mode"]] = text if isinstance(text, str) else text_of(text)
        message_id = MESSAGE_IDS.get(name, -1)
        if message_id not in RANKS:
            return False
        known = RANKS[MESSAGE_IDS[self._source]] if self._source else len(RANKS)
        if RANKS[message_id] > known and now_us - self.position_us < POSITION_FRESH_US:
            return False
        found = position_of(message_id, fields, self._origin)
        if found is None:
            return False
        self.position, self.position_us, self._source = found, now_us, name
        return True

    def age_us(self, now_us: int, *names: str) -> float:
        """Return the age of the newest of these messages; infinite if there is none."""
        heard = [self.heard_us[name] for name in names if name in self.heard_us]
        return now_us - max(heard) if heard else math.inf

    def valid_position(self, now_us: int) -> Position | None:
        """Return the position, if it is neither old nor marked as invalid by the estimator."""
        if self.position is None or now_us - self.position_us > POSITION_OLD_US:
            return None
        for name in ("ESTIMATOR_STATUS", "EKF_STATUS_REPORT") if self._source in _PRESENT else ():
            if self.age_us(now_us, name) <= QUALITY_OLD_US:
                flags = self.fields[name]["flags"]
                if not flags & _ABSOLUTE or flags & _CONSTANT:
                    return None
        return self.position

    def attitude(self) -> tuple[Quat, Vec3]:
        """Return the newest attitude, body FRD to NED, and the rates in rad/s; NaN if unknown."""
        quaternion, angles = self.fields.get("ATTITUDE_QUATERNION"), self.fields.get("ATTITUDE")
        late = self.heard_us.get("ATTITUDE", 0) - self.heard_us.get("ATTITUDE_QUATERNION", 0)
        if quaternion is not None and late < ATTITUDE_FRESH_US:
            q: Quat = (quaternion["q1"], quaternion["q2"], quaternion["q3"], quaternion["q4"])
            return q, _rates(quaternion)
        if angles is None:
            return UNKNOWN_QUAT, UNKNOWN_VEC3
        turned = (angles["roll"], angles["pitch"], angles["yaw"])
        is_known = all(map(math.isfinite, turned))
        return from_euler(*turned) if is_known else UNKNOWN_QUAT, _rates(angles)

    def heading_deg(self) -> float:
        """Return the heading from true north; NaN if unknown."""
        position, hud = self.fields.get("GLOBAL_POSITION_INT"), self.fields.get("VFR_HUD")
        if position is not None and position["hdg"] != UNKNOWN_U16:
            return float(position["hdg"] * DEG_PER_CDEG)
        return float(hud["heading"] % 360) if hud is not None else NAN

    def true_heading_deg(self, now_us: int) -> float:
        """Return the present heading as its sender reports it; NaN if unknown or old."""
        for name, field, unit_deg in (
            ("GLOBAL_POSITION_INT", "hdg", DEG_PER_CDEG),
            ("VFR_HUD", "heading", 1.0),
            ("HIGH_LATENCY2", "heading", 2.0),
        ):
            if self.age_us(now_us, name) <= POSITION_OLD_US:
                value = self.fields[name][field]
                return NAN if value == UNKNOWN_U16 else value * unit_deg % 360.0
        return NAN

    def airspeed_mps(self) -> float:
        """Return the airspeed; NaN if the field repeats the ground speed, without a sensor."""
        hud = self.fields.get("VFR_HUD")
        unknown = hud is None or hud["airspeed"] == hud["groundspeed"]
        return NAN if hud is None or unknown else float(hud["airspeed"])

    def course_deg(self, position: Position) -> float:
        """Return the direction of motion over ground from true north; NaN if unknown."""
        north, east, _ = position.vel_n_mps
        if math.isfinite(north):
            known = math.hypot(north, east) >= LEAST_SPEED_MPS
            return math.degrees(math.atan2(east, north)) % 360.0 if known else NAN
        fix = self.fix()
        return NAN if fix is None else fix.course_deg

    def battery(self) -> tuple[float, float]:
        """Return voltage in V and remaining charge in percent, each NaN if unknown."""
        battery, system = self.fields.get("BATTERY_STATUS"), self.fields.get("SYS_STATUS")
        cells = battery["voltages"] if battery else ()
        volts = [mv / MV_PER_V for mv in cells if mv != UNKNOWN_U16]
        if not volts and system and system["voltage_battery"] != UNKNOWN_U16:
            volts = [system["voltage_battery"] / MV_PER_V]
        sources = [source["battery_remaining"] for source in (battery, system) if source]
        percent = next((value for value in sources if value >= 0), NAN)
        return float(sum(volts)) if volts else NAN, float(percent)

    def satellites(self) -> float:
        """Return the number of satellites; NaN if unknown, as with a fix of 0 satellites."""
        fix = self.fields.get("GPS_RAW_INT")
        if fix is None or fix["satellites_visible"] == UNKNOWN_SATELLITES:
            return NAN
        counted = fix["satellites_visible"]
        return float(counted) if counted or fix["fix_type"] < FIX_2D else NAN

    def fix(self) -> GpsReport | None:
        """Return the newest GPS report."""
        found = self.fields.get("GPS_RAW_INT") or self.fields.get("GPS2_RAW")
        if found is None:
            return None
        ellipsoid_mm, course = found.get("alt_ellipsoid", 0), found["cog"]
        return GpsReport(
            found["fix_type"],
            self.satellites(),
            NAN if found["eph"] == UNKNOWN_U16 else found["eph"] * M_PER_CM,
            (ellipsoid_mm - found["alt"]) * M_PER_MM if ellipsoid_mm else NAN,
            NAN if course == UNKNOWN_U16 else course * DEG_PER_CDEG,
            *(_accuracy_m(found.get(name, 0)) for name in ("h_acc", "v_acc")),
        )

    def kind(self) -> int:
        """Return the MAV_TYPE."""
        beat = self.fields.get("HEARTBEAT") or self.fields.get("HIGH_LATENCY2")
        return int(beat["type"]) if beat else mavlink.MAV_TYPE_GENERIC

    def is_armed(self) -> bool:
        """Return whether the vehicle is armed."""
        beat = self.fields.get("HEARTBEAT")
        return bool(beat and beat["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def mode(self) -> str:
        """Return the flight mode under its autopilot's name; empty if unknown."""
        beat = self.fields.get("HEARTBEAT") or self.fields.get("HIGH_LATENCY2")
        if beat is None:
            return ""
        # HIGH_LATENCY2 contains the upper half of PX4's custom mode.
        is_half = "base_mode" not in beat and beat["autopilot"] == mavlink.MAV_AUTOPILOT_PX4
        number = beat["custom_mode"] << 16 if is_half else beat["custom_mode"]
        return mode_name(beat["autopilot"], beat["type"], number) or self.modes.get(number, "")


def _accuracy_m(accuracy_mm: int) -> float:
    return accuracy_mm * M_PER_MM if 0 < accuracy_mm < UNKNOWN_U32 else NAN


def _rates(fields: Fields) -> Vec3:
    return (fields["rollspeed"], fields["pitchspeed"], fields["yawspeed"])


class NewestVehicles:
    """The newest states of all vehicles whose frames are fed."""

    def __init__(self) -> None:
        self.states: dict[int, NewestState] = {}
        """States by system id."""
        self.components = VehicleComponents()

    def heard(self, now_us: int) -> dict[int, NewestState]:
        """Return the vehicles received within `HEARD_US`, ordered by system id."""
        return {
            system_id: state
            for system_id, state in sorted(self.states.items())
            if state.age_us(now_us, *state.heard_us) <= HEARD_US
        }

    def feed(self, frame: MavFrame, now_us: int) -> NewestState | None:
        """Process a frame of `STATE_IDS`; return its vehicle's state, if a vehicle sent it."""
        message_id, (system_id, component_id) = frame.message_id, frame.origin
        if message_id not in DEFINITIONS or not 0 < system_id < FIRST_GROUND_STATION:
            return None
        fields = fields_of(frame.data)
        is_beat = message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        autopilot = fields["autopilot"] if is_beat else None
        if not self.components.includes(system_id, component_id, autopilot):
            return None
        state = self.states.setdefault(system_id, NewestState())
        state.update(MESSAGE_NAMES[message_id], fields, now_us)
        return state
