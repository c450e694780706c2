"""Frames are cut out byte for byte, whatever surrounds them and however the bytes arrive."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect

from gateway.wire.frame_editing import edit_frame
from gateway.wire.framing import Fault, FaultKind
from gateway.wire.mavlink_messages import CRC_EXTRA, MESSAGE_IDS, MESSAGE_NAMES
from gateway.wire.mavlink_splitter import (
    KEPT_PEERS,
    KEPT_US,
    MAX_FALSE_STARTS,
    START_V2,
    DatagramSplitter,
    Event,
    MavFrame,
    MavlinkSplitter,
    frame_of,
    message_id_of,
    origin_of,
    read_datagram,
    split_datagram,
)
from tests.kit.ground_station import OWN_MESSAGES
from tests.kit.mavlink import KEY, frames_in, frames_of, packed

HEARTBEAT = dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)
COMMAND = dialect.MAVLink_command_long_message(9, 3, 512, 0, 1, 2, 3, 4, 5, 6, 7)
V2 = packed(HEARTBEAT, 7)
V2_SIGNED = packed(HEARTBEAT, 7, signing=(KEY, 1, 1))
V2_COMMAND = packed(COMMAND, 7)
V1 = packed(HEARTBEAT, 7, version=1)
LARGE_ID = packed(dialect.MAVLink_play_tune_message(9, 3, b"a"), 7)
UNKNOWN = b"\xfd\x02\x00\x00\x05\x07\x01\xff\xff\x7f\x01\x02\xaa\xbb"
FRAMES = {
    "version 2": V2,
    "signed": V2_SIGNED,
    "command": V2_COMMAND,
    "id of two bytes": LARGE_ID,
    "version 1": V1,
    "unknown": UNKNOWN,
}


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES.keys())
class TestOneFrame:
    def test_it_is_given_whole_and_byte_by_byte(self, frame: bytes) -> None:
        splitter = MavlinkSplitter()
        assert frames_in(frame) == frames_of(splitter.feed(frame)) == [frame]
        events = [event for byte in frame for event in splitter.feed(bytes((byte,)))]
        assert [event.data for event in events] == [frame]

    def test_garbage_before_it_is_one_fault(self, frame: bytes) -> None:
        events = split_datagram(b"hello" + frame)
        assert events[0] == Fault(FaultKind.GARBAGE, 5)
        assert frames_of(events) == [frame]

    def test_a_cut_frame_does_not_swallow_the_next(self, frame: bytes) -> None:
        checked = len(frame) - 13 if frame is V2_SIGNED else len(frame)
        for cut in range(1, checked):
            events = MavlinkSplitter().feed(frame[:cut] + V2_COMMAND + V2 * 30)
            frames = frames_of(events)
            assert V2_COMMAND in frames
            assert frames.count(V2) == 30


@pytest.mark.parametrize("name", FRAMES)
def test_a_datagram_is_read_at_once_only_if_it_is_one_plain_frame(name: str) -> None:
    frame = FRAMES[name]
    found = read_datagram(frame)
    assert (found is not None) == (name in {"version 2", "command", "id of two bytes"})
    if found is not None:
        assert [found] == split_datagram(frame)
    assert read_datagram(frame + b"x") is None
    assert read_datagram(frame[:-1]) is None
    assert read_datagram(b"") is None
    for at in range(len(frame)):
        damaged = frame[:at] + bytes((frame[at] ^ 1,)) + frame[at + 1 :]
        assert read_datagram(damaged) is None


CRC = FaultKind.CRC


@pytest.mark.parametrize(
    ("data", "frames", "faults"),
    [
        (b"", [], []),
        (V2[:-1] + bytes((V2[-1] ^ 1,)), [], [Fault(CRC, len(V2))]),
        # An unknown frame before garbage is dropped.
        (UNKNOWN + b"xyz" + V2, [V2], [Fault(CRC, len(UNKNOWN) + 3)]),
        # An unknown incompatibility flag.
        (V2[:2] + b"\x02" + V2[3:], [], [Fault(CRC, len(V2))]),
    ],
    ids=["empty", "damaged", "unknown", "flagged"],
)
def test_bytes_of_no_frame_are_a_fault(
    data: bytes, frames: list[bytes], faults: list[Fault]
) -> None:
    events = split_datagram(data)
    assert frames_of(events) == frames
    assert [event for event in events if isinstance(event, Fault)] == faults


STARTS = st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x00\x00", b"\xfd\xff\x01"])
KNOWN = st.sampled_from([V2, V1, V2_SIGNED, V2_COMMAND, LARGE_ID])
PIECES = st.one_of(KNOWN, st.just(UNKNOWN), STARTS, st.binary(max_size=40))
STREAMS = st.lists(PIECES, max_size=12).map(b"".join)
NOISE = st.binary(max_size=5).map(lambda data: bytes(byte % 0xF0 for byte in data))


def in_chunks(data: bytes, sizes: list[int]) -> list[Event]:
    """Split a stream that arrives in chunks of these sizes, and then the rest of it."""
    splitter, found = MavlinkSplitter(), []
    for size in [*sizes, len(data)]:
        found += splitter.feed(data[:size])
        data = data[size:]
    return found


@given(st.lists(st.tuples(NOISE, KNOWN), max_size=12), st.lists(st.integers(0, 60), max_size=20))
def test_frames_between_noise_are_all_found_and_every_byte_is_counted(
    sent: list[tuple[bytes, bytes]], sizes: list[int]
) -> None:
    data = b"".join(noise + frame for noise, frame in sent)
    events = in_chunks(data, sizes)
    assert frames_of(events) == [frame for _, frame in sent]
    assert sum(map(size_of, events)) == len(data)


def size_of(event: Event) -> int:
    return event.size if isinstance(event, Fault) else len(event.data)


@given(STREAMS, st.lists(st.integers(0, 60), max_size=20))
def test_frames_of_any_bytes_do_not_depend_on_the_chunks(data: bytes, sizes: list[int]) -> None:
    assert sum(map(size_of, split_datagram(data))) == len(data)
    # An unknown message passes if the chunk ends with it, wherever that is.
    whole, parts = (
        [frame for frame in frames_of(events) if read_datagram(frame)]
        for events in (MavlinkSplitter().feed(data), in_chunks(data, sizes))
    )
    assert whole == parts


@given(STREAMS, st.integers(0, 255))
def test_every_frame_of_any_bytes_can_be_read(data: bytes, sequence: int) -> None:
    for frame in split_datagram(data):
        if isinstance(frame, Fault):
            continue
        assert frame.origin == origin_of(frame.data)
        assert frame.message_id == message_id_of(frame.data)
        size = 3 if frame.data[0] == START_V2 else 1
        assert frame.key == bytes(frame.origin) + frame.message_id.to_bytes(size, "little")
        numbered = edit_frame(frame, sequence=sequence, drop_signature=True)
        assert numbered is None or frames_in(numbered.data) == [numbered.data]


@given(st.integers(0, 255), st.binary(max_size=255), st.integers(0, (1 << 24) - 1))
def test_bytes_cut_off_a_payload_are_zeros(flags: int, payload: bytes, message_id: int) -> None:
    head = bytes((len(payload), flags & 1, 0, 0, 9, 9)) + message_id.to_bytes(3, "little")
    frame = frame_of(b"\xfd" + head + payload + bytes(2))
    filled = frame_of(b"\xfd\xff" + head[1:] + payload.ljust(255, b"\0") + bytes(2))
    assert frame.target == filled.target
    assert frame.is_station_heartbeat == filled.is_station_heartbeat


def test_hostile_datagram_costs_a_bounded_number_of_checksums() -> None:
    data = (b"\xfe" * 65507)[: -len(V2)] + V2
    events = split_datagram(data)
    assert events == [Fault(FaultKind.CRC, len(data))]
    assert len(data) > MAX_FALSE_STARTS


@pytest.mark.parametrize("size", [1, 7, 20, 64, 100, 300])
def test_frames_cut_over_datagrams_are_joined(size: int) -> None:
    frames = [V2, V1, V2_SIGNED, V2_COMMAND, UNKNOWN, V2] * 20
    data = b"".join(frames)
    splitter, events = DatagramSplitter(), []
    for n, begin in enumerate(range(0, len(data), size)):
        events += splitter.feed(data[begin : begin + size], n * KEPT_US // 2)
    # An unknown message passes only where a datagram ends with it, or another begins behind it.
    known = [frame for frame in frames_of(events) if frame != UNKNOWN]
    assert known == [frame for frame in frames if frame != UNKNOWN]


@pytest.mark.parametrize("cut", range(1, len(V2_COMMAND)))
def test_whole_frame_after_a_lost_piece_is_returned_at_once(cut: int) -> None:
    splitter = DatagramSplitter()
    assert splitter.feed(V2_COMMAND[:cut], 0) == []
    events = splitter.feed(V2, 1)
    assert frames_of(events) == [V2]
    assert sum(event.size for event in events if isinstance(event, Fault)) == cut
    assert not splitter


def test_unfinished_frame_is_dropped_after_its_time() -> None:
    splitter = DatagramSplitter()
    assert splitter.feed(V2[:9], 0) == []
    events = splitter.feed(V2[9:], KEPT_US + 1)
    assert frames_of(events) == []
    assert events[0] == Fault(FaultKind.CRC, 9)


def test_pieces_of_two_peers_are_not_joined_and_their_number_is_bounded() -> None:
    splitter = DatagramSplitter()
    for peer in range(2 * KEPT_PEERS):
        assert splitter.feed(V2[:9], 0, peer) == []
    found = [frames_of(splitter.feed(V2[9:], 0, peer)) for peer in range(KEPT_PEERS, 0, -1)]
    assert found == [[V2]] + [[]] * (KEPT_PEERS - 1)
    assert frames_of(splitter.split_off(2 * KEPT_PEERS - 1).feed(V2[9:], 0)) == [V2]


def test_reset_discards_a_half_frame() -> None:
    splitter = MavlinkSplitter()
    splitter.feed(V2[:7])
    splitter.reset()
    assert frames_of(splitter.feed(V2)) == [V2]


@pytest.mark.parametrize("frame", [V2, V1, V2_SIGNED], ids=["v2", "v1", "signed"])
def test_header_has_the_fields_of_the_frame(frame: bytes) -> None:
    assert (origin_of(frame), message_id_of(frame)) == ((7, 1), 0)
    (found,) = split_datagram(frame)
    assert isinstance(found, MavFrame)
    key = bytes((7, 1, 0)) if frame is V1 else bytes((7, 1, 0, 0, 0))
    assert (found.data, found.key, found.message_id) == (frame, key, 0)
    assert (found.origin, found.target, found.sequence) == ((7, 1), (0, 0), 0)
    assert found.signed == (frame is V2_SIGNED)


@pytest.mark.parametrize("length", range(10))
def test_a_heartbeat_cut_short_is_no_station_and_no_error(length: int) -> None:
    """Cut zeros mean zero, and what follows the payload is no part of it."""
    payload = bytes((0, 0, 0, 0, 6, 8, 0, 0, 3))[:length]
    body = bytes((len(payload), 0, 0, 6, 7, 190, 0, 0, 0)) + payload
    # The checksum may look like the type of a station.
    frame = b"\xfd" + body + b"\x06\x06"
    assert frame_of(frame).is_station_heartbeat is (length > 4)
    station = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    assert frame_of(packed(station, 7, version=1)).is_station_heartbeat is True


def addressed(name: str) -> dialect.MAVLink_message:
    """Build a message to system 5, component 6."""
    kind = dialect.mavlink_map[MESSAGE_IDS[name]]
    values = dict.fromkeys(kind.fieldnames, 1) | {"target_system": 5, "target_component": 6}
    return kind(**values | ({"payload": [1] * 251} if "payload" in values else {}))


TARGETS = {
    "command": (COMMAND, (9, 3)),
    "cut zeros": (dialect.MAVLink_command_long_message(0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0), (0, 0)),
    "no component field": (dialect.MAVLink_set_mode_message(9, 1, 77), (9, 0)),
    "parameter list": (addressed("PARAM_REQUEST_LIST"), (5, 6)),
    "mission item": (addressed("MISSION_ITEM_INT"), (5, 6)),
    "file transfer": (addressed("FILE_TRANSFER_PROTOCOL"), (5, 6)),
}


@pytest.mark.parametrize("name", TARGETS)
def test_target_is_that_of_the_message(name: str) -> None:
    message, target = TARGETS[name]
    assert frame_of(packed(message, 7)).target == target


@pytest.mark.parametrize("number", [300, 397, 512])
def test_messages_that_the_dialects_lack_are_known(number: int) -> None:
    name, extra = OWN_MESSAGES[number]
    assert (MESSAGE_NAMES[number], CRC_EXTRA[number]) == (name, bytes((extra,)))
    assert (MESSAGE_IDS[name], MESSAGE_IDS["HEARTBEAT"]) == (number, 0)
