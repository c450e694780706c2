import errno
import sys
from pathlib import Path

import pandas as pd
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.analysis.reporting.page import Report
from gateway.analysis.reporting.raw_sensors import timing
from gateway.cli.recorded import report
from gateway.recordings.table import TableHeader
from gateway.wire.recorded_frames import RecordedFrame
from tests.analysis.test_flight import rows
from tests.kit.cli import invoke
from tests.kit.mavlink import packed
from tests.kit.recordings import SECOND_US, START_US, make_tlog, write_table

pytestmark = pytest.mark.io


def test_recording_is_compared_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One section stands for all of them, which take ten seconds to draw."""
    monkeypatch.setattr("gateway.analysis.reporting.compose.SECTIONS", (timing,))
    recording = write_table(tmp_path / "flight.csv", TableHeader(), rows(raw=True)[:2000])
    other, folder = tmp_path / "other.toml", tmp_path / "out"
    other.write_text('[estimation]\nestimator = "paper"\n')
    words = ("--against", other, "--reference", recording, "-o", folder)
    invoke("report", recording, *words, code=0)
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "Flight report: flight.csv" in page
    assert "Comparison" in page
    assert (folder / "comparison_difference.svg").exists()
    assert (folder / "timing.csv").exists()


def test_flight_without_samples_has_a_section_for_pilots(tmp_path: Path) -> None:
    records = []
    for second in range(60):
        at = (470_000_000 + 1000 * second, 80_000_000, 496_000, 96_000, 1000, 0, 0, 0)
        messages = (
            mavlink.MAVLink_heartbeat_message(1, 3, 128, 10, 4, 3),
            mavlink.MAVLink_global_position_int_message(1000 * second, *at),
            mavlink.MAVLink_sys_status_message(*(0,) * 4, 11_800, 0, 70, *(0,) * 6),
        )
        at_us = START_US + second * SECOND_US
        records += [RecordedFrame(at_us, packed(message, 1)) for message in messages]
    (tmp_path / "cut.tlog").write_bytes(make_tlog(records))
    result = invoke("report", tmp_path / "cut.tlog", "-o", tmp_path / "out", code=0)
    assert "contains no HIGHRES_IMU" in result.output
    page = (tmp_path / "out" / "index.html").read_text()
    assert "highest above home" in page
    assert "0:59" in page
    figures = pd.read_csv(tmp_path / "out" / "flight_figures.csv").set_index("figure")["value"]
    assert figures["in the air"] == figures["armed"] == 59.0
    assert {file.stem for file in (tmp_path / "out").glob("*.svg")} == {
        "flight_map", "flight_over_time",
    }  # fmt: skip


def test_missing_package_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    result = invoke("report", code=2)
    assert result.output.startswith("a report needs the extra plot; to install it: ")
    assert result.output.endswith("install 'jinja2>=3.1' 'matplotlib>=3.9'\n")


def test_full_disk_is_reported_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "page"))

    monkeypatch.setattr("gateway.analysis.reporting.page.write_report", full)
    empty = Report("", "", [], [])
    monkeypatch.setattr("gateway.analysis.reporting.compose.make_report", lambda *_: empty)
    monkeypatch.setattr("gateway.analysis.case.make_case", lambda *_, **__: None)
    monkeypatch.setattr(report, "load_flight", lambda *_: None)
    result = invoke("report", "-o", tmp_path / "page", code=2)
    assert f"{tmp_path / 'page'}: No space left" in result.output
