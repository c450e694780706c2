"""Records to MAVLink messages, with the units, signs and values for unknown of the definitions.

Each message has one builder, which works from the newest records of an aircraft at a time, and
returns None if there is nothing to send. If a definition has no value for unknown, the builder
documents the choice. Unknown floats are always NaN, as MAVLink requires.
"""

import math
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.geometry.quaternion import body_axes, rotate_inverse, to_euler
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    GpsFix,
    GpsFixType,
    ImuSample,
    NavFlags,
    NavState,
    Vec3,
)
from gateway.units import DEGE7_PER_DEG, PA_PER_HPA, STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.vehicle import encoding
from gateway.vehicle.plan import Home, Location, distance_and_bearing, is_3d
from gateway.vehicle.telemetry.health import ACCEL, GPS, GYRO, MAG, PRESSURE, Health
from gateway.vehicle.telemetry.streams import NewestRecords
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire import mavlink_messages

MIN_COURSE_SPEED_MPS: Final = 0.5
"""Speed below which the direction of a GPS velocity is only noise."""

MM: Final = 1e3
CM: Final = 1e2
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
PROTOCOL_VERSION: Final = encoding.MessagePacker(mavlink_messages.PROTOCOL_VERSION)
HIGHRES_IMU: Final = encoding.MessagePacker(mavlink.MAVLink_highres_imu_message)
SCALED_PRESSURE: Final = encoding.MessagePacker(mavlink.MAVLink_scaled_pressure_message)
"""Packers of the messages of samples, which are sent most often, and of one that pymavlink
lacks."""
FAILURES: Final = (
    (GPS, mavlink.HL_FAILURE_FLAG_GPS),
    (PRESSURE, mavlink.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE),
    (ACCEL, mavlink.HL_FAILURE_FLAG_3D_ACCEL),
    (GYRO, mavlink.HL_FAILURE_FLAG_3D_GYRO),
    (MAG, mavlink.HL_FAILURE_FLAG_3D_MAG),
)
UNMEASURED: Final = dict.fromkeys(
    (
        *("target_altitude", "target_heading", "target_distance", "throttle", "airspeed_sp"),
        *("windspeed", "wind_heading", "temperature_air", "wp_num"),
        *("custom0", "custom1", "custom2"),
    ),
    0,
)
"""Fields of HIGH_LATENCY2 that are always zero."""
HALF_DEGREES: Final = 2.0
FIFTHS: Final = 5.0
"""Units of speed per metre a second."""
TENTHS: Final = 10.0
INT8_MAX: Final = 127
UNKNOWN_PERCENT: Final = -1
CAPABILITIES: Final = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
UID_PREFIX: Final = int.from_bytes(b"mavgate")
MODE_NAME: Final = "Tracking"
MAX_MODE_NAME: Final = 34
AUTOPILOTS: Final[dict[str, tuple[int, int]]] = {
    "generic": (mavlink.MAV_AUTOPILOT_GENERIC, 0),
    "ardupilotmega": (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 0),
    "px4": (mavlink.MAV_AUTOPILOT_PX4, 1 << 16),
}
"""MAV_AUTOPILOT by the setting `autopilot`, and the mode in which a pilot flies manually: MANUAL or
STABILIZE of ArduPilot, main mode 1 of PX4."""
Builder = Callable[[Any, int], Any]
"""Builds a message from the newest records, at a time; None if there is nothing to send."""


class Newest(NewestRecords):
    """The newest records of one aircraft, and all else that its messages are built from."""

    def __init__(self, settings: VehicleSettings, health: Health) -> None:
        self.settings = settings
        self.health = health
        self.home: Home | None = None
        self.origin: Home | None = None
        """Origin of the local frame: the first home; a later home does not move it."""
        self.reference_alt_m = NAN
        """Height of home, or of the first position."""
        self.located_fix: GpsFix | None = None
        """The newest fix with a position, which is repeated without a fix."""
        self.mag_b_ut = UNKNOWN_VEC3
        self.updated = 0
        """Flags of the values that are new since the last HIGHRES_IMU."""
        self.unix_offset_us: int | None = None

    @property
    def vehicle_type(self) -> int:
        """The MAV_TYPE that is reported."""
        kind: int = getattr(mavlink, f"MAV_TYPE_{self.settings.type.upper()}")
        reported = self.health.reported.vehicle_type
        return kind if reported is None else reported

    @property
    def autopilot(self) -> int:
        """The MAV_AUTOPILOT that is reported."""
        return AUTOPILOTS[self.settings.autopilot][0]

    @property
    def mode(self) -> tuple[int, str]:
        """Number and name of the present mode."""
        reported = self.health.reported
        if reported.mode:
            return reported.custom_mode, reported.mode
        return AUTOPILOTS[self.settings.autopilot][1], MODE_NAME

    def reported(self, name: str, now_us: int) -> Any:
        """Return a field of the reports of the vehicle's own autopilot; None if it is unknown."""
        return self.health.reported.value(name, now_us, self.health.silent_us)


def boot_ms(time_us: int) -> int:
    """Convert gateway time to `time_boot_ms`, which wraps after 49.7 days."""
    return (time_us // MS_US) & encoding.UINT32_MAX


def attitude_quaternion(newest: Newest, _now_us: int) -> Any:
    """Encode the attitude; `repr_offset_q` is all zero: not supported."""
    state = newest.state
    if state is None or state.q_nb[0] != state.q_nb[0]:
        return None
    time_ms = boot_ms(state.time_us)
    return ATTITUDE_QUATERNION(time_ms, *state.q_nb, *state.rate_b_radps, 0.0, 0.0, 0.0, 0.0)


def attitude(newest: Newest, _now_us: int) -> Any:
    """Encode the attitude as Euler angles."""
    state = newest.state
    if state is None or state.q_nb[0] != state.q_nb[0]:
        return None
    return ATTITUDE(boot_ms(state.time_us), *to_euler(state.q_nb), *state.rate_b_radps)


def has_position(state: NavState | None) -> bool:
    """Return whether there is a position to report, even if dead-reckoned and old."""
    return state is not None and math.isfinite(state.lat_deg + state.lon_deg + state.alt_amsl_m)


def _coordinates(at: NavState | Location) -> tuple[int, int, int]:
    """Return latitude and longitude in 1e-7 degrees and height in mm."""
    return (
        encoding.int32(at.lat_deg * DEGE7_PER_DEG),
        encoding.int32(at.lon_deg * DEGE7_PER_DEG),
        encoding.int32(at.alt_amsl_m * MM),
    )


def global_position_int(newest: Newest, now_us: int) -> Any:
    """Encode the fused position.

    Latitude, longitude and heights have no value for unknown in this message, and 0, 0 is a valid
    position; so it is not sent before the first position, and always from then on: ESTIMATOR_STATUS
    reports the quality of the estimate. Velocities have no value for unknown either and are zero in
    the rare state that has a position but no velocity.
    """
    state = newest.state
    if state is None or not has_position(state):
        return None
    height_m = newest.reported("alt_home_m", now_us)
    if height_m is None or newest.health.is_fused(now_us):
        height_m = state.alt_amsl_m - newest.reference_alt_m
    return GLOBAL_POSITION_INT(
        boot_ms(state.time_us),
        *_coordinates(state),
        encoding.int32(height_m * MM),
        *(encoding.int16(speed * CM) for speed in state.vel_n_mps),
        encoding.compass_cdeg(
            to_euler(state.q_nb)[2] if state.flags & NavFlags.HEADING_VALID else NAN
        ),
    )


def vfr_hud(newest: Newest, now_us: int) -> Any:
    """Encode speed, heading, height and climb.

    Without an airspeed its field contains the ground speed, as in ArduPilot without such a sensor,
    because clients print it as an integer, where NaN fails. Throttle is 0 if none is reported. The
    heading is the yaw of ATTITUDE; without an attitude it is the reported heading, or else the
    course over ground, or 0.
    """
    state = newest.state
    if state is None:
        return None
    north, east, down = state.vel_n_mps
    speed = math.hypot(north, east)
    yaw = to_euler(state.q_nb)[2]
    if math.isnan(yaw):
        reported = newest.reported("heading_rad", now_us)
        yaw = math.atan2(east, north) if reported is None else reported
    heading = encoding.compass_deg(yaw) if math.isfinite(yaw) else 0
    airspeed = newest.reported("airspeed_mps", now_us)
    throttle = newest.reported("throttle_percent", now_us)
    return VFR_HUD(
        speed if airspeed is None else airspeed,
        speed,
        heading,
        0 if throttle is None else encoding.uint16(throttle, 0),
        state.alt_amsl_m,
        -down,
    )


def highres_imu(newest: Newest, _now_us: int) -> Any:
    """Encode the calibrated sensors.

    HIGHRES_IMU rather than SCALED_IMU: its floats keep the sensors' resolution, it contains the
    barometer, and `fields_updated` marks the new values, whereas SCALED_IMU would have to send a
    plausible zero for an absent magnetometer. An unknown field is NaN.
    """
    sample, baro = newest.sample, newest.baro
    if sample is None:
        return None
    updated, newest.updated = newest.updated, 0
    diff_pressure, imu_id = NAN, 0
    return HIGHRES_IMU(
        sample.time_us,
        *sample.accel_b_mps2,
        *sample.gyro_b_radps,
        *(part / UT_PER_GAUSS for part in newest.mag_b_ut),
        NAN if baro is None else baro.pressure_pa / PA_PER_HPA,
        diff_pressure,
        NAN if baro is None else baro.alt_pressure_m,
        sample.temperature_degc,
        updated,
        imu_id,
    )


def local_position_ned(newest: Newest, _now_us: int) -> Any:
    """Encode position and velocity in the local frame."""
    state, position = newest.state, local_position_m(newest)
    if state is None or position is None:
        return None
    return mavlink.MAVLink_local_position_ned_message(
        boot_ms(state.time_us), *position, *state.vel_n_mps
    )


def local_position_m(newest: Newest) -> Vec3 | None:
    """Project the position, if it is known, onto the tangent plane of the ellipsoid at the origin.

    The projection is azimuthal equidistant, as autopilots use: distance and bearing from the origin
    are exact.
    """
    state, origin = newest.state, newest.origin
    if state is None or origin is None or not has_position(state):
        return None
    here = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
    distance_m, bearing_rad = distance_and_bearing(origin.location, here)
    north_m, east_m = distance_m * math.cos(bearing_rad), distance_m * math.sin(bearing_rad)
    return (north_m, east_m, origin.location.alt_amsl_m - state.alt_amsl_m)


def odometry(newest: Newest, _now_us: int) -> Any:
    """Encode pose in the local frame and velocity in the body frame, with their variances.

    The state has no correlations, so these elements of the covariances are 0. The variances of the
    angular rates are not estimated and are NaN.
    """
    state, position = newest.state, local_position_m(newest)
    if state is None or position is None:
        return None
    return mavlink.MAVLink_odometry_message(
        state.time_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *position,
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


def altitude(newest: Newest, _now_us: int) -> Any:
    """Encode the altitudes; terrain and clearance are unknown."""
    state, origin, baro = newest.state, newest.origin, newest.baro
    if state is None or origin is None or not has_position(state):
        return None
    return mavlink.MAVLink_altitude_message(
        state.time_us,
        altitude_monotonic=state.alt_amsl_m if baro is None else baro.alt_pressure_m,
        altitude_amsl=state.alt_amsl_m,
        altitude_local=state.alt_amsl_m - origin.location.alt_amsl_m,
        altitude_relative=state.alt_amsl_m - newest.reference_alt_m,
        altitude_terrain=UNKNOWN_TERRAIN_M,
        bottom_clearance=-1.0,
    )


def _milli_imu(sample: ImuSample, mag_b_ut: Vec3) -> tuple[tuple[int, ...], int]:
    """Return accelerations in mG, rates in mrad/s and the field in mgauss, 0 if it is unknown.

    With the temperature in 0.01 degrees; 0 means unknown, so 0 degrees is sent as 1.
    """
    scales = (
        (sample.accel_b_mps2, MILLI / STANDARD_GRAVITY_MPS2),
        (sample.gyro_b_radps, MILLI),
        (mag_b_ut, MILLI / UT_PER_GAUSS),
    )
    values = tuple(encoding.int16(value * scale) for vector, scale in scales for value in vector)
    degc = sample.temperature_degc
    return values, 0 if math.isnan(degc) else encoding.int16(degc * CENTI) or 1


def scaled_imu(newest: Newest, _now_us: int) -> Any:
    """Encode the calibrated sensors as the integers of SCALED_IMU."""
    if (sample := newest.sample) is None:
        return None
    values, temperature = _milli_imu(sample, newest.mag_b_ut)
    return mavlink.MAVLink_scaled_imu_message(boot_ms(sample.time_us), *values, temperature)


def raw_imu(newest: Newest, _now_us: int) -> Any:
    """Encode RAW_IMU in the units of SCALED_IMU, as ArduPilot does and clients expect."""
    if (sample := newest.sample) is None:
        return None
    values, temperature = _milli_imu(sample, newest.mag_b_ut)
    return mavlink.MAVLink_raw_imu_message(sample.time_us, *values, 0, temperature)


def gps_global_origin(newest: Newest, _now_us: int) -> Any:
    """Encode the origin of the local frame."""
    if (origin := newest.origin) is None:
        return None
    return mavlink.MAVLink_gps_global_origin_message(
        *_coordinates(origin.location), origin.set_time_us
    )


def scaled_pressure(newest: Newest, _now_us: int) -> Any:
    """Encode the barometer; the differential pressure is not measured and is NaN."""
    if (sample := newest.baro) is None:
        return None
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


def gps_raw_int(newest: Newest, now_us: int) -> Any:
    """Encode the newest fix, or "no GPS" so that a good fix does not stay on screen.

    While the receiver has no position, the last one is repeated with fix type NO_FIX, as autopilots
    do: 0, 0 is a valid position.

    The receiver reports only the position's DOP, whose square is the sum of the squares of HDOP and
    VDOP; it is divided in proportion to the accuracies. An unknown extension field is 0.
    """
    fix, located = newest.fix, newest.located_fix
    if fix is None or not newest.health.is_alive(GPS, now_us):
        return mavlink.MAVLink_gps_raw_int_message(
            time_usec=now_us,
            fix_type=mavlink.GPS_FIX_TYPE_NO_GPS,
            lat=0 if located is None else located.lat_dege7,
            lon=0 if located is None else located.lon_dege7,
            alt=0 if located is None else encoding.int32(located.alt_amsl_m * MM),
            **dict.fromkeys(("eph", "epv", "vel", "cog"), encoding.UINT16_MAX),
            satellites_visible=encoding.UINT8_MAX,
        )
    north, east, _ = fix.vel_n_mps
    speed, is_good = math.hypot(north, east), is_3d(fix)
    moving = is_good and speed >= MIN_COURSE_SPEED_MPS
    accuracy_m = math.hypot(fix.h_acc_m, fix.v_acc_m)
    per_m = fix.pdop * CENTI / accuracy_m if is_good and accuracy_m > 0.0 else NAN
    position = fix if located is None or is_located(fix) else located
    return mavlink.MAVLink_gps_raw_int_message(
        time_usec=fix.time_us,
        fix_type=FIX_TYPES[fix.fix_type] if fix.fix_ok else mavlink.GPS_FIX_TYPE_NO_FIX,
        lat=position.lat_dege7,
        lon=position.lon_dege7,
        alt=encoding.int32(position.alt_amsl_m * MM),
        eph=encoding.uint16(fix.h_acc_m * per_m),
        epv=encoding.uint16(fix.v_acc_m * per_m),
        vel=encoding.uint16(speed * CM) if is_good else encoding.UINT16_MAX,
        cog=encoding.compass_cdeg(math.atan2(east, north)) if moving else encoding.UINT16_MAX,
        satellites_visible=encoding.uint8(fix.satellites),
        alt_ellipsoid=encoding.int32(position.alt_ellipsoid_m * MM),
        h_acc=encoding.uint32(fix.h_acc_m * MM),
        v_acc=encoding.uint32(fix.v_acc_m * MM),
        vel_acc=encoding.uint32(fix.speed_acc_mps * MM),
        hdg_acc=encoding.uint32(fix.course_acc_deg * DEGE5),
    )


def estimator_status(newest: Newest, _now_us: int) -> Any:
    """Encode which states our own estimator considers valid; it computes no test ratios."""
    state = newest.state
    if state is None or newest.sample is None:
        return None
    flags = 0
    for ours, theirs in ESTIMATOR_FLAGS:
        if state.flags & ours:
            flags |= theirs
    if not state.flags & (NavFlags.POSITION_VALID | NavFlags.DEAD_RECKONING):
        flags |= mavlink.ESTIMATOR_CONST_POS_MODE
    north, east, down = state.pos_std_m
    return mavlink.MAVLink_estimator_status_message(
        state.time_us, flags, *[NAN] * 6, math.hypot(north, east), down
    )


def home_position(newest: Newest, _now_us: int) -> Any:
    """Encode home; its local position, the slope and the approach are unknown."""
    if (home := newest.home) is None:
        return None
    unknown = (0.0, 0.0, 0.0, (NAN, NAN, NAN, NAN), *UNKNOWN_VEC3)
    return mavlink.MAVLink_home_position_message(
        *_coordinates(home.location), *unknown, home.set_time_us
    )


def system_time(newest: Newest, now_us: int) -> Any:
    """Encode the clocks; the Unix time is 0 until a GPS fix provides it."""
    offset_us = newest.unix_offset_us
    unix_us = 0 if offset_us is None else now_us + offset_us
    return mavlink.MAVLink_system_time_message(unix_us, boot_ms(now_us))


def high_latency2(newest: Newest, now_us: int) -> Any:
    """Encode the state of the vehicle in 42 bytes.

    Latitude, longitude and altitude have no value for unknown in this message, which is the only
    one on its link, so it is also sent before the first fix: as in PX4, with 0, 0, errors of
    UINT8_MAX and the GPS failure flag. Wind, airspeed and throttle are not measured.
    """
    state, fix, health = newest.state, newest.fix, newest.health
    failures = sum(flag for sensor, flag in FAILURES if not health.is_alive(sensor, now_us))
    h_acc_m = v_acc_m = NAN
    if fix is None or not is_3d(fix):
        failures |= mavlink.HL_FAILURE_FLAG_GPS
    elif health.is_alive(GPS, now_us):
        h_acc_m, v_acc_m = fix.h_acc_m, fix.v_acc_m
    lat, lon, _ = _coordinates(state) if state is not None and has_position(state) else (0, 0, 0)
    north, east, down = state.vel_n_mps if state is not None else (NAN, NAN, NAN)
    yaw_deg = math.degrees(to_euler(state.q_nb)[2]) if state is not None else NAN
    speed = encoding.uint8(math.hypot(north, east) * FIFTHS, unknown=0)
    return mavlink.MAVLink_high_latency2_message(
        timestamp=boot_ms(now_us),
        type=newest.vehicle_type,
        autopilot=newest.autopilot,
        # The upper half of the mode, as PX4 sends it.
        custom_mode=AUTOPILOTS[newest.settings.autopilot][1] >> 16,
        latitude=lat,
        longitude=lon,
        altitude=encoding.int16(state.alt_amsl_m) if state is not None else 0,
        heading=encoding.uint8(yaw_deg % 360.0 / HALF_DEGREES, unknown=0),
        airspeed=speed,
        groundspeed=speed,
        eph=encoding.uint8(h_acc_m * TENTHS),
        epv=encoding.uint8(v_acc_m * TENTHS),
        climb_rate=encoding.whole(-down * TENTHS, -INT8_MAX, INT8_MAX, 0),
        battery=UNKNOWN_PERCENT,
        failure_flags=failures,
        **UNMEASURED,
    )


def software_version(version: str) -> int:
    """Pack major, minor and patch into the upper three bytes, and the type into the lowest one."""
    parts = [int(part) if part.isdigit() else 0 for part in version.split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    kind: int = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
    return major << 24 | minor << 16 | patch << 8 | kind


def autopilot_version(newest: Newest, _now_us: int) -> Any:
    """Encode AUTOPILOT_VERSION; the uid is different for each vehicle of one gateway.

    The version of the nodes' firmware is in the field of the operating system's version. All
    parameters are floats, so that they have the same bytes in both encodings of integers; clients
    of ArduPilot expect the C cast.
    """
    nothing = [0] * 8
    encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    if newest.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        encoding = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=CAPABILITIES | encoding,
        flight_sw_version=software_version(__version__),
        middleware_sw_version=0,
        os_sw_version=newest.health.firmware,
        board_version=0,
        flight_custom_version=nothing,
        middleware_custom_version=nothing,
        os_custom_version=nothing,
        vendor_id=0,
        product_id=0,
        uid=UID_PREFIX << 8 | newest.health.vehicle_id,
    )


def protocol_version(*_: Any) -> Any:
    """Encode PROTOCOL_VERSION: both versions are read, version 2 is sent."""
    return PROTOCOL_VERSION(200, 100, 200, *[0] * 16)


def available_modes(newest: Newest, _now_us: int) -> Any:
    """Encode AVAILABLE_MODES: the one mode that a tracker has, or that is reported."""
    number, name = newest.mode
    return mavlink.MAVLink_available_modes_message(
        number_modes=1,
        mode_index=1,
        standard_mode=mavlink.MAV_STANDARD_MODE_NON_STANDARD,
        custom_mode=number,
        properties=mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE,
        mode_name=name.encode()[:MAX_MODE_NAME],
    )


def current_mode(newest: Newest, _now_us: int) -> Any:
    """Encode CURRENT_MODE."""
    return mavlink.MAVLink_current_mode_message(
        mavlink.MAV_STANDARD_MODE_NON_STANDARD, newest.mode[0], intended_custom_mode=0
    )


BUILDERS: Final[dict[int, Builder]] = {
    mavlink_messages.MESSAGE_IDS[build.__name__.upper()]: build
    for build in (
        *(attitude_quaternion, attitude, global_position_int, vfr_hud, highres_imu),
        *(local_position_ned, odometry, altitude, scaled_imu, raw_imu, gps_global_origin),
        *(scaled_pressure, gps_raw_int, estimator_status, home_position, system_time),
        *(high_latency2, autopilot_version, protocol_version, available_modes, current_mode),
    )
}
"""Builders by message."""
