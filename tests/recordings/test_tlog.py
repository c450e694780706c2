"""Records out of bytes, whatever has happened to the bytes."""

import numpy as np
import pytest
from pymavlink.dialects.v10 import common as dialect_v1
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.tlog import (
    STRIDE,
    Batch,
    Damage,
    TlogIndex,
    TlogRecord,
    TlogScanner,
    encode_record,
)
from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import message_id_of
from tests.recordings.frames import START_US, STEP_US, make_frames, make_records, make_tlog


def scan(data: bytes, *, strict: bool = False, chunk: int | None = None) -> list[Batch]:
    scanner = TlogScanner(strict=strict)
    chunk = chunk or max(len(data), 1)
    batches = [scanner.feed(data[i : i + chunk]) for i in range(0, len(data), chunk)]
    return [*batches, scanner.feed(b"", final=True)]


def records_of(batches: list[Batch]) -> list[TlogRecord]:
    return [record for batch in batches for record in batch.records()]


def index_of(batches: list[Batch]) -> TlogIndex:
    index = TlogIndex()
    for batch in batches:
        index.add(batch)
    return index


@pytest.mark.parametrize("chunk", [None, 1, 7, 100])
@pytest.mark.parametrize("strict", [False, True])
def test_what_is_written_is_read_in_any_chunks(chunk: int | None, strict: bool) -> None:
    records = make_records(40)
    batches = scan(make_tlog(records), strict=strict, chunk=chunk)
    assert records_of(batches) == records
    assert index_of(batches).damage == []


def test_columns_tell_sender_and_message() -> None:
    batch = TlogScanner().feed(make_tlog(make_records(3, system_id=7)), final=True)
    assert batch.origins.tolist() == [7 << 8 | 1] * 3
    assert batch.message_ids.tolist() == [0, 31, 253]
    assert batch.frame(1) == make_records(3, system_id=7)[1].frame


def test_mavlink_1_and_signed_frames_pass() -> None:
    mav = mavlink.MAVLink(None, 1, 1)
    old = bytes(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(mav, force_mavlink1=True))
    mav.signing.secret_key = bytes(32)
    mav.signing.sign_outgoing = True
    signed = bytes(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(mav))
    records = [TlogRecord(START_US + i, frame) for i, frame in enumerate([old, signed, old])]
    assert len(signed) == 12 + 9 + 13
    assert records_of(scan(make_tlog(records), strict=True)) == records


def test_a_damaged_mavlink_1_frame_is_left_out() -> None:
    sender = dialect_v1.MAVLink(None, 1, 1)
    message = dialect_v1.MAVLink_attitude_message(20, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    frames = [bytes(message.pack(sender)) for _ in range(3)]
    records = [TlogRecord(START_US + i * STEP_US, frame) for i, frame in enumerate(frames)]
    data = bytearray(make_tlog(records))
    size = len(data) // 3
    data[size + 20] ^= 1
    batches = scan(bytes(data), strict=True)
    assert records_of(batches) == [records[0], records[2]]
    assert [run for batch in batches for run in batch.damage] == [Damage(size, size)]


def test_every_prefix_opens_and_loses_at_most_the_cut_record() -> None:
    records = make_records(12)
    data = make_tlog(records)
    ends = np.cumsum([8 + len(record.frame) for record in records])
    for size in range(len(data) + 1):
        whole = int(np.searchsorted(ends, size, side="right"))
        batches = scan(data[:size])
        assert records_of(batches) == records[:whole]
        cut = size - (int(ends[whole - 1]) if whole else 0)
        assert (index_of(batches).damaged_bytes, index_of(batches).unfinished) == (0, cut)


@pytest.mark.parametrize("seed", range(20))
def test_a_flipped_byte_costs_at_most_its_own_record_in_a_strict_scan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    records = make_records(30)
    data = bytearray(make_tlog(records))
    position = int(rng.integers(len(data)))
    data[position] ^= 1 << int(rng.integers(8))
    ends = np.cumsum([8 + len(record.frame) for record in records])
    hit = int(np.searchsorted(ends, position, side="right"))
    found = records_of(scan(bytes(data), strict=True))
    # A flip in the time leaves the frame good; one in the message id may make it unknown.
    others = records[:hit] + records[hit + 1 :]
    left = [record for record in found if record not in others]
    assert all(
        record.frame == records[hit].frame or message_id_of(record.frame) not in CRC_EXTRA
        for record in left
    )
    assert set(others) <= set(found)


@pytest.mark.parametrize("seed", range(10))
def test_garbage_between_records_is_stepped_over(seed: int) -> None:
    rng = np.random.default_rng(seed)
    records = make_records(30)
    garbage = rng.bytes(int(rng.integers(1, 2000)))
    head, tail = make_tlog(records[:15]), make_tlog(records[15:])
    batches = scan(head + garbage + tail, chunk=int(rng.integers(1, 500)))
    assert records_of(batches) == records
    assert index_of(batches).damage == [Damage(len(head), len(garbage))]


@pytest.mark.parametrize("seed", range(10))
def test_noise_alone_gives_next_to_nothing_and_never_raises(seed: int) -> None:
    data = np.random.default_rng(seed).bytes(20_000)
    index = index_of(scan(data, chunk=777))
    assert index.size == len(data)
    assert index.count < 3


def test_zeros_at_the_end_as_after_a_power_cut_are_damage() -> None:
    records = make_records(5)
    data = make_tlog(records)
    index = index_of(scan(data + bytes(4096)))
    assert index.count == 5
    assert index.damage == [Damage(len(data), 4096)]


@pytest.mark.parametrize("fill", [b"\0", b"\xff"])
@pytest.mark.parametrize("torn", range(9))
def test_a_record_that_lost_a_part_of_its_time_has_that_of_the_one_before(
    torn: int, fill: bytes
) -> None:
    records = make_records(100)
    head, data = make_tlog(records[:50]), make_tlog(records)
    cut = data[: len(head) - 20] + fill * (20 + torn) + data[len(head) + torn :]
    batches = scan(cut, strict=True)
    found = records_of(batches)
    assert found[:49] == records[:49]
    assert found[-49:] == records[51:]
    assert all(abs(record.time_us - START_US) < 3600e6 for record in found)
    assert [record.frame for record in found[49:-49]] in ([], [records[50].frame])
    assert index_of(batches).damaged_bytes == len(cut) - len(make_tlog(found))


@pytest.mark.parametrize("chunk", [None, 1, 50, 333])
@pytest.mark.parametrize("hit", [(0,), (20,), (39,), (5, 7, 9, 30)], ids=str)
@pytest.mark.parametrize("flip", [1 << 23, 1 << 30, 1 << 40, 1 << 50])
def test_a_flipped_time_is_no_gap(chunk: int | None, hit: tuple[int, ...], flip: int) -> None:
    records = make_records(40)
    spoilt = list(records)
    for i in hit:
        spoilt[i] = TlogRecord(records[i].time_us ^ flip, records[i].frame)
    batches = scan(make_tlog(spoilt), chunk=chunk)
    found, index = records_of(batches), index_of(batches)
    assert [record.frame for record in found] == [record.frame for record in records]
    is_seen = flip > 1 << 30 or hit not in ((0,), (39,))
    assert index.mended == is_seen * len(hit)
    assert [r.time_us for i, r in enumerate(found) if i not in hit] == [
        r.time_us for i, r in enumerate(records) if i not in hit
    ]
    for i in hit:
        beside = records[abs(i - 1)].time_us
        assert found[i].time_us == (beside if is_seen else spoilt[i].time_us)


@pytest.mark.parametrize("chunk", [None, 1, 50])
@pytest.mark.parametrize("leap_us", [-(10**15), -5_000_000, 5_000_000, 10**15])
def test_a_clock_that_leaps_is_left_alone(chunk: int | None, leap_us: int) -> None:
    records = [
        TlogRecord(r.time_us + (leap_us if i >= 20 else 0), r.frame)
        for i, r in enumerate(make_records(40))
    ]
    batches = scan(make_tlog(records), chunk=chunk)
    assert records_of(batches) == records
    assert index_of(batches).mended == 0


def test_index_finds_each_time() -> None:
    count = 5 * STRIDE + 3
    records = make_records(count)
    data = make_tlog(records)
    index = index_of(scan(data, chunk=1000))
    assert (index.count, index.first_us) == (count, START_US)
    assert index.last_us == START_US + (count - 1) * STEP_US
    for wanted in (0, 1, STRIDE - 1, STRIDE, STRIDE + 1, count - 1):
        offset = index.offset_before(START_US + wanted * STEP_US)
        scanner = TlogScanner(offset)
        read = list(scanner.feed(data[offset:], final=True).records())
        skipped = next(i for i, r in enumerate(read) if r.time_us >= records[wanted].time_us)
        assert skipped <= STRIDE
        assert read[skipped] == records[wanted]


def test_index_stays_in_order_where_the_clock_jumped_back() -> None:
    frames = make_frames(3 * STRIDE)
    times = [START_US + (i if i < STRIDE else i - STRIDE) * STEP_US for i in range(len(frames))]
    data = b"".join(encode_record(t, f) for t, f in zip(times, frames, strict=True))
    index = index_of(scan(data))
    assert index.last_us == max(times)
    assert index.offset_before(START_US) == 0
    assert index.offset_before(max(times)) < len(data)


def test_an_empty_file_is_an_empty_index() -> None:
    index = index_of(scan(b""))
    assert (index.count, index.first_us, index.last_us) == (0, None, None)
    assert index.offset_before(START_US) == 0
