import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from gateway.analysis.reporting.compose import make_report
from gateway.analysis.reporting.page import Report, ReportTable, prose, write_report
from gateway.analysis.reporting.style import CSS_NAMES
from tests.analysis.flights import short_case

pytestmark = pytest.mark.io

CHROMIUM = shutil.which("chromium")
OFFLINE = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--hide-scrollbars",
)  # fmt: skip


@pytest.fixture(scope="module")
def report() -> Report:
    return make_report(short_case())


@pytest.fixture(scope="module")
def folder(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(report, folder)
    return folder


class Tags(HTMLParser):
    """Every tag with its attributes, and whether tags close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))


def test_the_page_is_well_formed_and_needs_no_network(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    for _, attributes in tags.seen:
        for name in ("src", "href", "xlink:href"):
            target = attributes.get(name) or "#"
            is_local = "/" not in target and (folder / target).is_file()
            assert target.startswith(("#", "data:")) or is_local
    assert "@import" not in text
    assert "<script" not in text


def test_the_pages_theme_colours_the_figures(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    figures = "".join(re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL))
    assert not [colour for colour in CSS_NAMES if colour in figures]
    for name in CSS_NAMES.values():
        assert len(re.findall(rf"--{name}: #", text)) == 2


def test_every_figure_and_table_is_a_file_too(report: Report, folder: Path) -> None:
    names = {picture.name for section in report.sections for picture in section.pictures}
    tables = {table.name for section in report.sections for table in section.tables}
    assert {path.stem for path in folder.glob("*.svg")} == names
    assert {path.stem for path in folder.glob("*.png")} == names
    assert {path.stem for path in folder.glob("*.csv")} == tables
    assert {"fig07_yaw", "fig08_quaternion", "fig09_acceleration_x", "table1_heat_map"} <= names
    assert len(pd.read_csv(folder / "table1.csv")) == 9


def test_every_link_has_its_section(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'<li><a href="#([^"]+)">', text)
    assert links
    assert set(links) == set(re.findall(r'<section id="([^"]+)">', text))


def test_numbers_are_shown_short_and_unknown_ones_as_a_dash() -> None:
    table = ReportTable(
        "t", pd.DataFrame({"a": [1.23456, float("nan")], "b": ["x", "y"]}), "", digits=1
    )
    assert table.rows() == [["1.2", "x"], ["–", "y"]]
    assert [table.is_text(0), table.is_text(1)] == [False, True]


def test_prose_is_escaped() -> None:
    assert prose("a `b` <c>") == "a <code>b</code> &lt;c&gt;"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize(("width", "height"), [(1100, 900), (390, 800)])
def test_a_browser_shows_the_page(folder: Path, tmp_path: Path, width: int, height: int) -> None:
    picture = tmp_path / "page.png"
    subprocess.run(
        [
            str(CHROMIUM), *OFFLINE, f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={width},{height}", f"--screenshot={picture}",
            (folder / "index.html").as_uri(),
        ],
        check=True, capture_output=True, timeout=240,
    )  # fmt: skip
    with Image.open(picture) as image:
        assert image.size == (width, height)
        assert len(image.convert("RGB").getcolors(1 << 24) or []) > 20
