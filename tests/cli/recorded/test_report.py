import errno
import sys
from pathlib import Path

import pytest

from gateway.analysis.reporting.page import Report
from gateway.analysis.reporting.raw_sensors import timing
from gateway.cli.recorded import report
from gateway.recordings.table import TableHeader
from tests.analysis.test_flight import rows
from tests.kit.cli import invoke
from tests.kit.recordings import write_table

pytestmark = pytest.mark.io


def test_recording_is_compared_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One section stands for all of them, which take ten seconds to draw."""
    monkeypatch.setattr("gateway.analysis.reporting.compose.SECTIONS", (timing,))
    recording = write_table(tmp_path / "flight.csv", TableHeader(), rows(raw=True))
    other, folder = tmp_path / "other.toml", tmp_path / "out"
    other.write_text('[estimation]\nestimator = "paper"\n')
    words = ("--against", other, "--reference", recording, "-o", folder)
    invoke("report", recording, *words, code=0)
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "Flight report: flight.csv" in page
    assert "Comparison" in page
    assert (folder / "comparison_difference.svg").exists()
    assert (folder / "timing.csv").exists()


def test_file_without_rows_is_refused(tmp_path: Path) -> None:
    empty = write_table(tmp_path / "empty.csv", TableHeader(), [])
    result = invoke("report", empty, "-o", tmp_path / "out", code=2)
    assert "contains no row" in result.output
    assert not (tmp_path / "out").exists()


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
