"""Tlogs made of tlogs: chosen, cut, joined, merged, renumbered."""

import math
import re
import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.tlog import TlogScanner
from gateway.recordings.workshop.merging import MAX_SAMPLE, Alignment, FrameSample, batched
from gateway.recordings.workshop.selection import ChosenState, StateChoice, while_in_state
from gateway.wire.mavlink_splitter import frame_of, message_id_of
from gateway.wire.recorded_frames import RecordedFrame, fields_of
from tests.kit.cli import run
from tests.kit.mavlink import Sender, frame_with, packed
from tests.kit.recordings import (
    SECOND_US,
    START_US,
    batch_of,
    make_records,
    make_tlog,
    read_tlog,
    records_of,
    records_sent,
    senders_of,
    with_jump,
    write_tlog,
)

pytestmark = pytest.mark.io


def as_float(whole: int) -> float:
    """Return the float with the bytes of an integer, as PX4 sends parameters."""
    (value,) = struct.unpack("<f", struct.pack("<i", whole))
    return float(value)


def convert(folder: Path, *words: object) -> tuple[list[RecordedFrame], str]:
    """Run `mavgate convert` to a tlog; lists of records become files. Return records and texts."""
    files = [
        write_tlog(folder / f"{k}.tlog", word) if isinstance(word, list) else word
        for k, word in enumerate(words)
    ]
    text = run("convert", *files, "-o", folder / "out.tlog", "--force")
    return read_tlog(folder / "out.tlog"), text


MIXED = sorted(
    [*make_records(90), *make_records(90, 2), *make_records(30, 7)], key=lambda r: r.time_us
)


@pytest.mark.parametrize(
    ("options", "is_kept"),
    [
        (("--system", 2), lambda f: frame_of(f).origin[0] == 2),
        (("--system", 1, "--system", "7"), lambda f: frame_of(f).origin[0] in (1, 7)),
        (("--component", 1), lambda f: True),
        (("--message", "HEARTBEAT"), lambda f: message_id_of(f) == 0),
        (("--message", "heart*", "--message", 253), lambda f: message_id_of(f) in (0, 253)),
        (("--message", "ATTITUDE*"), lambda f: message_id_of(f) == 31),
        (("--without", "ATTITUDE*"), lambda f: message_id_of(f) != 31),
        (
            ("--system", 1, "--message", "*", "--without", "0"),
            lambda f: message_id_of(f) != 0 and frame_of(f).origin[0] == 1,
        ),
    ],
)
def test_chosen_frames_are_kept_byte_for_byte(
    tmp_path: Path, options: tuple[object, ...], is_kept: Callable[[bytes], bool]
) -> None:
    kept, text = convert(tmp_path, MIXED, *options)
    assert kept == [record for record in MIXED if is_kept(record.frame)]
    assert f"kept {len(kept)} of {len(MIXED)} records" in text


DATA = make_tlog(MIXED)
HOLE = bytes(4 << 20)
DAMAGED = {
    "zeros at the end": (DATA + bytes(4096), 210, 4096),
    "cut at the end": (DATA[:-5], 209, 0),
    "garbage before": (b"\xff" * 70 + DATA, 210, 70),
    "garbage within": (DATA[:1000] + b"\xaa" * 300 + DATA[1000:], 208, 300),
    "hole": (DATA + HOLE + DATA, 420, len(HOLE)),
}
"""The bytes of a file, its intact records, and the bytes that are left out."""


@pytest.mark.parametrize("name", DAMAGED)
def test_intact_records_of_a_damaged_file_are_kept_and_the_rest_counted(
    tmp_path: Path, name: str
) -> None:
    data, intact, left_out = DAMAGED[name]
    (tmp_path / "a.tlog").write_bytes(data)
    kept, text = convert(tmp_path, tmp_path / "a.tlog", "--message", "*")
    assert {record.frame for record in kept} <= {record.frame for record in MIXED}
    assert intact <= len(kept) <= len(MIXED) * (2 if data is DAMAGED["hole"][0] else 1)
    assert "which contain no record" in text
    if left_out > 300:
        assert f"{left_out} bytes in 1 place" in text


def test_times_run_on_where_the_clock_was_set_back(tmp_path: Path) -> None:
    stepped = with_jump(MIXED, 100, -3600 * SECOND_US)
    kept, text = convert(tmp_path, stepped, "--system", 1)
    assert "jumped back by 3600 s" in text
    times = [record.time_us for record in kept]
    assert times == sorted(times)
    assert times[-1] - times[0] < 3 * SECOND_US


def test_messages_of_a_foreign_dialect_are_kept_and_chosen_by_id(tmp_path: Path) -> None:
    foreign = RecordedFrame(MIXED[50].time_us + 1, frame_with(60_001, b"foreign"))
    records = [*MIXED[:51], foreign, *MIXED[51:]]
    assert foreign in convert(tmp_path, records, "--system", 1)[0]
    assert convert(tmp_path, records, "--message", "60001")[0] == [foreign]


def armed_flight(*armed_s: tuple[int, int], length_s: int = 60) -> list[RecordedFrame]:
    """Make heartbeats once a second, armed in some ranges, with an attitude 0.5 s after each."""
    sender, frames = Sender(), []
    for second in range(length_s):
        mode = 128 * any(begin <= second < end for begin, end in armed_s)
        frames.append(sender.pack(mavlink.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3)))
        frames.append(sender.attitude(second))
    return records_of(frames, SECOND_US // 2)


@pytest.mark.parametrize(
    ("armed_s", "margin_s", "kept_s"),
    [
        ([(20, 30)], 0, [(20, 30)]),
        ([(20, 30)], 5, [(15, 35)]),
        ([(5, 10), (40, 60)], 2, [(3, 12), (38, 60)]),
        ([(5, 10), (12, 20)], 3, [(2, 23)]),
        ([(0, 60)], 0, [(0, 60)]),
        ([(59, 60)], 58, [(1, 60)]),
    ],
)
@pytest.mark.parametrize("piece", [97, 1 << 20])
def test_cut_to_armed_time_keeps_the_margin_on_both_sides(
    armed_s: list[tuple[int, int]], margin_s: float, kept_s: list[tuple[int, int]], piece: int
) -> None:
    records = armed_flight(*armed_s)
    data, scanner = make_tlog(records), TlogScanner()
    batches = [scanner.feed(data[at : at + piece]) for at in range(0, len(data), piece)]
    batches.append(scanner.feed(b"", final=True))
    state = ChosenState(senders_of(data), StateChoice(armed=True, margin_s=margin_s))
    cut = while_in_state(batches, state)
    found = [(r.time_us - START_US) / SECOND_US for batch in cut for r in batch.records()]
    assert found == [half / 2 for begin, end in kept_s for half in range(2 * begin, 2 * end)]


def test_armed_state_of_a_gimbal_or_a_station_does_not_count() -> None:
    disarmed = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    gimbal = mavlink.MAVLink_heartbeat_message(26, 8, 128, 0, 4, 3)
    records = records_sent([((1, 1), disarmed), *[((1, 154), gimbal)] * 20])
    senders = senders_of(make_tlog(records))
    state = ChosenState(senders, StateChoice(armed=True))
    cut = while_in_state([batch_of(records)], state)
    assert sum(map(len, cut)) == 0


@pytest.mark.parametrize(
    ("options", "kept_s"),
    [
        (("--from-mode", "auto"), [10, 11, 30, 31]),
        (("--from-mode", "AUTO", "--from-mode", "6"), [10, 11, 20, 21, 30, 31]),
        (("--from-mode", "AUTO", "--armed"), [30, 31]),
        (("--armed", "--margin", "2.5"), [28, 29, 30, 31, 32, 33]),
        (("--from-mode", "AUTO", "--from-mode", "LAND", "--system", "1"), [10, 11, 30, 31]),
    ],
)
def test_time_in_chosen_modes_is_kept(
    tmp_path: Path, options: tuple[str, ...], kept_s: list[int]
) -> None:
    """The modes of a copter are STABILIZE, AUTO (3) from 10 and 30 s, and RTL (6) from 20 s."""
    modes = {10: (0, 3), 20: (0, 6), 30: (128, 3)}
    states = [modes.get(second // 2 * 2, (0, 0)) for second in range(40)]
    beats = [mavlink.MAVLink_heartbeat_message(2, 3, *state, 4, 3) for state in states]
    records = records_sent([((1, 1), message) for message in beats], SECOND_US)
    kept, _ = convert(tmp_path, records, *options)
    assert [(one.time_us - START_US) // SECOND_US for one in kept] == kept_s


LOST = [(0, 1, 0), (0, 2, 128), (10, 1, 128), (20, 1, 0), (25, 2, None)]
"""Second, vehicle and flags from then on: vehicle 2 is armed when it is lost."""


@pytest.mark.parametrize(
    ("options", "last_s"), [((), 30), (("--system", "1"), 20), (("--system", "2"), 24)]
)
def test_armed_ends_some_seconds_after_the_last_heartbeat(
    tmp_path: Path, options: tuple[str, ...], last_s: int
) -> None:
    sent: list[tuple[tuple[int, int], Any]] = []
    for second in range(60):
        flags = {vehicle: flag for since_s, vehicle, flag in LOST if since_s <= second}
        beats = [
            ((vehicle, 1), mavlink.MAVLink_heartbeat_message(2, 3, flag, 0, 4, 3))
            for vehicle, flag in flags.items()
            if flag is not None
        ]
        sent += [*beats, *[((1, 1), mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))] * (
            10 - len(beats))]  # fmt: skip
    records = records_sent(sent, SECOND_US // 10)
    kept, _ = convert(tmp_path, records, "--armed", *options)
    assert (kept[-1].time_us - START_US) / SECOND_US == pytest.approx(last_s, abs=1.0)


def two_receivers(offset_us: int, *, loss: int = 7) -> tuple[list[RecordedFrame], ...]:
    """Return what two receivers record of a flight, the second with another clock and delays."""
    sender = Sender()
    whole = records_of(sender.attitude(k) for k in range(600))
    first = [record for k, record in enumerate(whole) if k % loss]
    second = [
        RecordedFrame(record.time_us + offset_us + 40 * (k % 11), record.frame)
        for k, record in enumerate(whole)
        if k % 5
    ]
    return first, second, whole


@pytest.mark.parametrize(
    ("offset_us", "option"),
    [
        *((0, "--force"), (300_000, "--force"), (-1_200_000_000, "--force")),
        *((-7_200_000_000, "--merge"), (86_400_000_000 * 30, "--merge")),
    ],
)
def test_files_of_two_receivers_are_merged_without_copies(
    tmp_path: Path, offset_us: int, option: str
) -> None:
    first, second, whole = two_receivers(offset_us)
    kept, text = convert(tmp_path, first, second, option)
    missing = {r.frame for k, r in enumerate(whole) if k % 35 == 0}
    assert [r.frame for r in kept] == [r.frame for r in whole if r.frame not in missing]
    assert all(abs(k.time_us - w.time_us) < 1000 for k, w in zip(
        kept, [r for r in whole if r.frame not in missing], strict=True))  # fmt: skip
    printed = re.search(r"shifted by ([+-][0-9.]+) s", text)
    assert printed is not None
    assert float(printed[1]) == pytest.approx(-offset_us / 1e6, abs=1e-3)
    assert f"left out {len(first) + len(second) - len(kept)} copied frames" in text


def test_clocks_that_differ_by_hours_are_not_aligned_unasked(tmp_path: Path) -> None:
    first, second, _ = two_receivers(-7_200_000_000)
    kept, text = convert(tmp_path, first, second)
    assert len(kept) == len(first) + len(second)
    assert "the clocks differ by +7200 s; if it is one flight, give --merge" in text


def two_boots(offset_us: int) -> tuple[list[RecordedFrame], ...]:
    """Return two flights of which the first second is equal, as after a start in simulation."""
    flights = []
    for number, begin_us in enumerate((0, offset_us)):
        sender = Sender()
        boot = [sender.pack(mavlink.MAVLink_statustext_message(6, b"%d" % k)) for k in range(14)]
        rest = [sender.attitude(k + 1000 * number) for k in range(300)]
        flown = records_of([*boot, *rest], 50_000)
        flights.append([RecordedFrame(r.time_us + begin_us, r.frame) for r in flown])
    return tuple(flights)


@pytest.mark.parametrize("option", ["--force", "--merge"])
@pytest.mark.parametrize("offset_us", [3_600_000_000, 60_000_000, 5_000_000])
def test_flights_with_equal_starts_follow_each_other(
    tmp_path: Path, offset_us: int, option: str
) -> None:
    first, second = two_boots(offset_us)
    kept, text = convert(tmp_path, first, second, option)
    assert kept == sorted([*first, *second], key=lambda record: record.time_us)
    assert "is taken for another flight, as its 14 equal frames are in" in text


def test_join_keeps_copies_and_times(tmp_path: Path) -> None:
    first, second, _ = two_receivers(1000)
    kept, _ = convert(tmp_path, first, second, "--join")
    assert [r.time_us for r in kept] == sorted(r.time_us for r in first + second)


EDGES = [k for k in range(1, len(MIXED)) if MIXED[k].time_us != MIXED[k - 1].time_us]


@given(cuts=st.lists(st.sampled_from(EDGES), min_size=1, max_size=4, unique=True))
@settings(max_examples=10)
def test_cut_then_join_is_the_identity(cuts: list[int]) -> None:
    edges = [0, *sorted(cuts), len(MIXED)]
    parts = [MIXED[begin:end] for begin, end in pairwise(edges)]
    with TemporaryDirectory() as folder:
        kept, text = convert(Path(folder), *reversed(parts))
    assert kept == MIXED
    assert "cop" not in text


def test_frames_that_repeat_in_one_file_are_no_copies(tmp_path: Path) -> None:
    same = packed(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
    first, second, _ = two_receivers(0)
    repeated = [RecordedFrame(START_US + k * 50_000, same) for k in range(20)]
    first = sorted([*first, *repeated], key=lambda r: r.time_us)
    kept, _ = convert(tmp_path, first, second, "--merge")
    assert sum(record.frame == same for record in kept) == 20


def test_vehicles_of_two_links_are_merged_although_nothing_is_equal(tmp_path: Path) -> None:
    parts = [make_records(90, 1), make_records(90, 2)]
    kept, text = convert(tmp_path, parts[0], parts[1])
    assert sorted(kept, key=lambda r: (r.time_us, r.frame)) == sorted(
        parts[0] + parts[1], key=lambda r: (r.time_us, r.frame)
    )
    assert "too few copies to compare clocks" in text


def test_third_file_is_aligned_by_copies_of_any_other() -> None:
    first, second, whole = two_receivers(5 * SECOND_US)
    third = with_jump(second, 0, 2 * SECOND_US)
    alignment = Alignment()
    for records in (first[:50], whole, third):
        alignment.add(batched(records))
    assert alignment.shifts_us[1] == 0
    assert alignment.shifts_us[2] == pytest.approx(-7 * SECOND_US, abs=1000)


def test_sample_of_a_long_file_is_bounded() -> None:
    sender, sample = Sender(), FrameSample()
    for batch in batched(records_of(sender.attitude(k) for k in range(MAX_SAMPLE + 5000))):
        sample.add(batch)
    assert MAX_SAMPLE // 4 < len(sample.frames) < MAX_SAMPLE
    assert sample.step == 2


def test_renumbering_changes_headers_and_fields_with_valid_checksums(tmp_path: Path) -> None:
    vehicle, station, signed = Sender(1), Sender(255, 190), Sender(1, signed=True)
    frames = [vehicle.heartbeat(), station.command(1, 1), station.command(2, 1), signed.heartbeat()]
    records = records_of(frames)
    kept, _ = convert(tmp_path, records, "--as", "1:9", "--as", "255:250")
    read = [frame_of(record.frame) for record in kept]
    assert [frame.origin[0] for frame in read] == [9, 250, 250, 9]
    assert [frame.target[0] for frame in read] == [0, 9, 2, 0]
    assert not read[3].signed
    assert [record.time_us for record in kept] == [record.time_us for record in records]


@pytest.mark.parametrize(
    ("options", "ids"),
    [
        (("--as", "2:1"), {2, 1}),
        (("--merge-systems",), {2}),
        (("--system", "1"), {2}),
    ],
    ids=["swapped", "merged", "one chosen"],
)
def test_systems_swap_or_share_an_id_only_if_wanted(
    tmp_path: Path, options: tuple[str, ...], ids: set[int]
) -> None:
    records = records_of(Sender(k % 2 + 1).heartbeat() for k in range(6))
    kept, _ = convert(tmp_path, records, "--as", "1:2", *options)
    assert {frame_of(record.frame).origin[0] for record in kept} == ids
    assert frame_of(kept[0].frame).origin[0] == 2


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        (b"SYSID_THISMAV", 1.0, 9.0),
        (b"MAV_SYSID", 1.0, 9.0),
        (b"MAV_SYS_ID", as_float(1), as_float(9)),
        (b"SYSID_MYGCS", 255.0, 255.0),
        (b"GAIN", 1.0, 1.0),
        (b"SYSID_THISMAV", math.nan, math.nan),
    ],
)
def test_parameters_with_a_system_id_are_renumbered(
    tmp_path: Path, name: bytes, value: float, expected: float
) -> None:
    message = mavlink.MAVLink_param_value_message(name, value, 6, 1, 0)
    ((kept,), _) = convert(tmp_path, records_of([Sender(1).pack(message)]), "--as", "1:9")
    assert fields_of(kept.frame)["param_value"] == pytest.approx(expected, abs=0, nan_ok=True)


def test_merge_of_a_clock_from_boot_with_an_older_recording_keeps_all_frames(
    tmp_path: Path,
) -> None:
    frames = [Sender().attitude(k) for k in range(50)]
    boot = write_tlog(tmp_path / "boot.tlog", [RecordedFrame(k, f) for k, f in enumerate(frames)])
    older = [
        RecordedFrame(START_US + k, frame) for k, frame in enumerate([*frames[:0:-1], *frames])
    ]
    out = tmp_path / "out.tlog"
    run("convert", boot, write_tlog(tmp_path / "b.tlog", older), "-o", out, "--merge")
    assert {record.frame for record in read_tlog(out)} == {*frames}


def test_unknown_message_that_cannot_be_renumbered_is_left_out_and_listed(tmp_path: Path) -> None:
    records = [
        *make_records(9),
        RecordedFrame(START_US + SECOND_US, frame_with(60_001, b"foreign")),
    ]
    kept, text = convert(tmp_path, records, "--as", "1:9")
    assert len(kept) == 9
    assert "kept 9 of 10 records" in text
    assert re.search(r"unknown message 60001 +1", text)
