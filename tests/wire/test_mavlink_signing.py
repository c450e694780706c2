"""Signatures of sent frames, checked by pymavlink as the strict receiver."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.wire.mavlink_signing import FrameSigner, timestamp_of
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.mavlink import TIMESTAMP, packed, signer, strict


def attitude(sequence: int, *, version: int = 2) -> bytes:
    message = mavlink.MAVLink_attitude_message(5, 0.1, 0, 0, 0, 0, 0)
    return packed(message, sequence=sequence, version=version)


def signed_by(signer: FrameSigner, data: bytes, sequence: int, now_us: int = 0) -> bytes:
    return signer.sequence_and_sign(frame_of(data), sequence, now_us).data


def test_a_strict_receiver_accepts_a_frame_with_its_new_number() -> None:
    ours, receiver = signer(), strict()
    for sequence in (9, 255, 0, 1):
        signed = signed_by(ours, attitude(7), sequence)
        message = receiver.decode(bytearray(signed))
        assert message.get_signed()
        assert message.get_seq() == sequence
        assert message.roll == pytest.approx(0.1)


def test_an_overtaken_frame_is_signed_again_when_it_is_sent() -> None:
    ours, receiver = signer(), strict()
    first, second = (signed_by(ours, attitude(n), n) for n in (0, 1))
    receiver.decode(bytearray(second))
    with pytest.raises(mavlink.MAVError):
        receiver.decode(bytearray(first))
    renewed = signed_by(ours, first, 2)
    assert receiver.decode(bytearray(renewed)).get_seq() == 2
    assert len(renewed) == len(first)


def test_timestamps_follow_the_clock_and_always_increase() -> None:
    ours = signer()
    found = [timestamp_of(signed_by(ours, attitude(0), 0, us)) for us in (0, 0, -50, 1000)]
    assert found == [TIMESTAMP, TIMESTAMP + 1, TIMESTAMP + 2, TIMESTAMP + 100]


def test_unknown_message_is_unchanged_and_version_1_is_numbered_only() -> None:
    ours, unknown = signer(), bytes.fromhex("fd000000000101fffe0a1234")
    assert signed_by(ours, unknown, 9) == unknown
    numbered = frame_of(signed_by(ours, attitude(3, version=1), 9))
    assert (numbered.sequence, numbered.signed) == (9, False)
    assert mavlink.MAVLink(None).decode(bytearray(numbered.data)).roll == pytest.approx(0.1)


def test_a_system_without_a_key_is_numbered_and_not_signed() -> None:
    ours = signer()
    del ours.keys[1]
    frame = frame_of(attitude(3))
    assert ours.sequence_and_sign(frame, 3, 0) is frame
    numbered = ours.sequence_and_sign(frame, 9, 0)
    assert (numbered.sequence, numbered.signed) == (9, False)
