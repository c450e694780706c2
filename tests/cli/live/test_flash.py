"""`mavgate flash` without a board: images to files, and everything that it refuses."""

import fcntl
import os
import pty
from pathlib import Path

import pytest
from intelhex import IntelHex

from gateway.flashing import boards
from gateway.flashing.boards import find_block
from tests.cli.arrangements import images as make_images
from tests.kit.cli import invoke

pytestmark = pytest.mark.io


@pytest.fixture
def images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Images of one program, and a machine without serial ports."""
    (folder := tmp_path / "images").mkdir()
    make_images(folder, monkeypatch=monkeypatch)
    return folder


def flash(*words: object, code: int = 0) -> str:
    return invoke("flash", *words, code=code).output


def test_output_holds_the_image_with_the_given_settings(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.hex"
    flash("imu", "-o", out, "--vehicle", 2, "--channel", 80, "--address", "00c0ffee")
    block = find_block(IntelHex(str(out)).tobinstr(start=0))
    settings = block.settings
    assert (settings.vehicle_id, settings.radio_channel, settings.radio_pipe) == (2, 80, 2)
    assert settings.radio_address == 0x00C0FFEE
    assert settings.imu_send_hz == 60
    before = IntelHex(str(images / "imu_16mhz.hex")).tobinstr()
    after = IntelHex(str(out)).tobinstr()
    assert before[:104] == after[:104]
    assert before[150:] == after[150:]


def test_lora_image_holds_its_settings_and_names_its_airtime(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.hex"
    words = ["--frequency", "868.3", "--spreading", "7", "--coding", "5", "--send-rate", "10"]
    output = flash("imu", "--radio", "sx1276", "-o", out, "--power", 20, *words)
    assert "time on air" in output
    assert "warning: 868.3 MHz allows 1 % in Europe" in output
    settings = find_block(IntelHex(str(out)).tobinstr(start=0)).settings
    assert (settings.radio, settings.lora_power_dbm, settings.imu_send_hz) == ("sx1276", 20, 10)
    assert settings.lora_frequency_khz == 868_300


def test_port_that_another_program_holds_is_left_alone(images: Path) -> None:
    master, slave = pty.openpty()
    try:
        fcntl.flock(slave, fcntl.LOCK_EX)
        output = flash("imu", "--port", os.ttyname(slave), code=2)
    finally:
        os.close(master)
        os.close(slave)
    assert "another program has it open" in output


def test_avrdude_that_waits_for_ever_is_ended_and_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a lost byte: the first run waits, the second one writes."""
    program = tmp_path / "avrdude"
    program.write_text(f"#!/bin/sh\nmkdir {tmp_path}/tried && exec sleep 60\nexit 0\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(boards, "AVRDUDE_LIMIT_S", 0.5)
    boards.write_flash("/dev/null", boards.BOOTLOADERS[0], b":00000001FF\n")
    assert (tmp_path / "tried").is_dir()


def test_missing_avrdude_is_named_with_the_way_to_install_it(
    images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(boards.FlashError, match="apt-get install avrdude"):
        boards.write_flash("/dev/null", boards.BOOTLOADERS[0], b"")
