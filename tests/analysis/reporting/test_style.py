import re

import numpy as np
import pytest

from gateway.analysis.reporting import style


def drawn() -> str:
    with style.styled():
        figure, (axes,) = style.panels(style.NARROW_IN, 1, 2.0)
        axes.plot([0.0, 1.0], [110.37101, 110.37499], color=style.BLUE, label="line")
        axes.yaxis.get_major_formatter().set_useOffset(False)
        return style.to_svg(figure)


def test_the_same_figure_is_the_same_file() -> None:
    assert drawn() == drawn()


def test_texts_keep_their_digits_while_paths_lose_theirs() -> None:
    svg = drawn()
    assert re.search(r">110\.37\d+<", svg)
    paths = svg.split('d="M')[1:]
    assert paths
    assert all("." not in p or len(p.split(".")[1].split()[0]) <= 2 for p in paths)


def test_page_colours_by_css_and_file_does_not() -> None:
    svg = drawn()
    assert style.BLUE in style.stand_alone(svg)
    assert "#ffffff" in style.stand_alone(svg)
    assert style.BLUE not in style.for_page(svg)
    assert "var(--blue)" in style.for_page(svg)
    assert style.for_page(svg).startswith("<svg ")
    assert 'width="' not in style.for_page(svg).split(">")[0]


def test_a_narrow_page_puts_panels_below_each_other() -> None:
    with style.styled():
        wide, _ = style.panels(style.WIDE_IN, 1, 2.0, columns=3)
        narrow, axes = style.panels(style.NARROW_IN, 1, 2.0, columns=3)
    assert wide.get_size_inches().tolist() == [style.WIDE_IN, 2.0]
    assert narrow.get_size_inches().tolist() == [style.NARROW_IN, 6.0]
    assert len(axes) == 3


def test_a_long_line_keeps_its_extremes(rng: np.random.Generator) -> None:
    x, y = np.arange(50_000.0), rng.normal(size=50_000)
    y[100:900] = np.nan
    y[1234], y[40_001] = 99.0, -99.0
    thin_x, thin_y = style.envelope(x, y)
    assert len(thin_x) <= style.MAX_POINTS + 2
    assert (np.nanmax(thin_y), np.nanmin(thin_y)) == (99.0, -99.0)
    assert (np.diff(thin_x) >= 0.0).all()
    assert np.isnan(thin_y).any()


def test_a_short_line_stays_as_it_is() -> None:
    x = np.arange(10.0)
    assert style.envelope(x, x)[0] is x


def test_a_square_holds_all_points() -> None:
    with style.styled():
        _, (axes,) = style.panels(style.WIDE_IN, 1, 3.0)
        style.fit_square(axes, np.array([0.0, 10.0]), np.array([5.0, 7.0]))
    assert np.ptp(axes.get_xlim()) == pytest.approx(np.ptp(axes.get_ylim()))
    assert axes.get_ylim()[0] < 5.0 < 7.0 < axes.get_ylim()[1]
