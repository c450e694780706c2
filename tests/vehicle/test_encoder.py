import math
import random

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle import encoding
from gateway.vehicle.encoding import Encoder, MessagePacker
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.ground_station import decode
from tests.kit.mavlink import random_message


def test_frames_are_numbered_in_one_sequence_per_system() -> None:
    first, second = Encoder(1), Encoder(2)
    message = mavlink.MAVLink_ping_message(7, 0, 0, 0)
    frames = [first.encode(message, client_id=9) for _ in range(300)] + [second.encode(message)]
    found = decode(frames)
    assert [m.get_seq() for m in found[:300]] == [n % 256 for n in range(300)]
    assert (found[300].get_seq(), found[300].get_srcSystem()) == (0, 2)
    assert {m.get_srcComponent() for m in found} == {1}
    assert (frames[0].message_id, frames[0].client_id) == (4, 9)


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e300, -1e300, math.nan])
def test_numbers_beyond_their_fields_are_saturated(value: float) -> None:
    huge = 10**30 if value > 0 else -(10**30)
    message = mavlink.MAVLink_global_position_int_message(*[huge] * 9)
    packed = MessagePacker(mavlink.MAVLink_global_position_int_message)(*[huge] * 9)
    assert Encoder(1).encode(message) == Encoder(1).encode(packed)
    [found] = decode([Encoder(1).encode(message)])
    assert found.lat == (2**31 - 1 if value > 0 else -(2**31))
    assert found.hdg == (65535 if value > 0 else 0)
    [hud] = decode([Encoder(1).encode(mavlink.MAVLink_vfr_hud_message(*[value] * 6))])
    assert math.isnan(hud.alt) if math.isnan(value) else abs(hud.alt) > 3e38
    home = mavlink.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [value, 0.5, 0, 0], 0, 0, 0)
    [found] = decode([Encoder(1).encode(home)])
    assert found.q[:2] == pytest.approx([hud.alt, 0.5], nan_ok=True), "item by item"


def test_every_message_of_the_dialect_is_framed_and_packed_as_pymavlink_does() -> None:
    for kind in mavlink.mavlink_map.values():
        chance, plain, ours = random.Random(kind.id), mavlink.MAVLink(None, 7, 1), Encoder(7)
        is_numeric = "char" not in kind.fieldtypes and len(kind.ordered_fieldnames) > 1
        for _ in range(8):
            message, values = random_message(kind, chance), []
            expected = message.pack(plain)
            plain.seq += 1
            assert ours.encode(message).frame == expected, kind.msgname
            for name in kind.fieldnames if is_numeric else ():
                value = getattr(message, name)
                values += value if isinstance(value, list) else [value]
            if is_numeric:
                packed = Encoder(7).encode(MessagePacker(kind)(*values))
                assert packed == Encoder(7).encode(message), kind.msgname
                assert packed.header in (None, frame_of(packed.frame)), kind.msgname


@pytest.mark.parametrize(
    ("fit", "unknown", "low", "high"),
    [
        (encoding.uint8, 255, 0, 254),
        (encoding.uint16, 65535, 0, 65534),
        (encoding.int16, 0, -32768, 32767),
        (encoding.int32, 0, -(2**31), 2**31 - 1),
        (encoding.uint32, 0, 0, 2**32 - 1),
    ],
)
def test_integer_is_saturated_and_nan_is_its_unknown_value(
    fit: object, unknown: int, low: int, high: int
) -> None:
    assert fit(math.nan) == unknown
    assert fit(-math.inf) == fit(-1e300) == low
    assert fit(math.inf) == fit(1e300) == high
    assert fit(12.5001) == 13
    assert isinstance(fit(12.2), int)
    assert encoding.uint16(1e9, unknown=0) == 65535, "with another unknown value the whole range"


@pytest.mark.parametrize(
    ("deg", "cdeg", "whole"),
    [(0.0, 0, 0), (-0.001, 0, 0), (359.999, 0, 0), (-90.0, 27000, 270), (180.0, 18000, 180)],
)
def test_heading_is_encoded_between_0_and_360_degrees(deg: float, cdeg: int, whole: int) -> None:
    assert encoding.compass_cdeg(math.radians(deg)) == cdeg
    assert encoding.compass_deg(math.radians(deg)) == whole
    assert encoding.compass_cdeg(math.nan) == 65535
