"""Sections, figures and page of a report."""

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib import rc_context
from PIL import Image

from gateway.analysis.case import make_case
from gateway.analysis.reporting import style
from gateway.analysis.reporting.compose import make_report
from gateway.analysis.reporting.estimators import estimators
from gateway.analysis.reporting.page import Report, ReportTable, prose, write_report
from gateway.analysis.reporting.raw_sensors import EXCERPT_S, liveliest, loss_table
from gateway.analysis.reporting.style import CSS_NAMES
from tests.analysis.flights import short_case, short_flight, with_imu

pytestmark = pytest.mark.io


def test_lost_and_late_samples_are_measured() -> None:
    flight = short_flight()
    node_time_us = 10_000 * np.arange(len(flight.time_us))
    node_time_us[100:] += 20_000
    late_us = 1000 * (np.arange(len(flight.time_us)) % 2)
    late = with_imu(flight, time_us=node_time_us + late_us)
    (row,) = loss_table(late, node_time_us).to_dict("records")
    assert (row["nominal interval, ms"], row["lost"]) == (10.0, 2)
    assert row["longest gap, ms"] == pytest.approx(30.0, abs=1.01)
    assert row["jitter of gateway time, ms RMS"] == pytest.approx(1.0)


def test_excerpt_is_where_acceleration_changes_most() -> None:
    flight = short_flight()
    count = round(EXCERPT_S * flight.rate_hz)
    accel = np.zeros_like(flight.imu.accel_b_mps2)
    accel[2 * count : 3 * count, 1] = np.resize([1.0, -1.0], count)
    assert liveliest(with_imu(flight, accel_b_mps2=accel), 1) == slice(2 * count, 3 * count)


def test_flight_without_a_sample_that_counts_has_no_comparison_of_estimators() -> None:
    flight = short_flight(12.0)
    assert estimators(make_case(flight)) is not None
    unsettled = replace(flight, scored=np.zeros_like(flight.scored))
    assert estimators(make_case(unsettled)) is None


def drawn() -> str:
    with rc_context(style.RC):
        figure, (axes,) = style.panels(style.NARROW_IN, 1, 2.0)
        axes.plot([0.0, 1.0], [110.37101, 110.37499], color=style.BLUE, label="line")
        axes.yaxis.get_major_formatter().set_useOffset(False)
        return style.to_svg(figure)


def test_svg_is_reproducible_with_rounded_paths_and_exact_texts() -> None:
    svg = drawn()
    assert svg == drawn()
    assert re.search(r">110\.37\d+<", svg)
    paths = svg.split('d="M')[1:]
    assert paths
    assert all("." not in p or len(p.split(".")[1].split()[0]) <= 2 for p in paths)


def test_svg_has_css_colours_on_page_and_fixed_ones_in_file() -> None:
    svg = drawn()
    assert style.BLUE in style.stand_alone(svg)
    assert "#ffffff" in style.stand_alone(svg)
    assert style.BLUE not in style.for_page(svg)
    assert "var(--blue)" in style.for_page(svg)
    assert style.for_page(svg).startswith("<svg ")
    assert 'width="' not in style.for_page(svg).split(">")[0]


def test_narrow_figure_stacks_its_panels() -> None:
    with rc_context(style.RC):
        wide, _ = style.panels(style.WIDE_IN, 1, 2.0, columns=3)
        narrow, axes = style.panels(style.NARROW_IN, 1, 2.0, columns=3)
    assert wide.get_size_inches().tolist() == [style.WIDE_IN, 2.0]
    assert narrow.get_size_inches().tolist() == [style.NARROW_IN, 6.0]
    assert len(axes) == 3


def test_envelope_of_long_line_keeps_extremes_and_gaps(rng: np.random.Generator) -> None:
    x, y = np.arange(50_000.0), rng.normal(size=50_000)
    y[100:900] = np.nan
    y[1234], y[40_001] = 99.0, -99.0
    thin_x, thin_y = style.envelope(x, y)
    assert len(thin_x) <= style.MAX_POINTS + 2
    assert (np.nanmax(thin_y), np.nanmin(thin_y)) == (99.0, -99.0)
    assert (np.diff(thin_x) >= 0.0).all()
    assert np.isnan(thin_y).any()
    assert style.envelope(x[:10], x[:10])[0].tolist() == x[:10].tolist()


def test_square_axes_contain_all_points() -> None:
    with rc_context(style.RC):
        _, (axes,) = style.panels(style.WIDE_IN, 1, 3.0)
        style.fit_square(axes, np.array([0.0, 10.0]), np.array([5.0, 7.0]))
    assert np.ptp(axes.get_xlim()) == pytest.approx(np.ptp(axes.get_ylim()))
    assert axes.get_ylim()[0] < 5.0 < 7.0 < axes.get_ylim()[1]


CHROMIUM = shutil.which("chromium")
OFFLINE = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--hide-scrollbars",
)  # fmt: skip


@pytest.fixture(scope="module")
def report() -> Report:
    return make_report(short_case())


@pytest.fixture(scope="module")
def page(report: Report) -> Report:
    """Sections with every kind of figure: map, time, heat map, logarithms, histogram."""
    titles = ("The flight", "Acceleration filters", "Alpha and beta: Table I", "Timing and loss")
    return replace(report, sections=[each for each in report.sections if each.title in titles])


@pytest.fixture(scope="module")
def folder(page: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(page, folder)
    return folder


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    return (folder / "index.html").read_text(encoding="utf-8")


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


def test_page_is_well_formed_without_scripts_or_remote_assets(folder: Path, html: str) -> None:
    tags = Tags()
    tags.feed(html)
    assert tags.open == []
    for _, attributes in tags.seen:
        for name in ("src", "href", "xlink:href"):
            target = attributes.get(name) or "#"
            is_local = "/" not in target and (folder / target).is_file()
            assert target.startswith(("#", "data:")) or is_local
    assert "@import" not in html
    assert "<script" not in html


def test_figures_take_colours_from_page_theme(html: str) -> None:
    figures = "".join(re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL))
    assert not [colour for colour in CSS_NAMES if colour in figures]
    for name in CSS_NAMES.values():
        assert len(re.findall(rf"--{name}: #", html)) == 2


def test_every_figure_is_drawn_at_phone_width(report: Report, page: Report) -> None:
    names = {picture.name for section in report.sections for picture in section.pictures}
    assert {"fig07_yaw", "fig08_quaternion", "fig09_acceleration_x", "table1_heat_map"} <= names
    others = [section for section in report.sections if section not in page.sections]
    for picture in (picture for section in others for picture in section.pictures):
        with rc_context(style.RC):
            picture.draw(style.NARROW_IN).draw_without_rendering()


def test_every_figure_and_table_is_written_to_a_file(page: Report, folder: Path) -> None:
    names = {picture.name for section in page.sections for picture in section.pictures}
    tables = {table.name for section in page.sections for table in section.tables}
    assert {path.stem for path in folder.glob("*.svg")} == names
    assert {path.stem for path in folder.glob("*.png")} == names
    assert {path.stem for path in folder.glob("*.csv")} == tables
    assert len(pd.read_csv(folder / "table1.csv")) == 9


def test_every_navigation_link_has_its_section(html: str) -> None:
    links = re.findall(r'<li><a href="#([^"]+)">', html)
    assert links
    assert set(links) == set(re.findall(r'<section id="([^"]+)">', html))


def test_numbers_are_rounded_and_nan_is_a_dash() -> None:
    frame = pd.DataFrame({"a": [1.23456, float("nan")], "b": ["x", "y"]})
    table = ReportTable("t", frame, "", digits=1)
    assert table.rows() == [["1.2", "x"], ["—", "y"]]
    assert [table.is_text(0), table.is_text(1)] == [False, True]


def test_prose_is_escaped() -> None:
    assert prose("a `b` <c>") == "a <code>b</code> &lt;c&gt;"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize(("width", "height"), [(1100, 900), (390, 800)])
def test_browser_renders_page_at_desktop_and_phone_width(
    folder: Path, tmp_path: Path, width: int, height: int
) -> None:
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
