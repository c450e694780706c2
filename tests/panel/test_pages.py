"""The page in a browser: every view with hostile texts, at each width, and a recording played."""

import re
from collections.abc import Iterator
from typing import Any, Final

import pytest
from playwright.sync_api import Browser, Page, expect

from gateway.vehicle_state.antenna import AntennaStation, pointing_of
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position
from tests.kit.process import Process
from tests.kit.recordings import write_tlog
from tests.panel.browsing import (
    START_LIMIT_MS,
    WAIT_MS,
    box_of,
    choose,
    launched,
    needs_chromium,
    open_page,
    show,
)
from tests.panel.messages import flight_records, short_tlog
from tests.panel.scripted_vehicle import HOME_DEG, HOSTILE_MARKUP, HOSTILE_NAMES, ScriptedVehicle

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]
expect.set_options(timeout=WAIT_MS)

CONFIG: Final = """
aircraft_folder = "{folder}/aircraft"
[hub]
endpoints = ["udp-listen:127.0.0.1:{port}"]
[recording]
folder = "{folder}/recordings"
mode = "manual"
[simulator]
gps_first_fix_s = 0.5
imu_rate_hz = 25
baro_rate_hz = 5
[panel]
port = 0
tiles_folder = "{folder}/tiles"
map_styles = []
"""
VIEWS: Final = {
    "flight": ".number-strip b", "map": ".craft", "link": "tr[data-key] >> nth=2",
    "recordings": "tr[data-key=mine]", "calibration": ".guide h2", "tuning": ".parameter >> nth=3",
    "plots": ".strip-chart", "events": ".table-frame",
}  # fmt: skip
"""Each view, and an element of it that is there once it is filled."""
WIDTHS: Final = {390: 844, 1024: 768, 1920: 1080}
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
LISTEN = """
window.drawn = [];
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
  if (this.canvas.closest(".flight-display")) {
    window.drawn.push(String(text));
    window.drawn.splice(0, window.drawn.length - 200);
  }
  return write.call(this, text, ...rest);
};
"""
"""Notes the words and figures that the flight display draws, the newest last."""
LOOKS = """
([points, expected]) => {
  const canvas = document.querySelector(".flight-display canvas");
  const pen = canvas.getContext("2d");
  const colours = points.map(([right, down]) => {
    const [red, , blue] = pen.getImageData(right * canvas.width, down * canvas.height, 1, 1).data;
    return blue > red ? "sky" : "ground";
  });
  return String(colours) === String(expected);
}
"""
"""Whether sky or ground is drawn as expected, at points that are shares of the flight display."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    yield from launched()


@pytest.fixture(scope="module")
def vehicle() -> Iterator[ScriptedVehicle]:
    started = ScriptedVehicle()
    started.start()
    yield started
    started.end()


@pytest.fixture(scope="module")
def demo(vehicle: ScriptedVehicle, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    """A gateway with a simulated aircraft 1, and recordings one of which has a flight."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "recordings").mkdir()
    for name in {name.replace("/", "")[:40] for name in HOSTILE_NAMES if name.isascii()}:
        (folder / "recordings" / f"{name}_01.tlog").write_bytes(short_tlog())
    write_tlog(folder / "recordings" / "mine_01.tlog", flight_records(60))
    config = CONFIG.format(folder=folder, port=vehicle.port)
    with Process(folder, "demo", "--plain", config=config) as started:
        yield started


@pytest.fixture(scope="module")
def troubles() -> list[str]:
    """Errors of the page, and messages of dialogs that a foreign script opens."""
    return []


@pytest.fixture(scope="module")
def page(browser: Browser, demo: Process, troubles: list[str]) -> Iterator[Page]:
    opened = open_page(browser, demo.link(), script=LISTEN)
    opened.on("console", lambda message: message.type == "error" and troubles.append(message.text))
    opened.on("pageerror", lambda error: troubles.append(str(error)))
    opened.on("dialog", lambda dialog: troubles.append(dialog.message))
    yield opened
    opened.close()


def until_drawn(page: Page, *texts: str) -> None:
    """Wait until the flight display has drawn all of these since the last such wait."""
    page.wait_for_function(
        "(texts) => texts.every((text) => window.drawn.includes(text))", arg=list(texts)
    )
    page.evaluate("window.drawn.splice(0)")


def test_flight_display_shows_the_figures_of_the_vehicle(
    page: Page, vehicle: ScriptedVehicle
) -> None:
    choose(page, "Aircraft", "Plane 2")
    display = page.locator(".flight-display")
    points = [(0.25, 0.5), (0.72, 0.5), (0.25, 0.62)]
    for roll, pitch, expected in (
        (30.0, 0.0, ("sky", "ground", "sky")),
        (-30.0, 0.0, ("ground", "sky", "ground")),
        (0.0, 15.0, ("sky", "sky", "sky")),
        (-0.0, -15.0, ("ground", "ground", "ground")),
    ):
        vehicle.roll_deg, vehicle.pitch_deg = roll, pitch
        page.wait_for_function(LOOKS, arg=[points, expected])
    vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg = -17.5, 8.3, 272.0
    vehicle.alt_home_m, vehicle.climb_mps = 317.0, -2.5
    for airspeed_mps, drawn in ((21.5, ("AS  m/s", "21.5", "GS 18.0")), (0.0, ("GS  m/s", "18.0"))):
        vehicle.airspeed_mps = airspeed_mps
        until_drawn(page, *drawn, "272°", "W", "300", "HOME  m", "317", "AMSL 748", "-2.5")
        spoken = (
            f"Roll -17.5°, pitch 8.3°, heading 272.0°, speed {drawn[1]} m/s, altitude 317.0 m, "
            "climb -2.5 m/s"
        )
        expect(display).to_have_attribute("aria-label", spoken)
    here = NewestState()
    here.position = Position(47.0, 8.0, vehicle.home_alt_m + vehicle.alt_home_m)
    here.position_us = 0
    home = AntennaStation(Position(*HOME_DEG, vehicle.home_alt_m))
    found = pointing_of(home, here, {}, 0)
    assert found is not None
    text = page.locator(".number-strip [data-item='From home']").inner_text()
    azimuth, elevation = map(float, re.findall(r"(-?[\d.]+)°", text))
    assert azimuth == pytest.approx(found.azimuth_deg, abs=0.6)
    assert elevation == pytest.approx(found.elevation_deg, abs=0.06)


def show_filled(page: Page, view: str) -> None:
    show(page, view).locator(VIEWS[view]).first.wait_for()
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))")


def test_views_with_hostile_texts_have_no_error_at_any_width(
    page: Page, troubles: list[str]
) -> None:
    choose(page, "Aircraft", "Plane 3")
    faults: dict[tuple[str, int], list[str]] = {}
    for width, height in WIDTHS.items():
        page.set_viewport_size({"width": width, "height": height})
        for view in VIEWS:
            show_filled(page, view)
            if found := page.evaluate(FAULTS, view):
                faults[view, width] = found
    assert faults == {}
    shown = {*show(page, "tuning").locator(".parameter .name").all_inner_texts()}
    assert {'B :a="q=1"', "<img/onerror=q>", "{{q=1}}"} <= shown
    show(page, "events").get_by_text(HOSTILE_MARKUP[:24]).first.wait_for()
    row = show(page, "recordings").locator("tr[data-key='{{q=1}}']")
    row.get_by_label("Delete").click()
    page.get_by_role("dialog").get_by_text("{{q=1}}").first.wait_for()
    page.keyboard.press("Escape")
    assert page.evaluate("typeof q") == "undefined"
    assert troubles == []


def test_axe_finds_no_serious_fault_in_either_theme(page: Page) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core").Axe()
    page.set_viewport_size({"width": 1024, "height": 768})
    choose(page, "Aircraft", "Plane 1")
    faults: dict[tuple[str, str], list[str]] = {}
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        page.wait_for_function(f"document.body.classList.contains('body--{scheme}')")
        for view in VIEWS:
            show_filled(page, view)
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


def test_recording_is_played_on_its_page_only(browser: Browser, page: Page, demo: Process) -> None:
    show(page, "recordings").locator("tr[data-key='mine']").get_by_label("Open").click()
    slider = page.locator(".player").get_by_role("slider")
    expect(slider).to_be_visible(timeout=START_LIMIT_MS)
    page.wait_for_function("mavgate.state.origin === 'recorded' && mavgate.state.system_id > 200")
    expect(page.locator(".playback-bar")).to_contain_text(re.compile(r"PLAYBACK 0:\d\d of 0:59"))
    other = open_page(browser, demo.link())
    other.wait_for_function("Object.keys(mavgate.vehicles).length === 3")
    assert set(other.evaluate("Object.values(mavgate.vehicles).map((v) => v.origin)")) == {"live"}
    other.close()
    toggle = page.get_by_label("Play or pause")
    toggle.click()
    expect(toggle).to_have_text("play_arrow")
    slider.click(position={"x": box_of(slider)["width"] * 0.5, "y": 20})
    expect(slider).to_have_attribute("aria-valuenow", re.compile("^(29|30)$"))
    page.keyboard.press("Space")
    expect(toggle).to_have_text("pause")
    page.get_by_role("button", name="Back to live").click()
    expect(slider).to_be_hidden()
    page.wait_for_function("mavgate.state && mavgate.state.origin === 'live'")
    page.wait_for_function("(mavgate.histories[mavgate.selected]?.time_us.length ?? 0) > 20")
    show(page, "flight").get_by_role("slider", name="Moment of the flight").press("ArrowLeft")
    page.wait_for_function("mavgate.past_us !== null")
    page.get_by_role("button", name="Go to live").click()
    page.wait_for_function("mavgate.past_us === null")


def test_policy_of_the_page_stops_an_injected_script(page: Page) -> None:
    policy = page.request.get(page.url).headers["content-security-policy"]
    assert "'nonce-" in policy
    page.evaluate(
        """() => {
            const script = document.createElement('script');
            script.textContent = 'window.ran = 1';
            window.refused = [];
            document.addEventListener('securitypolicyviolation',
                (event) => window.refused.push(event.violatedDirective));
            document.body.append(script);
            document.body.insertAdjacentHTML('beforeend', '<img src=x onerror="window.ran = 2">');
        }"""
    )
    page.wait_for_function("window.refused.length >= 2")
    assert page.evaluate("typeof ran") == "undefined"
