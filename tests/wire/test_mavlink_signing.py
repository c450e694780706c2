"""Signatures of sent frames, checked by pymavlink as the strict receiver."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.wire.mavlink_signing import FrameSigner, SigningClock
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.mavlink import packed

KEY = bytes(range(32))
TIMESTAMP = 30_000_000_000_000


def attitude(sequence: int, *, version: int = 2) -> bytes:
    message = mavlink.MAVLink_attitude_message(5, 0.1, 0, 0, 0, 0, 0)
    return packed(message, sequence=sequence, version=version)


def strict() -> Any:
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key, receiver.signing.timestamp = KEY, TIMESTAMP
    return receiver


class Clock(SigningClock):
    """The time in signing ticks, whatever the gateway's clock says."""

    def __init__(self) -> None:
        super().__init__(0)
        self.ticks = TIMESTAMP

    def timestamp(self, now_us: int) -> int:
        return self.ticks


def signer(clock: Clock) -> FrameSigner:
    signer = FrameSigner(clock)
    signer.keys[1] = KEY
    return signer


def signed_by(signer: FrameSigner, data: bytes, sequence: int) -> bytes:
    return signer.sequence_and_sign(frame_of(data), sequence, 0).data


def test_a_strict_receiver_accepts_a_frame_with_its_new_number() -> None:
    ours, receiver = signer(Clock()), strict()
    for sequence in (9, 255, 0, 1):
        signed = signed_by(ours, attitude(7), sequence)
        message = receiver.decode(bytearray(signed))
        assert message.get_signed()
        assert message.get_seq() == sequence
        assert message.roll == pytest.approx(0.1)


def test_an_overtaken_frame_is_signed_again_when_it_is_sent() -> None:
    ours, receiver = signer(Clock()), strict()
    first, second = (signed_by(ours, attitude(n), n) for n in (0, 1))
    receiver.decode(bytearray(second))
    with pytest.raises(mavlink.MAVError):
        receiver.decode(bytearray(first))
    renewed = signed_by(ours, first, 2)
    assert receiver.decode(bytearray(renewed)).get_seq() == 2
    assert len(renewed) == len(first)


def test_timestamps_follow_the_clock_and_always_increase() -> None:
    clock = Clock()
    ours, found = signer(clock), []
    for clock.ticks in (TIMESTAMP, TIMESTAMP, TIMESTAMP - 5, TIMESTAMP + 100):
        found.append(int.from_bytes(signed_by(ours, attitude(0), 0)[-12:-6], "little"))
    assert found == [TIMESTAMP, TIMESTAMP + 1, TIMESTAMP + 2, TIMESTAMP + 100]


def test_unknown_message_is_unchanged_and_version_1_is_numbered_only() -> None:
    ours, unknown = signer(Clock()), bytes.fromhex("fd000000000101fffe0a1234")
    assert signed_by(ours, unknown, 9) == unknown
    numbered = frame_of(signed_by(ours, attitude(3, version=1), 9))
    assert (numbered.sequence, numbered.signed) == (9, False)
    assert mavlink.MAVLink(None).decode(bytearray(numbered.data)).roll == pytest.approx(0.1)


def test_a_system_without_a_key_is_numbered_and_not_signed() -> None:
    ours = signer(Clock())
    del ours.keys[1]
    frame = frame_of(attitude(3))
    assert ours.sequence_and_sign(frame, 3, 0) is frame
    numbered = ours.sequence_and_sign(frame, 9, 0)
    assert (numbered.sequence, numbered.signed) == (9, False)
