"""Round trips: each request is numbered and sent by the gateway's own component."""

from pymavlink.dialects.v20 import common as dialect

from gateway.hub.round_trip import LONGEST_US, PROBE_COMPONENT, RoundTrip
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.kit.mavlink import packed

SYSTEM = 7


def pack(message: dialect.MAVLink_message) -> MavFrame:
    return frame_of(packed(message, 255, 190))


def pong(time_us: int) -> MavFrame:
    return pack(dialect.MAVLink_ping_message(time_us, 0, SYSTEM, PROBE_COMPONENT))


def test_frames_of_each_system_are_numbered_and_sent_by_the_gateways_component() -> None:
    probe = RoundTrip()
    heartbeat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    frames = [frame for _ in range(130) for frame in probe.ask(SYSTEM, 1000)]
    others = [probe.encode(heartbeat, SYSTEM + 1), probe.encode(heartbeat, SYSTEM + 1)]
    assert {frame.origin for frame in frames} == {(SYSTEM, PROBE_COMPONENT)}
    assert [frame.sequence for frame in frames] == [number % 256 for number in range(260)]
    assert [frame.sequence for frame in others] == [0, 1]


def test_request_of_ours_that_comes_back_is_recognised() -> None:
    probe, other = RoundTrip(), RoundTrip()
    for frame in (*probe.ask(SYSTEM, 1_000_000), *other.ask(SYSTEM, 2_000_000)):
        is_own = b"\x40\x42\x0f" in frame.data or (10**9).to_bytes(4, "little") in frame.data
        assert probe.is_returned(frame) is is_own is not other.is_returned(frame)
        answer = other.answer(frame, 0, 3_000_000)
        assert answer is not None
        assert (probe.read(answer, 1_001_500) == 1500) is is_own
        assert not probe.is_returned(answer)
        assert probe.answer(answer, SYSTEM, 3_000_000) is None, "an answer is not answered"


def test_frames_that_are_no_recent_answer_give_none() -> None:
    probe = RoundTrip()
    probe.ask(SYSTEM, 1_000_000)
    assert probe.read(pong(1_000_000), 999_999) is None
    assert probe.read(pong(1_000_000), 1_000_000) == 0
    assert probe.read(pong(1_000_000), 1_000_000 + LONGEST_US) == LONGEST_US
    assert probe.read(pong(1_000_000), 1_000_001 + LONGEST_US) is None
    question = dialect.MAVLink_timesync_message(0, 1_000_000 * 1000)
    foreign = dialect.MAVLink_timesync_message(123, 1_000_000 * 1000 + 1)
    of_another_asker = dialect.MAVLink_timesync_message(123, 1_000_001 * 1000)
    heartbeat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    for message in (question, foreign, of_another_asker, heartbeat):
        assert probe.read(pack(message), 1_001_500) is None
