import errno
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import pytest

from gateway import extras
from gateway.analysis.reporting.page import Report
from gateway.analysis.reporting.raw_sensors import timing
from gateway.cli.recorded import report
from gateway.recordings.columns import row_to_line
from gateway.recordings.table import TableHeader, encode_head
from tests.analysis.test_flight import rows
from tests.kit.cli import invoke

pytestmark = pytest.mark.io


def test_recording_is_compared_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One section stands for all of them, which take ten seconds to draw."""
    monkeypatch.setattr("gateway.analysis.reporting.compose.SECTIONS", (timing,))
    recording, other = tmp_path / "flight.csv", tmp_path / "other.toml"
    recording.write_text(encode_head(TableHeader()) + "".join(map(row_to_line, rows(raw=True))))
    other.write_text('[estimation]\nestimator = "paper"\n')
    folder = tmp_path / "out"
    arguments = ["--against-config", str(other), "--reference", str(recording), "-o", str(folder)]
    invoke("report", recording, *arguments, code=0)
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "Flight report: flight.csv" in page
    assert "Comparison" in page
    assert (folder / "comparison_difference.svg").exists()
    assert (folder / "timing.csv").exists()


def test_file_without_rows_is_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty.csv"
    empty.write_text(encode_head(TableHeader()))
    result = invoke("report", empty, "-o", tmp_path / "out", code=2)
    assert "contains no row" in result.output
    assert not (tmp_path / "out").exists()


def test_missing_package_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(name: str) -> ModuleSpec | None:
        return None if name == "jinja2" else find_spec(name)

    monkeypatch.setattr(extras, "find_spec", without)
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


def test_folder_that_is_not_empty_needs_force(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    result = invoke("report", "-o", tmp_path, code=2)
    assert "use --force to overwrite" in result.output
    assert (tmp_path / "index.html").read_text() == "mine"
