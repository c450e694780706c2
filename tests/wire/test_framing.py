"""The serial line's frames: golden bytes, chunks, garbage."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.wire.framing import (
    MAX_CONTENT,
    MAX_ENCODED,
    Fault,
    FaultKind,
    FrameDecoder,
    crc16,
    encode_frame,
)
from tests.kit.memory import size_of

VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "frames.json").read_text())


def test_frame_equals_one_worked_out_by_hand() -> None:
    """Content 11 00 is stuffed as 02 11, then 03 and the CRC: worked out with pencil and paper."""
    crc = crc16(b"\x11\x00").to_bytes(2, "little")
    assert 0 not in crc
    assert encode_frame(b"\x11\x00") == b"\x02\x11\x03" + crc + b"\x00"


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["name"])
class TestVectors:
    def test_encode(self, vector: dict) -> None:
        assert encode_frame(bytes.fromhex(vector["content_hex"])).hex() == vector["frame_hex"]

    @pytest.mark.parametrize("trailing", [b"", b"\x00\x00", b"\x05half"])
    def test_decode_whole_and_byte_by_byte(self, vector: dict, trailing: bytes) -> None:
        content, line = bytes.fromhex(vector["content_hex"]), bytes.fromhex(vector["frame_hex"])
        line += trailing
        decoder = FrameDecoder()
        assert FrameDecoder().feed(line) == [content]
        assert [each for byte in line for each in decoder.feed(bytes([byte]))] == [content]


def test_content_above_the_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="73 bytes"):
        encode_frame(bytes(MAX_CONTENT + 1))


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        (b"\x05ab\x00", FaultKind.COBS),
        (b"\x02\x11\x03\x01\x02\x00", FaultKind.CRC),
        (b"\x03ab\x00", FaultKind.TOO_SHORT),
        (b"\x01" * 200 + b"\x00", FaultKind.TOO_LONG),
    ],
)
def test_damaged_frame_is_one_fault_and_the_next_is_read(line: bytes, kind: FaultKind) -> None:
    good = encode_frame(b"good")
    for cut in range(len(line)):
        decoder = FrameDecoder()
        events = decoder.feed(line[:cut]) + decoder.feed(line[cut:] + good)
        assert events == [Fault(kind, len(line) - 1), b"good"]


CONTENTS = st.binary(min_size=1, max_size=MAX_CONTENT)


@given(st.lists(CONTENTS, max_size=5), st.lists(st.binary(max_size=300), max_size=5))
def test_frames_are_found_whatever_comes_before_them(
    contents: list[bytes], garbage: list[bytes]
) -> None:
    frames = [*map(encode_frame, contents)]
    assert all(frame.count(0) == 1 and len(frame) <= MAX_ENCODED + 1 for frame in frames)
    decoder = FrameDecoder()
    for data in garbage:
        assert all(isinstance(event, bytes | Fault) for event in decoder.feed(data))
    assert size_of(decoder) < 1000, "of a line without an end little is kept"
    found = decoder.feed(b"\0\0" + b"".join(frames))
    assert found[len(found) - len(frames) :] == contents
    again = FrameDecoder()
    again.feed(b"".join(garbage))
    again.reset()
    assert again.feed(b"\0\0" + b"".join(frames)) == contents, "the half frame is discarded"
