"""Any bytes, cut anywhere: only frames and faults come out, no byte is lost, nothing raises."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.wire import mavlink_splitter as splitter
from gateway.wire.frame_editing import edit_frame
from tests.kit.mavlink import frames_in, frames_of
from tests.wire.test_mavlink_splitter import FRAMES

STARTS = st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x00\x00", b"\xfd\xff\x01"])
PIECES = st.one_of(st.sampled_from(sorted(FRAMES.values())), STARTS, st.binary(max_size=40))
STREAMS = st.lists(PIECES, max_size=12).map(b"".join)


def size_of(event: splitter.Event) -> int:
    return event.size if isinstance(event, splitter.SplitFault) else len(event.data)


@given(STREAMS)
def test_every_byte_of_a_datagram_is_in_one_event(data: bytes) -> None:
    assert sum(map(size_of, splitter.split_datagram(data))) == len(data)


@given(STREAMS, st.lists(st.integers(0, 60), max_size=20))
def test_frames_do_not_depend_on_the_chunks_of_a_stream(data: bytes, sizes: list[int]) -> None:
    whole, pieces = splitter.MavlinkSplitter(), splitter.MavlinkSplitter()
    expected = frames_of(whole.feed(data))
    found, rest = [], data
    for size in [*sizes, len(data)]:
        found += frames_of(pieces.feed(rest[:size]))
        rest = rest[size:]
    # An unknown message passes if the chunk ends with it, wherever that is.
    known = [frame for frame in expected if splitter.read_datagram(frame)]
    assert [frame for frame in found if splitter.read_datagram(frame)] == known


@given(STREAMS, st.integers(0, 255))
def test_every_frame_of_any_bytes_can_be_read(data: bytes, sequence: int) -> None:
    for frame in splitter.split_datagram(data):
        if isinstance(frame, splitter.SplitFault):
            continue
        assert 0 <= frame.sequence <= 255
        assert frame.origin == splitter.origin_of(frame.data)
        assert frame.message_id == splitter.message_id_of(frame.data)
        size = 3 if frame.data[0] == splitter.START_V2 else 1
        assert frame.key == bytes(frame.origin) + frame.message_id.to_bytes(size, "little")
        assert len(frame.target) == 2
        assert frame.is_station_heartbeat in (True, False)
        numbered = edit_frame(frame, sequence=sequence, drop_signature=True)
        assert numbered is None or frames_in(numbered.data) == [numbered.data]


@given(st.integers(0, 255), st.binary(max_size=255), st.integers(0, (1 << 24) - 1))
def test_a_truncated_payload_is_read_as_zeros(flags: int, payload: bytes, message_id: int) -> None:
    head = bytes((len(payload), flags & 1, 0, 0, 9, 9)) + message_id.to_bytes(3, "little")
    frame = splitter.frame_of(b"\xfd" + head + payload + bytes(2))
    filled = splitter.frame_of(b"\xfd\xff" + head[1:] + payload.ljust(255, b"\0") + bytes(2))
    assert frame.target == filled.target
    assert frame.is_station_heartbeat == filled.is_station_heartbeat
