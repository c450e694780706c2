"""The wiring tables of firmware/README.md: their picture, the chip's pins, the programs' pins."""

import re
from pathlib import Path

from tools import draw_wiring

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
FIRST = {"B": ("D", 8), "C": ("A", 0), "D": ("D", 0)}
"""Name and number of a Nano's pin at bit 0 of each port."""


def tables() -> dict[str, list[draw_wiring.Wire]]:
    return draw_wiring.read_tables(draw_wiring.README.read_text())


def test_picture_is_that_of_the_tables() -> None:
    message = "call python -m tools.draw_wiring"
    assert draw_wiring.TARGET.read_text() == draw_wiring.draw(tables()), message


def test_every_module_of_a_board_has_its_table() -> None:
    assert set(tables()) == {module for _, modules in draw_wiring.BOARDS for module in modules}
    assert [len(wires) for wires in tables().values()] == [8, 8, 5, 4]


def test_names_of_the_chips_pins_and_of_the_boards_pins_agree() -> None:
    for wire in (wire for wires in tables().values() for wire in wires if wire.chip_pin):
        port, bit = wire.chip_pin[1], int(wire.chip_pin[2])
        letter, first = FIRST[port]
        assert wire.board_pin == f"{letter}{first + bit}", wire


def test_programs_use_the_pins_of_the_table() -> None:
    source = (FIRMWARE / "hal" / "spi.cpp").read_text()
    used = dict(re.findall(r"constexpr uint8_t (\w+) = 1 << (PB\d);", source))
    wired = {wire.module_pin: wire.chip_pin for wire in tables()["nRF24L01+"]}
    assert used == {pin: wired[pin] for pin in ("CE", "CSN", "MOSI", "SCK")}
    by_pin = {wire.chip_pin: wire.module_pin for wire in tables()["RFM95"]}
    assert [by_pin[used[pin]] for pin in ("CE", "CSN", "MOSI", "SCK")] == [
        *("RESET", "NSS", "MOSI", "SCK")
    ]
