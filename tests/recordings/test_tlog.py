"""Records out of bytes, whatever has happened to the bytes."""

import itertools
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from gateway.clock import GatewayClock
from gateway.recordings.recorded_clock import (
    DAY_US,
    JUMP_US,
    ORDER_US,
    CivilClock,
    Stamper,
    is_damaged,
)
from gateway.recordings.recorded_clock import STEP_US as STAMP_STEP_US
from gateway.recordings.tlog import STRIDE, TlogScanner
from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import SIGNATURE_SIZE, frame_of, message_id_of
from gateway.wire.recorded_frames import Batch, Damage, RecordedFrame
from gateway.wire.timesync import ENOUGH
from tests.kit.mavlink import KEY, packed
from tests.kit.recordings import (
    START_US,
    STEP_US,
    index_of,
    make_frames,
    make_records,
    make_tlog,
    records_of,
    with_jump,
)


def scan(data: bytes, *, strict: bool = False, chunk: int | None = None) -> list[Batch]:
    scanner = TlogScanner(strict=strict)
    chunk = chunk or max(len(data), 1)
    batches = [scanner.feed(data[i : i + chunk]) for i in range(0, len(data), chunk)]
    return [*batches, scanner.feed(b"", final=True)]


def read_of(batches: list[Batch]) -> list[RecordedFrame]:
    return [record for batch in batches for record in batch.records()]


ATTITUDE = mavlink.MAVLink_attitude_message(20, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
RECORDS = records_of(
    [*make_frames(20), packed(ATTITUDE, version=1), packed(ATTITUDE, signing=(KEY, 0, 1))] * 2
)
"""Of both versions of MAVLink, also signed."""
ENDS = np.cumsum([8 + len(record.frame) for record in RECORDS])
"""The end of each record in its file."""


@pytest.mark.parametrize("chunk", [None, 1, 7, 100])
@pytest.mark.parametrize("strict", [False, True])
def test_written_file_is_read_in_any_chunks(chunk: int | None, strict: bool) -> None:
    batches = scan(make_tlog(RECORDS), strict=strict, chunk=chunk)
    assert read_of(batches) == RECORDS
    assert index_of(batches).damage == []
    assert np.concatenate([batch.message_ids for batch in batches])[:3].tolist() == [0, 31, 253]
    assert {origin for batch in batches for origin in batch.origins.tolist()} == {0x101}


def test_truncated_tlog_loses_at_most_its_last_record() -> None:
    data = make_tlog(RECORDS[17:24])
    ends = ENDS[17:24] - ENDS[16]
    for size in range(len(data) + 1):
        whole = int(np.searchsorted(ends, size, side="right"))
        batches = scan(data[:size])
        assert read_of(batches) == RECORDS[17 : 17 + whole]
        cut = size - (int(ends[whole - 1]) if whole else 0)
        assert (index_of(batches).damaged_bytes, index_of(batches).unfinished) == (0, cut)


@given(st.integers(int(ENDS[1]), int(ENDS[-1]) - 1), st.integers(0, 7))
@example(position=int(ENDS[-1]) - 5, bit=0)
def test_flipped_bit_loses_at_most_its_record_in_a_strict_scan(position: int, bit: int) -> None:
    """The times of the first two records are compared only with one another."""
    data = bytearray(make_tlog(RECORDS))
    data[position] ^= 1 << bit
    hit = int(np.searchsorted(ENDS, position, side="right"))
    found = read_of(scan(bytes(data), strict=True))
    # A flip in the time leaves the frame good; one in the message id may make it unknown, and the
    # checksum does not cover the signature.
    others, frame = RECORDS[:hit] + RECORDS[hit + 1 :], RECORDS[hit].frame
    size = len(frame) - SIGNATURE_SIZE * frame_of(frame).signed
    left = [record.frame for record in found if record not in others]
    assert all(each[:size] == frame[:size] or message_id_of(each) not in CRC_EXTRA for each in left)
    assert set(others) <= set(found)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("at", [0, 15, len(RECORDS)])
def test_garbage_between_records_is_damage_and_skipped(seed: int, at: int) -> None:
    """Zeros are what a power cut leaves at the end; of random bytes hardly any are a record."""
    rng = np.random.default_rng(seed)
    garbage = rng.bytes(int(rng.integers(1, 2000))) if seed else bytes(4096)
    head, tail = make_tlog(RECORDS[:at]), make_tlog(RECORDS[at:])
    batches = scan(head + garbage + tail, chunk=int(rng.integers(1, 500)))
    assert read_of(batches) == RECORDS
    assert index_of(batches).damage == [Damage(len(head), len(garbage))]


@pytest.mark.parametrize("fill", [b"\0", b"\xff"])
@pytest.mark.parametrize("torn", range(9))
def test_record_with_partial_time_gets_time_of_previous_record(torn: int, fill: bytes) -> None:
    records = make_records(100)
    head, data = make_tlog(records[:50]), make_tlog(records)
    cut = data[: len(head) - 20] + fill * (20 + torn) + data[len(head) + torn :]
    batches = scan(cut, strict=True)
    found = read_of(batches)
    assert found[:49] == records[:49]
    assert found[-49:] == records[51:]
    assert all(abs(record.time_us - START_US) < 3600e6 for record in found)
    assert [record.frame for record in found[49:-49]] in ([], [records[50].frame])
    assert index_of(batches).damaged_bytes == len(cut) - len(make_tlog(found))


@pytest.mark.parametrize("chunk", [None, 1, 50, 333])
@pytest.mark.parametrize("hit", [(0,), (20,), (39,), (5, 7, 9, 30)], ids=str)
@pytest.mark.parametrize("flip", [1 << 23, 1 << 30, 1 << 40, 1 << 50])
def test_flipped_time_gives_no_gap(chunk: int | None, hit: tuple[int, ...], flip: int) -> None:
    records = make_records(40)
    spoilt = list(records)
    for i in hit:
        spoilt[i] = RecordedFrame(records[i].time_us ^ flip, records[i].frame)
    batches = scan(make_tlog(spoilt), chunk=chunk)
    found, index = read_of(batches), index_of(batches)
    assert [record.frame for record in found] == [record.frame for record in records]
    is_seen = flip > 1 << 30 or hit not in ((0,), (39,))
    assert index.mended == is_seen * len(hit)
    for i, record in enumerate(found):
        neighbour_us = records[abs(i - 1)].time_us
        damaged_us = neighbour_us if is_seen else spoilt[i].time_us
        assert record.time_us == (damaged_us if i in hit else records[i].time_us)


@pytest.mark.parametrize("chunk", [None, 1, 50])
@pytest.mark.parametrize("leap_us", [-(10**15), -5_000_000, 5_000_000, 10**15])
def test_jump_of_the_clock_is_kept(chunk: int | None, leap_us: int) -> None:
    records = with_jump(make_records(40), 20, leap_us)
    batches = scan(make_tlog(records), chunk=chunk)
    assert read_of(batches) == records
    assert index_of(batches).mended == 0


def test_index_finds_the_offset_of_each_time() -> None:
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
    records = [*make_records(STRIDE), *make_records(2 * STRIDE)]
    data, last_us = make_tlog(records), records[-1].time_us
    index = index_of(scan(data))
    assert index.last_us == last_us
    assert index.offset_before(START_US) == 0
    assert index.offset_before(last_us) < len(data)


UTC_US = 1_781_000_000_000_000
MINUTE_US = 60_000_000


@pytest.fixture
def civil() -> CivilClock:
    """Return a clock whose machine shows `UTC_US` at its begin."""
    clock = CivilClock()
    clock.update_machine(UTC_US, 0)
    return clock


def test_machine_clock_is_used_until_gps_time_is_confirmed() -> None:
    clock = CivilClock()
    assert clock.offset_us is None
    clock.update_machine(5_000_000, 1_000_000)
    for second in range(ENOUGH):
        assert clock.offset_us == 4_000_000
        clock.update_gps(1, UTC_US + second * 1_000_000, (3 + second) * 1_000_000)
    clock.update_machine(9_000_000, 4_000_000)
    assert clock.offset_us == UTC_US - 3_000_000


@pytest.mark.parametrize("jump_us", [-MINUTE_US, -JUMP_US - 1, JUMP_US + 1, 50 * MINUTE_US])
def test_jump_of_civil_time_is_reported(civil: CivilClock, jump_us: int) -> None:
    stamper = Stamper(UTC_US)
    assert not stamper.has_jumped(civil)
    for _ in range(ENOUGH):
        civil.update_gps(1, UTC_US + jump_us, 0)
    assert stamper.has_jumped(civil)


ERRORS: dict[str, Callable[[int], dict[int, int]]] = {
    "a small difference": lambda n: {1: 800_000},
    "one aircraft in three": lambda n: {1: 3_600_000_000, 2: 0, 3: 100_000},
    "single fixes": lambda n: {1: 7_000_000 * (n % 3 == 2)},
}
"""By the number of a fix: errors of the time that each aircraft reports, us."""


@pytest.mark.parametrize("name", ERRORS)
def test_correct_machine_clock_is_kept_over_gps_time(civil: CivilClock, name: str) -> None:
    for n in range(60):
        for vehicle_id, error_us in ERRORS[name](n).items():
            civil.update_gps(vehicle_id, UTC_US + n * 200_000 + error_us, n * 200_000)
        assert civil.offset_us == UTC_US


@pytest.mark.parametrize("set_by_us", [0, 3_600_000_000])
def test_suspend_is_distinguished_from_a_set_clock(
    monkeypatch: pytest.MonkeyPatch, set_by_us: int
) -> None:
    clocks = {time.CLOCK_BOOTTIME: 10**12, time.CLOCK_MONOTONIC: 10**12}
    monkeypatch.setattr(time, "clock_gettime_ns", clocks.__getitem__)
    monkeypatch.setattr(time, "monotonic_ns", lambda: clocks[time.CLOCK_MONOTONIC])
    now_us, clock = GatewayClock(), CivilClock()
    clock.update_machine(UTC_US, now_us())
    stamper = Stamper(UTC_US)
    clocks[time.CLOCK_BOOTTIME] += 3_600 * 10**9
    clock.update_machine(UTC_US + 3_600_000_000 + set_by_us, now_us())
    assert stamper.has_jumped(clock) == bool(set_by_us)


@given(st.lists(st.integers(0, 100_000), min_size=1, max_size=50), st.booleans())
def test_timestamps_increase_and_are_not_later_than_their_times(
    times: list[int], is_sorted: bool
) -> None:
    stamper, ordered = Stamper(UTC_US), sorted(times) if is_sorted else times
    stamps = [stamper.stamp(time) for time in ordered]
    assert all(b - a >= STAMP_STEP_US for a, b in itertools.pairwise(stamps))
    assert all(stamp % STAMP_STEP_US == 0 for stamp in stamps)
    assert 0 <= ordered[0] + UTC_US - stamps[0] < STAMP_STEP_US
    early = Stamper(-1_000_000)
    assert [early.stamp(0), early.stamp(1)] == [STAMP_STEP_US, 2 * STAMP_STEP_US], "before 1970"


@pytest.mark.parametrize(
    ("before", "time", "after", "is_odd"),
    [
        (0, 5, 10, False),
        (0, -ORDER_US, 10, False),
        (0, -ORDER_US - 1, 10, True),
        (0, 10 + ORDER_US, 10, False),
        (0, 11 + ORDER_US, 10, True),
        (0, 11 + ORDER_US, -ORDER_US - 1, False),
        (0, -DAY_US, DAY_US, True),
        (0, -DAY_US, DAY_US + 1, False),
    ],
)
def test_damaged_times_are_found_alike_in_numbers_and_arrays(
    before: int, time: int, after: int, is_odd: bool
) -> None:
    assert is_damaged(before, time, after) is is_odd
    columns = [np.array([value, 0]) for value in (before, time, after)]
    assert is_damaged(*columns).tolist() == [is_odd, False]
