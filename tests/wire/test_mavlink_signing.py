"""Signatures of what leaves, checked by pymavlink as the strict receiver."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.wire.mavlink_signing import Signer

KEY = bytes(range(32))
STAMP = 30_000_000_000_000


def attitude(sequence: int, *, version: int = 2) -> bytes:
    mav = mavlink.MAVLink(None, 1, 1)
    mav.seq = sequence
    message = mavlink.MAVLink_attitude_message(5, 0.1, 0, 0, 0, 0, 0)
    return bytes(message.pack(mav, force_mavlink1=version == 1))


def strict() -> Any:
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key, receiver.signing.timestamp = KEY, STAMP
    return receiver


def test_a_strict_receiver_takes_it_with_its_new_number() -> None:
    signer, receiver = Signer(), strict()
    for sequence in (9, 255, 0, 1):
        signed = signer.sign(attitude(7), sequence, KEY, STAMP)
        message = receiver.decode(bytearray(signed))
        assert message.get_signed()
        assert message.get_seq() == sequence
        assert message.roll == pytest.approx(0.1)


def test_a_frame_that_was_overtaken_is_signed_anew_in_the_order_of_leaving() -> None:
    signer, receiver = Signer(), strict()
    first, second = (signer.sign(attitude(n), n, KEY, STAMP) for n in (0, 1))
    receiver.decode(bytearray(second))
    with pytest.raises(mavlink.MAVError):
        receiver.decode(bytearray(first))
    renewed = signer.sign(first, 2, KEY, STAMP)
    assert receiver.decode(bytearray(renewed)).get_seq() == 2
    assert len(renewed) == len(first)


def test_stamps_follow_the_clock_and_never_stand_still() -> None:
    signer = Signer()
    stamps = [
        int.from_bytes(signer.sign(attitude(0), 0, KEY, now)[-12:-6], "little")
        for now in (STAMP, STAMP, STAMP - 5, STAMP + 100)
    ]
    assert stamps == [STAMP, STAMP + 1, STAMP + 2, STAMP + 100]


def test_what_cannot_be_signed_stays() -> None:
    old, unknown = attitude(3, version=1), bytes.fromhex("fd000000000101fffe0a1234")
    assert Signer().sign(old, 9, KEY, STAMP) == old
    assert Signer().sign(unknown, 9, KEY, STAMP) == unknown
