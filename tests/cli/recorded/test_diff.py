"""`mavgate diff`: recordings and parameter files."""

import json
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.kit.cli import run
from tests.kit.mavlink import Sender
from tests.kit.recordings import records_of, write_tlog

pytestmark = pytest.mark.io


def written(path: Path, messages: list[Any], lost: int = 0) -> Path:
    sender = Sender()
    frames = [sender.pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))]
    for _ in range(lost):
        sender.heartbeat()
    frames += [sender.pack(message) for message in messages]
    return write_tlog(path, records_of(frames, 500_000))


def param(name: bytes, value: float) -> Any:
    return mavlink.MAVLink_param_value_message(name, value, 9, 2, 0)


def mission(alt: float) -> list[Any]:
    item = mavlink.MAVLink_mission_item_int_message(
        255, 190, 0, 3, 16, 0, 1, 0, 0, 0, 0, 471_000_000, 85_000_000, alt, 0
    )
    return [mavlink.MAVLink_mission_count_message(255, 190, 1, 0), item]


@pytest.fixture
def flights(tmp_path: Path) -> tuple[Path, Path]:
    return write_both(tmp_path)


def write_both(folder: Path) -> tuple[Path, Path]:
    def version(patch: int) -> Any:
        number = 4 << 24 | 5 << 16 | patch << 8
        hashes = [[0] * 8] * 3
        return mavlink.MAVLink_autopilot_version_message(0, number, 0, 0, 9, *hashes, 1, 2, 0)

    text = mavlink.MAVLink_statustext_message
    battery = [
        mavlink.MAVLink_battery_status_message(0, 0, 0, 0, [1] * 10, 0, used, 0, 90)
        for used in (100, 350)
    ]
    one = [param(b"A", 0.1), param(b"B", 2), *mission(50), version(1), text(3, b"Bad gyro")]
    two = [param(b"A", 0.2), param(b"C", 3), *mission(60), version(2), text(6, b"Ready")]
    return written(folder / "a.tlog", [*one, *battery]), written(folder / "b.tlog", two, lost=3)


def test_recordings_are_compared_by_section(flights: tuple[Path, Path]) -> None:
    found = json.loads(run("diff", *flights, "--json"))
    assert found["parameters"] == {"A": ["0.1", "0.2"], "B": ["2", ""], "C": ["", "3"]}
    ((name, (before, after)),) = found["plans"].items()
    assert (name, before[-2:], after[-2:]) == ("mission 0", "50", "60")
    expected = {"firmware": ["4.5.1", "4.5.2"], "lost frames": ["0 (0.00%)", "3 (30.00%)"]}
    expected |= {"errors": ["1", "0"], "charge used, battery 0": ["250 mAh", ""]}
    assert {name: found["figures"][name] for name in expected} == expected
    assert found["texts"] == {"Bad gyro": ["Bad gyro", ""], "Ready": ["", "Ready"]}


def test_page_escapes_texts(flights: tuple[Path, Path], tmp_path: Path) -> None:
    other = written(tmp_path / "c.tlog", [mavlink.MAVLink_statustext_message(6, b"<script>")])
    run("diff", flights[0], other, "--html", tmp_path / "diff.html")
    text = (tmp_path / "diff.html").read_text()
    assert ("&lt;script&gt;" in text, "<script>" in text) == (True, False)
