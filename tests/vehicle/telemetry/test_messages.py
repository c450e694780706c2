"""Each message, decoded by pymavlink, against the units and signs of the definition."""

import math
from itertools import product
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

NAN = math.nan
FIELD = (20.0, -5.0, 43.0)
NO_FIELD = (NAN,) * 3
ORIGIN = Location(47.123_456_7, -8.765_432_1 - 0.001, 500.0)
UPDATED = messages.ACCEL_UPDATED | messages.GYRO_UPDATED | messages.MAG_UPDATED


def through_the_wire(message: Any) -> Any:
    [found] = decode([Encoder(1).encode(message)])
    return found


def named(names: str, values: Any) -> dict[str, Any]:
    """Return the values of fields, whose names are parted by spaces."""
    return dict(zip(names.split(), values, strict=True))


SEARCHING = replace(
    FIX, fix_type=GpsFixType.NONE, fix_ok=False, h_acc_m=4_294_967.295, v_acc_m=3_750_000.0
)
"""A u-blox receiver before its first fix."""


def summary(
    state: NavState | None, fix: GpsFix | None, now_us: int = 1_500_000, *, inertial: bool = True
) -> Any:
    """Return HIGH_LATENCY2 of an aircraft that has just sent a fix, and samples if it has any."""
    health = Health(1, 2.0)
    if inertial:
        health.on_state(STATE, SAMPLE)
        health.on_baro(BARO)
    if fix is not None:
        health.on_gps(fix)
    return messages.high_latency2(mavlink.MAV_TYPE_FIXED_WING, 0, state, fix, health, now_us)


SENSOR_FAILURES = (
    mavlink.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE
    | mavlink.HL_FAILURE_FLAG_3D_ACCEL
    | mavlink.HL_FAILURE_FLAG_3D_GYRO
    | mavlink.HL_FAILURE_FLAG_3D_MAG
    | mavlink.HL_FAILURE_FLAG_GPS
)
VALUES = {
    "attitude-quaternion": (
        messages.attitude_quaternion(STATE),
        named("q1 q2 q3 q4 rollspeed pitchspeed yawspeed", (*STATE.q_nb, *STATE.rate_b_radps))
        | {"time_boot_ms": 1000, "repr_offset_q": [0.0] * 4},
    ),
    # In radians, nose up positive.
    "attitude": (
        messages.attitude(STATE),
        named("roll pitch yaw yawspeed", (0.1, -0.2, math.radians(-88.5), -0.03)),
    ),
    "global-position": (
        messages.global_position_int(STATE, 500.0),
        named("lat lon alt relative_alt", (471_234_567, -87_654_321, 523_456, 23_456))
        | named("vx vy vz hdg", (300, -400, -125, 27_150)),
    ),
    "global-position-without-heading": (
        messages.global_position_int(
            replace(STATE, flags=STATE.flags & ~NavFlags.HEADING_VALID), 500.0
        ),
        {"hdg": 65535},
    ),
    "global-position-saturated": (
        messages.global_position_int(
            replace(STATE, vel_n_mps=(1e6, -1e6, NAN), alt_amsl_m=1e9), -1e9
        ),
        named("vx vy vz alt relative_alt", (32767, -32768, 0, 2**31 - 1, 2**31 - 1)),
    ),
    # Without a sensor the airspeed is the ground speed, as ArduPilot sends it.
    "vfr-hud": (
        messages.vfr_hud(STATE),
        named("groundspeed airspeed climb alt throttle", (5.0, 5.0, 1.25, 523.456, 0)),
    ),
    "vfr-hud-unknown": (
        messages.vfr_hud(NOTHING), named("airspeed groundspeed alt climb", (NAN,) * 4),
    ),
    "highres-imu": (
        messages.highres_imu(SAMPLE, FIELD, BARO, UPDATED),
        named("xacc yacc zacc", SAMPLE.accel_b_mps2)
        | named("xgyro ygyro zgyro", SAMPLE.gyro_b_radps)
        | named("xmag ymag zmag", (0.2, -0.05, 0.43))
        | named("abs_pressure pressure_alt temperature", (951.23, 529.5, 31.5))
        | {"time_usec": 1_000_000, "diff_pressure": NAN, "fields_updated": 0b1_1111_1111},
    ),
    "highres-imu-alone": (
        messages.highres_imu(SAMPLE, NO_FIELD, None, 0),
        named("xmag ymag zmag abs_pressure pressure_alt", (NAN,) * 5),
    ),
    "scaled-pressure": (
        messages.scaled_pressure(BARO),
        named("press_abs press_diff temperature", (951.23, NAN, -1234)),
    ),
    # A PDOP of 1.6, parted as 1.25 m to 2.5 m.
    "gps-raw": (
        messages.gps_raw_int(FIX),
        named("lat lon alt alt_ellipsoid", (471_234_567, -87_654_321, 520_250, 567_750))
        | named("fix_type satellites_visible eph epv vel yaw", (3, 11, 72, 143, 500, 0))
        | {"cog": round(math.degrees(math.atan2(-4.0, 3.0)) * 100) % 36000}
        | named("h_acc v_acc vel_acc hdg_acc", (1250, 2500, 125, 150_000)),
    ),
    "gps-raw-at-rest": (
        messages.gps_raw_int(replace(FIX, vel_n_mps=(0.1, 0.1, 0.0))), {"vel": 14, "cog": 65535},
    ),
    "gps-raw-without-accuracies": (
        messages.gps_raw_int(
            replace(
                NO_FIX, alt_ellipsoid_m=NAN, h_acc_m=NAN, v_acc_m=NAN, speed_acc_mps=NAN,
                course_acc_deg=NAN,
            )
        ),
        named("h_acc v_acc vel_acc hdg_acc alt_ellipsoid vel cog", (*(0,) * 5, 65535, 65535)),
    ),
    # The type of an invalid fix is not reported.
    **{
        f"fix-type-{kind.name}-{fix_ok}": (
            messages.gps_raw_int(replace(FIX, fix_type=kind, fix_ok=fix_ok)),
            {"fix_type": getattr(mavlink, f"GPS_FIX_TYPE_{reported}")},
        )
        for kind, fix_ok, reported in (
            (GpsFixType.NONE, False, "NO_FIX"), (GpsFixType.DEAD_RECKONING, True, "NO_FIX"),
            (GpsFixType.FIX_2D, True, "2D_FIX"), (GpsFixType.FIX_3D, True, "3D_FIX"),
            (GpsFixType.FIX_3D, False, "NO_FIX"), (GpsFixType.TIME_ONLY, True, "NO_FIX"),
            (GpsFixType.GNSS_AND_DEAD_RECKONING, True, "3D_FIX"),
        )
    },
    # The last position is repeated without a fix.
    "gps-raw-without-fix": (
        messages.gps_raw_int(replace(NO_FIX, lat_dege7=0, lon_dege7=0), FIX),
        named("fix_type lat lon alt", (1, 471_234_567, -87_654_321, 520_250)),
    ),
    "gps-raw-with-fix": (messages.gps_raw_int(replace(FIX, lat_dege7=5), FIX), {"lat": 5}),
    "gps-absent": (
        messages.gps_absent(5_000_000, FIX),
        named("fix_type lat lon alt", (0, 471_234_567, -87_654_321, 520_250)),
    ),
    "gps-never": (
        messages.gps_absent(5_000_000),
        named("fix_type satellites_visible eph vel cog", (0, 255, 65535, 65535, 65535)),
    ),
    **{
        f"imu-in-thousandths-{build.__name__}": (
            build(SAMPLE, FIELD),
            named("xacc yacc zacc xgyro ygyro zgyro", (51, -25, -994, 500, 250, -125))
            | named("xmag ymag zmag temperature", (200, -50, 430, 3150)),
        )
        for build in (messages.raw_imu, messages.scaled_imu)
    },
    # A temperature of 0 means unknown.
    "imu-at-0-degrees": (
        messages.raw_imu(replace(SAMPLE, temperature_degc=0.0), NO_FIELD),
        {"temperature": 1, "xmag": 0},
    ),
    "altitude": (
        messages.altitude(STATE, BARO, 510.0, ORIGIN),
        named(
            "altitude_monotonic altitude_amsl altitude_relative altitude_local",
            (BARO.alt_pressure_m, 523.456, 13.456, 23.456),
        ),
    ),
    "estimator-status": (
        messages.estimator_status(STATE),
        named("pos_horiz_accuracy pos_vert_accuracy vel_ratio", (1.0, 2.0, NAN))
        | {
            "flags": mavlink.ESTIMATOR_ATTITUDE
            | mavlink.ESTIMATOR_VELOCITY_HORIZ
            | mavlink.ESTIMATOR_VELOCITY_VERT
            | mavlink.ESTIMATOR_POS_HORIZ_REL
            | mavlink.ESTIMATOR_POS_HORIZ_ABS
            | mavlink.ESTIMATOR_POS_VERT_ABS
            | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
            | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
        },
    ),
    "estimator-status-unknown": (
        messages.estimator_status(NOTHING), {"flags": mavlink.ESTIMATOR_CONST_POS_MODE},
    ),
    "estimator-status-rejected": (
        messages.estimator_status(
            replace(NOTHING, flags=NavFlags.GPS_REJECTED | NavFlags.DEAD_RECKONING)
        ),
        {"flags": mavlink.ESTIMATOR_GPS_GLITCH},
    ),
    "home-position": (
        messages.home_position(Home(Location(47.5, -8.25, 432.1), 7_000_000)),
        named("latitude longitude altitude", (475_000_000, -82_500_000, 432_100))
        | named("x y z approach_x approach_z", (0.0, 0.0, 0.0, NAN, NAN))
        | {"q": [NAN] * 4, "time_usec": 7_000_000},
    ),
    "system-time-unknown": (messages.system_time(2_000_000, None), {"time_unix_usec": 0}),
    "system-time": (
        messages.system_time(2_000_000, 1_790_000_000_123_456),
        {"time_unix_usec": 1_790_000_000_123_456, "time_boot_ms": 2000},
    ),
    # In steps of 0.2 m/s for the speed, and 0.1 m or m/s for the others.
    "high-latency": (
        summary(STATE, FIX),
        named("latitude longitude altitude heading", (471_234_567, -87_654_321, 523, 272 // 2))
        | named("groundspeed climb_rate eph epv", (25, 12, 12, 25))
        | named("timestamp battery failure_flags", (1500, -1, 0)),
    ),
    **{
        f"high-latency-before-a-fix-{number}": (
            summary(state, fix, inertial=False),
            named("latitude longitude groundspeed eph epv", (0, 0, 0, 255, 255))
            | {"failure_flags": SENSOR_FAILURES},
        )
        for number, (state, fix) in enumerate(
            product((None, NOTHING), (None, SEARCHING, replace(FIX, fix_ok=False)))
        )
    },
    "high-latency-by-barometer": (
        summary(replace(NOTHING, alt_amsl_m=523.456), SEARCHING),
        named("latitude longitude altitude", (0, 0, 523)),
    ),
    "high-latency-lost": (
        summary(STATE, FIX, FIX.time_us + 60_000_000),
        named("latitude longitude eph epv", (471_234_567, -87_654_321, 255, 255))
        | {"failure_flags": SENSOR_FAILURES},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_fields_have_the_units_and_signs_of_the_definition(name: str) -> None:
    message, expected = VALUES[name]
    found = through_the_wire(message)
    for field, value in expected.items():
        close = pytest.approx(value, rel=1e-6, nan_ok=True)
        assert getattr(found, field) == (value if isinstance(value, int) else close), field


def test_heading_of_vfr_hud_is_in_whole_degrees() -> None:
    # Half way between two degrees: the float may fall on either side.
    assert through_the_wire(messages.vfr_hud(STATE)).heading in (271, 272)
    assert not messages.has_position(NOTHING)


@pytest.mark.parametrize(
    "change", [{"pdop": NAN}, {"h_acc_m": NAN}, {"h_acc_m": 0.0, "v_acc_m": 0.0}, {"fix_ok": False}]
)
def test_dilutions_are_unknown_without_a_fix_or_its_accuracy(change: dict[str, Any]) -> None:
    found = through_the_wire(messages.gps_raw_int(replace(FIX, **change)))
    assert (found.eph, found.epv) == (65535, 65535)


def test_local_position_is_north_east_down_of_the_origin() -> None:
    found = through_the_wire(messages.local_position_ned(STATE, ORIGIN))
    assert (found.x, found.y, found.z) == pytest.approx((0.0, 75.9, -23.456), abs=0.1)
    assert (found.vx, found.vy, found.vz) == STATE.vel_n_mps
    north = replace(STATE, lat_deg=STATE.lat_deg + 0.01, lon_deg=ORIGIN.lon_deg)
    assert messages.local_position_m(north, ORIGIN)[:2] == pytest.approx((1111.8, 0.0), abs=0.2)
    found = through_the_wire(messages.altitude(STATE, BARO, 510.0, ORIGIN))
    assert (found.altitude_terrain < -1000, found.bottom_clearance < 0) == (True, True)


def test_odometry_has_the_velocity_in_the_body_frame_and_its_variances() -> None:
    level_east = replace(
        STATE,
        q_nb=from_euler(0.0, 0.0, math.pi / 2),
        vel_n_mps=(0.0, 5.0, 0.0),
        vel_std_mps=(0.1, 0.2, 0.3),
        attitude_std_rad=(0.01, 0.02, 0.05),
    )
    found = through_the_wire(messages.odometry(level_east, ORIGIN))
    frames = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    assert (found.frame_id, found.child_frame_id) == frames
    assert (found.vx, found.vy, found.vz) == pytest.approx((5.0, 0.0, 0.0), abs=1e-6)
    assert found.q == pytest.approx(level_east.q_nb)
    diagonal = [found.pose_covariance[n] for n in (0, 6, 11, 15, 18, 20)]
    assert diagonal == pytest.approx([0.36, 0.64, 4.0, 4e-4, 1e-4, 25e-4])
    assert [found.velocity_covariance[n] for n in (0, 6, 11)] == pytest.approx([0.04, 0.01, 0.09])
    assert math.isnan(found.velocity_covariance[15])


def test_boot_time_wraps_after_49_days() -> None:
    assert messages.boot_ms(2**32 * 1000 + 5_000) == 5


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e30, -1e30])
def test_extreme_values_of_high_latency2_are_saturated(value: float) -> None:
    wild = replace(STATE, lat_deg=value, alt_amsl_m=value, vel_n_mps=(value, value, value))
    found = through_the_wire(summary(wild, replace(FIX, h_acc_m=abs(value))))
    assert (found.groundspeed, found.eph) == (255, 254)
    ends = (32767, -127) if value > 0.0 else (-32768, 127)
    assert (found.altitude, found.climb_rate) == ends


def test_high_latency2_is_sent_every_five_seconds(station: GroundStation) -> None:
    assert 11 <= kinds(station.wait(60.0)).count("HIGH_LATENCY2") <= 13
