"""A flight as one file: what it contains, how large it is, and that it loads nothing."""

import base64
import gzip
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect
from pymavlink.dialects.v20 import all as mavlink

from gateway.cli.support.options import read_options
from gateway.config import GatewaySettings
from gateway.estimation.select import ESTIMATORS
from gateway.panel.flight_page import (
    PageFlight,
    add_comparison,
    begin_comparison,
    read_flight,
    render_page,
)
from gateway.recordings.files import FlightError
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.cli import invoke
from tests.kit.mavlink import packed
from tests.kit.recordings import write_tlog
from tests.panel.browsing import FEW_FRAMES, launched, needs_chromium
from tests.panel.messages import BEGIN_US, HOSTILE_TEXT, flight_records

pytestmark = pytest.mark.io
GOLDEN = Path(__file__).parents[1] / "golden" / "take_off.csv.gz"
OPTIONS = read_options(GatewaySettings())


def flight_of(folder: Path, records: Iterable[RecordedFrame]) -> PageFlight:
    return read_flight([write_tlog(folder / "day_01.tlog", records)], OPTIONS, HOSTILE_TEXT)


def flight_with(folder: Path, messages: list[tuple[float, Any]]) -> PageFlight:
    """Return the flight of messages with their times in s."""
    sent = ((BEGIN_US + round(s * 1e6), packed(message, 3)) for s, message in messages)
    return flight_of(folder, (RecordedFrame(*record) for record in sent))


def unpacked(page: str, name: str) -> Any:
    packed = re.search(rf'id="{name}"[^>]*>([^<]*)<', page)
    assert packed is not None
    return json.loads(gzip.decompress(base64.b64decode(packed[1])))


def test_page_contains_the_states_and_texts_of_a_flight(tmp_path: Path) -> None:
    page = render_page(flight_of(tmp_path, flight_records(60)))
    assert HOSTILE_TEXT not in page
    data = unpacked(page, "data")
    (aircraft,) = data["aircraft"]
    assert (aircraft["system_id"], aircraft["model"]) == (3, "plane")
    column = aircraft["columns"]["alt_amsl_m"]
    heights = [column["r"] * sum(column["d"][: n + 1]) for n in range(len(column["d"]))]
    assert heights[0] == pytest.approx(400.0)
    assert len(heights) == pytest.approx(60 * 10 / 3, abs=2)
    assert data["texts"] == [[5.0, 3, 2, HOSTILE_TEXT[:50]]]
    assert set(unpacked(page, "modules")) >= {"vue", "./flight_page.js"}


def located(lat: int, boot_ms: int = 0) -> Any:
    return mavlink.MAVLink_global_position_int_message(boot_ms, lat, lat // 5, 430_000, *[0] * 5)


def test_page_leaves_out_positions_before_the_fix_and_joins_texts(tmp_path: Path) -> None:
    text = mavlink.MAVLink_statustext_message
    sent = [(k * 0.5, located(470_000_000 if k > 3 else 0)) for k in range(10)]
    sent += [(5.0, text(4, b"a" * 50, 7, 0)), (5.1, text(4, "ende ü".encode(), 7, 1))]
    data = unpacked(render_page(flight_with(tmp_path, sent)), "data")
    (aircraft,) = data["aircraft"]
    assert len(aircraft["columns"]["lat_deg"]["d"]) == 6
    assert (aircraft["breaks"], aircraft["distance_m"]) == ([], 0.0)
    assert [words for *_, words in data["texts"]] == ["a" * 50 + "ende ü"]


def test_page_of_gps_fixes_alone_has_a_track_and_its_interruption(tmp_path: Path) -> None:
    fixes = [
        (at, mavlink.MAVLink_gps_raw_int_message(
            0, 3, 470_000_000 + round(at * 100), 85_000_000, 430_000, 1, 1, 0, 0, 9))
        for at in (0.0, 1.0, 2.0, 3600.0, 3601.0)
    ]  # fmt: skip
    (aircraft,) = unpacked(render_page(flight_with(tmp_path, fixes)), "data")["aircraft"]
    assert len(aircraft["columns"]["lat_deg"]["d"]) == 5
    assert aircraft["breaks"] == [3_600_000_000]
    assert aircraft["distance_m"] == pytest.approx(3 * 1.11, rel=0.02)


@pytest.mark.slow
def test_page_of_a_quarter_of_an_hour_is_small(tmp_path: Path) -> None:
    empty = len(render_page(flight_of(tmp_path, flight_records(10))).encode())
    assert empty <= 3_000_000
    size = len(render_page(flight_of(tmp_path, flight_records(900))).encode())
    assert size - empty <= 500_000 / 4


def test_recording_without_a_position_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="no position"):
        flight_with(tmp_path, [(0, mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3))] * 3)


def test_page_of_the_last_recording_has_its_name_and_overwrites_none(tmp_path: Path) -> None:
    flight_of(tmp_path, flight_records(30))
    config, output = tmp_path / "gateway.toml", tmp_path / "flight.html"
    config.write_text(f'[recording]\nfolder = "{tmp_path}"\n')
    words = ("report", "last", "-o", output, "--quick", "-c", config)
    assert "MB" in invoke(*words, code=0).output
    page = output.read_text()
    assert "<title>day</title>" in page
    assert unpacked(page, "data")["name"] == "day"
    assert unpacked(page, "data")["aircraft"][0]["title"] == "Plane 3"
    assert "--force" in invoke(*words, code=2).output


def test_estimators_are_compared_in_another_process(tmp_path: Path) -> None:
    tlog = flight_of(tmp_path, flight_records(30))
    add_comparison(tlog, begin_comparison([tmp_path / "day_01.tlog"], OPTIONS))
    assert "The estimators are not compared: " in tlog.remarks[-1]
    flight = read_flight([GOLDEN], OPTIONS, "take-off")
    add_comparison(flight, begin_comparison([GOLDEN], OPTIONS))
    assert flight.remarks == []
    assert set(flight.compared) == set(ESTIMATORS)
    for curves in flight.compared.values():
        # On the page's clock, which begins with the first position.
        assert -10e6 < curves["time_us"][0] < curves["time_us"][-1] < 90e6


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a flight of two minutes."""
    path = tmp_path_factory.mktemp("page") / "flight.html"
    path.write_text(render_page(flight_of(path.parent, flight_records(120))))
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    yield from launched()


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1920, "dark")])
def test_page_works_offline(browser: Browser, page_file: Path, width: int, scheme: Any) -> None:
    context = browser.new_context(
        viewport={"width": width, "height": 600}, color_scheme=scheme, offline=True
    )
    context.add_init_script(FEW_FRAMES + LIST_DRAWN_TEXTS)
    page = context.new_page()
    troubles: list[str] = []
    page.on("console", lambda message: message.type == "error" and troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda r: r.url.startswith("http") and troubles.append(r.url))
    page.goto(page_file.as_uri())
    page.locator(".number-strip").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate("document.body.classList.contains('body--dark')") == (scheme == "dark")
    page.locator("input[type=range]").focus()
    page.keyboard.press("PageUp")
    assert page.locator("[data-role=clock]").inner_text() == "1:00 of 1:59"
    before = page.evaluate("mavgate.state.lat_deg")
    shown = page.locator(".number-strip [data-item='Latitude, longitude'] b")
    expect(shown).to_have_text(re.compile(f"^{before:.6f}, "))
    page.keyboard.press("ArrowRight")
    assert page.evaluate("mavgate.state.lat_deg") != before
    page.keyboard.press("Space")
    page.wait_for_function("mavgate.past_us > 66e6")
    page.keyboard.press("Space")
    page.get_by_title("Go to 0:05").click()
    assert page.locator("[data-role=clock]").inner_text().startswith("0:05")
    check_instruments(page)
    check_axes(page)
    assert page.evaluate("typeof ran") == "undefined"
    assert troubles == []
    context.close()


LIST_DRAWN_TEXTS = """
window.drawn = {};
const fill = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
  const name = this.canvas.ariaLabel ?? this.canvas.parentElement?.classList[0] ?? "";
  (window.drawn[name] ??= new Set()).add(String(text));
  fill.call(this, text, ...rest);
};
"""
"""Collects the texts of each canvas, by its label or its element's class."""


def check_axes(page: Page) -> None:
    """Check the marks of plots, and that the display and the map's scale follow the units."""

    def texts(name: str) -> set[str]:
        return set(page.evaluate("(name) => [...(window.drawn[name] ?? [])]", name))

    assert {"0", "90", "180", "270", "360"} <= texts("Heading")
    assert len([text for text in texts("Heading") if ":" in text]) >= 4
    scale = page.locator(".leaflet-control-scale-line")
    expect(scale).to_have_text(re.compile(r"^\d+ k?m$"))
    page.get_by_label("Units").select_option("aviation")
    expect(scale).to_have_text(re.compile(r"^\d+ (ft|NM)$"))
    page.wait_for_function("window.drawn['flight-display']?.has('1200')")
    assert {"ft/min", "200", "600", "1200"} <= texts("flight-display")


def check_instruments(page: Page) -> None:
    """Check that the instruments are drawn: none of their canvases has one colour only."""
    many = """(canvas) => {
        const copy = document.createElement('canvas');
        [copy.width, copy.height] = [64, 64];
        const pen = copy.getContext('2d');
        pen.drawImage(canvas, 0, 0, 64, 64);
        const data = new Uint32Array(pen.getImageData(0, 0, 64, 64).data.buffer);
        return new Set(data).size > 3;
    }"""
    for selector in (".flight-display canvas", ".plot canvas >> nth=0"):
        assert page.locator(selector).evaluate(many)
    assert int(page.locator(".scene").get_attribute("data-frames") or 0) > 1


NOTE_GAPS = """
window.gaps = 0;
for (const name of ['bufferData', 'bufferSubData']) {
  const send = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    const lines = given.filter((data) => data instanceof Float32Array);
    if (lines.some((data) => data.includes(1e9))) window.gaps += 1;
    return send.apply(this, given);
  };
}
"""
"""Counts the buffers of lines that are interrupted."""


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize(("later_s", "is_interrupted"), [(0.0, False), (3600.0, True)])
def test_path_in_3d_is_interrupted_where_the_recording_is(
    browser: Browser, tmp_path: Path, later_s: float, is_interrupted: bool
) -> None:
    sent = [(k * 0.5, located(470_000_000 + 1000 * k)) for k in range(40)]
    sent += [(20 + later_s + k * 0.5, located(470_040_000 + 1000 * k)) for k in range(40)]
    file = tmp_path / "flight.html"
    file.write_text(render_page(flight_with(tmp_path, sent)))
    page = browser.new_page()
    page.add_init_script(FEW_FRAMES + NOTE_GAPS)
    page.goto(file.as_uri())
    page.wait_for_function("Number(document.querySelector('.scene')?.dataset.frames) > 1")
    assert page.evaluate("window.gaps > 0") == is_interrupted
    page.close()
