"""MAVLink 2 signing, checked against pymavlink as the other side."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.service import LogWarning
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire import mavlink_signing as signing
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, of_kind
from tests.kit.mavlink import packed

NOW_UNIX_US = 1_790_000_000_000_000
KEY = signing.key_from_passphrase("correct horse")
SET = mavlink.MAVLink_param_set_message(1, 1, b"RATE_ATT", 5.0, mavlink.MAV_PARAM_TYPE_REAL32)


def ticks(unix_us: int) -> int:
    return (unix_us - signing.EPOCH_2015_US) // 10


@pytest.fixture
def vehicle() -> Vehicle:
    settings = VehicleSettings(signing_passphrase="correct horse")
    return Vehicle(settings, 1, clock=signing.SigningClock(NOW_UNIX_US))


def sign(station: GroundStation, key: bytes = KEY, at_us: int = NOW_UNIX_US) -> None:
    signing = station.mav.signing
    signing.secret_key, signing.sign_outgoing, signing.timestamp = key, True, ticks(at_us)


def changed(found: list[Any]) -> bool:
    return [m.param_value for m in of_kind(found, "PARAM_VALUE")] == [5.0]


def test_key_is_the_hash_of_the_passphrase() -> None:
    assert len(KEY) == signing.KEY_BYTES
    assert KEY.hex().startswith("4104d36f"), "sha256sum of the passphrase"


@pytest.mark.parametrize(
    ("signed", "trusted", "version"),
    [(False, True, 1), (False, True, 2), (True, False, 2), (True, True, 2)],
    ids=["version 1", "unsigned", "untrusted", "signed"],
)
def test_only_a_signed_request_of_a_trusted_client_changes_a_parameter(
    station: GroundStation, signed: bool, trusted: bool, version: int
) -> None:
    station.version, station.trusted = version, trusted
    if signed:
        sign(station)
    assert changed(station.send(SET)) == (signed and trusted)
    read = mavlink.MAVLink_param_request_read_message(1, 1, b"RATE_ATT", -1)
    assert station.send(read)[0].param_value == (5.0 if signed and trusted else 50.0)


def test_replayed_frame_is_dropped(station: GroundStation) -> None:
    """Even after a passphrase was changed and restored."""
    sign(station)
    frame = station.frame(SET)
    assert changed(station.send_bytes(frame)), "which is a change of the vehicle's settings"
    for _ in range(10):
        assert station.send_bytes(frame) == []
    change(station, "another horse")
    change(station, "correct horse")
    assert station.send_bytes(frame) == []
    assert station.vehicle.faults["bad signature"] == 11


@pytest.mark.parametrize(
    ("key", "behind_s", "reason"),
    [
        ("wrong", 0, "signed with another passphrase"),
        ("wrong", 180, "signed with another passphrase"),
        ("correct horse", 180, "its clock is 180 s behind"),
        ("correct horse", 86_400, "its clock is 86000 s behind"),
    ],
)
def test_refused_signature_is_listed_and_logged_with_its_reason(
    station: GroundStation, key: str, behind_s: int, reason: str
) -> None:
    for _ in range(30):
        sent_us = NOW_UNIX_US + station.clock.now_us - behind_s * 1_000_000
        sign(station, signing.key_from_passphrase(key), sent_us)
        assert station.send(SET) == []
        station.clock.now_us += 1_000_000
    assert station.vehicle.faults["bad signature"] == 30
    (entry,) = station.vehicle.requests.entries
    assert (entry.system_id, entry.component_id, entry.count) == (255, 190, 30)
    assert entry.outcome == f"refused: {reason}"
    sign(station, at_us=NOW_UNIX_US + station.clock.now_us)
    assert changed(station.send(SET)), "it does not lock out the true sender"
    lines = [action.text for action in station.of(LogWarning)]
    assert lines == [f"aircraft 1 refused the signature of system 255, component 190: {reason}"] * 2


@pytest.mark.parametrize("position", [3, 5, 10, 20, -1, -7, -13])
def test_signed_frame_with_changed_byte_is_rejected(station: GroundStation, position: int) -> None:
    sign(station)
    frame = bytearray(station.frame(SET))
    frame[position] ^= 0x01
    assert not changed(station.send_bytes(bytes(frame)))


def test_signed_frame_is_accepted_unchecked_without_a_key(clock: ManualClock) -> None:
    station = GroundStation(Vehicle(VehicleSettings(), 1), clock)
    sign(station)
    assert changed(station.send(SET))


def change(station: GroundStation, passphrase: str) -> None:
    settings = VehicleSettings(signing_passphrase=passphrase)
    station.vehicle.apply_settings("vehicle", settings)


def test_changed_passphrase_takes_effect_at_once(station: GroundStation) -> None:
    sign(station)
    old = station.frame(SET)
    change(station, "another horse")
    assert station.send_bytes(old) == []
    sign(station, signing.key_from_passphrase("another horse"))
    assert changed(station.send(SET))
    assert station.vehicle.signing_key == signing.key_from_passphrase("another horse")
    change(station, "")
    station.mav.signing.sign_outgoing = False
    assert changed(station.send(SET))
    assert station.vehicle.signing_key is None


def test_number_of_streams_is_bounded() -> None:
    verifier = signing.Verifier(KEY, signing.SigningClock(NOW_UNIX_US))
    senders = [(number % 256, 1 + number // 256) for number in range(2 * signing.MAX_STREAMS)]
    accepted = sum(not verifier.rejection(ping(sender=sender), 0) for sender in senders)
    assert accepted == signing.MAX_STREAMS


def test_short_key_raises_value_error() -> None:
    with pytest.raises(ValueError, match="31 bytes"):
        signing.Verifier(bytes(31), signing.SigningClock(0))


def ping(at_us: int = NOW_UNIX_US, sender: tuple[int, int] = (255, 190)) -> bytes:
    message = mavlink.MAVLink_ping_message(0, 0, 0, 0)
    return packed(message, *sender, signing=(KEY, 0, ticks(at_us)))


@pytest.mark.parametrize("orderly", [True, False])
def test_frame_is_not_accepted_again_after_a_restart(orderly: bool) -> None:
    clock, timestamps = signing.SigningClock(NOW_UNIX_US), signing.SigningTimestamps()
    verifier, kept = signing.Verifier(KEY, clock, timestamps), timestamps.to_keep()
    taken = [ping(NOW_UNIX_US + n * 100_000) for n in range(100)]
    for frame in taken:
        assert not verifier.rejection(frame, 0)
        if timestamps.is_due:
            kept = timestamps.to_keep()
    again = signing.SigningTimestamps(timestamps.exact() if orderly else kept)
    verifier = signing.Verifier(KEY, signing.SigningClock(NOW_UNIX_US - 86_400_000_000), again)
    assert not any(not verifier.rejection(frame, 0) for frame in taken)
    reserve_us = 0 if orderly else signing.RESERVE_TICKS * 10
    assert not verifier.rejection(ping(NOW_UNIX_US + 10_000_000 + reserve_us), 0)


def test_timestamps_of_a_busy_stream_are_written_every_few_seconds() -> None:
    timestamps = signing.SigningTimestamps()
    verifier, written = signing.Verifier(KEY, signing.SigningClock(NOW_UNIX_US), timestamps), 0
    for n in range(600):
        assert not verifier.rejection(ping(NOW_UNIX_US + n * 100_000), 0)
        if timestamps.is_due:
            written += 1
            timestamps.to_keep()
    assert 12 <= written <= 13, "a minute"


def test_old_recording_is_rejected_once_gps_time_is_known() -> None:
    day_us = 86_400_000_000
    clock = signing.SigningClock(NOW_UNIX_US - day_us)
    assert not signing.Verifier(KEY, clock).rejection(ping(NOW_UNIX_US - day_us), 0)
    clock.set_gps_time(NOW_UNIX_US)
    assert signing.Verifier(KEY, clock).rejection(ping(NOW_UNIX_US - day_us), 0)
    assert not signing.Verifier(KEY, clock).rejection(ping(NOW_UNIX_US), 0)


def test_oldest_key_is_discarded_beyond_the_limit() -> None:
    timestamps = signing.SigningTimestamps()
    for n in range(2 * signing.MAX_KEYS):
        assert timestamps.accept(f"{n}", "0.1.1", n, oldest=0)
    kept = range(signing.MAX_KEYS, 2 * signing.MAX_KEYS)
    assert list(timestamps.exact()) == [f"{n}" for n in kept]
    again = signing.SigningTimestamps(timestamps.to_keep())
    newest = signing.MAX_KEYS + signing.RESERVE_TICKS
    assert not again.accept(f"{signing.MAX_KEYS}", "0.1.1", newest, oldest=0)
    assert again.accept(f"{signing.MAX_KEYS}", "0.1.1", newest + 1, oldest=0)
