"""Bytes of a source in TUNNEL messages, and out of them again."""

import pytest

from gateway.records import NodeId
from gateway.sources.recorded_bytes import TunnelWriter, tunnelled

NODE = NodeId(7, 9)


@pytest.mark.parametrize("size", [0, 1, 127, 128, 129, 1000])
def test_bytes_are_the_same_after_packing_and_unpacking(size: int) -> None:
    data, writer = bytes(k % 251 for k in range(size)) + b"\0" * (size > 0), TunnelWriter(NODE)
    frames = [*writer.frames(data), *writer.frames(data)]
    assert b"".join(tunnelled(frame, NODE) for frame in frames) == data * 2
    assert [frame[4] for frame in frames] == [*range(len(frames))], "sequence numbers"


def test_bytes_of_other_sources_and_damaged_frames_are_left_out() -> None:
    (frame,) = TunnelWriter(NODE).frames(b"abc")
    assert tunnelled(frame, NodeId(7, 8)) == b""
    assert tunnelled(frame, NodeId(6, 9)) == b""
    assert tunnelled(frame[:-1] + bytes([frame[-1] ^ 1]), NODE) == b""
    heartbeat = bytes([0xFD, 9, 0, 0, 0, 7, 1, 0, 0, 0]) + bytes(11)
    assert tunnelled(heartbeat, NODE) == b""
