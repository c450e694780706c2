"""Any bytes, cut anywhere: only frames and faults come out, no byte is lost, nothing raises."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.wire.mavlink_splitter import (
    MavlinkSplitter,
    SplitFault,
    is_frame,
    is_signed,
    is_station_heartbeat,
    key_of,
    message_id_of,
    origin_of,
    restamp,
    sequence_of,
    split_datagram,
    target_of,
)
from tests.wire.test_mavlink_splitter import FRAMES

STARTS = st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x00\x00", b"\xfd\xff\x01"])
PIECES = st.one_of(st.sampled_from(sorted(FRAMES.values())), STARTS, st.binary(max_size=40))
STREAMS = st.lists(PIECES, max_size=12).map(b"".join)


def size_of(event: bytes | SplitFault) -> int:
    return event.size if isinstance(event, SplitFault) else len(event)


@given(STREAMS)
def test_every_byte_of_a_datagram_is_in_one_event(data: bytes) -> None:
    assert sum(map(size_of, split_datagram(data))) == len(data)


@given(STREAMS, st.lists(st.integers(0, 60), max_size=20))
def test_it_does_not_matter_where_a_stream_is_cut(data: bytes, sizes: list[int]) -> None:
    whole, pieces = MavlinkSplitter(), MavlinkSplitter()
    expected = [event for event in whole.feed(data) if isinstance(event, bytes)]
    found, rest = [], data
    for size in [*sizes, len(data)]:
        found += [event for event in pieces.feed(rest[:size]) if isinstance(event, bytes)]
        rest = rest[size:]
    # An unknown message is believed if the chunk ends with it, wherever that is.
    assert [f for f in found if is_frame(f)] == [f for f in expected if is_frame(f)]


@given(STREAMS, st.integers(0, 255))
def test_whatever_is_cut_out_can_be_read(data: bytes, sequence: int) -> None:
    for frame in split_datagram(data):
        if isinstance(frame, SplitFault):
            continue
        assert 0 <= sequence_of(frame) <= 255
        assert len(origin_of(frame)) == len(target_of(frame)) == 2
        assert message_id_of(frame) >= 0
        assert key_of(frame)
        assert is_station_heartbeat(frame) in (True, False)
        numbered = restamp(frame, sequence)
        assert len(numbered) == len(frame)
        assert split_datagram(numbered) == [numbered] or is_signed(frame)


@given(st.integers(0, 255), st.binary(max_size=255), st.integers(0, (1 << 24) - 1))
def test_a_payload_cut_short_is_read_as_zeros(flags: int, payload: bytes, message_id: int) -> None:
    head = bytes((len(payload), flags & 1, 0, 0, 9, 9)) + message_id.to_bytes(3, "little")
    frame = b"\xfd" + head + payload + bytes(2)
    filled = b"\xfd\xff" + head[1:] + payload.ljust(255, b"\0") + bytes(2)
    assert target_of(frame) == target_of(filled)
    assert is_station_heartbeat(frame) == is_station_heartbeat(filled)
