"""Queues in front of slow links: order, bounds, numbers, on the manual clock."""

import random

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.send_queue import BULK_BYTES, URGENT_RUN, Numbering, Outbox, Pacer, Packer
from gateway.wire.mavlink_splitter import split_datagram

HEARTBEAT, ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK = 0, 30, 27, 22, 77


def drain(outbox: Outbox) -> list[bytes]:
    frames = []
    while (waiting := outbox.pop()) is not None:
        frames.append(waiting[0])
    return frames


class TestOutbox:
    def test_urgent_first_yet_bulk_ends(self) -> None:
        outbox = Outbox(10_000)
        for n in range(8):
            outbox.push(b"b%d" % n, PARAM_VALUE)
        for n in range(20):
            outbox.push(b"a%02d" % n, ATTITUDE)
        order = drain(outbox)
        assert order[:URGENT_RUN] == [b"a00", b"a01", b"a02", b"a03"]
        assert order[URGENT_RUN] == b"b0"
        assert [f for f in order if f[:1] == b"a"] == [b"a%02d" % n for n in range(20)]
        assert [f for f in order if f[:1] == b"b"] == [b"b%d" % n for n in range(8)]
        assert outbox.size == 0

    def test_bulk_and_usual_take_turns(self) -> None:
        outbox = Outbox(10_000)
        for n in range(3):
            outbox.push(b"u%d" % n, RAW_IMU)
            outbox.push(b"b%d" % n, PARAM_VALUE)
        assert drain(outbox) == [b"b0", b"u0", b"b1", b"u1", b"b2", b"u2"]

    def test_oldest_telemetry_goes_first_and_answers_last(self) -> None:
        outbox = Outbox(30)
        outbox.push(b"c" * 10, COMMAND_ACK)
        outbox.push(b"a" * 10, ATTITUDE)
        outbox.push(b"1" * 10, RAW_IMU)
        assert outbox.push(b"2" * 10, RAW_IMU) == 1
        assert outbox.push(b"A" * 10, ATTITUDE) == 1
        assert outbox.push(b"C" * 10, COMMAND_ACK) == 1
        assert drain(outbox) == [b"c" * 10, b"C" * 10, b"A" * 10]

    def test_an_answer_overtakes_the_attitude(self) -> None:
        outbox = Outbox(1000)
        for message_id in (ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK, HEARTBEAT):
            outbox.push(bytes([message_id]), message_id)
        order = [frame[0] for frame in drain(outbox)]
        assert order == [COMMAND_ACK, HEARTBEAT, ATTITUDE, PARAM_VALUE, RAW_IMU]

    def test_all_parameters_find_room_beside_the_telemetry_of_the_slowest_line(self) -> None:
        outbox = Outbox(100)
        for n in range(300):
            assert outbox.push(n.to_bytes(2, "big") * 18, PARAM_VALUE) == 0
            outbox.push(b"a" * 44, ATTITUDE)
        parameters = [frame for frame in drain(outbox) if frame[:1] != b"a"]
        assert parameters == [n.to_bytes(2, "big") * 18 for n in range(300)]
        for _ in range(BULK_BYTES // 36 + 1):
            outbox.push(b"b" * 36, PARAM_VALUE)
        assert outbox.size <= BULK_BYTES

    def test_old_telemetry_expires_and_answers_do_not(self) -> None:
        outbox = Outbox(1000)
        for now_us in (1, 2, 3):
            for message_id in (ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK):
                outbox.push(bytes([message_id, now_us]), message_id, None, now_us)
        assert outbox.expire(3) == 4
        assert sorted(drain(outbox)) == [
            bytes([PARAM_VALUE, 1]),
            bytes([PARAM_VALUE, 2]),
            bytes([PARAM_VALUE, 3]),
            bytes([RAW_IMU, 3]),
            bytes([ATTITUDE, 3]),
            *(bytes([COMMAND_ACK, now_us]) for now_us in (1, 2, 3)),
        ]
        assert outbox.size == 0

    @pytest.mark.parametrize("message_id", [ATTITUDE, RAW_IMU, COMMAND_ACK])
    def test_the_newest_is_always_taken(self, message_id: int) -> None:
        outbox = Outbox(30)
        for n in range(3):
            outbox.push(bytes((n,)) * 10, (ATTITUDE, RAW_IMU, COMMAND_ACK)[n])
        assert outbox.push(b"n" * 30, message_id) == 3
        assert drain(outbox) == [b"n" * 30]

    @pytest.mark.parametrize("seed", range(5))
    def test_every_frame_leaves_or_is_counted_and_the_bound_holds(self, seed: int) -> None:
        rng = random.Random(seed)
        outbox, pushed, dropped, left = Outbox(500), 0, 0, 0
        for _ in range(2000):
            if rng.random() < 0.6:
                frame = bytes(rng.randrange(8, 60))
                kinds = (ATTITUDE, RAW_IMU, PARAM_VALUE, COMMAND_ACK)
                dropped += outbox.push(frame, rng.choice(kinds), None, pushed)
                pushed += 1
            elif rng.random() < 0.05:
                dropped += outbox.expire(pushed - 3)
            elif outbox.pop() is not None:
                left += 1
            assert outbox.size <= 500 + BULK_BYTES
        assert pushed == dropped + left + len(outbox)
        assert outbox.clear() == pushed - dropped - left
        assert (len(outbox), outbox.size, outbox.pop()) == (0, 0, None)


def heartbeat(system: int, sequence: int) -> bytes:
    link = dialect.MAVLink(None, system, 1)
    link.seq = sequence
    return bytes(dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(link))


class TestNumbering:
    @pytest.fixture
    def numbering(self) -> Numbering:
        return Numbering(lambda origin: origin == (1, 1))

    def test_without_drops_every_frame_leaves_as_it_came(self, numbering: Numbering) -> None:
        for sequence in (254, 255, 0, 9, 9, 3):
            frame = heartbeat(1, sequence)
            assert numbering.leave(frame, numbering.enter(frame)) is frame

    def test_dropped_frames_leave_no_gap(self, numbering: Numbering) -> None:
        frames = [heartbeat(1, sequence & 0xFF) for sequence in range(250, 262)]
        steps = [numbering.enter(frame) for frame in frames]
        kept = [0, 3, 4, 9, 11]
        left = [numbering.leave(frames[n], steps[n]) for n in kept]
        assert [frame[4] for frame in left] == [250, 251, 252, 253, 254]
        assert all(split_datagram(frame) == [frame] for frame in left)

    def test_a_frame_that_overtakes_takes_the_number(self, numbering: Numbering) -> None:
        first = heartbeat(1, 7)
        numbering.leave(first, numbering.enter(first))
        frames = [heartbeat(1, sequence) for sequence in (8, 9, 10)]
        steps = [numbering.enter(frame) for frame in frames]
        left = [numbering.leave(frames[n], steps[n]) for n in (2, 0, 1)]
        assert [frame[4] for frame in left] == [8, 9, 10]

    def test_frames_of_others_stay(self, numbering: Numbering) -> None:
        for sequence in (5, 9):
            frame = heartbeat(2, sequence)
            assert numbering.leave(frame, numbering.enter(frame)) is frame


class TestPacker:
    def test_full_datagrams_leave_and_the_rest_waits(self) -> None:
        packer = Packer(100)
        assert packer.add(b"a" * 60) == []
        assert packer.add(b"b" * 40) == []
        assert packer.add(b"c" * 1) == [b"a" * 60, b"b" * 40]
        assert packer.flush() == [b"c"]
        assert packer.flush() == []

    def test_an_overlong_frame_goes_alone(self) -> None:
        packer = Packer(100)
        assert packer.add(b"a" * 200) == []
        assert packer.add(b"b") == [b"a" * 200]


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
