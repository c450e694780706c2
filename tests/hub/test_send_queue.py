"""Queues in front of slow links: order, bounds, numbers, on the manual clock."""

import random
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.packer import Packer
from gateway.hub.send_queue import BULK_BYTES, SendQueue
from gateway.hub.transports.serial_line import Pacer
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.mavlink import frames_in, numbered, raw_frame

HEARTBEAT, ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK = 0, 30, 27, 22, 77


def queue_of(max_bytes: int, *own: tuple[int, int]) -> SendQueue:
    """Return a queue that numbers the frames of some origins."""
    return SendQueue(max_bytes, own.__contains__, FrameSigner())


def drain(queue: SendQueue) -> list[bytes]:
    frames = []
    while (frame := queue.pop(0)) is not None:
        frames.append(frame)
    return frames


ORDERS = {
    "urgent frames leave first without starving bulk":
        ("pppaaaaaaaaa", 1000, "a0 a1 a2 a3 p0 a4 a5 a6 a7 p1 a8 p2"),
    "bulk and usual frames take turns": ("ipipip", 1000, "p0 i0 p1 i1 p2 i2"),
    "answer overtakes attitudes": ("aipch", 1000, "c0 h0 a0 p0 i0"),
    "full queue drops oldest telemetry first and answers last": ("caiiac", 30, "c0 c1 a1"),
    **{f"newest frame is accepted: {kind}": (f"aic{kind}", 30, f"{kind}0") for kind in "AIC"},
}  # fmt: skip
"""Kinds of pushed frames of 10 bytes (large: 30), the bound, and the order in which they leave."""
KINDS = {"a": ATTITUDE, "i": RAW_IMU, "p": PARAM_VALUE, "c": COMMAND_ACK, "h": HEARTBEAT}


@pytest.mark.parametrize("name", ORDERS)
def test_frames_leave_by_their_importance(name: str) -> None:
    pushed, max_bytes, left = ORDERS[name]
    queue, dropped = queue_of(max_bytes), 0
    for at, kind in enumerate(pushed):
        data = f"{kind}{pushed[:at].count(kind)}".ljust(10 if kind.islower() else 30)
        dropped += queue.push(raw_frame(KINDS[kind.lower()], data.encode()), 0)
    found = drain(queue)
    assert b"".join(found).decode().split() == left.split()
    assert (dropped, queue.size) == (len(pushed) - len(found), 0)


class TestSendQueue:
    def test_all_parameters_fit_next_to_the_telemetry_of_the_slowest_line(self) -> None:
        queue = queue_of(100)
        for n in range(300):
            assert queue.push(raw_frame(PARAM_VALUE, n.to_bytes(2, "big") * 18), 0) == 0
            queue.push(raw_frame(ATTITUDE, b"a" * 44), 0)
        parameters = [frame for frame in drain(queue) if frame[:1] != b"a"]
        assert parameters == [n.to_bytes(2, "big") * 18 for n in range(300)]
        for _ in range(BULK_BYTES // 36 + 1):
            queue.push(raw_frame(PARAM_VALUE, b"b" * 36), 0)
        assert queue.size <= BULK_BYTES

    def test_old_telemetry_expires_and_answers_do_not(self) -> None:
        queue = queue_of(1000)
        for now_us in (1, 2, 3):
            for message_id in (ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK):
                queue.push(raw_frame(message_id, bytes([message_id, now_us])), now_us)
        assert queue.expire(3) == 4
        assert sorted(drain(queue)) == [
            bytes([PARAM_VALUE, 1]),
            bytes([PARAM_VALUE, 2]),
            bytes([PARAM_VALUE, 3]),
            bytes([RAW_IMU, 3]),
            bytes([ATTITUDE, 3]),
            *(bytes([COMMAND_ACK, now_us]) for now_us in (1, 2, 3)),
        ]
        assert queue.size == 0

    @pytest.mark.parametrize("seed", range(5))
    def test_every_frame_leaves_or_is_counted_and_the_bound_holds(self, seed: int) -> None:
        rng = random.Random(seed)
        queue, pushed, dropped, left = queue_of(500), 0, 0, 0
        for _ in range(2000):
            if rng.random() < 0.6:
                frame = bytes(rng.randrange(8, 60))
                kinds = (ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK)
                dropped += queue.push(raw_frame(rng.choice(kinds), frame), pushed)
                pushed += 1
            elif rng.random() < 0.05:
                dropped += queue.expire(pushed - 3)
            elif queue.pop(0) is not None:
                left += 1
            assert queue.size <= 500 + BULK_BYTES
        assert pushed == dropped + left + len(queue)
        assert queue.clear() == pushed - dropped - left
        assert (len(queue), queue.size, queue.pop(0)) == (0, 0, None)


class TestNumbers:
    """Numbers of our own frames, which are sent without a gap, and frames of others."""

    @pytest.fixture
    def queue(self) -> SendQueue:
        return queue_of(10_000, (1, 1))

    @pytest.mark.parametrize(("system", "sequences"), [(1, (254, 255, 0, 9, 9, 3)), (2, (5, 9))])
    def test_frames_are_unchanged_without_drops_and_those_of_others_always(
        self, queue: SendQueue, system: int, sequences: tuple[int, ...]
    ) -> None:
        for frame in (numbered(system, sequence) for sequence in sequences):
            assert queue.encode(frame, 0) is frame.data

    def test_dropped_frames_leave_no_gap(self) -> None:
        frames = [numbered(1, sequence & 0xFF, raw_imu()) for sequence in range(250, 262)]
        queue = queue_of(3 * len(frames[0].data), (1, 1))
        assert queue.encode(frames[0], 0) is frames[0].data
        assert sum(queue.push(frame, 0) for frame in frames[1:]) == 8
        left = drain(queue)
        assert [frame_of(data).sequence for data in left] == [251, 252, 253]
        assert all(frames_in(data) == [data] for data in left)

    def test_overtaking_frame_gets_the_next_number(self, queue: SendQueue) -> None:
        queue.encode(numbered(1, 7), 0)
        messages = (raw_imu(), raw_imu(), dialect.MAVLink_command_ack_message(512, 0))
        for sequence, message in enumerate(messages, start=8):
            queue.push(numbered(1, sequence, message), 0)
        found = [(frame_of(data).message_id, frame_of(data).sequence) for data in drain(queue)]
        assert found == [(COMMAND_ACK, 8), (RAW_IMU, 9), (RAW_IMU, 10)]


def raw_imu() -> dialect.MAVLink_message:
    return dialect.MAVLink_raw_imu_message(0, 0, 0, 0, 0, 0, 0, 0, 0, 9)


def test_packer_sends_full_datagrams_and_the_rest_when_it_is_flushed() -> None:
    sent: list[list[bytes]] = []
    due: list[Callable[[], None]] = []
    packer = Packer(100, sent.append, due.append)
    for frame in (b"a" * 60, b"b" * 40, b"c", b"d" * 200, b"e"):
        packer.add(frame)
    assert sent == [[b"a" * 60, b"b" * 40], [b"c"], [b"d" * 200]]
    (flush,) = due
    flush()
    flush()
    assert sent[3:] == [[b"e"]]
    packer.add(b"f")
    assert due == [flush, flush]


def test_pacer_keeps_the_line_busy_but_its_buffer_short() -> None:
    pacer, now_us, written = Pacer(baud=57600, ahead_us=20_000), 0, 0
    while now_us < 10_000_000:
        delay_us = pacer.delay_us(now_us)
        if delay_us:
            now_us += delay_us
            continue
        pacer.wrote(50, now_us)
        written += 50
        sent = now_us * 57600 // 10_000_000
        assert written - sent <= 57600 * 20_000 // 10_000_000 + 51
    assert written >= 57600
    assert Pacer(57600, 20_000).delay_us(0) == 0
