"""Records to MAVLink messages: every unit, sign and "unknown" of the message definitions.

Where a definition has no value for "unknown", the function that builds the message documents the
choice. Unknown floats are NaN throughout, which is MAVLink's own rule.
"""

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import to_euler
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    BaroSample,
    GpsFix,
    GpsFixType,
    ImuSample,
    NavFlags,
    NavState,
    Vec3,
)
from gateway.units import PA_PER_HPA
from gateway.vehicle.home import Home, is_3d
from gateway.vehicle.telemetry import fields

MIN_COURSE_SPEED_MPS: Final = 0.5
"""Below this the direction of a GPS velocity is its noise."""

UT_PER_GAUSS: Final = 100.0
MM: Final = 1e3
CM: Final = 1e2
CENTI_DOP: Final = 1e2
DEGE5: Final = 1e5
DEGE7: Final = 1e7
MS_US: Final = 1000

FIX_TYPES: Final = {
    GpsFixType.NONE: mavlink.GPS_FIX_TYPE_NO_FIX,
    # MAVLink knows no dead reckoning: without satellites there is no fix.
    GpsFixType.DEAD_RECKONING: mavlink.GPS_FIX_TYPE_NO_FIX,
    GpsFixType.FIX_2D: mavlink.GPS_FIX_TYPE_2D_FIX,
    GpsFixType.FIX_3D: mavlink.GPS_FIX_TYPE_3D_FIX,
    GpsFixType.GNSS_AND_DEAD_RECKONING: mavlink.GPS_FIX_TYPE_3D_FIX,
    GpsFixType.TIME_ONLY: mavlink.GPS_FIX_TYPE_NO_FIX,
}

ESTIMATOR_FLAGS: Final = (
    (NavFlags.ATTITUDE_VALID, mavlink.ESTIMATOR_ATTITUDE),
    (
        NavFlags.VELOCITY_VALID,
        mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_VELOCITY_VERT,
    ),
    (
        NavFlags.POSITION_VALID,
        mavlink.ESTIMATOR_POS_HORIZ_REL
        | mavlink.ESTIMATOR_POS_HORIZ_ABS
        | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
        | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS,
    ),
    (NavFlags.ALTITUDE_VALID, mavlink.ESTIMATOR_POS_VERT_ABS),
    (NavFlags.GPS_REJECTED, mavlink.ESTIMATOR_GPS_GLITCH),
)

ACCEL_UPDATED: Final = 0b111
GYRO_UPDATED: Final = 0b111 << 3
MAG_UPDATED: Final = 0b111 << 6
PRESSURE_UPDATED: Final = (
    mavlink.HIGHRES_IMU_UPDATED_ABS_PRESSURE | mavlink.HIGHRES_IMU_UPDATED_PRESSURE_ALT
)
IMU_UPDATED: Final = ACCEL_UPDATED | GYRO_UPDATED | mavlink.HIGHRES_IMU_UPDATED_TEMPERATURE


def boot_ms(time_us: int) -> int:
    """Turn the gateway clock into `time_boot_ms`, which wraps after 49.7 days."""
    return (time_us // MS_US) & fields.UINT32_MAX


def attitude_quaternion(state: NavState) -> Any:
    """Encode the attitude; `repr_offset_q` is all zero: not supported."""
    return mavlink.MAVLink_attitude_quaternion_message(
        boot_ms(state.time_us), *state.q_nb, *state.rate_b_radps, (0.0, 0.0, 0.0, 0.0)
    )


def attitude(state: NavState) -> Any:
    """Encode the attitude as Euler angles."""
    return mavlink.MAVLink_attitude_message(
        boot_ms(state.time_us), *to_euler(state.q_nb), *state.rate_b_radps
    )


def has_position(state: NavState) -> bool:
    """Return whether there is a position to report, even if dead-reckoned and old."""
    return math.isfinite(state.lat_deg + state.lon_deg + state.alt_amsl_m)


def global_position_int(state: NavState, reference_alt_m: float) -> Any:
    """Encode the fused position; for states that have one.

    Latitude, longitude and heights have no "unknown" in this message, and 0, 0 is a place; so
    nothing is sent before the first position, and the estimate always from then on:
    ESTIMATOR_STATUS reports its quality. Velocities have no "unknown" either and are zero in the
    rare state that has a position but no velocity.

    Parameters
    ----------
    state : NavState
        With finite latitude, longitude and height.
    reference_alt_m : float
        Height of home above mean sea level.

    Returns
    -------
    MAVLink_message
    """
    heading = NAN
    if state.flags & NavFlags.HEADING_VALID:
        heading = to_euler(state.q_nb)[2]
    return mavlink.MAVLink_global_position_int_message(
        boot_ms(state.time_us),
        fields.int32(state.lat_deg * DEGE7),
        fields.int32(state.lon_deg * DEGE7),
        fields.int32(state.alt_amsl_m * MM),
        fields.int32((state.alt_amsl_m - reference_alt_m) * MM),
        *(fields.int16(speed * CM) for speed in state.vel_n_mps),
        fields.compass_cdeg(heading),
    )


def vfr_hud(state: NavState) -> Any:
    """Encode speed, heading, height and climb.

    No airspeed is measured: its field carries the ground speed, as ArduPilot's does without such a
    sensor, because clients print it as an integer, where NaN fails. Throttle is 0, since a tracker
    has no motor control. The heading is the yaw of ATTITUDE, and like it always sent.
    """
    north, east, down = state.vel_n_mps
    speed = math.hypot(north, east)
    yaw = to_euler(state.q_nb)[2]
    return mavlink.MAVLink_vfr_hud_message(
        airspeed=speed,
        groundspeed=speed,
        heading=fields.compass_deg(yaw) if math.isfinite(yaw) else 0,
        throttle=0,
        alt=state.alt_amsl_m,
        climb=-down,
    )


def highres_imu(sample: ImuSample, mag_b_ut: Vec3, baro: BaroSample | None, updated: int) -> Any:
    """Encode the calibrated sensors.

    HIGHRES_IMU rather than SCALED_IMU: its floats keep the sensors' resolution, it carries the
    barometer, and `fields_updated` marks the new values, where SCALED_IMU would have to send a
    plausible zero for an absent magnetometer.

    Parameters
    ----------
    sample : ImuSample
        The sample to send.
    mag_b_ut : tuple of 3 floats
        Newest magnetic field in microtesla, NaN if there was none.
    baro : BaroSample or None
        Newest barometer sample.
    updated : int
        HIGHRES_IMU_UPDATED_FLAGS since the previous message.

    Returns
    -------
    MAVLink_message
    """
    x, y, z = mag_b_ut
    return mavlink.MAVLink_highres_imu_message(
        sample.time_us,
        *sample.accel_b_mps2,
        *sample.gyro_b_radps,
        x / UT_PER_GAUSS,
        y / UT_PER_GAUSS,
        z / UT_PER_GAUSS,
        abs_pressure=NAN if baro is None else baro.pressure_pa / PA_PER_HPA,
        diff_pressure=NAN,
        pressure_alt=NAN if baro is None else baro.alt_pressure_m,
        temperature=sample.temperature_degc,
        fields_updated=updated,
    )


def scaled_pressure(sample: BaroSample) -> Any:
    """Encode the barometer; the differential pressure, which nothing measures, is NaN."""
    return mavlink.MAVLink_scaled_pressure_message(
        boot_ms(sample.time_us),
        sample.pressure_pa / PA_PER_HPA,
        NAN,
        fields.int16(sample.temperature_degc * 100.0),
    )


def is_located(fix: GpsFix) -> bool:
    """Return whether a fix has a latitude and a longitude."""
    return fix.fix_ok and FIX_TYPES[fix.fix_type] != mavlink.GPS_FIX_TYPE_NO_FIX


def gps_raw_int(fix: GpsFix, located: GpsFix | None = None) -> Any:
    """Encode a fix.

    While the receiver has no position, the last one is repeated with fix type NO_FIX, as autopilots
    do: 0, 0 is a place.

    The receiver reports only the position's DOP, whose square is the sum of those of HDOP and
    VDOP; it is divided by the accuracies, which are proportional to them. An extension field that
    is not known is 0.
    """
    north, east, _ = fix.vel_n_mps
    speed = math.hypot(north, east)
    moving = is_3d(fix) and speed >= MIN_COURSE_SPEED_MPS
    hdop, vdop = dilutions(fix)
    position = fix if located is None or is_located(fix) else located
    return mavlink.MAVLink_gps_raw_int_message(
        time_usec=fix.time_us,
        fix_type=FIX_TYPES[fix.fix_type] if fix.fix_ok else mavlink.GPS_FIX_TYPE_NO_FIX,
        lat=position.lat_dege7,
        lon=position.lon_dege7,
        alt=fields.int32(position.alt_amsl_m * MM),
        eph=fields.uint16(hdop * CENTI_DOP),
        epv=fields.uint16(vdop * CENTI_DOP),
        vel=fields.uint16(speed * CM) if is_3d(fix) else fields.UINT16_MAX,
        cog=fields.compass_cdeg(math.atan2(east, north)) if moving else fields.UINT16_MAX,
        satellites_visible=fields.uint8(fix.satellites),
        alt_ellipsoid=fields.int32(position.alt_ellipsoid_m * MM),
        h_acc=fields.uint32(fix.h_acc_m * MM),
        v_acc=fields.uint32(fix.v_acc_m * MM),
        vel_acc=fields.uint32(fix.speed_acc_mps * MM),
        hdg_acc=fields.uint32(fix.course_acc_deg * DEGE5),
    )


def dilutions(fix: GpsFix) -> tuple[float, float]:
    """Return HDOP and VDOP; NaN without a fix, or if the receiver does not report enough."""
    accuracy_m = math.hypot(fix.h_acc_m, fix.v_acc_m)
    if not is_3d(fix) or not accuracy_m > 0.0:
        return NAN, NAN
    return fix.pdop * fix.h_acc_m / accuracy_m, fix.pdop * fix.v_acc_m / accuracy_m


def gps_absent(now_us: int, located: GpsFix | None = None) -> Any:
    """Encode "no GPS" at the last position, so that a good fix does not stay on screen."""
    return mavlink.MAVLink_gps_raw_int_message(
        time_usec=now_us,
        fix_type=mavlink.GPS_FIX_TYPE_NO_GPS,
        lat=0 if located is None else located.lat_dege7,
        lon=0 if located is None else located.lon_dege7,
        alt=0 if located is None else fields.int32(located.alt_amsl_m * MM),
        eph=fields.UINT16_MAX,
        epv=fields.UINT16_MAX,
        vel=fields.UINT16_MAX,
        cog=fields.UINT16_MAX,
        satellites_visible=fields.UINT8_MAX,
    )


def estimator_status(state: NavState) -> Any:
    """Encode which states the estimator considers valid; it computes no test ratios."""
    flags = 0
    for ours, theirs in ESTIMATOR_FLAGS:
        if state.flags & ours:
            flags |= theirs
    if not state.flags & (NavFlags.POSITION_VALID | NavFlags.DEAD_RECKONING):
        flags |= mavlink.ESTIMATOR_CONST_POS_MODE
    north, east, down = state.pos_std_m
    return mavlink.MAVLink_estimator_status_message(
        state.time_us, flags, NAN, NAN, NAN, NAN, NAN, NAN, math.hypot(north, east), down
    )


def home_position(home: Home) -> Any:
    """Encode home, which is the origin of the local frame; slope and approach are not known."""
    return mavlink.MAVLink_home_position_message(
        fields.int32(home.place.lat_deg * DEGE7),
        fields.int32(home.place.lon_deg * DEGE7),
        fields.int32(home.place.alt_amsl_m * MM),
        0.0,
        0.0,
        0.0,
        (NAN, NAN, NAN, NAN),
        *UNKNOWN_VEC3,
        home.set_time_us,
    )


def system_time(now_us: int, unix_us: int | None) -> Any:
    """Encode the clocks; the Unix time is 0 until a GPS fix provides it."""
    return mavlink.MAVLink_system_time_message(unix_us or 0, boot_ms(now_us))
