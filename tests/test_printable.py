"""Text from the network on a terminal, in JSON output and in a log; states in words."""

import io
import json
import logging
import math
import unicodedata

import pytest
from rich.table import Table
from rich.text import Text

from gateway.cli.support.terminal import console_of
from gateway.printable import (
    LONGEST,
    PrintableFormatter,
    figure,
    printable,
    printable_json,
    receiver_state,
    without_folders,
)

RIGHT_TO_LEFT = "\u202e"
DIRECTIONS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


def log_line(text: str) -> str:
    record = logging.makeLogRecord({"msg": "from %s", "args": (text,)})
    return PrintableFormatter("%(message)s").format(record)


def test_control_and_direction_characters_are_escaped() -> None:
    for text, shown in {
        "\x1b[2J\r": r"\x1b[2J\x0d",
        "\x9b2J": r"\x9b2J",
        f"a{RIGHT_TO_LEFT}gnp.exe": r"a\u202egnp.exe",
        "\u2028\ufeff": r"\u2028\ufeff",
        "\U000e0041": r"\U000e0041",
        "tab\tline\nÄ µ 高度 \u0645\u06cc\u200c\u062e\u0648": "tab\tline\nÄ µ 高度 می\u200cخو",
    }.items():
        assert printable(text) == shown
        assert printable(shown) == shown


def test_every_control_and_direction_character_of_unicode_is_escaped() -> None:
    dangerous = [
        chr(code)
        for code in range(0x110000)
        if unicodedata.category(chr(code)) in ("Cc", "Zl", "Zp")
        or unicodedata.bidirectional(chr(code)) in DIRECTIONS
    ]
    assert [each for each in dangerous if printable(each) == each] == ["\t", "\n"]


def test_json_output_is_escaped_and_decodes_to_the_same_value() -> None:
    text = "\x1b \x9b \u202e \u2028 \U000e0041 ä"
    shown = printable_json(json.dumps(text, ensure_ascii=False))
    assert json.loads(shown) == text
    assert all(letter.isprintable() for letter in shown)


def table(text: str) -> Table:
    table = Table(text)
    table.add_row(Text(text))
    return table


@pytest.mark.parametrize("make", [str, Text, table])
def test_console_escapes_text_of_any_renderable(make: object) -> None:
    console = console_of()
    console.file = io.StringIO()
    console.print(make(f"Site {RIGHT_TO_LEFT}\x9b2J"))
    assert r"Site \u202e\x9b2J" in console.file.getvalue()
    assert not {RIGHT_TO_LEFT, "\x9b"} & set(console.file.getvalue())


def test_log_line_is_escaped_bounded_and_cannot_be_imitated_by_a_line_feed() -> None:
    assert log_line(f"\x1b{RIGHT_TO_LEFT}") == r"from \x1b\u202e"
    assert len(log_line("/" * 60_000)) == LONGEST + 1
    assert log_line("x\n2026-01-01 INFO all is well") == "from x\n    2026-01-01 INFO all is well"


def test_port_without_frames_is_described() -> None:
    assert receiver_state("auto", True, 5000, 90) == "receiver: auto connected"
    for connected, received, text in (
        (False, 0, "receiver: not connected (serial.port = auto)"),
        (True, 0, "receiver: auto connected, silent"),
        (True, 5000, "receiver: auto connected, sends no frames"),
    ):
        assert receiver_state("auto", connected, received, 0).startswith(text)


def test_text_for_other_machines_has_no_folder_of_this_one() -> None:
    for text, shown in {
        "radio: /dev/ttyUSB0: No such device": "radio: ttyUSB0: No such device",
        "to install it: /opt/x.y/bin/python -m pip install 'a>=2'":
            "to install it: python -m pip install 'a>=2'",
        "see '/home/jo/.config/a b' and ~/x/y.toml": "see 'a b' and y.toml",
        "tcp://host:1/path is 3 m/s, 1/2 of -/- or a/b; tls:HOST:8883": None,
    }.items():  # fmt: skip
        assert without_folders(text) == (shown or text)


def test_known_number_is_followed_by_its_unit_and_an_unknown_one_is_a_dash() -> None:
    assert {figure(value, ".1f", "m") for value in (None, math.nan, math.inf, -math.inf)} == {"—"}
    assert figure(2.25, ".1f", "m") == "2.2 m"
    assert figure(0.1, ".0%") == "10%"
