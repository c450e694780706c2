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


def say(picture: VehicleState, text: str, now_us: int, severity: int = 2) -> None:
    picture.take(mavlink.MAVLink_statustext_message(severity, text.encode()), now_us)


def titles(picture: VehicleState, now_us: int) -> list[str]:
    return [alert.title for alert in alerts_of(picture, now_us)]


def picture_at(now_us: int = 0) -> VehicleState:
    picture = VehicleState(1)
    picture.take(HEARTBEAT, now_us)
    return picture


def test_all_is_well() -> None:
    picture = picture_at()
    picture.take(gps(3), 0)
    assert titles(picture, US_PER_S) == []


def test_gps_that_was_never_there_is_no_loss() -> None:
    picture = picture_at()
    picture.take(gps(0), 0)
    assert titles(picture, 0) == []


def test_gps_lost_and_found() -> None:
    picture = picture_at()
    picture.take(gps(3), 0)
    picture.take(gps(0), 1)
    [alert] = alerts_of(picture, 2)
    assert (alert.title, alert.level) == ("GPS lost", AlertLevel.CRITICAL)
    picture.take(gps(3), 3)
    assert titles(picture, 4) == []


def test_gps_that_says_nothing_more() -> None:
    picture = picture_at()
    picture.take(gps(3), 0)
    picture.take(HEARTBEAT, 6 * US_PER_S)
    [alert] = alerts_of(picture, 6 * US_PER_S)
    assert (alert.title, alert.detail) == ("GPS lost", "nothing from the receiver for 6 s")


def test_node_silent_until_it_is_back() -> None:
    picture = picture_at()
    say(picture, "IMU node 1 silent", 0)
    say(picture, "GPS node 2 silent", 0)
    assert titles(picture, 1) == ["IMU node 1 silent", "GPS node 2 silent"]
    say(picture, "IMU node 1 is back", 2, severity=6)
    assert titles(picture, 3) == ["GPS node 2 silent"]
    say(picture, "Receiver connected: /dev/ttyUSB0", 4, severity=6)
    assert titles(picture, 5) == []


def test_receiver_lost() -> None:
    picture = picture_at()
    say(picture, "Receiver lost: /dev/ttyUSB0", 0)
    assert titles(picture, 1) == ["Receiver lost"]


def test_recording_failed_until_one_runs() -> None:
    picture = picture_at()
    for text in ("Recording stopped: less than 100 MB free", "Cannot record: No space left"):
        say(picture, text, 0, severity=4)
        [alert] = alerts_of(picture, 1)
        assert (alert.title, alert.detail) == ("Recording failed", text.partition(": ")[2])
        say(picture, "Recording 2026-11-22_001122", 2, severity=5)
        assert titles(picture, 3) == []


def test_sensors_that_are_not_healthy() -> None:
    picture = picture_at()
    mag, gyro = 4, 1
    picture.take(mavlink.MAVLink_sys_status_message(mag | gyro, mag | gyro, gyro, *[0] * 10), 0)
    [alert] = alerts_of(picture, 1)
    assert alert.detail == "magnetometer"


def test_grave_words_of_any_vehicle_stand_for_a_while() -> None:
    picture = picture_at()
    say(picture, "Crash: Disarming", 0)
    assert titles(picture, 1) == ["Crash: Disarming"]
    picture.take(HEARTBEAT, 30 * US_PER_S)
    assert titles(picture, 30 * US_PER_S) == []


def test_words_of_nothing_are_no_alert() -> None:
    picture = picture_at()
    say(picture, "", 0)
    say(picture, "  ", 0)
    assert titles(picture, 1) == []
    assert not picture.texts.all


def test_silent_aircraft_hides_what_is_no_longer_known() -> None:
    picture = picture_at()
    say(picture, "IMU node 1 silent", 0)
    assert titles(picture, 10 * US_PER_S) == ["Aircraft silent"]
