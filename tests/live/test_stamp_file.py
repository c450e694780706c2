"""Signing stamps outlive the gateway."""

import stat
from pathlib import Path

import pytest

from gateway.live.kept_files import STAMPS_NAME, StampFile

pytestmark = pytest.mark.io

STAMPS = {1: {"0123456789abcdef": {"0.255.190": 36_000_000_000_000}}, 31: {"ff": {"1.2.3": 7}}}


def test_what_is_saved_is_loaded_again(tmp_path: Path) -> None:
    file = StampFile(tmp_path / "new")
    assert file.load() == {}
    file.save({1: {}})
    file.close(STAMPS)
    assert StampFile(tmp_path / "new").load() == STAMPS
    assert stat.S_IMODE((tmp_path / "new" / STAMPS_NAME).stat().st_mode) == 0o600


def test_nothing_to_keep_leaves_what_is_there(tmp_path: Path) -> None:
    StampFile(tmp_path).close(STAMPS)
    StampFile(tmp_path).close({})
    assert StampFile(tmp_path).load() == STAMPS


@pytest.mark.parametrize("text", ["", "[]", '{"1":{"k":{"0.1":3}}}', '{"1":{"k":{"0.1.1":-3}}}'])
def test_a_broken_file_is_reported(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / STAMPS_NAME).write_text(text)
    assert StampFile(tmp_path).load() == {}
    assert "cannot be read" in caplog.text


def test_a_disk_that_does_not_take_it_is_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / STAMPS_NAME).mkdir()
    file = StampFile(tmp_path)
    file._write()
    file._write()
    file.close({})
    assert caplog.text.count("cannot be written") == 1
