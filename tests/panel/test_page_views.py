"""The views of a page with a gateway that the test feeds: what each does, seen on the page.

In the end a viewer looks over TLS, and the gateway dies.
"""

import csv
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from gateway.estimation.select import ESTIMATORS
from gateway.live.control_socket import request
from tests.kit.process import wait_for
from tests.panel.bench_receiver import RATE_HZ, BenchReceiver
from tests.panel.browsing import (
    CONFIG,
    DESKTOP,
    FEW_FRAMES,
    START_LIMIT_MS,
    WAIT_MS,
    Process,
    choose,
    download,
    needs_chromium,
    opened,
    show,
)
from tests.panel.web_client import OPERATOR, VIEWER

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]
expect.set_options(timeout=WAIT_MS)
RATE_OF_THE_SENSOR = "/v1/mavlink/vehicles/1/components/1/messages/HIGHRES_IMU/message/zgyro"
FIELD_OF_THE_SENSOR = RATE_OF_THE_SENSOR.replace("zgyro", "xmag")
OFFLINE = (
    '{{name = "Street", url = "http://127.0.0.1:9/{{z}}/{{x}}/{{y}}", attribution = "Someone"}}'
)
"""A style whose tiles cannot be fetched."""
PNG = b"\x89PNG\r\n\x1a\n"
DESK = CONFIG.partition("map_styles")[0].replace(
    "highres_imu_hz = 5", f"highres_imu_hz = {RATE_HZ}"
)
LOCKED = CONFIG.replace(
    "[panel]",
    f"""[panel]
password = "{OPERATOR}"
viewer_password = "{VIEWER}"
certificate = "{{folder}}/panel.pem"
certificate_key = "{{folder}}/panel.key"
""",
)


@dataclass
class Desk:
    """A gateway on a receiver of the test's, and the one page that all tests look at."""

    folder: Path
    gateway: Process
    receiver: BenchReceiver
    page: Page

    def view(self, key: str) -> Locator:
        return show(self.page, key)

    @property
    def status(self) -> dict[str, Any]:
        return request(self.folder / "mavgate" / "run.sock", "status", timeout_s=WAIT_MS / 1000)

    @property
    def home_and_mark(self) -> dict[str, tuple[float, float]]:
        """Those that are set, as the gateway has them."""
        aircraft = self.status["aircraft"][0]
        known = {name: spot for name in ("home", "mark") if (spot := aircraft[name])}
        return {name: (spot["lat_deg"], spot["lon_deg"]) for name, spot in known.items()}

    def let_pass(self, duration_s: float) -> None:
        """Wait until the aircraft has flown on for so long, and the view has been refreshed."""
        begun_us = self.page.evaluate("mavgate.state.time_us")
        self.page.wait_for_function(f"mavgate.state.time_us > {begun_us} + {duration_s} * 1e6")

    @property
    def kept(self) -> str:
        """Stored settings of all aircraft."""
        return "".join(p.read_text() for p in sorted((self.folder / "aircraft").glob("*.toml")))


def start_gateway(folder: Path, receiver: BenchReceiver, panel_settings: str = "") -> Process:
    config = DESK + panel_settings
    return Process(folder, "run", "--plain", "--port", receiver.port, config=config)


@pytest.fixture(scope="module")
def desk(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    folder, receiver = tmp_path_factory.mktemp("desk"), BenchReceiver()
    receiver.start()
    gateway = start_gateway(folder, receiver, f"enabled = true\nmap_styles = [{OFFLINE}]\n")
    with opened(browser, gateway.link()) as page:
        made = Desk(folder, gateway, receiver, page)
        yield made
    made.gateway.end()
    receiver.end()


def test_receiver_on_a_serial_port_is_shown_as_serial(desk: Desk) -> None:
    expect(desk.page.locator(".chips").get_by_text("serial", exact=True)).to_be_visible()
    expect(desk.page.locator(".chips").get_by_text("GPS 11 sats")).to_be_visible()


def test_gyroscope_calibration_is_stored_only_after_confirmation(desk: Desk) -> None:
    view = desk.view("calibration")
    expect(view.locator("[aria-current=step]")).to_contain_text("Mounting")
    view.locator(".step", has_text="Gyroscope").click()
    expect(view.locator(".now")).to_contain_text("do not touch it until this is done")
    view.get_by_role("button", name="Start").click()
    expect(view.locator(".now")).to_contain_text("Store it?")
    rate = view.locator(".residuals tr", has_text="Rate at rest")
    before, after = (float(cell) for cell in rate.locator("td").all_inner_texts()[1:])
    assert before == pytest.approx(1.26, abs=0.1)
    assert after < 0.05
    expect(view.locator(".residuals")).to_contain_text("CAL_GYRO_BIAS_X")
    assert desk.kept == ""
    view.get_by_role("button", name="Store it").click()
    expect(view.locator(".step", has_text="Gyroscope")).to_contain_text("stored")
    assert "gyro_bias" in desk.kept


def test_selected_orientation_of_the_board_is_stored(desk: Desk) -> None:
    view = desk.view("calibration")
    step = view.locator(".step", has_text="Mounting")
    step.click()
    pictures = view.locator(".pose.pick")
    desk.page.wait_for_function("document.querySelector('.pose-picture')?.naturalWidth > 0")
    expect(pictures).to_have_count(8)
    expect(pictures.first).to_contain_text("roll 180°, pitch 0°, yaw 0°")
    # Once the parameters are loaded.
    expect(view.get_by_role("button", name="Use it")).to_be_enabled()
    choice = view.get_by_label("Orientation of the board")
    expect(choice).to_have_value("face up, arrow to the nose")
    for way in ("tail", "nose"):
        pictures.filter(has_text=f"face up, arrow to the {way}").click()
        view.get_by_role("button", name="Use it").click()
        # The heading is the way of the nose: the magnetometer's own x axis is turned with it.
        desk.page.wait_for_function(
            "async ([url, sign]) => Math.sign(Number(await (await fetch(url)).text())) === sign",
            arg=[FIELD_OF_THE_SENSOR, -1 if way == "tail" else 1],
            polling=200,
        )
        expect(choice).to_have_value(f"face up, arrow to the {way}")
        expect(step).to_contain_text("in use")
        before = desk.kept
        view.get_by_role("button", name="Store it").click()
        expect(step).to_contain_text("stored")
        assert desk.kept != before
    view.locator(".step", has_text="Gyroscope").click()


def test_magnetometer_calibration_is_drawn_and_undone(desk: Desk) -> None:
    view, kept = desk.view("calibration"), desk.kept
    step = view.locator(".step", has_text="Magnetometer")
    step.click()
    expect(view.locator(".guide h2")).to_have_text("Magnetometer")
    expect(step).to_be_focused()
    desk.receiver.is_turned = True
    view.get_by_role("button", name="Start").click()
    sphere = view.locator("canvas.field-sphere")
    expect(sphere).to_have_attribute("aria-label", re.compile(r"\d{2,} samples"))
    expect(view.locator(".figures")).to_contain_text("directions uncovered")
    # One that turns about a single axis sees no more than a ring of these.
    desk.page.wait_for_function("document.querySelector('canvas.field-sphere').dataset.seen > 22")
    sphere.evaluate("(element) => { window.turned = element; }")
    view.get_by_role("button", name="Cancel").click()
    expect(view.locator(".now")).to_contain_text("Nothing has changed")
    # The same element, which the user may have turned or focused.
    assert sphere.evaluate("(element) => element === window.turned")
    desk.receiver.is_turned = False
    assert desk.kept == kept


def test_parameter_is_searched_changed_and_compared_with_its_default(desk: Desk) -> None:
    view = desk.view("tuning")
    view.get_by_label("Search", exact=True).fill("gyroscope bias sensor")
    rows = view.locator(".parameter")
    # Words are searched for in the descriptions, which come after the parameters.
    expect(rows).to_have_count(3, timeout=START_LIMIT_MS)
    row = view.locator(".parameter[data-name='CAL_GYRO_BIAS_Z']")
    expect(row).to_contain_text("-572.96 to 572.96 °/s · default 0")
    field = row.get_by_label("CAL_GYRO_BIAS_Z")
    field.fill("46")
    desk.let_pass(0.6)
    field.press("Enter")
    # What is typed stays when the view is refreshed, and when the first change is answered.
    field.fill("0")
    # Not the attitude's rate: a second later the estimator has found the bias that was set.
    desk.page.wait_for_function(
        "async (url) => Math.abs(Number(await (await fetch(url)).text())) > 0.3",
        arg=RATE_OF_THE_SENSOR,
        polling=200,
    )
    expect(row).to_have_class(re.compile(r"\bchanged\b"))
    desk.let_pass(0.6)
    field.press("Enter")
    expect(row).not_to_have_class(re.compile(r"\bchanged\b"))
    field.fill("4000")
    field.press("Enter")
    expect(row.get_by_role("alert")).to_be_visible()


def test_estimators_are_compared_on_the_last_minutes(desk: Desk) -> None:
    view = desk.view("tuning")
    card = view.locator("[data-card=comparison]")
    rows = card.locator(".residuals tr")

    # Allowed once enough was collected since the view was opened.
    card.get_by_role("button", name="Compare").click()
    expect(rows.locator("td:first-child")).to_have_text(list(ESTIMATORS), timeout=START_LIMIT_MS)
    figures = rows.locator("td:nth-child(2)").all_inner_texts()
    assert all(re.fullmatch(r"\d+\.\d+ °", figure) for figure in figures)


def test_field_is_plotted_paused_and_exported(desk: Desk, tmp_path: Path) -> None:
    view = desk.view("plots")
    card = view.locator(".strip-card").first
    chart = card.locator(".strip-chart")
    expect(chart).to_have_attribute("aria-label", re.compile(r"ATTITUDE.roll -?\d"))
    desk.page.wait_for_function("document.querySelector('.strip-chart').dataset.points > 20")
    view.get_by_role("button", name="Pause").click()
    expect(chart).to_have_attribute("data-paused", "true")
    points = chart.get_attribute("data-points")
    table, picture = (
        download(desk.page, card.get_by_label(f"Save as {kind}"), tmp_path)
        for kind in ("CSV", "PNG")
    )
    head, *rows = csv.reader(table.read_text().splitlines())
    assert any("ATTITUDE.roll" in name for name in head)
    assert len(rows) > 10
    assert picture.read_bytes().startswith(PNG)
    assert chart.get_attribute("data-points") == points
    view.get_by_role("button", name="Resume").click()
    expect(chart).to_have_attribute("data-paused", "false")


def test_home_is_set_by_click_after_confirmation(desk: Desk) -> None:
    view = desk.view("map")
    expect(view.locator(".pin.home")).to_be_visible()
    before = desk.home_and_mark["home"]
    view.locator(".map-canvas").click(position={"x": 300, "y": 250})
    place = view.locator(".map-ask .title").inner_text()
    view.locator(".map-ask").get_by_role("button", name="Set home here …").click()
    asks = desk.page.locator(".asks")
    expect(asks).to_contain_text(f"to {place}?")
    assert desk.home_and_mark["home"] == before
    # As over a link that answers only after the question has left the page.
    desk.gateway.process.send_signal(signal.SIGSTOP)
    asks.get_by_role("button", name="Set home").click()
    expect(asks).to_have_count(0)
    desk.gateway.process.send_signal(signal.SIGCONT)
    # A busy machine may have taken longer to close the question than the page waits for answers.
    answer = desk.page.get_by_text(re.compile("^Home set$|does not answer$"))
    expect(answer).to_be_visible()
    lat_deg, lon_deg = (float(part) for part in place.split(","))
    desk.page.wait_for_function(f"Math.abs(mavgate.state.home.lat_deg - {lat_deg}) < 1e-6")
    assert desk.home_and_mark["home"] == pytest.approx((lat_deg, lon_deg), abs=1e-6)


def test_map_without_tiles_reports_it_and_shows_coasts_and_towns(desk: Desk) -> None:
    view = desk.view("map")
    names = view.locator("canvas.map-towns")
    owners = view.locator(".leaflet-control-attribution")
    expect(view.get_by_text("no map tiles (offline)")).to_be_visible()
    view.locator(".map").evaluate("(map) => { map.mavgate_map.setZoom(5, { animate: false }); }")
    # At 47 degrees north and 8 east.
    expect(names).to_have_attribute("data-names", re.compile(r"^\d{2}$"))
    expect(owners).to_contain_text("Made with Natural Earth")
    expect(owners).not_to_contain_text("Someone")
    view.get_by_label("Map style").select_option(label="Grid")
    expect(names).to_have_count(0)
    expect(owners).not_to_contain_text("Natural Earth")
    expect(view.get_by_text("no map tiles (offline)")).to_have_count(0)
    view.get_by_label("Map style").select_option(label="Street")
    expect(names).to_have_count(1)


def test_client_is_added_and_removed(desk: Desk) -> None:
    view = desk.view("link")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(WAIT_MS / 1000)
        name = f"udp:127.0.0.1:{sock.getsockname()[1]}"
        view.get_by_label("Endpoint of a new client").fill(name)
        view.get_by_role("button", name="Add", exact=True).click()
        row = view.locator(f"tr[data-key='{name}']")
        expect(row).to_contain_text("open")
        assert sock.recv(2048)
        row.get_by_label("Remove this client").click()
        assert name in [client["name"] for client in desk.status["clients"]]
        desk.page.locator(".asks").get_by_role("button", name="Remove").click()
        wait_for(lambda: name not in [client["name"] for client in desk.status["clients"]])
        expect(row).to_have_count(0)


def test_serial_port_is_disconnected_and_connected_again(desk: Desk) -> None:
    view = desk.view("link")
    banner = desk.page.locator(".banner", has_text="Receiver lost")
    state = view.locator("[data-role=serial]")
    expect(state).to_contain_text(f"{desk.receiver.port} is open")
    view.get_by_role("button", name="Disconnect").click()
    expect(state).to_contain_text("disconnected")
    expect(banner).to_be_visible()
    assert not desk.status["report"]["connected"]
    choose(desk.page, "Serial port", desk.receiver.port)
    view.get_by_role("button", name="Connect", exact=True).click()
    expect(state).to_contain_text(f"{desk.receiver.port} is open")
    expect(banner).to_have_count(0)
    assert desk.status["report"]["connected"]


def test_node_timeout_is_a_banner_over_every_view_and_an_event(desk: Desk) -> None:
    banner = desk.page.locator(".banner", has_text="GPS node 1 silent")
    expect(banner).to_have_count(0)
    desk.receiver.has_gps = False
    expect(banner).to_be_visible()
    view = desk.view("events")
    row = view.locator("tr", has_text="GPS node 1 silent").first
    expect(row).to_contain_text("Critical")
    expect(row.locator("td").first).to_have_text(re.compile(r"\d\d:\d\d:\d\d"))
    desk.receiver.has_gps = True
    expect(view.locator("tr", has_text="GPS node 1 is back").first).to_be_visible()
    expect(banner).to_have_count(0)


def test_number_keys_select_a_view_with_a_button_focused(desk: Desk) -> None:
    view = desk.view("events")
    desk.page.locator(".rail button[data-view='link']").focus()
    desk.page.keyboard.press("Enter")
    expect(view).to_be_hidden()
    desk.page.keyboard.press("8")
    expect(view).to_be_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_of_buttons_has_enough_contrast(desk: Desk, scheme: Literal["light", "dark"]) -> None:
    desk.page.emulate_media(color_scheme=scheme)
    expect(desk.page.locator("body")).to_have_class(re.compile(f"body--{scheme}"))
    filled = desk.view("plots").locator(".q-btn.bg-primary, .q-btn[aria-pressed=true]")
    expect(filled).to_have_count(2)
    for colours in filled.evaluate_all(
        "(all) => all.map((button) => [getComputedStyle(button).color,"
        " getComputedStyle(button).backgroundColor])"
    ):
        text, ground = sorted(map(luminance, colours))
        assert (ground + 0.05) / (text + 0.05) >= 4.5, colours


def luminance(colour: str) -> float:
    """Return the relative luminance of `rgb(r, g, b)`, as WCAG 2.2 defines it."""
    parts = [int(part) / 255 for part in re.findall(r"\d+", colour)]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_selected_units_are_shown(desk: Desk) -> None:
    page, view = desk.page, desk.view("map")
    choose(page, "Units", "aviation")
    page.wait_for_function("mavgate.show('speed', 100)[1] === 'kt'")
    expect(view.locator(".key.circle")).to_contain_text("ft")


@pytest.fixture(scope="module")
def viewers_page(browser: Browser, desk: Desk) -> Iterator[Page]:
    """The page of a viewer, over TLS, of a panel that is a process of its own."""
    desk.page.close()
    write_certificate(desk.folder / "panel.pem", desk.folder / "panel.key")
    panel = Process(desk.folder, "panel", config=LOCKED)
    opened = browser.new_page(viewport=DESKTOP, ignore_https_errors=True)
    opened.set_default_timeout(WAIT_MS)
    opened.add_init_script(FEW_FRAMES)
    opened.goto(panel.link())
    yield opened
    opened.close()
    panel.end()


def write_certificate(certificate: Path, key: Path) -> None:
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    command += ["-nodes", "-days", "1", "-subj", "/CN=127.0.0.1"]
    subprocess.run([*command, "-out", certificate, "-keyout", key], check=True, capture_output=True)


def test_viewer_over_tls_cannot_change_anything(desk: Desk, viewers_page: Page) -> None:
    page, before = viewers_page, desk.home_and_mark
    assert page.url.startswith("https://")
    for password, seen in (
        ("wrong", page.get_by_role("alert").get_by_text("not the password")),
        ("guest", page.locator(".head").get_by_text("viewer")),
    ):
        page.get_by_label("Password").fill(password)
        page.get_by_text("Open the panel").click()
        expect(seen).to_be_visible()
    page.wait_for_function("mavgate.state && mavgate.state.lat_deg !== null")
    expect(show(page, "recordings").locator("[data-role='recorder']")).to_have_text("idle")
    expect(page.get_by_label("Start recording")).to_have_count(0)
    view = show(page, "map")
    expect(page.get_by_label("Upload a PMTiles file")).to_have_count(0)
    view.locator(".map-canvas").click(position={"x": 300, "y": 300})
    expect(page.get_by_text("Mark this position")).to_have_count(0)
    expect(show(page, "link").locator("[data-role='receiver']")).to_be_visible()
    expect(page.get_by_label("Serial port")).to_have_count(0)
    # A request that a page hides can be sent all the same.
    for path in ("/recordings/forged", "/maps/forged"):
        status = page.evaluate(
            "(path) => fetch(path, {method: 'PUT', body: 'x'}).then((answer) => answer.status)",
            path,
        )
        assert status == 403
    assert desk.home_and_mark == before


def test_page_reconnects_to_a_killed_and_restarted_gateway(desk: Desk, viewers_page: Page) -> None:
    page = viewers_page
    chips = page.locator(".chips")
    expect(chips.get_by_text("link", exact=True)).to_be_visible()
    desk.gateway.end(signal.SIGKILL)
    expect(chips.get_by_text(re.compile(r"silent for \d+ s"))).to_be_visible()
    desk.gateway = start_gateway(desk.folder, desk.receiver)
    expect(chips.get_by_text("link", exact=True)).to_be_visible(timeout=START_LIMIT_MS)
    before = page.evaluate("mavgate.state.time_us")
    page.wait_for_function(f"mavgate.state.time_us > {before}")
