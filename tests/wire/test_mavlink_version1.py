"""MAVLink 1 frames, against pymavlink's dialects of that version."""

import numpy as np
import pytest
from pymavlink.dialects.v10 import all as v1
from pymavlink.dialects.v20 import all as v2

from gateway.wire.mavlink_messages import base_size
from gateway.wire.mavlink_splitter import to_mavlink1


def test_size_without_extensions_is_that_of_the_older_dialect() -> None:
    for message_id, message in v1.mavlink_map.items():
        assert base_size(message_id) == message.unpacker.size, message.msgname


@pytest.mark.parametrize("seed", range(3))
def test_every_message_is_byte_equal_to_the_older_encoder(seed: int) -> None:
    rng = np.random.default_rng(seed)
    encoder = v1.MAVLink(None, 7, 1)
    encoder.seq = 9
    for message_id, kind in v1.mavlink_map.items():
        payload = bytes(rng.integers(0, 128, kind.unpacker.size, np.uint8))
        body = payload.rstrip(b"\0") or payload[:1]
        content = bytes((len(body), 0, 0, 9, 7, 1, message_id, 0, 0)) + body
        crc = v2.x25crc(content + bytes((kind.crc_extra,))).crc
        frame = b"\xfd" + content + crc.to_bytes(2, "little")
        older = to_mavlink1(frame)
        assert older is not None
        head = bytes((0xFE, len(payload), 9, 7, 1, message_id))
        crc = v1.x25crc(head[1:] + payload + bytes((kind.crc_extra,))).crc
        assert older == head + payload + crc.to_bytes(2, "little")
        assert to_mavlink1(older) is older


def test_extensions_are_cut_and_new_messages_left_out() -> None:
    link = v2.MAVLink(None, 1, 1)
    raw = v2.MAVLink_gps_raw_int_message(1, 3, 2, 3, 4, 5, 6, 7, 8, 9, h_acc=1234, hdg_acc=5)
    older = to_mavlink1(raw.pack(link))
    assert older is not None
    found = v1.MAVLink(None).decode(bytearray(older))
    assert (found.get_type(), found.lat, found.satellites_visible) == ("GPS_RAW_INT", 2, 9)
    new = v2.MAVLink_odometry_message(*[0] * 6, [1, 0, 0, 0], *[0] * 6, [0] * 21, [0] * 21)
    assert to_mavlink1(new.pack(link)) is None
