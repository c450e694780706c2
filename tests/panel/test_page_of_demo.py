"""The functions of the page, and its layout, on one page of a demo."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal
from zipfile import ZipFile

import pytest
from PIL import Image
from playwright.sync_api import Browser, Locator, Page, expect

from gateway.live.control_socket import request
from tests.kit.process import wait_for
from tests.kit.recordings import write_tlog
from tests.panel.browsing import (
    START_LIMIT_MS,
    WAIT_MS,
    Process,
    box_of,
    choose,
    download,
    needs_chromium,
    open_page,
    opened,
    show,
)
from tests.panel.messages import flight_records
from tests.panel.test_map_tiles import write_pmtiles

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]
expect.set_options(timeout=WAIT_MS)


@pytest.fixture(scope="module")
def page(browser: Browser, demo: Process) -> Iterator[Page]:
    """The one page that all tests of the demo look at."""
    with opened(browser, demo.link()) as page:
        yield page


def test_several_simulated_aircraft_are_distinguished_and_selected(page: Page) -> None:
    view = show(page, "map")
    expect(page.locator(".chips").get_by_text("simulation")).to_be_visible()
    page.wait_for_function("Object.keys(mavgate.vehicles).length === 2")
    expect(view.locator(".craft")).to_have_count(2)
    for number in (2, 1):
        choose(page, "Aircraft", f"Plane {number}")
        page.wait_for_function(f"mavgate.state.system_id === {number}")


def test_scene_shows_the_aircraft_from_two_viewpoints(page: Page) -> None:
    scene = show(page, "flight").locator(".scene")
    expect(scene).to_have_attribute("data-model", "plane")
    choices = scene.locator("select")
    assert [choices.nth(i).input_value() for i in range(2)] == ["chase", "ground"]
    page.wait_for_function("document.querySelector('.scene').dataset.frames > 5")
    # Over each half's own region the world is drawn: sky, ground and aircraft, not one colour.
    # Not the element's own photograph, which waits until nothing moves.
    clip = box_of(scene)

    def halves() -> list[Image.Image]:
        """The two halves as soon as the browser has put what was drawn on the page."""
        picture = Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")
        middle = picture.height // 2
        found = [picture.crop((0, y + 60, picture.width, y + middle)) for y in (0, middle)]
        return found if all(len(half.getcolors(1 << 24)) > 20 for half in found) else []

    upper, lower = wait_for(halves, lambda: "one colour")
    assert upper.tobytes() != lower.resize(upper.size).tobytes()
    choices.nth(0).select_option("above")
    before = scene.get_attribute("data-frames")
    page.wait_for_function(f"document.querySelector('.scene').dataset.frames > {before} + 2")


TOUCH_THE_BODY = """
async () => {
  const scene = document.querySelector(".scene");
  const drawn = new Set();
  const last = Number(scene.dataset.frames) + 5;
  while (Number(scene.dataset.frames) < last) {
    document.body.classList.toggle("touched");
    await new Promise(requestAnimationFrame);
    drawn.add(scene.dataset.model);
  }
  return [...drawn];
}
"""
"""Changes the body's classes, as its framework does; returns what is drawn meanwhile."""


def test_3d_model_is_not_reloaded_while_the_theme_stays(page: Page) -> None:
    scene = show(page, "flight").locator(".scene")
    expect(scene).to_have_attribute("data-model", "plane")
    assert page.evaluate(TOUCH_THE_BODY) == ["plane"]
    page.emulate_media(color_scheme="dark")
    assert page.evaluate(TOUCH_THE_BODY) == ["plane"]


def test_map_changes_style_and_zoom_and_accepts_an_upload(page: Page, tmp_path: Path) -> None:
    view = show(page, "map")
    expect(view.locator(".leaflet-tile-loaded").first).to_be_visible()
    style = view.get_by_label("Map style")
    assert style.locator("option").all_inner_texts() == ["Field", "Other", "Grid"]
    first = view.locator(".leaflet-tile-loaded").first.get_attribute("src")
    style.select_option(label="Other")
    expect(view.locator(".leaflet-tile-loaded[src*='/tiles/1/']").first).to_be_visible()
    assert first is not None
    assert "/tiles/0/" in first
    style.select_option(label="Grid")
    expect(view.locator(".leaflet-tile")).to_have_count(0)
    grid = view.locator("canvas.map-grid")
    expect(grid).to_have_attribute("data-step", re.compile(r"\d"))
    step = grid.get_attribute("data-step")
    for _ in range(3):
        view.locator(".leaflet-control-zoom-out").click()
    page.wait_for_function(
        f"document.querySelector('[data-view=map] .map-grid').dataset.step > {step}"
    )
    expect(view.locator(".craft[data-selected='true']")).to_be_visible()
    expect(view.locator(".pin.home")).to_be_visible()
    upload = view.get_by_label("Upload a PMTiles file")
    (tmp_path / "hostile.pmtiles").write_bytes(b"no tiles at all")
    upload.set_input_files(tmp_path / "hostile.pmtiles")
    expect(page.get_by_text("it is no PMTiles file")).to_be_visible()
    write_pmtiles(tmp_path / "home field.pmtiles", tiles=[(4, 12, 8)])
    upload.set_input_files(tmp_path / "home field.pmtiles")
    expect(style.locator("option")).to_have_text(["Field", "Other", "home field", "Grid"])
    style.select_option(label="home field")
    expect(view.locator(".leaflet-tile-loaded[src*='/tiles/2/']").first).to_be_visible()
    # Its one tile, drawn much larger, would cost the tests to follow much time.
    style.select_option(label="Field")


LISTEN_TO_WORDS = """
(element) => {
  window.words = [];
  const kinds = { childList: true, characterData: true, subtree: true };
  const note = () => window.words.push(element.textContent);
  new MutationObserver(note).observe(element, kinds);
}
"""
"""Records every text of an element from now on, also one that is shown for a moment."""


def test_position_is_copied_as_latitude_and_longitude(page: Page) -> None:
    view = show(page, "map")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    position = view.locator("[data-role='position']")
    expect(position).to_have_text(re.compile(r"-7\.7\d{5}, 110\.3\d{5}"))
    copy = view.get_by_text("Copy", exact=True)
    copy.evaluate(LISTEN_TO_WORDS)
    copy.click()
    page.wait_for_function("window.words.includes('Copied')")
    copied = page.evaluate("navigator.clipboard.readText()")
    assert re.fullmatch(r"-7\.7\d{5}, 110\.3\d{5}", copied)


def test_marked_position_is_sent_and_shown_with_its_distance(page: Page, demo: Process) -> None:
    view = show(page, "map")
    expect(view.locator(".pin.home")).to_be_visible()
    expect(view.locator("[data-role='sight']")).to_have_text(re.compile(r"from home \d{1,3}°"))
    canvas = view.locator(".map-canvas")
    canvas.click(position={"x": 300, "y": 250})
    ask = view.locator(".map-ask")
    # Next to the point, not over all of the map, and named as in the header.
    expect(ask).to_contain_text("Plane 1")
    box, around = box_of(ask), box_of(canvas)
    assert 0 < box["x"] - (around["x"] + 300) < 30
    assert box["width"] < around["width"] / 2
    ask.get_by_text("Mark this position").click()
    expect(ask).to_have_count(0)
    expect(view.locator("[data-role='way']")).to_have_text(
        re.compile(r"mark \d+(\.\d+)? (m|km), \d{1,3}°")
    )
    expect(view.locator(".pin.mark")).to_be_visible()
    socket = demo.log.parent / "mavgate" / "run.sock"
    aircraft, _ = request(socket, "status", timeout_s=WAIT_MS / 1000)["aircraft"]
    # Until the mark is acknowledged, it is known by rounded distance and bearing alone.
    page.wait_for_function(
        "(mark) => ['lat_deg', 'lon_deg'].every("
        "(key) => mavgate.state.mark && Math.abs(mavgate.state.mark[key] - mark[key]) < 2e-7)",
        arg=aircraft["mark"],
    )
    canvas.click(position={"x": 400, "y": 300})
    view.locator(".map-ask").get_by_text("Clear the mark").click()
    expect(view.locator("[data-role='way']")).to_have_count(0)


def test_recording_is_saved_loaded_cut_played_and_deleted(page: Page, tmp_path: Path) -> None:
    view = show(page, "recordings")
    state = view.locator("[data-role='recorder']")
    expect(state).to_have_text("idle")
    start, stop = view.get_by_label("Start recording"), view.get_by_label("Stop recording")
    expect(stop).to_be_disabled()
    expect(stop).to_have_attribute("title", "Nothing is being recorded.")
    start.click()
    expect(state).to_have_text("recording")
    expect(start).to_be_disabled()
    expect(start).to_have_attribute("title", "A recording is in progress.")
    expect(page.locator(".chips").get_by_text("REC")).to_be_visible()
    page.evaluate("window.begun_us = mavgate.state.time_us")
    # Longer than two heartbeats, so that the recording contains the vehicle type.
    page.wait_for_function("mavgate.state.time_us > window.begun_us + 2.5e6")
    stop.click()
    expect(state).to_have_text("idle")
    view.get_by_label("Save recording").click()
    page.get_by_label("Name of the recording").fill("morning flight")
    page.locator(".asks").get_by_role("button", name="Save").click()
    row = view.locator("tr[data-key='morning flight']")
    # One file after another gets the new name.
    expect(row).to_contain_text("2 tables, 1 tlog")
    with ZipFile(download(page, row.get_by_label("Download"), tmp_path)) as packed:
        names = packed.namelist()
        tlog = next(name for name in names if name.endswith(".tlog"))
        (tmp_path / "evening_01.tlog").write_bytes(packed.read(tlog))
    assert {"morning flight_01_v1.csv", "morning flight_01_v2.csv"} <= set(names)
    _cut_and_extract(page, row, tmp_path)
    view.get_by_label("Upload a recording").set_input_files(tmp_path / "evening_01.tlog")
    brought = view.locator("tr[data-key='evening']")
    expect(brought).to_be_visible()
    (tmp_path / "holiday.tlog").write_text("this is no flight at all, but a text\n")
    view.get_by_label("Upload a recording").set_input_files(tmp_path / "holiday.tlog")
    expect(page.get_by_text("unknown file format")).to_be_visible()
    _move_in_time(page, row)
    for name in ("morning flight", "evening"):
        view.locator(f"tr[data-key='{name}']").get_by_label("Delete").click()
        page.locator(".asks").get_by_role("button", name="Delete").click()
        expect(view.locator(f"tr[data-key='{name}']")).to_have_count(0)
        expect(page.locator(".asks")).to_have_count(0)


def _cut_and_extract(page: Page, row: Locator, folder: Path) -> None:
    cut, dialog = row.get_by_label("Cut or extract"), page.locator(".asks")
    cut.click()
    dialog.get_by_label("From").fill("soon")
    dialog.get_by_role("button", name="Cut to a tlog").click()
    expect(page.get_by_text("invalid time 'soon'")).to_be_visible()
    for label, value, button, name in (
        ("To", "1.5", "Anonymised tlog", "anonymised.tlog"),
        ("Vehicle", "1", "Parameters", "morning flight.param"),
    ):
        cut.click()
        dialog.get_by_label(label).fill(value)
        assert download(page, dialog.get_by_role("button", name=button), folder).name == name


def _move_in_time(page: Page, row: Locator) -> None:
    view = page.locator(".player")
    row.get_by_label("Open").click()
    slider = view.get_by_role("slider")
    expect(slider).to_be_visible()
    page.wait_for_function("document.querySelector('.player .time-slider').dataset.points > 5")
    # Both aircraft of the recording fly, under numbers that no live one has.
    expect(slider).to_have_attribute("data-curves", "2")
    flown = "Object.values(mavgate.vehicles).filter((v) => v.origin === 'recorded')"
    page.wait_for_function(f"{flown}.length === 2 && {flown}.every((v) => v.system_id > 200)")
    choose(page, "Aircraft", "Plane 2, recorded")
    page.wait_for_function("mavgate.state.origin === 'recorded'")
    expect(page.locator(".chips").get_by_text("playback", exact=True)).to_be_visible()
    expect(page.locator(".chips").get_by_text("link", exact=True)).to_have_count(0)
    playing = re.compile(r"PLAYBACK \d+:\d\d of \d+:\d\d")
    expect(page.locator(".playback-bar")).to_contain_text(playing)
    # Nothing of the live recorder and of the live flight is offered meanwhile.
    expect(page.locator(".recorder >> visible=true")).to_have_count(0)
    for key in ("map", "flight"):
        show(page, key)
        expect(slider).to_be_visible()
    expect(page.get_by_role("button", name=re.compile("Back to live"))).to_be_visible()
    expect(page.get_by_title("Show the present")).to_be_hidden()
    expect(page.locator("[data-view='map'] [data-role=path]")).to_have_text(["live", "recorded"])
    view.get_by_label("Play or pause").click()
    expect(view.get_by_label("Play or pause")).to_have_text("play_arrow")
    length_s = float(slider.get_attribute("aria-valuemax") or 0)
    assert length_s > 2
    slider.click(position={"x": box_of(slider)["width"] * 0.5, "y": 20})
    half = re.compile("|".join(f"^{int(length_s / 2) + off}$" for off in (-1, 0, 1)))
    expect(slider).to_have_attribute("aria-valuenow", half)
    for icon in ("pause", "play_arrow"):
        page.keyboard.press("Space")
        expect(view.get_by_label("Play or pause")).to_have_text(icon)
    choose(page, "Speed", "0.5×")
    speed = view.get_by_label("Speed")
    expect(speed).to_have_value("0.5×")
    view.get_by_text("fused again next to it").click()
    # The table is fused by another process.
    page.wait_for_function(
        "Object.values(mavgate.vehicles).filter((v) => v.origin === 'fused again').length === 2",
        timeout=START_LIMIT_MS,
    )
    expect(slider).to_be_visible()
    expect(speed).to_have_value("1×")
    view.get_by_label("Close the playback").click()
    expect(slider).to_be_hidden()
    page.wait_for_function("Object.values(mavgate.vehicles).every((v) => v.origin === 'live')")
    show(page, "recordings")


def test_path_has_no_gap_after_another_view_was_shown(page: Page) -> None:
    """Points that came while the map was hidden are drawn when it is shown again."""
    show(page, "flight")
    show(page, "plots")
    begin = page.evaluate("mavgate.track(mavgate.selected).points.length")
    page.wait_for_function(f"mavgate.track(mavgate.selected).points.length > {begin} + 8")
    show(page, "map")
    page.wait_for_function(
        """() => {
            const map = document.querySelector('[data-view=map] .map').mavgate_map, lengths = [];
            map.eachLayer((layer) => lengths.push(layer.getLatLngs?.().flat().length ?? 0));
            return Math.max(...lengths) >= mavgate.track(mavgate.selected).points.length - 2;
        }"""
    )
    longest = page.evaluate(
        """() => {
            const points = mavgate.track(mavgate.selected).points;
            return Math.max(...points.slice(1).map((p, n) => mavgate.distance_m(points[n], p)));
        }"""
    )
    assert longest < 50


def test_flight_view_seeks_back_and_returns_to_the_present(page: Page) -> None:
    view = show(page, "flight")
    slider = view.get_by_role("slider", name="Moment of the flight")
    page.wait_for_function("(mavgate.histories[mavgate.selected]?.time_us.length ?? 0) > 20")
    slider.press("ArrowLeft")
    page.wait_for_function("mavgate.past_us !== null")
    past_us = page.evaluate("mavgate.state.time_us")
    page.wait_for_function(f"mavgate.now_us > {past_us} + 6e6")
    assert page.evaluate("mavgate.state.time_us") == past_us
    expect(view.locator(".number-strip [data-item='Ground speed'] b")).not_to_be_empty()
    # A page that was busy shows the present for a moment.
    state = page.evaluate("mavgate.state")
    spot = view.locator(".number-strip [data-item='Latitude, longitude'] b")
    expect(spot).to_have_text(f"{state['lat_deg']:.6f}, {state['lon_deg']:.6f}")
    view.get_by_role("button", name="Go to live").click()
    page.wait_for_function(f"mavgate.state.time_us > {past_us} + 6e6")


def test_recording_is_hidden_on_another_page(browser: Browser, page: Page, demo: Process) -> None:
    folder = demo.log.parent / "recordings"
    folder.mkdir(exist_ok=True)
    write_tlog(folder / "mine_01.tlog", flight_records(60))
    view = show(page, "recordings")
    view.locator("tr[data-key='mine']").get_by_label("Open").click()
    expect(page.locator(".playback-bar")).to_be_visible(timeout=START_LIMIT_MS)
    other = open_page(browser, demo.link())
    # Several states after the first: the player sends as often as the gateway.
    other.wait_for_function(f"mavgate.now_us > {other.evaluate('mavgate.now_us')} + 5e5")
    origins = other.evaluate("Object.values(mavgate.vehicles).map((v) => v.origin)")
    assert origins == ["live", "live"]
    expect(other.locator(".playback-bar")).to_be_hidden()
    other.close()
    page.get_by_role("button", name="Back to live").click()
    expect(page.locator(".playback-bar")).to_be_hidden()
    page.wait_for_function("mavgate.state && mavgate.state.origin === 'live'")


VIEWS: Final = {
    "flight": ".number-strip b", "map": ".craft", "link": "tr[data-key] >> nth=3",
    "recordings": ".table-frame", "calibration": ".guide h2", "tuning": ".parameter >> nth=3",
    "plots": ".strip-chart", "events": ".table-frame",
}  # fmt: skip
"""Each view, and an element of it that is there once it is filled."""
WIDTHS: Final = {390: 844, 1024: 768, 1920: 1080}
SWITCH_MS: Final = 200
"""From a click to the view, which the browser shows by itself."""

FAULTS: Final = """
(view) => {
  const section = document.querySelector(`section[data-view='${view}']`);
  const controls = 'button, input, select, a, [role=slider], h1, h2, dt, dd, .chip';
  const seen = (element) => {
    const box = element.getBoundingClientRect();
    const style = getComputedStyle(element);
    return box.width > 1 && box.height > 1 && style.visibility !== 'hidden' && +style.opacity > 0;
  };
  const scrolls = (element) => {
    for (let e = element.parentElement; e && e !== section; e = e.parentElement)
      if (/auto|scroll/.test(getComputedStyle(e).overflowX)) return true;
    return false;
  };
  const found = [];
  for (const element of [document.documentElement, section])
    if (element.scrollWidth > innerWidth) found.push(`too wide: ${element.tagName}`);
  for (const button of document.querySelectorAll('.rail button'))
    if (button.scrollWidth > button.clientWidth) found.push(`cut: ${button.textContent}`);
  const text = (e) => (e.ariaLabel || e.textContent || '').trim().slice(0, 30);
  const name = (e) => `${e.tagName}.${e.className} ${text(e)}`;
  const around = document.querySelectorAll('.head button, .head input, .rail button');
  const all = [...section.querySelectorAll(controls), ...around].filter(seen);
  for (const element of all) {
    const box = element.getBoundingClientRect();
    const is_cut = box.right > innerWidth + 1 || box.left < -1;
    if (is_cut && !scrolls(element)) found.push(`cut: ${name(element)}`);
  }
  const boxes = all.filter((e) => e.matches('button, select, a') && !scrolls(e));
  for (const a of boxes)
    for (const b of boxes) {
      if (a.contains(b) || b.contains(a) || a.compareDocumentPosition(b) & 2) continue;
      const [p, q] = [a.getBoundingClientRect(), b.getBoundingClientRect()];
      const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
      const high = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
      const inside = section.contains(a) === section.contains(b);
      if (inside && wide > 2 && high > 2) found.push(`overlap: ${name(a)} and ${name(b)}`);
    }
  return found;
}
"""


SCHEMES: Final[tuple[Literal["light", "dark"], ...]] = ("light", "dark")
NEXT_FRAME: Final = "() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))"


def show_filled(page: Page, view: str) -> None:
    """Show a view, and wait until it is filled and drawn."""
    section = show(page, view)
    if view == "tuning":
        # The rows are alike, and drawing and checking all of them takes seconds.
        page.get_by_label("Search", exact=True).fill("gyroscope")
        expect(page.locator(".parameter").nth(20)).to_have_count(0)
    section.locator(VIEWS[view]).first.wait_for()
    page.evaluate(NEXT_FRAME)


def views_in_both_themes(page: Page) -> Iterator[tuple[str, str]]:
    """Show every view, filled and drawn, first light and then dark."""
    for scheme in SCHEMES:
        page.emulate_media(color_scheme=scheme)
        page.wait_for_function(f"document.body.classList.contains('body--{scheme}')")
        for view in VIEWS:
            show_filled(page, view)
            yield view, scheme


@pytest.mark.parametrize("width", WIDTHS)
def test_no_control_is_cut_or_overlapped_and_no_error_is_logged(page: Page, width: int) -> None:
    troubles: list[str] = []

    def note(message: Any) -> None:
        if message.type == "error":
            troubles.append(message.text)

    page.on("console", note)
    page.set_viewport_size({"width": width, "height": WIDTHS[width]})
    faults: dict[tuple[str, str], list[str]] = {}
    for view, scheme in views_in_both_themes(page):
        if found := page.evaluate(FAULTS, view):
            faults[view, scheme] = found
    page.remove_listener("console", note)
    assert faults == {}
    assert troubles == []


def test_view_is_switched_without_the_server_within_its_limit(page: Page) -> None:
    for view in VIEWS:
        show_filled(page, view)
    times_ms = [
        page.evaluate(
            """(view) => new Promise((resolve) => {
                const section = document.querySelector(`section[data-view='${view}']`);
                const begin = performance.now();
                const look = () => section.hidden || resolve(performance.now() - begin);
                new MutationObserver(look).observe(section, { attributes: true });
                document.querySelector(`.rail button[data-view='${view}']`).click();
                look();
            })""",
            view,
        )
        for view in VIEWS
    ]
    assert min(times_ms) < SWITCH_MS
    assert sorted(times_ms)[len(times_ms) // 2] < SWITCH_MS


def test_axe_finds_no_serious_fault_in_either_theme(page: Page) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core").Axe()
    page.set_viewport_size({"width": 1024, "height": 768})
    faults: dict[tuple[str, str], list[str]] = {}
    for view, scheme in views_in_both_themes(page):
        context = None if view == "flight" else f"section[data-view='{view}']"
        options: dict[str, Any] = {"resultTypes": ["violations"]}
        if scheme == "dark":
            # Nothing but the colours differs.
            options["runOnly"] = ["color-contrast"]
        for fault in axe.run(page, context, options).response["violations"]:
            if fault["impact"] in ("serious", "critical"):
                nodes = [node["html"][:160] for node in fault["nodes"][:4]]
                faults.setdefault((view, scheme), []).append(f"{fault['id']}: {nodes}")
    assert faults == {}
