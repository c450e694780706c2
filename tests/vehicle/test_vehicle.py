from collections import Counter
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import GpsFix, ImuFlags, NavFlags, NavState, Outgoing
from gateway.vehicle.plan import Location, StoredPlan
from gateway.vehicle.service import INFO
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import RateSettings, VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, kinds, of_kind, texts
from tests.kit.records import (
    BARO,
    FIX,
    GPS_NODE,
    NO_FIX,
    NOTHING,
    SAMPLE,
    STATE,
    fix_at,
    link,
    report,
    sample_at,
    state_at,
    status,
)

ONE_S = 1_000_000
BYTEWISE = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
C_CAST = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


def make(**changes: Any) -> Vehicle:
    return Vehicle(VehicleSettings(**changes), system_id=1)


def fly(
    vehicle: Vehicle,
    start_s: int,
    seconds: int,
    state: NavState = STATE,
    fix: GpsFix | None = FIX,
    **changes: Any,
) -> list[Outgoing]:
    """Feed IMU at 200 Hz, GPS at 5 Hz and the barometer at 20 Hz, polling as asked to."""
    found = []
    for time_us in range(start_s * ONE_S, (start_s + seconds) * ONE_S, 5_000):
        now = replace(state, time_us=time_us, **changes)
        found += vehicle.on_state(now, sample_at(time_us), time_us)
        if time_us % 50_000 == 0:
            found += vehicle.on_baro(replace(BARO, time_us=time_us), time_us)
        if fix is not None and time_us % 200_000 == 0:
            found += vehicle.on_gps(replace(fix, time_us=time_us), time_us)
        if vehicle.next_due_us() <= time_us:
            found += vehicle.poll(time_us)
    return found


AT_RATES = {
    **dict.fromkeys(("ATTITUDE_QUATERNION", "ATTITUDE"), 500),
    **dict.fromkeys(("GLOBAL_POSITION_INT", "VFR_HUD", "HIGHRES_IMU"), 100),
    **dict.fromkeys(("GPS_RAW_INT", "SCALED_PRESSURE"), 50),
    **dict.fromkeys(("SYS_STATUS", "EXTENDED_SYS_STATE"), 20),
    **dict.fromkeys(("HEARTBEAT", "SYSTEM_TIME", "HOME_POSITION", "ESTIMATOR_STATUS"), 10),
    "HIGH_LATENCY2": 2,
}
RECKONED = NavFlags.ATTITUDE_VALID | NavFlags.DEAD_RECKONING | NavFlags.DEGRADED
NO_POSITION = {"GLOBAL_POSITION_INT": 0, "HOME_POSITION": 0, "GPS_RAW_INT": 10}
OFF = ("ATTITUDE", "GPS_RAW_INT", "SYS_STATUS")
SENT: dict[str, tuple[dict[str, float], dict[str, Any], dict[str, int]]] = {
    "usual rates": ({}, {}, AT_RATES),
    "rates of zero": (
        {f"{name.lower()}_hz": 0.0 for name in OFF}, {}, AT_RATES | dict.fromkeys(OFF, 0),
    ),
    "no position yet": ({}, {"state": NOTHING, "fix": None}, AT_RATES | NO_POSITION),
    "dead reckoning": ({}, {"flags": RECKONED}, AT_RATES),
}  # fmt: skip


@pytest.mark.parametrize("name", SENT)
def test_every_message_is_sent_at_its_own_rate(name: str) -> None:
    rates, flown, expected = SENT[name]
    vehicle = make(rates=RateSettings(**rates))
    fly(vehicle, 0, 2, **flown)
    found = fly(vehicle, 2, 10, **flown)
    counted = Counter(kinds(found))
    assert {name: counted[name] for name in expected} == pytest.approx(expected, abs=1)
    if "fix" in flown:
        no_gps = {mavlink.GPS_FIX_TYPE_NO_GPS}
        assert {m.fix_type for m in of_kind(found, "GPS_RAW_INT")} == no_gps


def test_messages_are_not_due_all_at_once() -> None:
    vehicle = make()
    reported = []
    # A minute is missing, after which all that was missed is due.
    for start_s in (0, 60):
        for time_us in range(start_s * ONE_S, (start_s + 10) * ONE_S, 10_000):
            reported.append(kinds(vehicle.on_state(state_at(time_us), sample_at(time_us), time_us)))
            if time_us % 200_000 == 0:
                vehicle.on_gps(fix_at(time_us), time_us)
            reported.append(kinds(vehicle.poll(time_us)))
        reported[-2000:-1900] = []
    assert max(map(len, reported)) <= 2
    assert len({name for each in reported for name in each}) > 12


@pytest.mark.parametrize(
    ("name", "autopilot", "custom_mode", "encoding"),
    [("generic", 0, 0, BYTEWISE), ("ardupilotmega", 3, 0, C_CAST), ("px4", 12, 1 << 16, BYTEWISE)],
)
def test_autopilot_of_the_settings_is_reported(
    clock: ManualClock, name: str, autopilot: int, custom_mode: int, encoding: int
) -> None:
    station = GroundStation(make(autopilot=name), clock)
    beat = of_kind(station.wait(1.0), "HEARTBEAT")[0]
    assert (beat.autopilot, beat.custom_mode) == (autopilot, custom_mode)
    assert bool(beat.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED) == (autopilot != 0)
    [_, version] = station.request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert version.capabilities & (BYTEWISE | C_CAST) == encoding
    [_, summary] = station.request(mavlink.MAVLINK_MSG_ID_HIGH_LATENCY2)
    assert (summary.autopilot, summary.custom_mode) == (autopilot, custom_mode >> 16)


def test_home_is_the_first_good_fix() -> None:
    vehicle = make()
    vehicle.on_gps(replace(NO_FIX, time_us=0), 0)
    for changes in ({"satellites": 5}, {"h_acc_m": 20.0}, {"lat_dege7": 0, "lon_dege7": 0}):
        vehicle.on_gps(fix_at(200_000, **changes), 200_000)
    assert vehicle.telemetry.home is None
    found = vehicle.on_gps(fix_at(600_000), 600_000)
    [home] = of_kind(found, "HOME_POSITION")
    assert (home.latitude, home.longitude, home.altitude) == (471_234_567, -87_654_321, 520_250)
    assert "Home set by GPS" in texts(found)
    found = vehicle.on_gps(fix_at(800_000, lat_dege7=0), 800_000)
    assert "HOME_POSITION" not in kinds(found)
    found = of_kind(fly(vehicle, 2, 1), "GLOBAL_POSITION_INT")
    assert {m.relative_alt for m in found} == {523_456 - 520_250}


def test_stored_home_elsewhere_does_not_mean_in_flight() -> None:
    """One that was kept of another field, two hundred metres lower."""
    stored = StoredPlan(home=Location(46.0, 8.0, 300.0))
    vehicle = Vehicle(VehicleSettings(), 1, stored=stored)
    fly(vehicle, 0, 10, vel_n_mps=(0.0, 0.0, 0.0))
    assert vehicle.telemetry.motion.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND


@pytest.mark.parametrize(
    ("rule", "recording", "speed", "armed"),
    [
        ("flying", True, 0.0, False),
        ("flying", False, 20.0, True),
        ("recording", True, 0.0, True),
        ("recording", False, 20.0, False),
        ("flying_or_recording", True, 0.0, True),
        ("flying_or_recording", False, 20.0, True),
        ("flying_or_recording", False, 0.0, False),
        ("always", False, 0.0, True),
        ("never", True, 20.0, False),
    ],
)
def test_armed_bit_follows_the_rule(rule: str, recording: bool, speed: float, armed: bool) -> None:
    vehicle = make(armed_when=rule)
    vehicle.on_recorder("", 0, recording=recording)
    found = fly(vehicle, 0, 4, vel_n_mps=(speed, 0.0, 0.0), alt_amsl_m=521.0)
    last = of_kind(found, "HEARTBEAT")[-1]
    assert bool(last.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED) is armed
    assert last.autopilot == mavlink.MAV_AUTOPILOT_GENERIC
    assert last.type == mavlink.MAV_TYPE_FIXED_WING
    expected = mavlink.MAV_STATE_ACTIVE if speed > 0.0 else mavlink.MAV_STATE_STANDBY
    assert last.system_status == expected


def test_heartbeats_go_on_when_nothing_is_received() -> None:
    vehicle = make()
    fly(vehicle, 0, 2)
    found = [o for now in range(2 * ONE_S, 12 * ONE_S, 20_000) for o in vehicle.poll(now)]
    beats = of_kind(found, "HEARTBEAT")
    assert len(beats) == 10
    assert beats[-1].system_status == mavlink.MAV_STATE_CRITICAL
    assert "GPS fix lost" in texts(found)


def test_link_and_nodes_are_reported() -> None:
    vehicle = make()
    both = link(), link(GPS_NODE)
    vehicle.on_node_status(status(GPS_NODE, sensors_present=0b1000), 0)
    alive = link(last_time_us=30 * ONE_S), link(GPS_NODE, last_time_us=30 * ONE_S)
    silent = {"node 1": "GPS node 1 silent"}
    lost = {"link": "Receiver lost: /dev/ttyUSB0"}
    for time_s, found, expected, troubles in (
        (1, report(*both), ["Receiver connected: /dev/ttyUSB0"], {}),
        (9, report(link(last_time_us=9 * ONE_S), link(GPS_NODE)), [*silent.values()], silent),
        (20, report(*both, connected=False), [*lost.values()], lost | silent),
        (30, report(*alive), ["Receiver connected: /dev/ttyUSB0", "GPS node 1 is back"], {}),
    ):
        assert texts(vehicle.on_link(found, time_s * ONE_S)) == expected
        assert vehicle.troubles == troubles


@pytest.mark.parametrize(
    ("restarts", "expected"),
    [
        ([3, 4], ["Node 0 restarted"]),
        # As with two trackers of one id, whose stamps disagree with each sample.
        (
            [100 * min(second, 20) for second in range(60)],
            ["Node 0 keeps restarting, or two nodes share id 0", "Node 0 no longer restarts"],
        ),
    ],
    ids=["once", "repeatedly"],
)
def test_restarts_of_a_node_are_reported(restarts: list[int], expected: list[str]) -> None:
    vehicle, reported = make(), []
    for second, number in enumerate(restarts, 1):
        alive = link(restarts=number, last_time_us=second * ONE_S)
        reported += texts(vehicle.on_link(report(alive), second * ONE_S))
    assert reported == ["Receiver connected: /dev/ttyUSB0", *expected]


@pytest.mark.parametrize(
    ("latencies", "expected"),
    [
        # It moves on until it is what the motion shows, and varies a little there.
        (
            [0.3 - 0.01 * min(n, 14) + 0.003 * (n % 2) for n in range(90)],
            ["GPS is 0.16 s late, not 0.30: set REF_GPS_LATENCY"],
        ),
        # The first manoeuvres were misleading.
        ([0.3 - 0.01 * min(n, 8, max(50 - n, 0)) for n in range(200)], []),
        ([0.3] * 200, []),
    ],
    ids=["settled", "returns", "as set"],
)
def test_gps_latency_is_announced_once_its_estimate_has_settled(
    latencies: list[float], expected: list[str]
) -> None:
    vehicle, reported = make(), []
    for second, used_s in enumerate(latencies):
        reported += texts(vehicle.on_latency(used_s, 0.3, second * ONE_S))
    assert reported == expected


LOST = NavFlags.DEAD_RECKONING | NavFlags.DEGRADED
REJECTED = LOST | NavFlags.GPS_REJECTED
FAULT = NavFlags.SENSOR_FAULT | NavFlags.DEGRADED
MISPLACED = NavFlags.MAG_MISPLACED | NavFlags.MAG_DISTURBED
FINE = STATE.flags
NO_ATTITUDE = ~(NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID)
BEGIN_S = 20

EVENTS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no fix": ({"fix": NO_FIX, "flags": LOST}, ["GPS fix lost", "GPS fix"]),
    "no data from the receiver": ({"fix": None, "flags": LOST}, ["GPS fix lost", "GPS fix"]),
    "silent node": (
        {"fix": None, "node": False, "flags": LOST}, ["GPS node 1 silent", "GPS node 1 is back"],
    ),
    "receiver unplugged": (
        {"fix": None, "link": False, "flags": LOST},
        ["Receiver lost: port", "Receiver connected: port"],
    ),
    "rejected fixes": ({"flags": REJECTED}, ["GPS fixes rejected", "GPS accepted again"]),
    "useless fixes": ({"flags": LOST}, ["Position is dead-reckoned", "Position follows GPS again"]),
    "faulty sensor": ({"valid": NO_ATTITUDE, "flags": FAULT}, ["Sensor fault", "Sensors OK again"]),
    "lost attitude": ({"valid": NO_ATTITUDE}, ["Attitude not valid", "Attitude valid"]),
    "disturbed field": (
        {"valid": ~NavFlags.HEADING_VALID, "flags": NavFlags.MAG_DISTURBED},
        ["Magnetic field disturbed", "Magnetic field normal again"],
    ),
    "misplaced compass": (
        {"flags": MISPLACED},
        ["Compass axes wrong, not used: check CAL_MAG_MNT", "Compass axes right again"],
    ),
    "uncalibrated compass": (
        {"sample": ImuFlags.MAG_UNCALIBRATED}, ["Compass not calibrated", "Compass calibrated"],
    ),
    "uncalibrated accelerometer": (
        {"sample": ImuFlags.ACCEL_UNCALIBRATED},
        ["Accelerometer not calibrated", "Accelerometer calibrated"],
    ),
    "short outage": ({"flags": LOST, "seconds": 3}, []),
}  # fmt: skip


@pytest.mark.parametrize("name", EVENTS)
def test_one_cause_is_announced_once_and_so_is_its_end(name: str) -> None:
    """The end has the severity INFO: stations speak a NOTICE and show it as trouble."""
    event, expected = EVENTS[name]
    vehicle, reported = make(), []
    vehicle.on_node_status(status(node=GPS_NODE, sensors_present=1 << 3), 0)
    last_us = 0
    for time_us in range(0, 60 * ONE_S, ONE_S // 5):
        now = event if BEGIN_S <= time_us / ONE_S < BEGIN_S + event.get("seconds", 20) else {}
        # The estimator notices an outage after a while.
        seen = now if time_us >= (BEGIN_S + 1.5) * ONE_S else {}
        state = state_at(time_us, flags=FINE & seen.get("valid", FINE) | seen.get("flags", 0))
        # The field is not new in every sample.
        field = None if time_us % ONE_S else SAMPLE.mag_b_ut
        sample = sample_at(time_us, flags=now.get("sample", ImuFlags(0)), mag_b_ut=field)
        found = [*vehicle.on_state(state, sample, time_us)]
        if (fix := now.get("fix", FIX)) is not None:
            found += vehicle.on_gps(replace(fix, time_us=time_us), time_us)
        if time_us % ONE_S == 0:
            last_us = time_us if now.get("node", True) else last_us
            node = link(node=GPS_NODE, last_time_us=last_us)
            line = report(node, time_us=time_us, port="port", connected=now.get("link", True))
            found += vehicle.on_link(line, time_us)
        texts_now = of_kind([*found, *vehicle.poll(time_us)], "STATUSTEXT")
        reported += texts_now if time_us >= BEGIN_S * ONE_S else []
    assert [message.text for message in reported] == expected
    assert [message.severity < INFO for message in reported] == [True, False][: len(expected)]


def test_system_time_follows_gps() -> None:
    vehicle = make()
    before = of_kind([*vehicle.poll(0), *vehicle.poll(ONE_S)], "SYSTEM_TIME")
    assert before[0].time_unix_usec == 0
    vehicle.on_gps(fix_at(ONE_S, utc_us=1_790_000_000_000_000), ONE_S)
    after = of_kind(vehicle.poll(3 * ONE_S), "SYSTEM_TIME")
    assert after[0].time_unix_usec == 1_790_000_002_000_000
