"""Each message, decoded by pymavlink, against the units and signs of the definition."""

import math
import xml.etree.ElementTree as ET
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.records import GpsFixType, NavFlags
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.plan import Home, Location
from gateway.vehicle.telemetry import messages
from gateway.vehicle.telemetry.health import Health
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.ground_station import decode
from tests.kit.records import BARO, FIX, NO_FIX, NOTHING, SAMPLE, STATE

NAN = math.nan
FIELD = (20.0, -5.0, 43.0)
ORIGIN = Home(Location(47.123_456_7, -8.765_432_1 - 0.001, 500.0), 0)
SEARCHING = replace(
    FIX, fix_type=GpsFixType.NONE, fix_ok=False, h_acc_m=4_294_967.295, v_acc_m=3_750_000.0
)
"""A u-blox receiver before its first fix."""
SILENT_US = 60_000_000
"""A time at which no sensor has sent anything for long."""


def newest(**known: Any) -> messages.Newest:
    """Return the newest records of an aircraft of which these are known."""
    health = Health(1, 2.0)
    found = messages.Newest(VehicleSettings(), health)
    for name, value in known.items():
        setattr(found, name, value)
    if found.sample is not None:
        health.on_state(STATE, found.sample)
        health.on_baro(BARO)
    if found.fix is not None:
        health.on_gps(found.fix)
    return found


def message(build: messages.Builder, now_us: int = 1_500_000, **known: Any) -> Any:
    """Return a message as it is received."""
    [found] = decode([Encoder(1).encode(build(newest(**known), now_us))])
    return found


def named(names: str, values: Any) -> dict[str, Any]:
    """Return the values of fields, whose names are parted by spaces."""
    return dict(zip(names.split(), values, strict=True))


SENSOR_FAILURES = (
    mavlink.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE
    | mavlink.HL_FAILURE_FLAG_3D_ACCEL
    | mavlink.HL_FAILURE_FLAG_3D_GYRO
    | mavlink.HL_FAILURE_FLAG_3D_MAG
    | mavlink.HL_FAILURE_FLAG_GPS
)
ALL_UPDATED = messages.ACCEL_UPDATED | messages.GYRO_UPDATED | messages.MAG_UPDATED
NOT_MEASURED = dict.fromkeys(
    ("alt_ellipsoid_m", "h_acc_m", "v_acc_m", "speed_acc_mps", "course_acc_deg"), NAN
)
POSITION = (471_234_567, -87_654_321, 520_250)
Case = tuple[messages.Builder, dict[str, Any], dict[str, Any]]
VALUES: dict[str, Case] = {
    "attitude-quaternion": (
        messages.attitude_quaternion, {"state": STATE},
        named("q1 q2 q3 q4 rollspeed pitchspeed yawspeed", (*STATE.q_nb, *STATE.rate_b_radps))
        | {"time_boot_ms": 1000, "repr_offset_q": [0.0] * 4},
    ),
    # In radians, nose up positive.
    "attitude": (
        messages.attitude, {"state": STATE},
        named("roll pitch yaw yawspeed", (0.1, -0.2, math.radians(-88.5), -0.03)),
    ),
    "global-position": (
        messages.global_position_int, {"state": STATE, "reference_alt_m": 500.0},
        named("lat lon alt relative_alt", (471_234_567, -87_654_321, 523_456, 23_456))
        | named("vx vy vz hdg", (300, -400, -125, 27_150)),
    ),
    "global-position-without-heading": (
        messages.global_position_int,
        {"state": replace(STATE, flags=STATE.flags & ~NavFlags.HEADING_VALID)},
        {"hdg": 65535},
    ),
    "global-position-saturated": (
        messages.global_position_int,
        {
            "state": replace(STATE, vel_n_mps=(1e6, -1e6, NAN), alt_amsl_m=1e9),
            "reference_alt_m": -1e9,
        },
        named("vx vy vz alt relative_alt", (32767, -32768, 0, 2**31 - 1, 2**31 - 1)),
    ),
    # Without a sensor the airspeed is the ground speed, as ArduPilot sends it.
    "vfr-hud": (
        messages.vfr_hud, {"state": STATE},
        named("groundspeed airspeed climb alt throttle", (5.0, 5.0, 1.25, 523.456, 0)),
    ),
    "vfr-hud-unknown": (
        messages.vfr_hud, {"state": NOTHING},
        named("airspeed groundspeed alt climb", (NAN,) * 4),
    ),
    "highres-imu": (
        messages.highres_imu,
        {"sample": SAMPLE, "mag_b_ut": FIELD, "baro": BARO, "updated": ALL_UPDATED},
        named("xacc yacc zacc", SAMPLE.accel_b_mps2)
        | named("xgyro ygyro zgyro", SAMPLE.gyro_b_radps)
        | named("xmag ymag zmag", (0.2, -0.05, 0.43))
        | named("abs_pressure pressure_alt temperature", (951.23, 529.5, 31.5))
        | {"time_usec": 1_000_000, "diff_pressure": NAN, "fields_updated": 0b1_1111_1111},
    ),
    "highres-imu-alone": (
        messages.highres_imu, {"sample": SAMPLE},
        named("xmag ymag zmag abs_pressure pressure_alt", (NAN,) * 5),
    ),
    "scaled-pressure": (
        messages.scaled_pressure, {"baro": BARO},
        named("press_abs press_diff temperature", (951.23, NAN, -1234)),
    ),
    # A PDOP of 1.6, parted as 1.25 m to 2.5 m.
    "gps-raw": (
        messages.gps_raw_int, {"fix": FIX},
        named("lat lon alt alt_ellipsoid", (*POSITION, 567_750))
        | named("fix_type satellites_visible eph epv vel yaw", (3, 11, 72, 143, 500, 0))
        | {"cog": round(math.degrees(math.atan2(-4.0, 3.0)) * 100) % 36000}
        | named("h_acc v_acc vel_acc hdg_acc", (1250, 2500, 125, 150_000)),
    ),
    "gps-raw-at-rest": (
        messages.gps_raw_int, {"fix": replace(FIX, vel_n_mps=(0.1, 0.1, 0.0))},
        {"vel": 14, "cog": 65535},
    ),
    "gps-raw-without-accuracies": (
        messages.gps_raw_int, {"fix": replace(NO_FIX, **NOT_MEASURED)},
        named("h_acc v_acc vel_acc hdg_acc alt_ellipsoid vel cog", (*(0,) * 5, 65535, 65535)),
    ),
    # The dilutions are unknown without a fix or its accuracy.
    **{
        f"gps-raw-dilution-{name}": (
            messages.gps_raw_int, {"fix": replace(FIX, **change)},
            {"eph": 65535, "epv": 65535},
        )
        for name, change in {
            "pdop": {"pdop": NAN},
            "accuracy": {"h_acc_m": NAN},
            "zero": {"h_acc_m": 0.0, "v_acc_m": 0.0},
            "fix": {"fix_ok": False},
        }.items()
    },
    # The type of an invalid fix is not reported.
    **{
        f"fix-type-{kind.name}-{fix_ok}": (
            messages.gps_raw_int, {"fix": replace(FIX, fix_type=kind, fix_ok=fix_ok)},
            {"fix_type": getattr(mavlink, f"GPS_FIX_TYPE_{reported}")},
        )
        for kind, fix_ok, reported in (
            (GpsFixType.NONE, False, "NO_FIX"),
            (GpsFixType.DEAD_RECKONING, True, "NO_FIX"),
            (GpsFixType.FIX_2D, True, "2D_FIX"),
            (GpsFixType.FIX_3D, True, "3D_FIX"),
            (GpsFixType.FIX_3D, False, "NO_FIX"),
            (GpsFixType.TIME_ONLY, True, "NO_FIX"),
            (GpsFixType.GNSS_AND_DEAD_RECKONING, True, "3D_FIX"),
        )
    },
    # The last position is repeated without a fix.
    "gps-raw-without-fix": (
        messages.gps_raw_int,
        {"fix": replace(NO_FIX, lat_dege7=0, lon_dege7=0), "located_fix": FIX},
        named("fix_type lat lon alt", (1, *POSITION)),
    ),
    "gps-raw-with-fix": (
        messages.gps_raw_int, {"fix": replace(FIX, lat_dege7=5), "located_fix": FIX},
        {"lat": 5},
    ),
    "gps-absent": (
        messages.gps_raw_int, {"located_fix": FIX},
        named("fix_type lat lon alt", (0, *POSITION)),
    ),
    "gps-never": (
        messages.gps_raw_int, {},
        named("fix_type satellites_visible eph vel cog", (0, 255, 65535, 65535, 65535)),
    ),
    **{
        f"imu-in-thousandths-{build.__name__}": (
            build, {"sample": SAMPLE, "mag_b_ut": FIELD},
            named("xacc yacc zacc xgyro ygyro zgyro", (51, -25, -994, 500, 250, -125))
            | named("xmag ymag zmag temperature", (200, -50, 430, 3150)),
        )
        for build in (messages.raw_imu, messages.scaled_imu)
    },
    # A temperature of 0 means unknown.
    "imu-at-0-degrees": (
        messages.raw_imu, {"sample": replace(SAMPLE, temperature_degc=0.0)},
        {"temperature": 1, "xmag": 0},
    ),
    "altitude": (
        messages.altitude,
        {"state": STATE, "baro": BARO, "reference_alt_m": 510.0, "origin": ORIGIN},
        named("altitude_amsl altitude_relative altitude_local", (523.456, 13.456, 23.456))
        | named("altitude_monotonic altitude_terrain bottom_clearance", (529.5, -10_000.0, -1.0)),
    ),
    "local-position": (
        messages.local_position_ned, {"state": STATE, "origin": ORIGIN},
        named("vx vy vz z", (*STATE.vel_n_mps, -23.456)),
    ),
    "estimator-status": (
        messages.estimator_status, {"state": STATE, "sample": SAMPLE},
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
        messages.estimator_status, {"state": NOTHING, "sample": SAMPLE},
        {"flags": mavlink.ESTIMATOR_CONST_POS_MODE},
    ),
    "estimator-status-rejected": (
        messages.estimator_status,
        {
            "state": replace(NOTHING, flags=NavFlags.GPS_REJECTED | NavFlags.DEAD_RECKONING),
            "sample": SAMPLE,
        },
        {"flags": mavlink.ESTIMATOR_GPS_GLITCH},
    ),
    "home-position": (
        messages.home_position, {"home": Home(Location(47.5, -8.25, 432.1), 7_000_000)},
        named("latitude longitude altitude", (475_000_000, -82_500_000, 432_100))
        | named("x y z approach_x approach_z", (0.0, 0.0, 0.0, NAN, NAN))
        | {"q": [NAN] * 4, "time_usec": 7_000_000},
    ),
    "system-time-unknown": (messages.system_time, {}, {"time_unix_usec": 0, "time_boot_ms": 1500}),
    "system-time": (
        messages.system_time, {"unix_offset_us": 1_790_000_000_123_456},
        {"time_unix_usec": 1_790_000_001_623_456},
    ),
    # In steps of 0.2 m/s for the speed, and 0.1 m or m/s for the others.
    "high-latency": (
        messages.high_latency2, {"state": STATE, "fix": FIX, "sample": SAMPLE},
        named("latitude longitude altitude heading", (471_234_567, -87_654_321, 523, 272 // 2))
        | named("groundspeed climb_rate eph epv", (25, 12, 12, 25))
        | named("timestamp battery failure_flags", (1500, -1, 0)),
    ),
    **{
        f"high-latency-before-a-fix-{state is None}-{number}": (
            messages.high_latency2, {"state": state, "fix": fix},
            named("latitude longitude groundspeed eph epv", (0, 0, 0, 255, 255))
            | {"failure_flags": SENSOR_FAILURES},
        )
        for state, (number, fix) in product(
            (None, NOTHING), enumerate((None, SEARCHING, replace(FIX, fix_ok=False)))
        )
    },
    "high-latency-by-barometer": (
        messages.high_latency2, {"state": replace(NOTHING, alt_amsl_m=523.456), "fix": SEARCHING},
        named("latitude longitude altitude", (0, 0, 523)),
    ),
    **{
        f"high-latency-saturated-{value}": (
            messages.high_latency2,
            {
                "state": replace(
                    STATE, lat_deg=value, alt_amsl_m=value, vel_n_mps=(value, value, value)
                ),
                "fix": replace(FIX, h_acc_m=abs(value)),
            },
            named("groundspeed eph", (255, 254))
            | named("altitude climb_rate", (32767, -127) if value > 0.0 else (-32768, 127)),
        )
        for value in (math.inf, -math.inf, 1e30, -1e30)
    },
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_fields_have_the_units_and_signs_of_the_definition(name: str) -> None:
    build, known, expected = VALUES[name]
    found = message(build, **known)
    for field, value in expected.items():
        close = pytest.approx(value, rel=1e-6, nan_ok=True)
        assert getattr(found, field) == (value if isinstance(value, int) else close), field


def test_high_latency2_after_an_outage_has_the_last_position_and_all_failures() -> None:
    found = message(messages.high_latency2, SILENT_US, state=STATE, fix=FIX, sample=SAMPLE)
    assert (found.latitude, found.eph, found.failure_flags) == (471_234_567, 255, SENSOR_FAILURES)


@pytest.mark.parametrize("name", [each.__name__ for each in messages.BUILDERS.values()])
def test_message_without_its_records_is_not_built(name: str) -> None:
    always = {"gps_raw_int", "system_time", "high_latency2", "autopilot_version"}
    always |= {"protocol_version", "available_modes", "current_mode"}
    assert (getattr(messages, name)(newest(), 0) is not None) == (name in always)


def test_heading_of_vfr_hud_is_in_whole_degrees() -> None:
    # Half way between two degrees: the float may fall on either side.
    assert message(messages.vfr_hud, state=STATE).heading in (271, 272)
    assert not messages.has_position(NOTHING)


def test_local_position_is_north_east_down_of_the_origin() -> None:
    found = message(messages.local_position_ned, state=STATE, origin=ORIGIN)
    assert (found.x, found.y) == pytest.approx((0.0, 75.9), abs=0.1)
    lat_deg, lon_deg = STATE.lat_deg + 0.01, ORIGIN.location.lon_deg
    north = replace(STATE, lat_deg=lat_deg, lon_deg=lon_deg)
    found = message(messages.local_position_ned, state=north, origin=ORIGIN)
    assert (found.x, found.y) == pytest.approx((1111.8, 0.0), abs=0.2)


def test_odometry_has_the_velocity_in_the_body_frame_and_its_variances() -> None:
    level_east = replace(
        STATE,
        q_nb=from_euler(0.0, 0.0, math.pi / 2),
        vel_n_mps=(0.0, 5.0, 0.0),
        vel_std_mps=(0.1, 0.2, 0.3),
        attitude_std_rad=(0.01, 0.02, 0.05),
    )
    found = message(messages.odometry, state=level_east, origin=ORIGIN)
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


def invalid_marks(name: str) -> dict[str, str]:
    """Read the marks for unknown values out of the definition itself."""
    folder = Path(mavlink.__file__).parent
    for file in ("common.xml", "standard.xml", "minimal.xml"):
        for element in ET.parse(folder / file).getroot().iter("message"):
            if element.get("name") == name:
                fields = [field for field in element.iter("field") if field.get("invalid")]
                return {str(f.get("name")): str(f.get("invalid")) for f in fields}
    raise AssertionError(f"no {name} in the definitions")


NUMBERS = {"UINT8_MAX": 255, "UINT16_MAX": 65_535, "INT16_MAX": 32_767}
UNKNOWN: dict[str, tuple[messages.Builder, dict[str, Any]]] = {
    "GPS_RAW_INT": (messages.gps_raw_int, {"fix": NO_FIX}),
    "GLOBAL_POSITION_INT": (
        messages.global_position_int,
        {"state": replace(STATE, flags=NavFlags(0))},
    ),
    "SYS_STATUS": (lambda each, now_us: each.health.sys_status(now_us), {}),
    "SCALED_PRESSURE": (messages.scaled_pressure, {"baro": BARO}),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_unknown_values_are_sent_as_the_definition_requires(name: str) -> None:
    build, known = UNKNOWN[name]
    found, marks = message(build, **known), invalid_marks(name)
    assert marks
    for field, mark in marks.items():
        if field != "satellites_visible":
            expected = NUMBERS[mark] if mark in NUMBERS else int(mark)
            assert getattr(found, field) == expected, field
