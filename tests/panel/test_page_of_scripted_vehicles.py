"""A panel of two vehicles by UDP: one of exact figures, one whose names and texts are scripts."""

import contextlib
import math
import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, Page, expect
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import to_euler
from gateway.vehicle_state.antenna import AntennaStation, pointing_of
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position
from tests.panel.browsing import (
    CONFIG_WITHOUT_MAP,
    WAIT_MS,
    Process,
    choose,
    needs_chromium,
    open_page,
    show,
)
from tests.panel.messages import short_tlog
from tests.panel.scripted_vehicle import HOME_DEG, HOSTILE_MARKUP, HOSTILE_NAMES, ScriptedVehicle

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]
expect.set_options(timeout=WAIT_MS)

VIEWS = (
    "flight", "map", "link", "recordings", "calibration", "tuning", "plots", "events",
)  # fmt: skip
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
def vehicle() -> Iterator[ScriptedVehicle]:
    started = ScriptedVehicle()
    started.start()
    yield started
    started.end()


@pytest.fixture(scope="module")
def troubles() -> list[str]:
    """Errors of the page, and messages of dialogs that a foreign script opens."""
    return []


@pytest.fixture(scope="module")
def page(
    browser: Browser,
    vehicle: ScriptedVehicle,
    troubles: list[str],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Page]:
    folder = tmp_path_factory.mktemp("scripted")
    (folder / "recordings").mkdir()
    for name in HOSTILE_NAMES:
        with contextlib.suppress(OSError):
            (folder / "recordings" / f"{name.replace('/', '')}_01.tlog").write_bytes(short_tlog())
    connect = f"udp-listen:127.0.0.1:{vehicle.port}"
    panel = Process(folder, "panel", "--connect", connect, config=CONFIG_WITHOUT_MAP)
    opened = open_page(browser, panel.link(), script=LISTEN)
    opened.on("console", lambda message: message.type == "error" and troubles.append(message.text))
    opened.on("pageerror", lambda error: troubles.append(str(error)))
    opened.on("dialog", lambda dialog: troubles.append(dialog.message))
    yield opened
    opened.close()
    panel.end()


def until_drawn(page: Page, *texts: str) -> None:
    """Wait until the flight display has drawn all of these since the last such wait.

    `window.seen` is then all that it has drawn in that time.
    """
    page.wait_for_function(
        "(texts) => texts.every((text) => window.drawn.includes(text))", arg=list(texts)
    )
    page.evaluate("window.seen = window.drawn.splice(0)")


def display_of(page: Page) -> Locator:
    return page.locator(".flight-display")


def test_horizon_follows_roll_and_pitch(page: Page, vehicle: ScriptedVehicle) -> None:
    points = [(0.25, 0.5), (0.72, 0.5), (0.25, 0.62)]
    for roll, pitch, expected in (
        (30, 0, ("sky", "ground", "sky")),
        (-30, 0, ("ground", "sky", "ground")),
        (0, 15, ("sky", "sky", "sky")),
        (0, -15, ("ground", "ground", "ground")),
    ):
        vehicle.roll_deg, vehicle.pitch_deg = roll, pitch
        spoken = re.compile(f"^Roll {roll}.0°, pitch {pitch}.0°,")
        expect(display_of(page)).to_have_attribute("aria-label", spoken)
        page.wait_for_function(LOOKS, arg=[points, expected])
    vehicle.roll_deg = vehicle.pitch_deg = 0.0


def test_compass_follows_the_heading(page: Page, vehicle: ScriptedVehicle) -> None:
    vehicle.heading_deg = 272.0
    until_drawn(page, "272°", "W", "300")
    expect(display_of(page)).to_have_attribute("aria-label", re.compile(r"heading 272.0°"))
    vehicle.heading_deg = 3.0
    until_drawn(page, "003°", "N", "030")
    until_drawn(page, "003°", "N", "030")
    assert "W" not in page.evaluate("window.seen")


def test_altitude_and_climb_are_drawn(page: Page, vehicle: ScriptedVehicle) -> None:
    vehicle.alt_home_m, vehicle.climb_mps = 123.0, -2.5
    until_drawn(page, "HOME  m", "123", "AMSL 554", "-2.5")
    expect(display_of(page)).to_have_attribute(
        "aria-label", re.compile(r"altitude 123.0 m, climb -2.5 m/s$")
    )


def test_direction_from_home_is_that_of_an_antenna(page: Page, vehicle: ScriptedVehicle) -> None:
    vehicle.alt_home_m = 317.0
    strip = page.locator(".number-strip")
    expect(strip.locator("[data-item='Above home'] b")).to_have_text("317.0")
    here = NewestState()
    here.position = Position(47.0, 8.0, vehicle.home_alt_m + vehicle.alt_home_m)
    here.position_us = 0
    home = AntennaStation(Position(*HOME_DEG, vehicle.home_alt_m))
    found = pointing_of(home, here, {}, 0)
    assert found is not None
    text = strip.locator("[data-item='From home']").inner_text()
    azimuth, elevation = map(float, re.findall(r"(-?[\d.]+)°", text))
    assert azimuth == pytest.approx(found.azimuth_deg, abs=0.6)
    assert elevation == pytest.approx(found.elevation_deg, abs=0.06)


def test_airspeed_is_drawn_unless_it_is_the_ground_speed(
    page: Page, vehicle: ScriptedVehicle
) -> None:
    vehicle.groundspeed_mps = 19.3
    for airspeed_mps, drawn in (
        (21.5, ("AS  m/s", "21.5", "GS 19.3")),
        (0.0, ("GS  m/s", "19.3")),
        (18.2, ("AS  m/s", "18.2", "GS 19.3")),
        (19.3, ("GS  m/s", "19.3")),
    ):
        vehicle.airspeed_mps = airspeed_mps
        until_drawn(page, *drawn)
        spoken = re.compile(f"speed {drawn[1]} m/s")
        expect(display_of(page)).to_have_attribute("aria-label", spoken)


def test_angles_are_spoken_and_sent_exactly(page: Page, vehicle: ScriptedVehicle) -> None:
    vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg = -17.5, 8.3, 123.4
    spoken = re.compile(r"^Roll -17.5°, pitch 8.3°, heading 123.4°,")
    expect(display_of(page)).to_have_attribute("aria-label", spoken)
    drawn = to_euler(tuple(page.evaluate("mavgate.state.q_nb")))
    assert [math.degrees(angle) for angle in drawn] == pytest.approx([-17.5, 8.3, 123.4], abs=0.01)


def test_model_in_3d_is_that_of_the_vehicle_type(page: Page, vehicle: ScriptedVehicle) -> None:
    scene = page.locator(".scene")
    expect(scene).to_have_attribute("data-model", "plane")
    vehicle.kind = mavlink.MAV_TYPE_QUADROTOR
    expect(scene).to_have_attribute("data-model", "copter")
    expect(page.get_by_label("Aircraft", exact=True)).to_have_value("Copter 1")
    expect(page.locator(".chips").get_by_text("MAVLink")).to_be_visible()


def test_hostile_names_and_texts_do_not_run_as_scripts(page: Page, troubles: list[str]) -> None:
    choose(page, "Aircraft", "Plane 2")
    for view in VIEWS:
        show(page, view).locator("> *").first.wait_for()
        # Two messages of each kind have come and were drawn.
        page.evaluate("window.begun_us = mavgate.now_us")
        page.wait_for_function("mavgate.now_us > window.begun_us + 4e5")
        assert page.evaluate("typeof q") == "undefined"
    show(page, "tuning")
    names = page.locator(".parameter .name")
    expect(names).to_have_count(len(HOSTILE_NAMES))
    shown = set(names.all_inner_texts())
    assert {'B :a="q=1"', "<img/onerror=q>", "{{q=1}}"} <= shown
    rows = page.locator(".parameter").evaluate_all("rows => rows.map(row => row.dataset.name)")
    assert set(rows) >= {name for name in HOSTILE_NAMES if name.isascii()}
    show(page, "events")
    page.locator(".events").get_by_text(HOSTILE_MARKUP[:24]).first.wait_for()
    show(page, "recordings")
    page.locator("tr[data-key='{{q=1}}']").wait_for()
    page.locator("tr[data-key='{{q=1}}']").get_by_label("Delete").click()
    page.get_by_role("dialog").get_by_text("{{q=1}}").first.wait_for()
    page.keyboard.press("Escape")
    assert page.evaluate("typeof q") == "undefined"
    assert troubles == []


def test_parameter_keeps_focus_and_text_as_the_list_grows(
    page: Page, vehicle: ScriptedVehicle
) -> None:
    choose(page, "Aircraft", "Plane 2")
    show(page, "tuning")
    field = page.get_by_label("{{q=1}}", exact=True)
    field.fill("7.5")
    vehicle.hostile_names = [*HOSTILE_NAMES, "LATE"]
    count = f"{len(vehicle.hostile_names)} parameters"
    expect(page.locator("section[data-view='tuning'] .tools").get_by_text(count)).to_be_visible()
    expect(field).to_be_focused()
    expect(field).to_have_value("7.5")
    late = page.locator(".parameter[data-name='LATE']")
    expect(late).to_have_count(0)
    page.get_by_label("Search", exact=True).click()
    expect(late).to_be_visible()


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
