from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.alerts import AlertLevel, alerts_of
from gateway.panel.state.vehicle import VehicleState
from gateway.units import US_PER_S

HEARTBEAT = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)


def gps(fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        0, fix_type, 480000000, 110000000, 500000, 100, 100, 0, 0, 9
    )


def say(vehicle: VehicleState, text: str, now_us: int, severity: int = 2) -> None:
    vehicle.take(mavlink.MAVLink_statustext_message(severity, text.encode()), now_us)


def titles(vehicle: VehicleState, now_us: int) -> list[str]:
    return [alert.title for alert in alerts_of(vehicle, now_us)]


def vehicle_at(now_us: int = 0) -> VehicleState:
    vehicle = VehicleState(1)
    vehicle.take(HEARTBEAT, now_us)
    return vehicle


def test_all_is_well() -> None:
    vehicle = vehicle_at()
    vehicle.take(gps(3), 0)
    assert titles(vehicle, US_PER_S) == []


def test_gps_that_was_never_there_is_no_loss() -> None:
    vehicle = vehicle_at()
    vehicle.take(gps(0), 0)
    assert titles(vehicle, 0) == []


def test_gps_lost_and_found() -> None:
    vehicle = vehicle_at()
    vehicle.take(gps(3), 0)
    vehicle.take(gps(0), 1)
    [alert] = alerts_of(vehicle, 2)
    assert (alert.title, alert.level) == ("GPS lost", AlertLevel.CRITICAL)
    vehicle.take(gps(3), 3)
    assert titles(vehicle, 4) == []


def test_gps_that_says_nothing_more() -> None:
    vehicle = vehicle_at()
    vehicle.take(gps(3), 0)
    vehicle.take(HEARTBEAT, 6 * US_PER_S)
    [alert] = alerts_of(vehicle, 6 * US_PER_S)
    assert (alert.title, alert.detail) == ("GPS lost", "nothing from the receiver for 6 s")


def test_node_silent_until_it_is_back() -> None:
    vehicle = vehicle_at()
    say(vehicle, "IMU node 1 silent", 0)
    say(vehicle, "GPS node 2 silent", 0)
    assert titles(vehicle, 1) == ["IMU node 1 silent", "GPS node 2 silent"]
    say(vehicle, "IMU node 1 is back", 2, severity=6)
    assert titles(vehicle, 3) == ["GPS node 2 silent"]
    say(vehicle, "Receiver connected: /dev/ttyUSB0", 4, severity=6)
    assert titles(vehicle, 5) == []


def test_receiver_lost() -> None:
    vehicle = vehicle_at()
    say(vehicle, "Receiver lost: /dev/ttyUSB0", 0)
    assert titles(vehicle, 1) == ["Receiver lost"]


def test_recording_failed_until_one_runs() -> None:
    vehicle = vehicle_at()
    for text in ("Recording stopped: less than 100 MB free", "Cannot record: No space left"):
        say(vehicle, text, 0, severity=4)
        [alert] = alerts_of(vehicle, 1)
        assert (alert.title, alert.detail) == ("Recording failed", text.partition(": ")[2])
        say(vehicle, "Recording 2026-11-22_001122", 2, severity=5)
        assert titles(vehicle, 3) == []


def test_sensors_that_are_not_healthy() -> None:
    vehicle = vehicle_at()
    mag, gyro = 4, 1
    vehicle.take(mavlink.MAVLink_sys_status_message(mag | gyro, mag | gyro, gyro, *[0] * 10), 0)
    [alert] = alerts_of(vehicle, 1)
    assert alert.detail == "magnetometer"


def test_grave_words_of_any_vehicle_stand_for_a_while() -> None:
    vehicle = vehicle_at()
    say(vehicle, "Crash: Disarming", 0)
    assert titles(vehicle, 1) == ["Crash: Disarming"]
    vehicle.take(HEARTBEAT, 30 * US_PER_S)
    assert titles(vehicle, 30 * US_PER_S) == []


def test_words_of_nothing_are_no_alert() -> None:
    vehicle = vehicle_at()
    say(vehicle, "", 0)
    say(vehicle, "  ", 0)
    assert titles(vehicle, 1) == []
    assert not vehicle.texts.all


def test_silent_aircraft_hides_its_other_alerts() -> None:
    vehicle = vehicle_at()
    say(vehicle, "IMU node 1 silent", 0)
    assert titles(vehicle, 10 * US_PER_S) == ["Aircraft silent"]
