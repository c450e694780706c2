"""Records of one aircraft, as its stages exchange them."""

import math
from typing import Any

from msgspec.structs import replace

from gateway.geometry.quaternion import from_euler
from gateway.records import (
    BaroSample,
    GpsFix,
    GpsFixType,
    ImuFlags,
    ImuRaw,
    ImuSample,
    LinkReport,
    NavFlags,
    NavState,
    NodeId,
    NodeLink,
    NodeStatus,
)

IMU_NODE = NodeId(1, 0)
GPS_NODE = NodeId(1, 1)

ALL_VALID = (
    NavFlags.ATTITUDE_VALID
    | NavFlags.HEADING_VALID
    | NavFlags.POSITION_VALID
    | NavFlags.VELOCITY_VALID
    | NavFlags.ALTITUDE_VALID
)

STATE = NavState(
    time_us=1_000_000,
    q_nb=from_euler(0.1, -0.2, math.radians(271.5)),
    rate_b_radps=(0.01, 0.02, -0.03),
    lat_deg=47.123_456_7,
    lon_deg=-8.765_432_1,
    alt_amsl_m=523.456,
    vel_n_mps=(3.0, -4.0, -1.25),
    attitude_std_rad=(0.01, 0.01, 0.05),
    vel_std_mps=(0.1, 0.1, 0.2),
    pos_std_m=(0.6, 0.8, 2.0),
    flags=ALL_VALID,
)

NOTHING = replace(
    STATE,
    lat_deg=math.nan,
    lon_deg=math.nan,
    alt_amsl_m=math.nan,
    vel_n_mps=(math.nan,) * 3,
    attitude_std_rad=(math.nan,) * 3,
    vel_std_mps=(math.nan,) * 3,
    pos_std_m=(math.nan,) * 3,
    flags=NavFlags(0),
)
"""Output of an estimator that has only an attitude so far."""

SAMPLE = ImuSample(
    time_us=1_000_000,
    accel_b_mps2=(0.5, -0.25, -9.75),
    gyro_b_radps=(0.5, 0.25, -0.125),
    mag_b_ut=(20.0, -5.0, 43.0),
    temperature_degc=31.5,
    flags=ImuFlags(0),
)

RAW = ImuRaw(
    time_us=0,
    node=IMU_NODE,
    node_time_us=0,
    accel_raw=(0, 0, 4096),
    gyro_raw=(0, 0, 0),
    mag_raw=(218, 0, 431),
    temperature_raw=-3920,
    accel_range_g=8,
    gyro_range_dps=1000,
    mag_lsb_per_gauss=1090,
    flags=ImuFlags.MAG_NEW,
)
"""At rest, face up: one gravity upwards in sensor axes."""

BARO = BaroSample(1_000_000, 95_123.0, -12.34, 529.5)

FIX = GpsFix(
    time_us=1_000_000,
    node=GPS_NODE,
    node_time_us=900_000,
    itow_ms=345_600_000,
    fix_type=GpsFixType.FIX_3D,
    fix_ok=True,
    satellites=11,
    lat_dege7=471_234_567,
    lon_dege7=-87_654_321,
    alt_amsl_m=520.25,
    vel_n_mps=(3.0, -4.0, 0.5),
    alt_ellipsoid_m=567.75,
    h_acc_m=1.25,
    v_acc_m=2.5,
    speed_acc_mps=0.125,
    course_acc_deg=1.5,
    pdop=1.6,
    utc_us=1_790_000_000_000_000,
)

NO_FIX = replace(FIX, fix_type=GpsFixType.NONE, fix_ok=False, satellites=0, utc_us=None)


def state_at(time_us: int, **changes: Any) -> NavState:
    return replace(STATE, time_us=time_us, **changes)


def sample_at(time_us: int, **changes: Any) -> ImuSample:
    return replace(SAMPLE, time_us=time_us, **changes)


def raw_at(time_us: int, **changes: Any) -> ImuRaw:
    return replace(RAW, **{"time_us": time_us, "node_time_us": time_us} | changes)


def fix_at(time_us: int, **changes: Any) -> GpsFix:
    return replace(FIX, time_us=time_us, **changes)


def status(node: NodeId = IMU_NODE, **changes: Any) -> NodeStatus:
    plain = NodeStatus(
        time_us=0,
        node=node,
        node_time_us=0,
        firmware_version=(1, 0),
        reset_cause=1,
        sensors_present=0b111,
        sensors_failed=0,
        bus_errors=0,
        radio_failed=0,
        radio_retries=0,
        loop_max_us=2_500,
        sample_rate_hz=200,
        supply_mv=0,
    )
    return replace(plain, **changes)


def link(node: NodeId = IMU_NODE, **changes: Any) -> NodeLink:
    plain = NodeLink(
        node=node,
        pipe=1,
        received=1000,
        rate_hz=200.0,
        last_time_us=1_000_000,
        clock_skew_ppm=3.0,
    )
    return replace(plain, **changes)


def report(*nodes: NodeLink, time_us: int = 1_000_000, **changes: Any) -> LinkReport:
    plain = LinkReport(
        time_us=time_us,
        connected=True,
        port="/dev/ttyUSB0",
        bytes_received=0,
        frames=0,
        frames_lost=0,
        faults=(),
        nodes=nodes,
        receiver=None,
    )
    return replace(plain, **changes)
