"""Tlogs made of tlogs: chosen, cut, joined, merged, renumbered."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.files import FlightError, open_tlog
from gateway.recordings.merging import MAX_SAMPLE, Alignment, FrameSample, batched
from gateway.recordings.selection import (
    MAX_MARGIN_S,
    FrameChoice,
    StateChoice,
    message_ids_of,
    while_in_state,
)
from gateway.recordings.senders import Senders
from gateway.recordings.tlog import TlogRecord, TlogScanner, encode_record
from gateway.recordings.tlog_editing import Renumbering, TlogEdits
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import frame_of, message_id_of
from tests.kit.cli import run
from tests.kit.mavlink import Sender, packed
from tests.kit.recordings import START_US, make_records, make_tlog, read_tlog, senders_of

pytestmark = pytest.mark.io

SECOND_US = 1_000_000
ATTITUDE = MESSAGE_IDS["ATTITUDE"]


class Write(Protocol):
    """Write records to a file in the folder of the test."""

    def __call__(self, records: list[TlogRecord], name: str = "flight.tlog") -> Path: ...


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(records: list[TlogRecord], name: str = "flight.tlog") -> Path:
        path = tmp_path / name
        path.write_bytes(make_tlog(records))
        return path

    return written


def convert(*words: object, folder: Path) -> tuple[list[TlogRecord], str]:
    """Run `mavgate convert` to a tlog; return its records and the texts."""
    out = folder / "out.tlog"
    text = run("convert", *words, "-o", out, "--force")
    return read_tlog(out), text


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
    write: Write, tmp_path: Path, options: tuple[object, ...], is_kept: Callable[[bytes], bool]
) -> None:
    kept, text = convert(write(MIXED, "a.tlog"), *options, folder=tmp_path)
    assert kept == [record for record in MIXED if is_kept(record.frame)]
    assert f"kept {len(kept)} of {len(MIXED)} records" in text


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--message", "ATITUDE"), "did you mean ATTITUDE"),
        (("--without", "NONE_SUCH_AT_ALL_*"), "no MAVLink message is named"),
        (("--system", 99), "no vehicle 99 in this file; it has 1, 2, 7"),
        (("--system", 1, "--message", "CAMERA_TRIGGER"), "no record matches all of these options"),
        (("--as", "1"), "write OLD:NEW"),
        (("--as", "1:256"), "write OLD:NEW"),
        (("--as", "1:3", "--as", "1:4"), "write OLD:NEW"),
        (("--margin", MAX_MARGIN_S + 1), "--margin"),
    ],
)
def test_options_that_fit_nothing_are_refused(
    write: Write, tmp_path: Path, options: tuple[object, ...], text: str
) -> None:
    out = tmp_path / "out.tlog"
    assert text in run("convert", write(MIXED, "a.tlog"), "-o", out, *options, code=2)
    assert not out.exists()


def test_options_of_tlogs_are_refused_for_other_formats(write: Write, tmp_path: Path) -> None:
    for options in (("--without", "HEARTBEAT"), ("--as", "1:2"), ("--while", "armed")):
        text = run("convert", write(MIXED), "-o", tmp_path / "x.kml", *options, code=2)
        assert "ends in .tlog" in text


def test_input_is_never_the_output(write: Write) -> None:
    path = write(MIXED)
    text = run("convert", path, "-o", path, "--force", "--system", 1, code=2)
    assert "name another" in text
    assert read_tlog(path) == MIXED


@pytest.mark.parametrize(
    ("spoil", "lost", "left_out"),
    [
        (lambda data: data + bytes(4096), 0, 4096),
        (lambda data: data[:-5], 1, 0),
        (lambda data: b"\xff" * 70 + data, 0, 70),
        (lambda data: data[:1000] + b"\xaa" * 300 + data[1000:], None, 300),
    ],
    ids=["zeros at the end", "cut at the end", "garbage before", "garbage within"],
)
def test_intact_records_of_a_damaged_file_are_kept_and_the_rest_counted(
    write: Write,
    tmp_path: Path,
    spoil: Callable[[bytes], bytes],
    lost: int | None,
    left_out: int,
) -> None:
    path = write(MIXED)
    path.write_bytes(spoil(path.read_bytes()))
    kept, text = convert(path, "--message", "*", folder=tmp_path)
    assert set(kept) <= set(MIXED)
    assert len(kept) == len(MIXED) - lost if lost is not None else len(kept) >= len(MIXED) - 2
    assert "which contain no record" in text
    if left_out > 300:
        assert f"{left_out} bytes in 1 place" in text


def test_sparse_file_keeps_the_records_around_its_hole(write: Write, tmp_path: Path) -> None:
    path = write(MIXED)
    data = path.read_bytes()
    with path.open("r+b") as file:
        file.seek(len(data) + (32 << 20))
        file.write(data)
    kept, text = convert(path, "--system", 2, folder=tmp_path)
    assert [r.frame for r in kept] == 2 * [
        r.frame for r in MIXED if frame_of(r.frame).origin[0] == 2
    ]
    assert f"{32 << 20} bytes in 1 place" in text


def test_times_run_on_where_the_clock_was_set_back(write: Write, tmp_path: Path) -> None:
    back_us = 3600 * SECOND_US
    stepped = [TlogRecord(r.time_us - back_us * (i >= 100), r.frame) for i, r in enumerate(MIXED)]
    kept, text = convert(write(stepped), "--system", 1, folder=tmp_path)
    assert "jumped back by 3600 s" in text
    times = [record.time_us for record in kept]
    assert times == sorted(times)
    assert times[-1] - times[0] < 3 * SECOND_US


def test_messages_of_a_foreign_dialect_are_kept_and_chosen_by_id(
    write: Write, tmp_path: Path
) -> None:
    frame = bytearray(packed(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 1.0)))
    frame[7:10] = (60_001).to_bytes(3, "little")
    foreign = TlogRecord(MIXED[50].time_us + 1, bytes(frame))
    path = write([*MIXED[:51], foreign, *MIXED[51:]])
    assert foreign in convert(path, "--system", 1, folder=tmp_path)[0]
    assert convert(path, "--message", "60001", folder=tmp_path)[0] == [foreign]


def beat(sender: Sender, *, armed: bool) -> bytes:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return sender.pack(mavlink.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))


def armed_flight(*armed_s: tuple[int, int], length_s: int = 60) -> list[TlogRecord]:
    """Make heartbeats once a second, armed in some ranges, with an attitude 0.5 s after each."""
    sender, records = Sender(), []
    for second in range(length_s):
        armed = any(begin <= second < end for begin, end in armed_s)
        at_us = START_US + second * SECOND_US
        records.append(TlogRecord(at_us, beat(sender, armed=armed)))
        records.append(TlogRecord(at_us + SECOND_US // 2, sender.attitude(second)))
    return records


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
    cut = while_in_state(batches, senders_of(data), StateChoice(armed=True, margin_s=margin_s))
    found = [(r.time_us - START_US) / SECOND_US for batch in cut for r in batch.records()]
    # The heartbeat that disarms ends the armed time, so that half a second of margin is left.
    expected = [
        (r.time_us - START_US) / SECOND_US
        for r in records
        if any(begin <= (r.time_us - START_US) / SECOND_US < end for begin, end in kept_s)
    ]
    assert found == [t for t in expected if not _is_in_last_half(t, armed_s, margin_s)]


def _is_in_last_half(time_s: float, armed_s: list[tuple[int, int]], margin_s: float) -> bool:
    return all(not begin - margin_s <= time_s <= end - 0.5 + margin_s for begin, end in armed_s)


def test_armed_state_of_a_gimbal_or_a_station_does_not_count() -> None:
    vehicle, other = Sender(), Sender(1, 154)
    records = [TlogRecord(START_US, beat(vehicle, armed=False))]
    gimbal = mavlink.MAVLink_heartbeat_message(26, 8, 128, 0, 4, 3)
    records += [TlogRecord(START_US + k, other.pack(gimbal)) for k in range(1, 20)]
    data = make_tlog(records)
    batches = [TlogScanner().feed(data, final=True)]
    cut = while_in_state(batches, senders_of(data), StateChoice(armed=True))
    assert sum(map(len, cut)) == 0


def test_armed_parts_are_cut_on_the_command_line(write: Write, tmp_path: Path) -> None:
    path = write(armed_flight((20, 30)))
    kept, _ = convert(path, "--while", "armed", "--margin", 2.5, folder=tmp_path)
    assert kept[0].time_us == START_US + 17_500_000
    assert kept[-1].time_us == START_US + 32 * SECOND_US


@pytest.mark.parametrize(
    ("options", "kept_s"),
    [
        (("--from-mode", "auto"), [10, 11, 30, 31]),
        (("--from-mode", "AUTO", "--from-mode", "6"), [10, 11, 20, 21, 30, 31]),
        (("--from-mode", "AUTO", "--while", "armed"), [30, 31]),
    ],
)
def test_time_in_chosen_modes_is_kept(
    write: Write, tmp_path: Path, options: tuple[str, ...], kept_s: list[int]
) -> None:
    """The modes of a copter are STABILIZE, AUTO (3) from 10 and 30 s, and RTL (6) from 20 s."""
    modes, sender = {10: (0, 3), 20: (0, 6), 30: (128, 3)}, Sender()
    records = []
    for second in range(40):
        armed, mode = modes.get(second // 2 * 2, (0, 0))
        message = mavlink.MAVLink_heartbeat_message(2, 3, armed, mode, 4, 3)
        records.append(TlogRecord(START_US + second * SECOND_US, sender.pack(message)))
    kept, _ = convert(write(records), *options, folder=tmp_path)
    assert [(one.time_us - START_US) // SECOND_US for one in kept] == kept_s


def two_receivers(offset_us: int, *, loss: int = 7) -> tuple[list[TlogRecord], ...]:
    """Return what two receivers record of a flight, the second with another clock and delays."""
    sender = Sender()
    frames = [sender.attitude(k) for k in range(600)]
    times = [START_US + k * 20_000 for k in range(len(frames))]
    whole = [TlogRecord(t, f) for t, f in zip(times, frames, strict=True)]
    first = [record for k, record in enumerate(whole) if k % loss]
    second = [
        TlogRecord(record.time_us + offset_us + 40 * (k % 11), record.frame)
        for k, record in enumerate(whole)
        if k % 5
    ]
    return first, second, whole


@pytest.mark.parametrize("offset_us", [0, 300_000, -7_200_000_000, 86_400_000_000 * 30])
def test_files_of_two_receivers_are_merged_without_copies(
    write: Write, tmp_path: Path, offset_us: int
) -> None:
    first, second, whole = two_receivers(offset_us)
    kept, text = convert(write(first, "a.tlog"), write(second, "b.tlog"), folder=tmp_path)
    missing = {r.frame for k, r in enumerate(whole) if k % 35 == 0}
    assert [r.frame for r in kept] == [r.frame for r in whole if r.frame not in missing]
    assert all(abs(k.time_us - w.time_us) < 1000 for k, w in zip(
        kept, [r for r in whole if r.frame not in missing], strict=True))  # fmt: skip
    printed = re.search(r"shifted by ([+-][0-9.]+) s", text)
    assert printed is not None
    assert float(printed[1]) == pytest.approx(-offset_us / 1e6, abs=1e-3)
    assert f"left out {len(first) + len(second) - len(kept)} copied frames" in text


def test_join_keeps_copies_and_times(write: Write, tmp_path: Path) -> None:
    first, second, _ = two_receivers(1000)
    paths = write(first, "a.tlog"), write(second, "b.tlog")
    kept, _ = convert(*paths, "--join", folder=tmp_path)
    assert sorted(r.time_us for r in kept) == sorted(r.time_us for r in first + second)
    assert [r.time_us for r in kept] == sorted(r.time_us for r in kept)


def test_files_one_behind_another_are_joined_in_order_of_time(write: Write, tmp_path: Path) -> None:
    paths = [write(part, name) for part, name in ((MIXED[100:], "b.tlog"), (MIXED[:100], "a.tlog"))]
    kept, text = convert(*paths, folder=tmp_path)
    assert kept == MIXED
    assert "cop" not in text


def test_frames_that_repeat_in_one_file_are_no_copies(write: Write, tmp_path: Path) -> None:
    same = packed(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
    first, second, _ = two_receivers(0)
    repeated = [TlogRecord(START_US + k * 50_000, same) for k in range(20)]
    first = sorted([*first, *repeated], key=lambda r: r.time_us)
    kept, _ = convert(write(first, "a.tlog"), write(second, "b.tlog"), "--merge", folder=tmp_path)
    assert sum(record.frame == same for record in kept) == 20


def test_vehicles_of_two_links_are_merged_although_nothing_is_equal(
    write: Write, tmp_path: Path
) -> None:
    parts = [make_records(90, 1), make_records(90, 2)]
    kept, text = convert(write(parts[0], "a.tlog"), write(parts[1], "b.tlog"), folder=tmp_path)
    assert sorted(kept, key=lambda r: (r.time_us, r.frame)) == sorted(
        parts[0] + parts[1], key=lambda r: (r.time_us, r.frame)
    )
    assert "too few copies to compare clocks" in text


def test_third_file_is_aligned_by_copies_of_any_other() -> None:
    first, second, whole = two_receivers(5 * SECOND_US)
    third = [TlogRecord(r.time_us + 2 * SECOND_US, r.frame) for r in second]
    alignment = Alignment()
    for records in (first[:50], whole, third):
        alignment.add(batched(records))
    assert alignment.shifts_us[1] == 0
    assert alignment.shifts_us[2] == pytest.approx(-7 * SECOND_US, abs=1000)


def test_sample_of_a_long_file_is_bounded() -> None:
    sender, sample = Sender(), FrameSample()
    records = (
        TlogRecord(START_US + k * 1000, sender.attitude(k)) for k in range(MAX_SAMPLE + 5000)
    )
    for batch in batched(records):
        sample.add(batch)
    assert MAX_SAMPLE // 4 < len(sample.frames) < MAX_SAMPLE
    assert sample.step == 2


def test_renumbering_changes_headers_and_fields_with_valid_checksums(
    write: Write, tmp_path: Path
) -> None:
    vehicle, station, signed = Sender(1), Sender(255, 190), Sender(1, signed=True)
    frames = [vehicle.heartbeat(), station.command(1, 1), station.command(2, 1), signed.heartbeat()]
    records = [TlogRecord(START_US + k, frame) for k, frame in enumerate(frames)]
    kept, _ = convert(write(records), "--as", "1:9", "--as", "255:250", folder=tmp_path)
    read = [frame_of(record.frame) for record in kept]
    assert [frame.origin[0] for frame in read] == [9, 250, 250, 9]
    assert [frame.target[0] for frame in read] == [0, 9, 2, 0]
    assert not read[3].signed
    assert [record.time_us for record in kept] == [record.time_us for record in records]


def test_systems_can_swap_their_ids(write: Write, tmp_path: Path) -> None:
    records = [TlogRecord(START_US + k, Sender(k % 2 + 1).heartbeat()) for k in range(6)]
    kept, _ = convert(write(records), "--as", "1:2", "--as", "2:1", folder=tmp_path)
    assert [frame_of(r.frame).origin[0] for r in kept] == [2, 1, 2, 1, 2, 1]


def test_unknown_message_that_cannot_be_renumbered_is_left_out_and_listed(
    write: Write, tmp_path: Path
) -> None:
    frame = bytearray(packed(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 1.0)))
    frame[7:10] = (60_001).to_bytes(3, "little")
    records = [*make_records(9), TlogRecord(START_US + SECOND_US, bytes(frame))]
    kept, text = convert(write(records), "--as", "1:9", folder=tmp_path)
    assert len(kept) == 9
    assert "kept 9 of 10 records" in text
    assert "left out 1 frame of unknown message 60001" in text


def test_encoded_batch_without_some_records_equals_their_bytes() -> None:
    batch = TlogScanner().feed(b"\xff\xff" + make_tlog(MIXED) + bytes(99), final=True)
    wanted = batch.origins >> 8 == 1
    chosen = batch.chosen(wanted)
    assert chosen.encoded() == b"".join(encode_record(r.time_us, r.frame) for r in chosen.records())
    assert batch.chosen(wanted & False).encoded() == b""


def test_message_patterns_are_ids_names_and_globs() -> None:
    assert message_ids_of(["ATTITUDE", "0", "60001"]) == {ATTITUDE, 0, 60001}
    assert ATTITUDE in message_ids_of(["att*"])
    with pytest.raises(FlightError):
        message_ids_of(["ATT?"])


def test_edits_that_change_nothing_are_recognised() -> None:
    assert TlogEdits().are_none
    assert not TlogEdits(choice=FrameChoice(systems=frozenset({1}))).are_none
    assert not TlogEdits(frames=(Renumbering({1: 2}),)).are_none


def test_margin_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="margin"):
        list(while_in_state([], Senders(), StateChoice(margin_s=MAX_MARGIN_S + 1)))


def test_empty_tlog_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").write_bytes(bytes(100))
    assert open_tlog(tmp_path / "a.tlog") is not None
    run("convert", tmp_path / "a.tlog", "-o", tmp_path / "b.tlog", code=2)
