"""Another sender, and an independent decoder believes it."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.tlog import readdress
from tests.recordings.frames import make_frames


def decode(frame: bytes) -> mavlink.MAVLink_message:
    (message,) = mavlink.MAVLink(None).parse_buffer(frame)
    return message


@pytest.mark.parametrize("frame", make_frames(3))
def test_only_the_sender_changes(frame: bytes) -> None:
    before, after = decode(frame), decode(readdress(frame, 42))
    assert after.get_srcSystem() == 42
    assert after.get_srcComponent() == before.get_srcComponent()
    assert after.to_dict() == before.to_dict()


def test_mavlink_1() -> None:
    mav = mavlink.MAVLink(None, 1, 1)
    frame = bytes(
        mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(mav, force_mavlink1=True)
    )
    assert decode(readdress(frame, 9)).get_srcSystem() == 9


def test_a_signature_that_cannot_hold_is_taken_off() -> None:
    mav = mavlink.MAVLink(None, 1, 1)
    mav.signing.secret_key = bytes(32)
    mav.signing.sign_outgoing = True
    frame = bytes(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(mav))
    after = readdress(frame, 9)
    assert len(after) == len(frame) - 13
    assert decode(after).get_srcSystem() == 9


def test_an_unknown_message_is_left_alone() -> None:
    frame = b"\xfd\x00\x00\x00\x00\x01\x01\xff\xff\xff\x00\x00"
    assert readdress(frame, 9) == frame
