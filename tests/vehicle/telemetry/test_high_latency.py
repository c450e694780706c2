"""HIGH_LATENCY2: the vehicle in one message, whatever is known of it."""

import math
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import GpsFix, GpsFixType, NavState
from gateway.vehicle.telemetry.health import Health
from gateway.vehicle.telemetry.messages import high_latency2
from tests.kit.ground_station import GroundStation
from tests.kit.records import BARO, FIX, NOTHING, SAMPLE, STATE


@pytest.fixture
def well() -> Health:
    health = Health(1, 2.0)
    health.on_state(STATE, SAMPLE)
    health.on_baro(BARO)
    health.on_gps(FIX)
    return health


def decoded(
    state: NavState | None, fix: GpsFix | None, health: Health, now_us: int = 1_500_000
) -> Any:
    message = high_latency2(mavlink.MAV_TYPE_FIXED_WING, 0, state, fix, health, now_us)
    link = mavlink.MAVLink(None, 1, 1)
    return mavlink.MAVLink(None).parse_buffer(message.pack(link))[0]


def test_fields(well: Health) -> None:
    message = decoded(STATE, FIX, well)
    assert (message.latitude, message.longitude) == (471_234_567, -87_654_321)
    assert (message.altitude, message.heading * 2) == (523, 272)
    assert (message.groundspeed / 5, message.climb_rate / 10) == (
        5.0,
        pytest.approx(1.25, abs=0.06),
    )
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
    message = decoded(state, fix, health)
    assert (message.latitude, message.longitude, message.groundspeed) == (0, 0, 0)
    assert (message.eph, message.epv) == (255, 255)
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_GPS
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_3D_ACCEL


def test_barometric_altitude_is_reported_before_the_first_fix(well: Health) -> None:
    message = decoded(replace(NOTHING, alt_amsl_m=523.456), SEARCHING, well)
    assert (message.latitude, message.longitude, message.altitude) == (0, 0, 523)


def test_accuracy_is_unknown_after_the_gps_receiver_is_lost(well: Health) -> None:
    message = decoded(STATE, FIX, well, now_us=FIX.time_us + 60_000_000)
    assert (message.latitude, message.longitude) == (471_234_567, -87_654_321)
    assert (message.eph, message.epv) == (255, 255)
    assert message.failure_flags & mavlink.HL_FAILURE_FLAG_GPS


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e30, -1e30])
def test_wild_values_are_saturated(well: Health, value: float) -> None:
    wild = replace(STATE, lat_deg=value, alt_amsl_m=value, vel_n_mps=(value, value, value))
    assert decoded(wild, replace(FIX, h_acc_m=abs(value)), well)


def test_a_vehicle_sends_it_every_five_seconds(station: GroundStation) -> None:
    found = [m for m in station.wait(60.0) if m.get_type() == "HIGH_LATENCY2"]
    assert 11 <= len(found) <= 13
