"""HIGH_LATENCY2: a whole vehicle in one message, for links of a few bytes a second.

References
----------
.. [1] https://mavlink.io/en/services/high_latency.html
"""

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import to_euler
from gateway.records import NAN, GpsFix, NavState
from gateway.vehicle.home import is_3d
from gateway.vehicle.identity import CUSTOM_MODES
from gateway.vehicle.telemetry import fields
from gateway.vehicle.telemetry.health import ACCEL, GPS, GYRO, MAG, PRESSURE, Health
from gateway.vehicle.telemetry.messages import DEGE7, boot_ms, has_position

FAILURES: Final = (
    (GPS, mavlink.HL_FAILURE_FLAG_GPS),
    (PRESSURE, mavlink.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE),
    (ACCEL, mavlink.HL_FAILURE_FLAG_3D_ACCEL),
    (GYRO, mavlink.HL_FAILURE_FLAG_3D_GYRO),
    (MAG, mavlink.HL_FAILURE_FLAG_3D_MAG),
)
HALF_DEGREES: Final = 2.0
FIFTHS: Final = 5.0
"""Of a metre a second."""
TENTHS: Final = 10.0
INT8_MAX: Final = 127
UNKNOWN_PERCENT: Final = -1


def high_latency2(
    kind: int,
    autopilot: int,
    state: NavState | None,
    fix: GpsFix | None,
    health: Health,
    now_us: int,
) -> Any:
    """Encode the state of the vehicle in 42 bytes.

    A position has no "unknown" in this message: it is 0, 0 before the first fix, and the GPS
    failure flag is set. Nothing measures wind, airspeed or throttle.

    Parameters
    ----------
    kind : int
        A MAV_TYPE.
    autopilot : int
        A MAV_AUTOPILOT.
    state : NavState, optional
        The newest.
    fix : GpsFix, optional
        The newest.
    health : Health
        State of the sensors.
    now_us : int
        Gateway clock.

    Returns
    -------
    MAVLink_message
    """
    failures = sum(flag for sensor, flag in FAILURES if not health.is_alive(sensor, now_us))
    if fix is None or not is_3d(fix):
        failures |= mavlink.HL_FAILURE_FLAG_GPS
    known = state is not None and has_position(state)
    north, east, down = state.vel_n_mps if state is not None else (NAN, NAN, NAN)
    yaw_deg = math.degrees(to_euler(state.q_nb)[2]) if state is not None else NAN
    speed = fields.uint8(math.hypot(north, east) * FIFTHS, unknown=0)
    return mavlink.MAVLink_high_latency2_message(
        timestamp=boot_ms(now_us),
        type=kind,
        autopilot=autopilot,
        # The upper half of PX4's, as PX4 sends it.
        custom_mode=CUSTOM_MODES[autopilot] >> 16,
        latitude=fields.int32(state.lat_deg * DEGE7) if state is not None and known else 0,
        longitude=fields.int32(state.lon_deg * DEGE7) if state is not None and known else 0,
        altitude=fields.int16(state.alt_amsl_m) if state is not None and known else 0,
        target_altitude=0,
        heading=fields.uint8(yaw_deg % 360.0 / HALF_DEGREES, unknown=0),
        target_heading=0,
        target_distance=0,
        throttle=0,
        airspeed=speed,
        airspeed_sp=0,
        groundspeed=speed,
        windspeed=0,
        wind_heading=0,
        eph=fields.uint8(fix.h_acc_m * TENTHS if fix is not None else NAN),
        epv=fields.uint8(fix.v_acc_m * TENTHS if fix is not None else NAN),
        temperature_air=0,
        climb_rate=fields.whole(-down * TENTHS, -INT8_MAX, INT8_MAX, 0),
        battery=UNKNOWN_PERCENT,
        wp_num=0,
        failure_flags=failures,
        custom0=0,
        custom1=0,
        custom2=0,
    )
