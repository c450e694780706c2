"""One MAVLink message as CSV: every row, every instance, arrays and texts in full."""

import csv
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.kit.cli import run
from tests.kit.recordings import records_sent, write_tlog

pytestmark = pytest.mark.io


def battery(number: int) -> Any:
    return mavlink.MAVLink_battery_status_message(
        number, 0, 0, 2000, [4100 + number, *[65535] * 9], 0, 0, 0, 90
    )


def rows_of(folder: Path, name: str, *options: object) -> list[dict[str, str]]:
    out = folder / "out.csv"
    run("convert", folder / "a.tlog", "-o", out, "--message", name, "--force", *options)
    return list(csv.DictReader(out.read_text().splitlines()))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    first, second = (1, 1), (2, 1)
    sent = [
        (first, battery(0)), (first, battery(1)), (second, battery(0)),
        (first, mavlink.MAVLink_statustext_message(6, 'Höhe, "5 m"'.encode())),
        (first, mavlink.MAVLink_attitude_message(7, 0.1, -1e-9, float("nan"), 0, 0, 0)),
    ]  # fmt: skip
    write_tlog(tmp_path / "a.tlog", records_sent(sent, step_us=0))
    return tmp_path


def test_messages_of_one_time_and_of_other_instances_are_rows_of_their_own(folder: Path) -> None:
    rows = rows_of(folder, "BATTERY_STATUS")
    assert [(row["system_id"], row["id"]) for row in rows] == [("1", "0"), ("1", "1"), ("2", "0")]
    assert {row["time"] for row in rows} == {"2025-10-09T08:53:20.000000Z"}
    assert [row["voltages[0]"] for row in rows] == ["4100", "4101", "4100"]
    assert rows[0]["voltages[9]"] == "65535"
    assert rows_of(folder, "BATTERY_STATUS", "--system", 2) == rows[2:]


def test_texts_are_whole_and_floats_have_their_shortest_text(folder: Path) -> None:
    assert rows_of(folder, "STATUSTEXT")[0]["text"] == 'Höhe, "5 m"'
    (row,) = rows_of(folder, "attitude")
    expected = {"roll": "0.1", "pitch": "-1e-09", "yaw": "nan", "time_boot_ms": "7"}
    assert row.items() >= expected.items()
