"""Finished files get their true times, whole or not at all."""

import errno
import os
from pathlib import Path

import pytest

from gateway.live.part import STEP, Restamper, clear_copies
from gateway.recordings.table import TableHeader, TableReader, encode_head, encode_header
from gateway.recordings.tlog import TlogScanner
from tests.recordings.frames import START_US, make_records, make_tlog

pytestmark = pytest.mark.io

SHIFT_US = 5_000_000
RECORDS = make_records(10_000)


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    path = tmp_path / "a_01.tlog"
    path.write_bytes(make_tlog(RECORDS))
    return path


def test_a_tlog_of_any_size_is_shifted_in_small_steps(tlog: Path) -> None:
    before = tlog.read_bytes()
    assert len(before) > 5 * STEP
    restamper = Restamper(0)
    restamper.add(tlog, SHIFT_US)
    steps = 0
    while restamper.step():
        steps += 1
        assert steps > 5 or tlog.read_bytes() == before
    after = list(TlogScanner(strict=True).feed(tlog.read_bytes(), final=True).records())
    assert [record.frame for record in after] == [record.frame for record in RECORDS]
    assert [r.time_us for r in after] == [r.time_us + SHIFT_US for r in RECORDS]
    assert list(tlog.parent.iterdir()) == [tlog]


def test_table_contains_its_corrected_time(tmp_path: Path) -> None:
    path = tmp_path / "a_01_v1.csv"
    header = TableHeader(unix_us_at_zero=7)
    rest = "1,2\n" * STEP + encode_header(header) + "# header: {\n5"
    path.write_text(encode_head(header) + rest)
    restamper = Restamper(0)
    restamper.add(path, SHIFT_US)
    restamper.finish()
    moved = TableHeader(unix_us_at_zero=7 + SHIFT_US)
    assert path.read_text() == encode_head(moved) + rest.replace(
        encode_header(header), encode_header(moved)
    )
    reader = TableReader()
    reader.feed(path.read_bytes()[:10_000])
    assert reader.header == moved


def test_what_was_deleted_meanwhile_does_not_come_back(tlog: Path) -> None:
    restamper = Restamper(0)
    restamper.add(tlog, SHIFT_US)
    restamper.step()
    tlog.unlink()
    restamper.finish()
    assert list(tlog.parent.iterdir()) == []


def test_a_full_disk_leaves_the_file_and_does_the_next(
    tlog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tlog.with_name("a_02.tlog")
    other.write_bytes(make_tlog(RECORDS[:10]))
    before = tlog.read_bytes()
    restamper = Restamper(0)
    restamper.add(tlog, SHIFT_US)
    restamper.add(other, SHIFT_US)

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", refuse)
        while restamper._waiting[0][0] == tlog:
            restamper.step()
    restamper.finish()
    assert tlog.read_bytes() == before
    (first, *_) = TlogScanner().feed(other.read_bytes(), final=True).records()
    assert first.time_us == START_US + SHIFT_US
    assert sorted(tlog.parent.iterdir()) == [tlog, other]


def test_a_copy_never_takes_the_last_space(tlog: Path) -> None:
    before = tlog.read_bytes()
    restamper = Restamper(1 << 60)
    restamper.add(tlog, SHIFT_US)
    restamper.finish()
    assert tlog.read_bytes() == before


def test_copies_of_a_power_cut_are_removed(tlog: Path) -> None:
    copy = tlog.with_name("a_01.tlog.new")
    copy.touch()
    clear_copies(tlog.parent)
    assert list(tlog.parent.iterdir()) == [tlog]
