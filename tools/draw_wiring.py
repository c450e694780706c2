"""Draw firmware/wiring.svg from the tables of firmware/README.md, which are its only source."""

import re
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

FIRMWARE: Final = Path(__file__).resolve().parent.parent / "firmware"
README: Final = FIRMWARE / "README.md"
TARGET: Final = FIRMWARE / "wiring.svg"
HEADING: Final = "## Wiring"

BOARDS: Final = (
    ("IMU node", ("nRF24L01+", "GY-87")),
    ("GPS node", ("nRF24L01+", "GPS receiver")),
    ("Receiver", ("nRF24L01+",)),
    ("LoRa: any of the three", ("RFM95",)),
)
"""Each board and the modules at its left and right side."""
COLOURS: Final = (
    (r"VCC|3\.3V", "#d55e00"),
    (r"GND", "#222222"),
    (r"MOSI|MISO|SCK|CE|CSN|NSS|RESET", "#0072b2"),
    (r"SDA|SCL", "#009e73"),
    (r"IRQ|INTA|DIO0", "#e69f00"),
    (r"TX|RX", "#cc79a7"),
)
"""Colour of a wire by its pin, from a palette for people with colour blindness."""

WIDTH: Final = 980
ROW: Final = 26
HEAD: Final = 46
GAP: Final = 34
MODULE: Final = 130
CHIP_LEFT, CHIP_RIGHT = 380, 600
MARGIN: Final = 20


@dataclass(frozen=True, slots=True)
class Wire:
    """One row of a wiring table."""

    module_pin: str
    chip_pin: str
    board_pin: str
    note: str


def read_tables(text: str) -> dict[str, list[Wire]]:
    """Read the wiring tables by the name of the module, which heads their first column."""
    _, _, section = text.partition(f"\n{HEADING}\n")
    section = section.partition("\n## ")[0]
    tables: dict[str, list[Wire]] = {}
    rows: list[Wire] = []
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|") or len(cells) != len(Wire.__slots__):
            continue
        if cells[1] == "ATmega328P":
            rows = tables.setdefault(cells[0], [])
        elif not cells[0].startswith("---"):
            rows.append(Wire(*cells))
    return tables


def draw(tables: dict[str, list[Wire]]) -> str:
    """Return the diagram as SVG: a panel for each board, modules left and right of it."""
    parts: list[str] = []
    top = MARGIN
    for name, modules in BOARDS:
        rows = max(len(tables[module]) for module in modules)
        height = HEAD + rows * ROW + 10
        parts += _board(name, top, height)
        for side, module in enumerate(modules):
            parts += _module(module, tables[module], top, bool(side))
        top += height + GAP
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top}" width="{WIDTH}" '
        f'height="{top}" font-family="sans-serif" font-size="13">'
    )
    ground = f'<rect width="{WIDTH}" height="{top}" fill="#ffffff"/>'
    return "\n".join([head, ground, *parts, "</svg>", ""])


def _board(name: str, top: int, height: int) -> list[str]:
    middle = (CHIP_LEFT + CHIP_RIGHT) // 2
    return [
        _box(CHIP_LEFT, top, CHIP_RIGHT - CHIP_LEFT, height, "#e8f1f8"),
        _text(middle, top + 19, name, "middle", bold=True),
        _text(middle, top + 35, "Nano or Pro Mini", "middle"),
    ]


def _module(name: str, wires: list[Wire], top: int, right: bool) -> list[str]:
    left = WIDTH - MARGIN - MODULE if right else MARGIN
    edge = left if right else left + MODULE
    chip, inwards = (CHIP_RIGHT, "end") if right else (CHIP_LEFT, "start")
    parts = [
        _box(left, top, MODULE, HEAD + len(wires) * ROW + 10, "#f4f4f4"),
        _text(left + MODULE // 2, top + 19, name, "middle", bold=True),
    ]
    for number, wire in enumerate(wires):
        y = top + HEAD + number * ROW + ROW // 2
        colour = next(value for form, value in COLOURS if re.search(form, wire.module_pin))
        parts += [
            f'<line x1="{edge}" y1="{y}" x2="{chip}" y2="{y}" stroke="{colour}" stroke-width="3"/>',
            _text(edge + (8 if right else -8), y + 4, wire.module_pin, "start" if right else "end"),
            _text(chip + (-8 if right else 8), y + 4, wire.board_pin, inwards),
            _text((edge + chip) // 2, y - 5, wire.note, "middle", small=True),
        ]
    return parts


def _box(x: int, y: int, width: int, height: int, fill: str) -> str:
    size = f'width="{width}" height="{height}"'
    return f'<rect x="{x}" y="{y}" {size} rx="6" fill="{fill}" stroke="#555555"/>'


def _text(
    x: int, y: int, text: str, anchor: str, *, bold: bool = False, small: bool = False
) -> str:
    style = ' font-weight="bold"' * bold + ' font-size="11" fill="#444444"' * small
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}"{style}>{escape(text)}</text>'


if __name__ == "__main__":
    TARGET.write_text(draw(read_tables(README.read_text(encoding="utf-8"))), encoding="utf-8")
