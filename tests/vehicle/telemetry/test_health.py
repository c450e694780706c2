import pytest
from msgspec.structs import replace

from gateway.records import ImuFlags, NavFlags, NodeId
from gateway.vehicle.telemetry.health import (
    ACCEL,
    AHRS,
    GEOFENCE,
    GPS,
    GYRO,
    LOGGING,
    MAG,
    PREARM,
    PRESSURE,
    Health,
)
from tests.kit.records import (
    BARO,
    FIX,
    GPS_NODE,
    IMU_NODE,
    NO_FIX,
    SAMPLE,
    STATE,
    link,
    report,
    status,
)

ALL = GYRO | ACCEL | MAG | PRESSURE | GPS | AHRS


def healthy() -> Health:
    health = Health(1, 2.0)
    health.on_state(STATE, SAMPLE)
    health.on_baro(BARO)
    health.on_gps(FIX)
    return health


def test_sensor_is_absent_before_its_first_sample() -> None:
    present, _, well = Health(1, 2.0).sensors(0)
    assert not present & ALL
    assert well == GEOFENCE


def test_healthy_sensors_are_ready_to_fly() -> None:
    present, enabled, well = healthy().sensors(1_500_000)
    assert present == ALL | LOGGING | PREARM
    assert enabled == ALL | PREARM
    assert well == ALL | PREARM | GEOFENCE


def test_sensor_that_timed_out_is_present_but_unhealthy() -> None:
    health = healthy()
    assert health.sensors(3_000_000)[2] & ALL == ALL
    present, _, well = health.sensors(3_000_001)
    assert present & ALL == ALL
    assert not well & (ALL | PREARM)


@pytest.mark.parametrize(
    ("sample", "state", "bad"),
    [
        (replace(SAMPLE, flags=ImuFlags.SELF_TEST_FAILED), STATE, GYRO | ACCEL | AHRS | PREARM),
        (SAMPLE, replace(STATE, flags=NavFlags(0)), AHRS | PREARM),
        (SAMPLE, replace(STATE, flags=STATE.flags | NavFlags.SENSOR_FAULT), AHRS | PREARM),
    ],
)
def test_faults_of_the_imu(sample: object, state: object, bad: int) -> None:
    health = healthy()
    health.on_state(state, sample)
    assert health.sensors(1_500_000)[2] == (ALL | PREARM | GEOFENCE) & ~bad


def test_an_absent_magnetometer_does_not_forbid_flying() -> None:
    health = healthy()
    health.on_state(STATE, replace(SAMPLE, flags=ImuFlags.MAG_ABSENT, mag_b_ut=None))
    present, _, well = health.sensors(1_500_000)
    assert not present & MAG
    assert well & PREARM


def test_no_fix_is_an_unhealthy_gps() -> None:
    health = healthy()
    health.on_gps(NO_FIX)
    present, _, well = health.sensors(1_500_000)
    assert present & GPS
    assert not well & (GPS | PREARM)
    assert not health.has_fix(1_500_000)


def test_failed_sensor_in_a_node_status_is_unhealthy() -> None:
    health = healthy()
    health.on_node_status(status(sensors_failed=0b010))
    assert not health.sensors(1_500_000)[2] & MAG
    health.on_node_status(status(sensors_failed=0))
    assert health.sensors(1_500_000)[2] & MAG


def test_sys_status_has_the_lowest_supply_of_the_nodes() -> None:
    health = healthy()
    found = health.sys_status(1_500_000)
    unknown = (found.voltage_battery, found.current_battery, found.battery_remaining)
    assert unknown == (65535, -1, -1)
    health.on_node_status(status(supply_mv=3300))
    health.on_node_status(status(GPS_NODE, supply_mv=3150))
    assert health.sys_status(1_500_000).voltage_battery == 3150


def test_load_is_the_share_of_the_longest_loop() -> None:
    health = healthy()
    health.on_node_status(status(loop_max_us=2_500, sample_rate_hz=200))
    assert health.sys_status(0).load == 500
    health.on_node_status(status(GPS_NODE, sensors_present=0b1000, loop_max_us=65_535))
    assert health.sys_status(0).load == 500


def test_losses_of_this_aircraft_only() -> None:
    health = healthy()
    other = link(NodeId(2, 0), received=10, lost=990)
    health.on_link(report(link(received=900, lost=100), link(GPS_NODE, received=100), other))
    found = health.sys_status(0)
    assert (found.drop_rate_comm, found.errors_comm) == (round(1e4 * 100 / 1100), 100)
    health.on_link(report(link(received=1000, lost=100), link(GPS_NODE, received=110), other))
    assert health.sys_status(0).drop_rate_comm == 0


def test_stall_of_the_gateway_is_no_outage_of_a_sensor() -> None:
    health = healthy()
    health.on_link(report(link(), link(GPS_NODE, last_time_us=-9_000_000)))
    health.on_stall(5_000_000, 6_500_000)
    assert health.sensors(6_500_000)[2] & ALL == ALL
    assert health.silent_nodes(6_500_000) == {GPS_NODE.node_id}, "it was silent before"
    assert health.silent_nodes(9_000_000) == {IMU_NODE.node_id, GPS_NODE.node_id}


def test_sensor_that_was_silent_before_a_stall_stays_so() -> None:
    health = healthy()
    health.on_stall(5_000_000, 60_000_000)
    assert not health.sensors(60_000_000)[2] & ALL


def test_silent_nodes() -> None:
    health = healthy()
    never = link(NodeId(1, 2), received=0, last_time_us=0)
    health.on_link(report(link(), link(GPS_NODE, last_time_us=0), never))
    assert health.silent_nodes(2_500_000) == {GPS_NODE.node_id}
    assert health.known_nodes() == {IMU_NODE.node_id, GPS_NODE.node_id}
