"""Each message, decoded by pymavlink, against the units and signs of the definition."""

import math
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.records import GpsFix, GpsFixType, NavFlags, NavState
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.plan import Home, Location
from gateway.vehicle.telemetry import messages
from gateway.vehicle.telemetry.health import Health
from tests.kit.ground_station import GroundStation, decode, kinds
from tests.kit.records import BARO, FIX, NO_FIX, NOTHING, SAMPLE, STATE


def through_the_wire(message: Any) -> Any:
    [found] = decode([Encoder(1).encode(message)])
    return found


def test_attitude_quaternion() -> None:
    found = through_the_wire(messages.attitude_quaternion(STATE))
    assert found.time_boot_ms == 1000
    assert (found.q1, found.q2, found.q3, found.q4) == pytest.approx(STATE.q_nb, abs=1e-7)
    rates = (found.rollspeed, found.pitchspeed, found.yawspeed)
    assert rates == pytest.approx(STATE.rate_b_radps)
    assert found.repr_offset_q == [0.0, 0.0, 0.0, 0.0]


def test_attitude_is_in_radians_with_the_nose_up_positive() -> None:
    found = through_the_wire(messages.attitude(STATE))
    angles = (found.roll, found.pitch, found.yaw)
    assert angles == pytest.approx((0.1, -0.2, math.radians(-88.5)), abs=1e-6)
    assert found.yawspeed == pytest.approx(-0.03)


def test_global_position_int() -> None:
    found = through_the_wire(messages.global_position_int(STATE, 500.0))
    assert (found.lat, found.lon) == (471_234_567, -87_654_321)
    assert (found.alt, found.relative_alt) == (523_456, 23_456)
    assert (found.vx, found.vy, found.vz) == (300, -400, -125)
    assert found.hdg == 27_150


def test_global_position_int_without_heading() -> None:
    state = replace(STATE, flags=STATE.flags & ~NavFlags.HEADING_VALID)
    assert through_the_wire(messages.global_position_int(state, 500.0)).hdg == 65535


def test_global_position_int_saturates() -> None:
    state = replace(STATE, vel_n_mps=(1e6, -1e6, math.nan), alt_amsl_m=1e9)
    found = through_the_wire(messages.global_position_int(state, -1e9))
    assert (found.vx, found.vy, found.vz) == (32767, -32768, 0)
    assert found.alt == found.relative_alt == 2**31 - 1


def test_vfr_hud() -> None:
    found = through_the_wire(messages.vfr_hud(STATE))
    assert found.groundspeed == pytest.approx(5.0)
    assert found.climb == pytest.approx(1.25)
    assert found.alt == pytest.approx(523.456, abs=1e-3)
    # Half way between two degrees: the float may fall on either side.
    assert found.heading in (271, 272)
    assert found.throttle == 0
    assert found.airspeed == found.groundspeed, "no sensor: as ArduPilot does without one"


def test_vfr_hud_of_nothing_is_unknown() -> None:
    found = through_the_wire(messages.vfr_hud(NOTHING))
    assert all(math.isnan(v) for v in (found.airspeed, found.groundspeed, found.alt, found.climb))


def test_highres_imu() -> None:
    updated = messages.ACCEL_UPDATED | messages.GYRO_UPDATED | messages.MAG_UPDATED
    found = through_the_wire(messages.highres_imu(SAMPLE, (20.0, -5.0, 43.0), BARO, updated))
    assert found.time_usec == 1_000_000
    assert (found.xacc, found.yacc, found.zacc) == SAMPLE.accel_b_mps2
    assert (found.xgyro, found.ygyro, found.zgyro) == SAMPLE.gyro_b_radps
    assert (found.xmag, found.ymag, found.zmag) == pytest.approx((0.2, -0.05, 0.43))
    assert found.abs_pressure == pytest.approx(951.23)
    assert found.pressure_alt == pytest.approx(529.5)
    assert found.temperature == pytest.approx(31.5)
    assert math.isnan(found.diff_pressure)
    assert found.fields_updated == 0b1_1111_1111


def test_highres_imu_without_magnetometer_and_barometer() -> None:
    found = through_the_wire(messages.highres_imu(SAMPLE, (math.nan,) * 3, None, 0))
    unknown = (found.xmag, found.ymag, found.zmag, found.abs_pressure, found.pressure_alt)
    assert all(math.isnan(value) for value in unknown)


def test_scaled_pressure() -> None:
    found = through_the_wire(messages.scaled_pressure(BARO))
    assert found.press_abs == pytest.approx(951.23)
    assert math.isnan(found.press_diff)
    assert found.temperature == -1234


@pytest.mark.parametrize(
    "change",
    [
        {"pdop": math.nan},
        {"h_acc_m": math.nan},
        {"h_acc_m": 0.0, "v_acc_m": 0.0},
        {"fix_ok": False},
    ],
)
def test_dilutions_that_are_not_known(change: dict[str, Any]) -> None:
    found = through_the_wire(messages.gps_raw_int(replace(FIX, **change)))
    assert (found.eph, found.epv) == (65535, 65535)


def test_gps_raw_int() -> None:
    found = through_the_wire(messages.gps_raw_int(FIX))
    assert found.fix_type == mavlink.GPS_FIX_TYPE_3D_FIX
    assert (found.lat, found.lon, found.alt) == (471_234_567, -87_654_321, 520_250)
    assert found.alt_ellipsoid == 567_750
    # A PDOP of 1.6, parted as 1.25 m to 2.5 m.
    assert (found.eph, found.epv) == (72, 143)
    assert math.hypot(found.eph, found.epv) == pytest.approx(160, abs=1)
    assert found.vel == 500
    assert found.cog == round(math.degrees(math.atan2(-4.0, 3.0)) * 100) % 36000
    assert found.satellites_visible == 11
    assert (found.h_acc, found.v_acc, found.vel_acc) == (1250, 2500, 125)
    assert found.hdg_acc == 150_000
    assert found.yaw == 0


def test_gps_raw_int_at_rest_has_no_course() -> None:
    found = through_the_wire(messages.gps_raw_int(replace(FIX, vel_n_mps=(0.1, 0.1, 0.0))))
    assert (found.vel, found.cog) == (14, 65535)


@pytest.mark.parametrize(
    ("fix_type", "fix_ok", "expected"),
    [
        (GpsFixType.NONE, False, mavlink.GPS_FIX_TYPE_NO_FIX),
        (GpsFixType.DEAD_RECKONING, True, mavlink.GPS_FIX_TYPE_NO_FIX),
        (GpsFixType.FIX_2D, True, mavlink.GPS_FIX_TYPE_2D_FIX),
        (GpsFixType.FIX_3D, True, mavlink.GPS_FIX_TYPE_3D_FIX),
        (GpsFixType.FIX_3D, False, mavlink.GPS_FIX_TYPE_NO_FIX),
        (GpsFixType.GNSS_AND_DEAD_RECKONING, True, mavlink.GPS_FIX_TYPE_3D_FIX),
        (GpsFixType.TIME_ONLY, True, mavlink.GPS_FIX_TYPE_NO_FIX),
    ],
)
def test_fix_types(fix_type: GpsFixType, fix_ok: bool, expected: int) -> None:
    fix = replace(FIX, fix_type=fix_type, fix_ok=fix_ok)
    assert through_the_wire(messages.gps_raw_int(fix)).fix_type == expected


ORIGIN = Location(47.123_456_7, -8.765_432_1 - 0.001, 500.0)


def test_local_position_is_north_east_down_of_the_origin() -> None:
    found = through_the_wire(messages.local_position_ned(STATE, ORIGIN))
    assert (found.x, found.y, found.z) == pytest.approx((0.0, 75.9, -23.456), abs=0.1)
    assert (found.vx, found.vy, found.vz) == STATE.vel_n_mps
    north = replace(STATE, lat_deg=STATE.lat_deg + 0.01, lon_deg=ORIGIN.lon_deg)
    assert messages.local_position_m(north, ORIGIN)[:2] == pytest.approx((1111.8, 0.0), abs=0.2)


def test_odometry_has_the_velocity_in_the_body_frame_and_its_variances() -> None:
    level_east = replace(
        STATE,
        q_nb=from_euler(0.0, 0.0, math.pi / 2),
        vel_n_mps=(0.0, 5.0, 0.0),
        vel_std_mps=(0.1, 0.2, 0.3),
        attitude_std_rad=(0.01, 0.02, 0.05),
    )
    found = through_the_wire(messages.odometry(level_east, ORIGIN))
    assert (found.frame_id, found.child_frame_id) == (
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
    )
    assert (found.vx, found.vy, found.vz) == pytest.approx((5.0, 0.0, 0.0), abs=1e-6)
    assert found.q == pytest.approx(level_east.q_nb)
    diagonal = [found.pose_covariance[n] for n in (0, 6, 11, 15, 18, 20)]
    assert diagonal == pytest.approx([0.36, 0.64, 4.0, 4e-4, 1e-4, 25e-4])
    assert [found.velocity_covariance[n] for n in (0, 6, 11)] == pytest.approx([0.04, 0.01, 0.09])
    assert math.isnan(found.velocity_covariance[15])


def test_altitude_is_relative_to_home_and_local_to_the_origin() -> None:
    found = through_the_wire(messages.altitude(STATE, BARO, 510.0, ORIGIN))
    assert found.altitude_monotonic == BARO.alt_pressure_m
    heights = (found.altitude_amsl, found.altitude_relative, found.altitude_local)
    assert heights == pytest.approx((523.456, 13.456, 23.456), abs=1e-3)
    assert (found.altitude_terrain < -1000, found.bottom_clearance < 0) == (True, True)


@pytest.mark.parametrize("build", [messages.raw_imu, messages.scaled_imu])
def test_imu_in_thousandths(build: Any) -> None:
    found = through_the_wire(build(SAMPLE, (20.0, -5.0, 43.0)))
    assert (found.xacc, found.yacc, found.zacc) == (51, -25, -994)
    assert (found.xgyro, found.ygyro, found.zgyro) == (500, 250, -125)
    assert (found.xmag, found.ymag, found.zmag) == (200, -50, 430)
    assert found.temperature == 3150
    cold = through_the_wire(build(replace(SAMPLE, temperature_degc=0.0), (math.nan,) * 3))
    assert (cold.temperature, cold.xmag) == (1, 0)


def test_gps_raw_int_with_unknown_accuracies() -> None:
    nan = math.nan
    fix = replace(
        NO_FIX, alt_ellipsoid_m=nan, h_acc_m=nan, v_acc_m=nan, speed_acc_mps=nan, course_acc_deg=nan
    )
    found = through_the_wire(messages.gps_raw_int(fix))
    assert (found.h_acc, found.v_acc, found.vel_acc, found.hdg_acc, found.alt_ellipsoid) == (0,) * 5
    assert (found.vel, found.cog) == (65535, 65535)


def test_last_position_is_repeated_without_a_fix() -> None:
    for message, fix_type in (
        (messages.gps_raw_int(replace(NO_FIX, lat_dege7=0, lon_dege7=0), FIX), 1),
        (messages.gps_absent(5_000_000, FIX), 0),
    ):
        found = through_the_wire(message)
        assert (found.fix_type, found.lat, found.lon) == (fix_type, 471_234_567, -87_654_321)
        assert found.alt == 520_250
    assert through_the_wire(messages.gps_raw_int(replace(FIX, lat_dege7=5), FIX)).lat == 5


def test_gps_absent() -> None:
    found = through_the_wire(messages.gps_absent(5_000_000))
    assert found.fix_type == mavlink.GPS_FIX_TYPE_NO_GPS
    assert found.satellites_visible == 255
    assert (found.eph, found.vel, found.cog) == (65535,) * 3


def test_estimator_status() -> None:
    found = through_the_wire(messages.estimator_status(STATE))
    assert found.flags == (
        mavlink.ESTIMATOR_ATTITUDE
        | mavlink.ESTIMATOR_VELOCITY_HORIZ
        | mavlink.ESTIMATOR_VELOCITY_VERT
        | mavlink.ESTIMATOR_POS_HORIZ_REL
        | mavlink.ESTIMATOR_POS_HORIZ_ABS
        | mavlink.ESTIMATOR_POS_VERT_ABS
        | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
        | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
    )
    assert found.pos_horiz_accuracy == pytest.approx(1.0)
    assert found.pos_vert_accuracy == pytest.approx(2.0)
    assert math.isnan(found.vel_ratio)


def test_estimator_status_of_nothing() -> None:
    found = through_the_wire(messages.estimator_status(NOTHING))
    assert found.flags == mavlink.ESTIMATOR_CONST_POS_MODE
    rejected = replace(NOTHING, flags=NavFlags.GPS_REJECTED | NavFlags.DEAD_RECKONING)
    assert messages.estimator_status(rejected).flags == mavlink.ESTIMATOR_GPS_GLITCH


def test_home_position() -> None:
    home = Home(Location(47.5, -8.25, 432.1), 7_000_000)
    found = through_the_wire(messages.home_position(home))
    assert (found.latitude, found.longitude, found.altitude) == (475_000_000, -82_500_000, 432_100)
    assert (found.x, found.y, found.z) == (0.0, 0.0, 0.0)
    assert all(math.isnan(v) for v in (*found.q, found.approach_x, found.approach_z))
    assert found.time_usec == 7_000_000


def test_system_time() -> None:
    assert through_the_wire(messages.system_time(2_000_000, None)).time_unix_usec == 0
    found = through_the_wire(messages.system_time(2_000_000, 1_790_000_000_123_456))
    assert (found.time_unix_usec, found.time_boot_ms) == (1_790_000_000_123_456, 2000)


def test_boot_time_wraps_after_49_days() -> None:
    assert messages.boot_ms(2**32 * 1000 + 5_000) == 5


@pytest.fixture
def well() -> Health:
    health = Health(1, 2.0)
    health.on_state(STATE, SAMPLE)
    health.on_baro(BARO)
    health.on_gps(FIX)
    return health


def summary(
    state: NavState | None, fix: GpsFix | None, health: Health, now_us: int = 1_500_000
) -> Any:
    kind = mavlink.MAV_TYPE_FIXED_WING
    return through_the_wire(messages.high_latency2(kind, 0, state, fix, health, now_us))


def test_high_latency2(well: Health) -> None:
    message = summary(STATE, FIX, well)
    assert (message.latitude, message.longitude) == (471_234_567, -87_654_321)
    assert (message.altitude, message.heading * 2) == (523, 272)
    assert message.groundspeed / 5 == 5.0
    assert message.climb_rate / 10 == pytest.approx(1.25, abs=0.06)
    assert message.eph == round(FIX.h_acc_m * 10)
    assert (message.timestamp, message.battery) == (1500, -1)
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_3D_GYRO == 0


SEARCHING = replace(
    FIX, fix_type=GpsFixType.NONE, fix_ok=False, h_acc_m=4_294_967.295, v_acc_m=3_750_000.0
)
"""A u-blox receiver before its first fix."""


@pytest.mark.parametrize("state", [None, NOTHING])
@pytest.mark.parametrize("fix", [None, SEARCHING, replace(FIX, fix_ok=False)])
def test_no_position_is_reported_before_the_first_fix(
    state: NavState | None, fix: GpsFix | None
) -> None:
    health = Health(1, 2.0)
    if fix is not None:
        health.on_gps(fix)
    message = summary(state, fix, health)
    assert (message.latitude, message.longitude, message.groundspeed) == (0, 0, 0)
    assert (message.eph, message.epv) == (255, 255)
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_GPS
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_3D_ACCEL


def test_barometric_altitude_is_reported_before_the_first_fix(well: Health) -> None:
    message = summary(replace(NOTHING, alt_amsl_m=523.456), SEARCHING, well)
    assert (message.latitude, message.longitude, message.altitude) == (0, 0, 523)


def test_accuracy_is_unknown_after_the_gps_receiver_is_lost(well: Health) -> None:
    message = summary(STATE, FIX, well, now_us=FIX.time_us + 60_000_000)
    assert (message.latitude, message.longitude) == (471_234_567, -87_654_321)
    assert (message.eph, message.epv) == (255, 255)
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_GPS


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e30, -1e30])
def test_wild_values_are_saturated(well: Health, value: float) -> None:
    wild = replace(STATE, lat_deg=value, alt_amsl_m=value, vel_n_mps=(value, value, value))
    assert summary(wild, replace(FIX, h_acc_m=abs(value)), well)


def test_high_latency2_is_sent_every_five_seconds(station: GroundStation) -> None:
    assert 11 <= kinds(station.wait(60.0)).count("HIGH_LATENCY2") <= 13
