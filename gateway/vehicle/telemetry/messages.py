"""Records to MAVLink messages, with the units, signs and values for unknown of the definitions.

If a definition has no value for unknown, the function that builds the message documents the choice.
Unknown floats are always NaN, as MAVLink requires.
"""

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import body_axes, rotate_inverse, to_euler
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
from gateway.units import DEGE7_PER_DEG, PA_PER_HPA, STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.vehicle import encoding
from gateway.vehicle.encoding import CUSTOM_MODES
from gateway.vehicle.plan import Home, Location, distance_and_bearing, is_3d
from gateway.vehicle.telemetry.health import ACCEL, GPS, GYRO, MAG, PRESSURE, Health

MIN_COURSE_SPEED_MPS: Final = 0.5
"""Speed below which the direction of a GPS velocity is only noise."""

MM: Final = 1e3
CM: Final = 1e2
CENTI_DOP: Final = 1e2
CENTI: Final = 1e2
MILLI: Final = 1e3
MIN_COS_SQ: Final = 1e-4
"""Least square of the cosine of the pitch, so that the variances of roll and yaw, which are
indistinguishable at 90 degrees, stay finite."""
UNKNOWN_TERRAIN_M: Final = -10_000.0
"""Unknown terrain altitude in ALTITUDE: any value below -1000."""
DEGE5: Final = 1e5
MS_US: Final = 1000

FIX_TYPES: Final = {
    GpsFixType.NONE: mavlink.GPS_FIX_TYPE_NO_FIX,
    # MAVLink has no fix type for dead reckoning: without satellites there is no fix.
    GpsFixType.DEAD_RECKONING: mavlink.GPS_FIX_TYPE_NO_FIX,
    GpsFixType.FIX_2D: mavlink.GPS_FIX_TYPE_2D_FIX,
    GpsFixType.FIX_3D: mavlink.GPS_FIX_TYPE_3D_FIX,
    GpsFixType.GNSS_AND_DEAD_RECKONING: mavlink.GPS_FIX_TYPE_3D_FIX,
    GpsFixType.TIME_ONLY: mavlink.GPS_FIX_TYPE_NO_FIX,
}

ESTIMATOR_FLAGS: Final = (
    (NavFlags.ATTITUDE_VALID, mavlink.ESTIMATOR_ATTITUDE),
    (NavFlags.VELOCITY_VALID, mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_VELOCITY_VERT),
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


ATTITUDE_QUATERNION: Final = encoding.MessagePacker(mavlink.MAVLink_attitude_quaternion_message)
ATTITUDE: Final = encoding.MessagePacker(mavlink.MAVLink_attitude_message)
GLOBAL_POSITION_INT: Final = encoding.MessagePacker(mavlink.MAVLink_global_position_int_message)
VFR_HUD: Final = encoding.MessagePacker(mavlink.MAVLink_vfr_hud_message)
HIGHRES_IMU: Final = encoding.MessagePacker(mavlink.MAVLink_highres_imu_message)
SCALED_PRESSURE: Final = encoding.MessagePacker(mavlink.MAVLink_scaled_pressure_message)
"""Packers of the messages of samples, which are sent most often."""
FAILURES: Final = (
    (GPS, mavlink.HL_FAILURE_FLAG_GPS),
    (PRESSURE, mavlink.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE),
    (ACCEL, mavlink.HL_FAILURE_FLAG_3D_ACCEL),
    (GYRO, mavlink.HL_FAILURE_FLAG_3D_GYRO),
    (MAG, mavlink.HL_FAILURE_FLAG_3D_MAG),
)
HALF_DEGREES: Final = 2.0
FIFTHS: Final = 5.0
"""Units of speed per metre a second."""
TENTHS: Final = 10.0
INT8_MAX: Final = 127
UNKNOWN_PERCENT: Final = -1


def boot_ms(time_us: int) -> int:
    """Convert gateway time to `time_boot_ms`, which wraps after 49.7 days."""
    return (time_us // MS_US) & encoding.UINT32_MAX


def attitude_quaternion(state: NavState) -> Any:
    """Encode the attitude; `repr_offset_q` is all zero: not supported."""
    return ATTITUDE_QUATERNION(
        boot_ms(state.time_us), *state.q_nb, *state.rate_b_radps, 0.0, 0.0, 0.0, 0.0
    )


def attitude(state: NavState) -> Any:
    """Encode the attitude as Euler angles."""
    return ATTITUDE(boot_ms(state.time_us), *to_euler(state.q_nb), *state.rate_b_radps)


def has_position(state: NavState) -> bool:
    """Return whether there is a position to report, even if dead-reckoned and old."""
    return math.isfinite(state.lat_deg + state.lon_deg + state.alt_amsl_m)


def global_position_int(state: NavState, reference_alt_m: float) -> Any:
    """Encode the fused position of a state that has one.

    Latitude, longitude and heights have no value for unknown in this message, and 0, 0 is a valid
    position; so it is not sent before the first position, and always from then on: ESTIMATOR_STATUS
    reports the quality of the estimate. Velocities have no value for unknown either and are zero in
    the rare state that has a position but no velocity.
    """
    heading = NAN
    if state.flags & NavFlags.HEADING_VALID:
        heading = to_euler(state.q_nb)[2]
    return GLOBAL_POSITION_INT(
        boot_ms(state.time_us),
        encoding.int32(state.lat_deg * DEGE7_PER_DEG),
        encoding.int32(state.lon_deg * DEGE7_PER_DEG),
        encoding.int32(state.alt_amsl_m * MM),
        encoding.int32((state.alt_amsl_m - reference_alt_m) * MM),
        *(encoding.int16(speed * CM) for speed in state.vel_n_mps),
        encoding.compass_cdeg(heading),
    )


def vfr_hud(
    state: NavState,
    heading_rad: float | None = None,
    airspeed_mps: float | None = None,
    throttle_percent: float | None = None,
) -> Any:
    """Encode speed, heading, height and climb.

    Without an airspeed its field contains the ground speed, as in ArduPilot without such a sensor,
    because clients print it as an integer, where NaN fails. Throttle is 0 if none is reported. The
    heading is the yaw of ATTITUDE; without an attitude it is the reported heading, or else the
    course over ground, or 0.
    """
    north, east, down = state.vel_n_mps
    speed = math.hypot(north, east)
    yaw = to_euler(state.q_nb)[2]
    if math.isnan(yaw):
        yaw = math.atan2(east, north) if heading_rad is None else heading_rad
    heading = encoding.compass_deg(yaw) if math.isfinite(yaw) else 0
    airspeed = speed if airspeed_mps is None else airspeed_mps
    throttle = 0 if throttle_percent is None else encoding.uint16(throttle_percent, 0)
    return VFR_HUD(airspeed, speed, heading, throttle, state.alt_amsl_m, -down)


def highres_imu(sample: ImuSample, mag_b_ut: Vec3, baro: BaroSample | None, updated: int) -> Any:
    """Encode the calibrated sensors.

    HIGHRES_IMU rather than SCALED_IMU: its floats keep the sensors' resolution, it contains the
    barometer, and `fields_updated` marks the new values, whereas SCALED_IMU would have to send a
    plausible zero for an absent magnetometer. `updated` has the flags of the values that are new
    since the previous message; an unknown field is NaN.
    """
    x, y, z = mag_b_ut
    diff_pressure, imu_id = NAN, 0
    return HIGHRES_IMU(
        sample.time_us,
        *sample.accel_b_mps2,
        *sample.gyro_b_radps,
        x / UT_PER_GAUSS,
        y / UT_PER_GAUSS,
        z / UT_PER_GAUSS,
        NAN if baro is None else baro.pressure_pa / PA_PER_HPA,
        diff_pressure,
        NAN if baro is None else baro.alt_pressure_m,
        sample.temperature_degc,
        updated,
        imu_id,
    )


def local_position_ned(state: NavState, origin: Location) -> Any:
    """Encode position and velocity in the local frame, of a state that has a position."""
    return mavlink.MAVLink_local_position_ned_message(
        boot_ms(state.time_us), *local_position_m(state, origin), *state.vel_n_mps
    )


def local_position_m(state: NavState, origin: Location) -> Vec3:
    """Project a position onto the tangent plane of the ellipsoid at the origin.

    The projection is azimuthal equidistant, as autopilots use: distance and bearing from the origin
    are exact.
    """
    here = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
    distance_m, bearing_rad = distance_and_bearing(origin, here)
    north_m, east_m = distance_m * math.cos(bearing_rad), distance_m * math.sin(bearing_rad)
    return (north_m, east_m, origin.alt_amsl_m - state.alt_amsl_m)


def odometry(state: NavState, origin: Location) -> Any:
    """Encode pose in the local frame and velocity in the body frame, with their variances.

    The state has no correlations, so these elements of the covariances are 0. The variances of the
    angular rates are not estimated and are NaN.
    """
    return mavlink.MAVLink_odometry_message(
        state.time_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *local_position_m(state, origin),
        state.q_nb,
        *rotate_inverse(state.q_nb, state.vel_n_mps),
        *state.rate_b_radps,
        pose_covariance=_covariance(*_squared(state.pos_std_m), *_euler_variances(state)),
        velocity_covariance=_covariance(*_body_velocity_variances(state), *UNKNOWN_VEC3),
        reset_counter=0,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
    )


def _squared(values: Vec3) -> Vec3:
    x, y, z = values
    return (x * x, y * y, z * z)


def _covariance(*variances: float) -> list[float]:
    """Lay out the upper right triangle, row by row, of a 6x6 matrix with this diagonal."""
    found = [0.0] * 21
    for index, variance in zip((0, 6, 11, 15, 18, 20), variances, strict=True):
        found[index] = variance
    return found


def _euler_variances(state: NavState) -> Vec3:
    """Convert variances about north, east and down to those of roll, pitch and yaw.

    From the kinematics of intrinsic Z-Y-X angles: roll = (c N + s E) / cos(pitch),
    pitch = c E - s N, yaw = D + tan(pitch) (c N + s E), with c and s of the yaw.
    """
    _, pitch, yaw = to_euler(state.q_nb)
    north, east, down = _squared(state.attitude_std_rad)
    cos_sq = math.cos(yaw) ** 2
    along = cos_sq * north + (1.0 - cos_sq) * east
    across = cos_sq * east + (1.0 - cos_sq) * north
    level_sq = max(math.cos(pitch) ** 2, MIN_COS_SQ)
    return (along / level_sq, across, down + along * (1.0 - level_sq) / level_sq)


def _body_velocity_variances(state: NavState) -> Vec3:
    variances = _squared(state.vel_std_mps)
    x, y, z = (
        sum(part * part * variance for part, variance in zip(axis, variances, strict=True))
        for axis in body_axes(state.q_nb)
    )
    return (x, y, z)


def altitude(state: NavState, baro: BaroSample | None, home_alt_m: float, origin: Location) -> Any:
    """Encode the altitudes; terrain and clearance are unknown."""
    return mavlink.MAVLink_altitude_message(
        state.time_us,
        altitude_monotonic=state.alt_amsl_m if baro is None else baro.alt_pressure_m,
        altitude_amsl=state.alt_amsl_m,
        altitude_local=state.alt_amsl_m - origin.alt_amsl_m,
        altitude_relative=state.alt_amsl_m - home_alt_m,
        altitude_terrain=UNKNOWN_TERRAIN_M,
        bottom_clearance=-1.0,
    )


def _milli_imu(sample: ImuSample, mag_b_ut: Vec3) -> tuple[int, ...]:
    """Return accelerations in mG, rates in mrad/s and the field in mgauss, 0 if it is unknown."""
    scales = (
        (sample.accel_b_mps2, MILLI / STANDARD_GRAVITY_MPS2),
        (sample.gyro_b_radps, MILLI),
        (mag_b_ut, MILLI / UT_PER_GAUSS),
    )
    return tuple(encoding.int16(value * scale) for values, scale in scales for value in values)


def _temperature_cdegc(sample: ImuSample) -> int:
    """Return the temperature in 0.01 degrees; 0 means unknown, so 0 degrees is sent as 1."""
    temperature = sample.temperature_degc
    return 0 if math.isnan(temperature) else encoding.int16(temperature * CENTI) or 1


def scaled_imu(sample: ImuSample, mag_b_ut: Vec3) -> Any:
    """Encode the calibrated sensors as the integers of SCALED_IMU."""
    values = _milli_imu(sample, mag_b_ut)
    return mavlink.MAVLink_scaled_imu_message(
        boot_ms(sample.time_us), *values, _temperature_cdegc(sample)
    )


def raw_imu(sample: ImuSample, mag_b_ut: Vec3) -> Any:
    """Encode RAW_IMU in the units of SCALED_IMU, as ArduPilot does and clients expect."""
    values = _milli_imu(sample, mag_b_ut)
    return mavlink.MAVLink_raw_imu_message(sample.time_us, *values, 0, _temperature_cdegc(sample))


def gps_global_origin(origin: Location, time_us: int) -> Any:
    """Encode the origin of the local frame."""
    return mavlink.MAVLink_gps_global_origin_message(
        encoding.int32(origin.lat_deg * DEGE7_PER_DEG),
        encoding.int32(origin.lon_deg * DEGE7_PER_DEG),
        encoding.int32(origin.alt_amsl_m * MM),
        time_us,
    )


def scaled_pressure(sample: BaroSample) -> Any:
    """Encode the barometer; the differential pressure is not measured and is NaN."""
    press_diff, temperature_of_press_diff = NAN, 0
    return SCALED_PRESSURE(
        boot_ms(sample.time_us),
        sample.pressure_pa / PA_PER_HPA,
        press_diff,
        encoding.int16(sample.temperature_degc * CENTI),
        temperature_of_press_diff,
    )


def is_located(fix: GpsFix) -> bool:
    """Return whether a fix has a latitude and a longitude."""
    return fix.fix_ok and FIX_TYPES[fix.fix_type] != mavlink.GPS_FIX_TYPE_NO_FIX


def gps_raw_int(fix: GpsFix, located: GpsFix | None = None) -> Any:
    """Encode a fix.

    While the receiver has no position, the last one is repeated with fix type NO_FIX, as autopilots
    do: 0, 0 is a valid position.

    The receiver reports only the position's DOP, whose square is the sum of the squares of HDOP and
    VDOP; it is divided in proportion to the accuracies. An unknown extension field is 0.
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
        alt=encoding.int32(position.alt_amsl_m * MM),
        eph=encoding.uint16(hdop * CENTI_DOP),
        epv=encoding.uint16(vdop * CENTI_DOP),
        vel=encoding.uint16(speed * CM) if is_3d(fix) else encoding.UINT16_MAX,
        cog=encoding.compass_cdeg(math.atan2(east, north)) if moving else encoding.UINT16_MAX,
        satellites_visible=encoding.uint8(fix.satellites),
        alt_ellipsoid=encoding.int32(position.alt_ellipsoid_m * MM),
        h_acc=encoding.uint32(fix.h_acc_m * MM),
        v_acc=encoding.uint32(fix.v_acc_m * MM),
        vel_acc=encoding.uint32(fix.speed_acc_mps * MM),
        hdg_acc=encoding.uint32(fix.course_acc_deg * DEGE5),
    )


def dilutions(fix: GpsFix) -> tuple[float, float]:
    """Return HDOP and VDOP; NaN without a fix, or if the receiver reports too little for them."""
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
        alt=0 if located is None else encoding.int32(located.alt_amsl_m * MM),
        eph=encoding.UINT16_MAX,
        epv=encoding.UINT16_MAX,
        vel=encoding.UINT16_MAX,
        cog=encoding.UINT16_MAX,
        satellites_visible=encoding.UINT8_MAX,
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
    """Encode home; its local position, the slope and the approach are unknown."""
    return mavlink.MAVLink_home_position_message(
        encoding.int32(home.location.lat_deg * DEGE7_PER_DEG),
        encoding.int32(home.location.lon_deg * DEGE7_PER_DEG),
        encoding.int32(home.location.alt_amsl_m * MM),
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


def high_latency2(
    kind: int,
    autopilot: int,
    state: NavState | None,
    fix: GpsFix | None,
    health: Health,
    now_us: int,
) -> Any:
    """Encode the state of the vehicle in 42 bytes.

    Latitude, longitude and altitude have no value for unknown in this message, which is the only
    one on its link, so it is also sent before the first fix: as in PX4, with 0, 0, errors of
    UINT8_MAX and the GPS failure flag. Wind, airspeed and throttle are not measured.
    """
    failures = sum(flag for sensor, flag in FAILURES if not health.is_alive(sensor, now_us))
    h_acc_m = v_acc_m = NAN
    if fix is None or not is_3d(fix):
        failures |= mavlink.HL_FAILURE_FLAG_GPS
    elif health.is_alive(GPS, now_us):
        h_acc_m, v_acc_m = fix.h_acc_m, fix.v_acc_m
    known = state if state is not None and has_position(state) else None
    north, east, down = state.vel_n_mps if state is not None else (NAN, NAN, NAN)
    yaw_deg = math.degrees(to_euler(state.q_nb)[2]) if state is not None else NAN
    speed = encoding.uint8(math.hypot(north, east) * FIFTHS, unknown=0)
    return mavlink.MAVLink_high_latency2_message(
        timestamp=boot_ms(now_us),
        type=kind,
        autopilot=autopilot,
        # The upper half of the mode, as PX4 sends it.
        custom_mode=CUSTOM_MODES[autopilot] >> 16,
        latitude=encoding.int32(known.lat_deg * DEGE7_PER_DEG) if known is not None else 0,
        longitude=encoding.int32(known.lon_deg * DEGE7_PER_DEG) if known is not None else 0,
        altitude=encoding.int16(state.alt_amsl_m) if state is not None else 0,
        target_altitude=0,
        heading=encoding.uint8(yaw_deg % 360.0 / HALF_DEGREES, unknown=0),
        target_heading=0,
        target_distance=0,
        throttle=0,
        airspeed=speed,
        airspeed_sp=0,
        groundspeed=speed,
        windspeed=0,
        wind_heading=0,
        eph=encoding.uint8(h_acc_m * TENTHS),
        epv=encoding.uint8(v_acc_m * TENTHS),
        temperature_air=0,
        climb_rate=encoding.whole(-down * TENTHS, -INT8_MAX, INT8_MAX, 0),
        battery=UNKNOWN_PERCENT,
        wp_num=0,
        failure_flags=failures,
        custom0=0,
        custom1=0,
        custom2=0,
    )
