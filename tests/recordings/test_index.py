"""The folder of recordings: nothing is lost by mistake."""

import os
from pathlib import Path

import msgspec
import pytest

from gateway.recordings.index import (
    RecordingError,
    delete_recording,
    find_recording,
    free_name,
    list_recordings,
    parts_together,
    rename_recording,
)

pytestmark = pytest.mark.io


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for age, name in enumerate(["b_01.tlog", "b_01_v1.csv", "b_02.tlog", "a_01.tlog"]):
        path = tmp_path / name
        path.write_bytes(bytes(age + 1))
        os.utime(path, (age, age))
    (tmp_path / "note.txt").write_text("not a recording")
    return tmp_path


def test_files_belong_to_recordings_oldest_first(folder: Path) -> None:
    found = list_recordings(folder)
    assert [(r.name, len(r.files), r.size) for r in found] == [("b", 3, 6), ("a", 1, 4)]
    assert find_recording(folder, "last").name == "a"
    assert list_recordings(folder / "none") == []


def test_file_whose_name_is_not_utf_8_is_no_recording(folder: Path) -> None:
    (folder / os.fsdecode(b"\xff\xfe_01.tlog")).touch()
    found = list_recordings(folder)
    assert [recording.name for recording in found] == ["b", "a"]
    assert msgspec.json.encode(found, enc_hook=str)


def test_recordings_of_equal_time_are_sorted_by_name(tmp_path: Path) -> None:
    for name in ("day-2_01.tlog", "day_01.tlog", "day-3_01.tlog"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1, 1))
    assert [recording.name for recording in list_recordings(tmp_path)] == ["day", "day-2", "day-3"]
    assert find_recording(tmp_path, "last").name == "day-3"


def test_rename_moves_all_files(folder: Path) -> None:
    renamed = rename_recording(folder, "b", "new one")
    assert [path.name for path in renamed.files] == [
        "new one_01.tlog",
        "new one_01_v1.csv",
        "new one_02.tlog",
    ]
    assert [recording.name for recording in list_recordings(folder)] == ["new one", "a"]


@pytest.mark.parametrize(("name", "to_name"), [("b", "a"), ("b", "../c"), ("none", "c")])
def test_refused_rename_changes_nothing(folder: Path, name: str, to_name: str) -> None:
    before = sorted(folder.iterdir())
    with pytest.raises(RecordingError):
        rename_recording(folder, name, to_name)
    assert sorted(folder.iterdir()) == before


def test_delete_removes_only_files_of_the_recording(folder: Path) -> None:
    delete_recording(folder, "b")
    assert sorted(path.name for path in folder.iterdir()) == ["a_01.tlog", "note.txt"]
    with pytest.raises(RecordingError, match="no recording 'b'"):
        delete_recording(folder, "b")


def test_consecutive_parts_are_grouped(tmp_path: Path) -> None:
    names = ["a_01.tlog", "a_01_v1.csv", "a_02.tlog", "x.tlog", "a_02_v1.csv", "a_02_v2.csv"]
    found = parts_together([tmp_path / name for name in [*names, "x.tlog", "a_02.tlog"]])
    assert [[path.name for path in parts] for parts in found] == [
        ["a_01.tlog", "a_02.tlog"],
        ["a_01_v1.csv", "a_02_v1.csv"],
        ["x.tlog"],
        ["a_02_v2.csv"],
        ["x.tlog"],
        ["a_02.tlog"],
    ]


def test_free_name_of_a_taken_one_is_numbered(folder: Path) -> None:
    assert free_name(folder, "c") == "c"
    assert free_name(folder, "a") == "a-2"
    (folder / "a-2_01.tlog").touch()
    assert free_name(folder, "a") == "a-3"
