"""The newest reports of a vehicle's own autopilot, and the messages built from them.

The reports are passed on with their own times. A field that has not been reported for the timeout
of the settings is unknown: its message is not sent, or contains the value for unknown. Mode, arming
and type change rarely, and slow radios send them rarely: their timeout is at least `RARE_US`.
"""

import math
from typing import Any, Final

from msgspec.structs import asdict, replace
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.records import (
    NAN,
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    BatteryReport,
    GpsFix,
    NavFlags,
    NavState,
    VehicleReport,
)
from gateway.units import DEG_PER_DEGE7, MV_PER_V, US_PER_S
from gateway.vehicle import encoding
from gateway.vehicle.plan import is_3d

WITHOUT_IMU_US: Final = 3 * US_PER_S
"""Time without an IMU sample after which a vehicle's position is taken from its fixes."""
RARE_US: Final = 15 * US_PER_S
"""Least timeout of mode, arming and type: a slow radio link sends each every 10 s."""
MAX_CELLS: Final = 14
JOINED_US: Final = 10 * US_PER_S
"""Maximum age of the other part of a battery report."""
CHANNELS: Final = 18
MAX_BATTERIES: Final = 8
MAX_MODES: Final = 64
OWN_MODE: Final = 1000
"""First number of modes that ArduPilot does not have; its own numbers are below 100."""
LOW_PERCENT: Final = 20.0
_STATES: Final[dict[str, Any]] = {"mode": "", "armed": None, "vehicle_type": None}
"""Fields that expire, with their values for unknown."""
_NUMBERS: Final = (
    "heading_rad",
    "climb_mps",
    "airspeed_mps",
    "alt_home_m",
    "throttle_percent",
    "link_quality_percent",
)


class Reported:
    """The newest reports of one vehicle."""

    def __init__(self) -> None:
        self.mode = ""
        """Name of the mode; empty if none was reported."""
        self.custom_mode = 0
        self.armed: bool | None = None
        self.vehicle_type: int | None = None
        self.mode_changes = 0
        self._since_us = dict.fromkeys(_STATES, 0)
        """Time of the newest mode, arming and type."""
        self.batteries: dict[int, tuple[int, BatteryReport]] = {}
        """Time and content of the batteries, by number."""
        self._modes: dict[str, int] = {}
        self._newest: dict[str, tuple[int, Any]] = {}
        """Time and value of the other fields."""

    def update(self, report: VehicleReport) -> None:
        """Store the fields of a report."""
        for name in ("attitude_rad", "channels_us"):
            if value := getattr(report, name):
                self._newest[name] = (report.time_us, value)
        for name in _NUMBERS:
            number = getattr(report, name)
            if number == number:
                self._newest[name] = (report.time_us, number)
        if report.battery is not None and 0 <= report.battery.number < MAX_BATTERIES:
            self.batteries[report.battery.number] = (report.time_us, self._joined(report))
        if report.mode and report.mode != self.mode:
            self.mode_changes += 1
        if report.mode:
            self.custom_mode = self._number_of(report)
        for name, unknown in _STATES.items():
            if (value := getattr(report, name)) != unknown:
                self._since_us[name] = report.time_us
                setattr(self, name, value)

    def expire(self, now_us: int, timeout_us: int) -> None:
        """Discard mode, arming and type if they are too old."""
        for name, unknown in _STATES.items():
            if now_us - self._since_us[name] > max(timeout_us, RARE_US):
                setattr(self, name, unknown)

    def _joined(self, report: VehicleReport) -> BatteryReport:
        """Join a battery with its other report: cells are reported separately from the rest."""
        fresh = report.battery or BatteryReport()
        known = self.battery(report.time_us, JOINED_US, fresh.number)
        if known is None:
            return fresh
        fields = asdict(fresh).items()
        return replace(known, **{name: v for name, v in fields if v == v and v != ()})

    def _number_of(self, report: VehicleReport) -> int:
        """Return the number of a mode: ArduPilot's, or the next free one for another mode."""
        if report.custom_mode is not None:
            return report.custom_mode
        if len(self._modes) < MAX_MODES:
            self._modes.setdefault(report.mode, OWN_MODE + len(self._modes))
        return self._modes.get(report.mode, OWN_MODE)

    def value(self, name: str, now_us: int, timeout_us: int) -> Any:
        """Return a field, or None if it is unknown or older than the timeout."""
        time_us, value = self._newest.get(name, (0, None))
        return value if value is not None and now_us - time_us <= timeout_us else None

    def state(self, time_us: int, fix: GpsFix | None, timeout_us: int) -> NavState:
        """Return the state at the time of a report or a fix; unknown values are NaN."""
        attitude = self.value("attitude_rad", time_us, timeout_us)
        climb = self.value("climb_mps", time_us, timeout_us)
        flags = NavFlags(0) if attitude is None else NavFlags.ATTITUDE_VALID
        if attitude is not None and math.isfinite(attitude[2]):
            flags |= NavFlags.HEADING_VALID
        lat = lon = alt = h_acc = v_acc = speed_acc = NAN
        vel = UNKNOWN_VEC3
        if fix is not None and fix.fix_ok and time_us - fix.time_us <= timeout_us:
            lat, lon = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
            alt, vel = fix.alt_amsl_m, fix.vel_n_mps
            h_acc, v_acc, speed_acc = fix.h_acc_m, fix.v_acc_m, fix.speed_acc_mps
            flags |= NavFlags.POSITION_VALID | NavFlags.USING_GPS
            flags |= NavFlags.ALTITUDE_VALID if is_3d(fix) else NavFlags(0)
            if math.isfinite(vel[0] + vel[1]):
                flags |= NavFlags.VELOCITY_VALID
        if climb is not None:
            vel = (vel[0], vel[1], -climb)
        level = h_acc / math.sqrt(2.0)
        return NavState(
            time_us=time_us,
            q_nb=UNKNOWN_QUAT if attitude is None else from_euler(*attitude),
            rate_b_radps=UNKNOWN_VEC3,
            lat_deg=lat,
            lon_deg=lon,
            alt_amsl_m=alt,
            vel_n_mps=vel,
            attitude_std_rad=UNKNOWN_VEC3,
            vel_std_mps=(speed_acc, speed_acc, speed_acc),
            pos_std_m=(level, level, v_acc),
            flags=flags,
        )

    def channels(self, now_us: int, timeout_us: int) -> Any:
        """Encode RC_CHANNELS; None without a link. The rssi is the link's quality in percent."""
        quality = self.value("link_quality_percent", now_us, timeout_us)
        channels = self.value("channels_us", now_us, timeout_us) or ()
        if quality is None and not channels:
            return None
        widths = [*channels[:CHANNELS]]
        return mavlink.MAVLink_rc_channels_message(
            now_us // 1000 & encoding.UINT32_MAX,
            len(widths),
            *widths,
            *[encoding.UINT16_MAX] * (CHANNELS - len(widths)),
            encoding.UINT8_MAX if quality is None else encoding.uint8(quality),
        )

    def battery(self, now_us: int, timeout_us: int, number: int = 0) -> BatteryReport | None:
        """Return a battery, or None if its report is too old."""
        time_us, battery = self.batteries.get(number, (0, None))
        return battery if battery is not None and now_us - time_us <= timeout_us else None


def battery_status(
    battery: BatteryReport,
    function: int = mavlink.MAV_BATTERY_FUNCTION_ALL,
    low: bool | None = None,
) -> Any:
    """Encode BATTERY_STATUS of a battery or supply, with its cells or else the total voltage.

    Whether it is `low` follows from the remaining charge if it is not given.
    """
    cells = battery.cells_v[:MAX_CELLS] or (battery.voltage_v,)
    mv = [encoding.uint16(cell * MV_PER_V) for cell in cells]
    first = [*mv[:10], *[encoding.UINT16_MAX] * (10 - len(mv[:10]))]
    is_low = battery.remaining_percent < LOW_PERCENT if low is None else low
    state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW if is_low else mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if low is None and math.isnan(battery.remaining_percent):
        state = mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED
    return mavlink.MAVLink_battery_status_message(
        id=battery.number,
        battery_function=function,
        type=mavlink.MAV_BATTERY_TYPE_UNKNOWN,
        temperature=encoding.INT16_MAX,
        voltages=first,
        current_battery=whole_or_unknown(battery.current_a * 100.0),
        current_consumed=whole_or_unknown(battery.used_mah),
        energy_consumed=-1,
        battery_remaining=whole_or_unknown(battery.remaining_percent, 100),
        time_remaining=0,
        charge_state=state,
        voltages_ext=[*mv[10:], *[0] * (4 - len(mv[10:]))],
    )


def whole_or_unknown(value: float, most: int = encoding.INT16_MAX) -> int:
    """Round to an integer field whose -1 means unknown."""
    return encoding.whole(value, 0, most, -1)


def named_values(report: VehicleReport) -> list[Any]:
    """Encode other measurements as NAMED_VALUE_FLOAT."""
    ms = report.time_us // 1000 & encoding.UINT32_MAX
    return [
        mavlink.MAVLink_named_value_float_message(ms, name.encode()[:10], value)
        for name, value in report.values
    ]
