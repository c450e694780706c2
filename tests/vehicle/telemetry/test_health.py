from collections.abc import Callable

import pytest
from msgspec.structs import replace

from gateway.records import ImuFlags, NavFlags, NodeId, RadioSignal
from gateway.vehicle.telemetry import health as bits
from gateway.vehicle.telemetry.health import AHRS, GEOFENCE, GPS, LOGGING, MAG, PREARM, Health
from tests.kit.records import GPS_NODE, IMU_NODE, NO_FIX, SAMPLE, STATE, link, report, status

INERTIAL = bits.GYRO | bits.ACCEL
ALL = INERTIAL | MAG | bits.PRESSURE | GPS | AHRS
NOW_US = 1_500_000


def with_flags(sample: ImuFlags, state: NavFlags = STATE.flags) -> Callable[[Health], object]:
    field = None if sample & ImuFlags.MAG_ABSENT else SAMPLE.mag_b_ut
    records = replace(STATE, flags=state), replace(SAMPLE, flags=sample, mag_b_ut=field)
    return lambda health: health.on_state(*records)


def later(_health: Health) -> None:
    """Nothing is received for some time."""


@pytest.mark.parametrize(
    ("change", "now_us", "absent", "bad"),
    [
        (later, 3_000_000, 0, 0),
        (later, 3_000_001, 0, ALL | PREARM),
        (with_flags(ImuFlags.SELF_TEST_FAILED), NOW_US, 0, INERTIAL | AHRS | PREARM),
        (with_flags(ImuFlags(0), NavFlags(0)), NOW_US, 0, AHRS | PREARM),
        (with_flags(ImuFlags(0), STATE.flags | NavFlags.SENSOR_FAULT), NOW_US, 0, AHRS | PREARM),
        # Lost GPS is no failed attitude; without a magnetometer it may fly.
        (with_flags(ImuFlags(0), STATE.flags | NavFlags.DEAD_RECKONING), NOW_US, 0, 0),
        (with_flags(ImuFlags.MAG_ABSENT), NOW_US, MAG, 0),
        (lambda h: h.on_gps(NO_FIX), NOW_US, 0, GPS | PREARM),
        (lambda h: h.on_node_status(status(sensors_failed=0b010)), NOW_US, 0, MAG | PREARM),
    ],
)
def test_sys_status_reports_outages_and_faults_of_sensors(
    health: Health, change: Callable[[Health], object], now_us: int, absent: int, bad: int
) -> None:
    change(health)
    present, enabled, well = health.sensors(now_us)
    assert present == (ALL | LOGGING | PREARM) & ~absent
    assert enabled == present & ~LOGGING
    assert well == (ALL | PREARM | GEOFENCE) & ~absent & ~bad
    assert health.has_fix(now_us) == (not bad & GPS)


def test_recording_that_waits_for_arming_is_not_shown_as_switched_off(health: Health) -> None:
    health.recording_expected = False
    assert not health.sensors(NOW_US)[0] & LOGGING
    health.recording = True
    assert all(bits & LOGGING for bits in health.sensors(NOW_US))


def test_radio_status_has_the_weakest_measured_signal_if_any(health: Health) -> None:
    health.on_link(report(link(IMU_NODE), link(GPS_NODE)))
    assert health.radio_status() is None
    strong, weak = RadioSignal(-60, 10.0), RadioSignal(-121, -7.25)
    other = link(NodeId(2, 0), signal=RadioSignal(-127, -15.0))
    nodes = link(IMU_NODE, signal=strong), link(GPS_NODE, signal=weak, lost=7)
    health.on_link(report(*nodes, other))
    sent = health.radio_status()
    # As QGroundControl reads them: signed bytes.
    assert [value - 256 for value in (sent.rssi, sent.noise)] == [-121, -114]
    assert (sent.remrssi, sent.remnoise, sent.txbuf, sent.rxerrors) == (255, 255, 100, 7)


def test_sensor_is_absent_before_its_first_sample() -> None:
    present, _, well = Health(1, 2.0).sensors(0)
    assert not present & ALL
    assert well == GEOFENCE


def test_sys_status_has_the_lowest_supply_of_the_nodes(health: Health) -> None:
    found = health.sys_status(NOW_US)
    unknown = (found.voltage_battery, found.current_battery, found.battery_remaining)
    assert unknown == (65535, -1, -1)
    health.on_node_status(status(supply_mv=3300))
    health.on_node_status(status(GPS_NODE, supply_mv=3150))
    assert health.sys_status(NOW_US).voltage_battery == 3150


def test_load_is_the_share_of_the_longest_loop(health: Health) -> None:
    health.on_node_status(status(loop_max_us=2_500, sample_rate_hz=200))
    assert health.sys_status(0).load == 500
    health.on_node_status(status(GPS_NODE, sensors_present=0b1000, loop_max_us=65_535))
    assert health.sys_status(0).load == 500


def test_sys_status_counts_losses_of_its_own_aircraft_only(health: Health) -> None:
    other = link(NodeId(2, 0), received=10, lost=990)
    health.on_link(report(link(received=900, lost=100), link(GPS_NODE, received=100), other))
    found = health.sys_status(0)
    assert (found.drop_rate_comm, found.errors_comm) == (round(1e4 * 100 / 1100), 100)
    health.on_link(report(link(received=1000, lost=100), link(GPS_NODE, received=110), other))
    assert health.sys_status(0).drop_rate_comm == 0


def test_stall_of_the_gateway_is_no_outage_of_a_sensor(health: Health) -> None:
    health.on_link(report(link(), link(GPS_NODE, last_time_us=-9_000_000)))
    health.on_stall(5_000_000, 6_500_000)
    assert health.sensors(6_500_000)[2] & ALL == ALL
    assert health.silent_nodes(6_500_000) == {GPS_NODE.node_id}, "it was silent before"
    assert health.silent_nodes(9_000_000) == {IMU_NODE.node_id, GPS_NODE.node_id}
    health.on_stall(5_000_000, 60_000_000)
    assert not health.sensors(60_000_000)[2] & ALL, "they were silent before"


def test_known_node_without_new_payloads_is_silent(health: Health) -> None:
    never = link(NodeId(1, 2), received=0, last_time_us=0)
    health.on_link(report(link(), link(GPS_NODE, last_time_us=0), never))
    assert health.silent_nodes(2_500_000) == {GPS_NODE.node_id}
    assert health.known_nodes() == {IMU_NODE.node_id, GPS_NODE.node_id}
