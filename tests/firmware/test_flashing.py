"""Real avrdude and real bootloaders on the simulated chip; then the boards fly."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from intelhex import IntelHex

from firmware.rig.boards import Board
from firmware.rig.build import make
from firmware.rig.mcu import WATCHDOG
from firmware.rig.usb_serial import BOOTLOADERS, NEW_BOOTLOADER, OLD_BOOTLOADER, UsbSerial
from gateway.flashing.boards import BoardSettings, find_block, with_settings
from gateway.wire.payloads import ImuPayload, NodeStatusPayload
from tests.firmware.harness import MakeBench, MakeRig

pytestmark = [pytest.mark.io, pytest.mark.slow]

LIMIT_S = 240.0
SPI_CLOCK = 1 << 5


Plug = Callable[[Board], UsbSerial]


@pytest.fixture(scope="session")
def tools(programs: Path) -> None:
    if shutil.which("avrdude") is None or not BOOTLOADERS.is_dir():
        pytest.skip("avrdude or arduino-core-avr not found: apt-get install both")
    make("images")
    make("optiboot")


@pytest.fixture
def plugged() -> Iterator[Plug]:
    made: list[UsbSerial] = []

    def plug(board: Board) -> UsbSerial:
        made.append(UsbSerial(board))
        return made[-1]

    yield plug
    for one in made:
        one.close()


def flash(usb: UsbSerial, *words: str) -> str:
    """Run `mavgate flash` on a simulated board; returns its output."""
    command = [sys.executable, "-m", "gateway.cli", "flash", *words, "--port", usb.path]
    environment = {**os.environ, "COLUMNS": "100"}
    with subprocess.Popen(
        command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment
    ) as process:
        assert process.stdout is not None
        try:
            code = usb.run_while(process, LIMIT_S)
        except TimeoutError as error:
            raise AssertionError(process.stdout.read()) from error
        output = process.stdout.read()
    assert code == 0, output
    return output


def test_boards_flashed_through_optiboot_fly_with_their_settings(
    tools: None, programs: Path, imu_rig: MakeRig, plugged: Plug, tmp_path: Path
) -> None:
    other = BoardSettings(radio_channel=81, radio_kbps=250, radio_power_dbm=-6)
    image = with_settings(IntelHex(str(programs / "receiver.hex")), other)
    flashed = tmp_path / "receiver.hex"
    flashed.write_bytes(NEW_BOOTLOADER.with_suffix(".hex").read_bytes() + b"\n" + image)
    rig, node = imu_rig(receiver=str(flashed.with_suffix("")), program=str(NEW_BOOTLOADER))
    usb = plugged(node)
    flash(usb, "imu", "--vehicle", "2", "--channel", "80", "--air-rate", "250", "--send-rate", "60")
    shown = flash(usb, "--show")
    settings = ("vehicle_id       2", "radio_channel    80", "imu_send_hz      60")
    for text in ("imu, version", *settings):
        assert text in shown
    # The receiver on another channel receives nothing.
    rig.run(2.5)
    assert rig.statuses[-1].channel == 81
    assert rig.frames == []
    kept = flash(plugged(rig.receiver), "receiver", "--keep", "--channel", "80")
    for text in ("radio_channel    80", "radio_power_dbm  -6"):
        assert text in kept
    since_s = rig.now_s + 2.0
    rig.run(3.0)
    payloads = rig.payloads(ImuPayload, since_s=since_s)
    assert len(payloads) == pytest.approx(60, abs=3)
    assert {f.header.node.vehicle_id for _, f in rig.frames} == {2}
    assert {f.pipe for _, f in rig.frames} == {2}


def test_old_bootloader_is_found_and_gets_the_restart_by_interrupt(
    tools: None, bench: MakeBench, plugged: Plug
) -> None:
    rig = bench()
    usb = plugged(rig.imu_node(program=str(OLD_BOOTLOADER)))
    output = flash(usb, "imu")
    assert "soft_restart     True" in output
    rig.run(3.0)
    assert len(rig.payloads(ImuPayload, since_s=rig.now_s - 1.0)) == pytest.approx(100, abs=3)


def test_hang_on_a_board_with_an_old_bootloader_restarts_it_without_a_reset(
    imu_rig: MakeRig, changed: Callable[..., Path]
) -> None:
    rig, node = imu_rig(1.2, build=changed(soft_restart=True))
    release = node.mcu.hang("events_wait()")
    rig.run(0.3)
    release()
    rig.run(1.6)
    assert node.mcu.resets == 0
    assert rig.last(NodeStatusPayload).reset_cause == WATCHDOG
    assert len(rig.payloads(ImuPayload, since_s=rig.now_s - 0.5)) == pytest.approx(50, abs=3)


def test_damaged_settings_keep_the_board_off_the_air_and_blink(
    imu_rig: MakeRig, programs: Path, tmp_path: Path
) -> None:
    image = IntelHex(str(programs / "imu_node.hex"))
    offset = find_block(image.tobinstr(start=0)).offset
    image[offset + 12] ^= 1
    image.write_hex_file(str(tmp_path / "imu_node.hex"))
    rig, node = imu_rig(program=str(tmp_path / "imu_node"))
    flashes = led_of(node)
    rig.run(4.2)
    assert rig.frames == []
    assert node.mcu.resets == 0
    assert len(flashes) == pytest.approx(16, abs=1)


def led_of(node: Board) -> list[float]:
    """Record when the LED on the SPI's clock line is switched on."""
    flashes: list[float] = []
    level = [0]
    before = node.mcu.on_port_b

    def look(value: int) -> None:
        if value & SPI_CLOCK and not level[0]:
            flashes.append(node.mcu.now_ps)
        level[0] = value & SPI_CLOCK
        before(value)

    node.mcu.on_port_b = look
    return flashes


@pytest.mark.parametrize(
    ("absent", "per_cycle"), [("receiver", 1), ("sensor", 2), ("radio", 3)], ids=str
)
def test_led_flashes_count_the_fault(imu_rig: MakeRig, absent: str, per_cycle: int) -> None:
    rig, node = imu_rig()
    flashes = led_of(node)
    rig.run(2.2)
    assert flashes == []
    if absent == "sensor":
        node.barometer.absent = True
    else:
        (rig.receiver if absent == "receiver" else node).radio.absent = True
    rig.run(2.1)
    flashes.clear()
    rig.run(4.2)
    assert len(flashes) == pytest.approx(2 * per_cycle, abs=per_cycle - 0.5)
