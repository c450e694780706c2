"""The page through what happens to it: other widths, roles, aircraft, a gateway that dies."""

import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from gateway.live.control_socket import request
from gateway.panel.access import hash_password
from tests.panel.browsing import (
    CONFIG,
    DESKTOP,
    START_LIMIT_MS,
    WAIT_MS,
    Process,
    needs_chromium,
    show,
)

pytestmark = [
    pytest.mark.io,
    pytest.mark.slow,
    needs_chromium,
]
expect.set_options(timeout=WAIT_MS)

LOCKED = CONFIG.replace(
    "[panel]",
    f"""[panel]
password = "{hash_password("tower")}"
viewer_password = "{hash_password("look")}"
certificate = "{{folder}}/panel.pem"
certificate_key = "{{folder}}/panel.key"
""",
)


def write_certificate(certificate: Path, key: Path) -> None:
    """Make a certificate that vouches for itself."""
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    command += ["-nodes", "-days", "1", "-subj", "/CN=127.0.0.1"]
    subprocess.run(
        [*command, "-out", str(certificate), "-keyout", str(key)], check=True, capture_output=True
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("life")
    write_certificate(made / "panel.pem", made / "panel.key")
    return made


@pytest.fixture(scope="module")
def gateways(folder: Path) -> Iterator[list[Process]]:
    """A gateway, and those that a test starts after it."""
    started = [Process(folder, "demo", "--plain", "--no-panel")]
    yield started
    for process in started:
        process.end()


@pytest.fixture(scope="module")
def page(browser: Browser, folder: Path, gateways: list[Process]) -> Iterator[Page]:
    """The page of a viewer, over TLS, of a panel that is a process of its own."""
    gateways[0].until("receiver on")
    panel = Process(folder, "panel", config=LOCKED)
    opened = browser.new_page(viewport=DESKTOP, ignore_https_errors=True)  # type: ignore[arg-type]
    opened.set_default_timeout(WAIT_MS)
    opened.goto(panel.link())
    yield opened
    opened.close()
    panel.end()


def test_viewer_looks_over_tls_and_does_not_touch(page: Page, folder: Path) -> None:
    assert page.url.startswith("https://")
    page.get_by_label("Password").fill("wrong")
    page.get_by_text("Open the panel").click()
    expect(page.get_by_role("alert")).to_contain_text("not the password")
    page.get_by_label("Password").fill("look")
    page.get_by_text("Open the panel").click()
    expect(page.locator(".head").get_by_text("viewer")).to_be_visible()
    page.wait_for_function("mavgate.state && mavgate.state.lat_deg !== null")
    show(page, "recordings")
    recorder = page.locator("section[data-view='recordings'] [data-role='recorder']")
    expect(recorder).to_have_text("idle")
    expect(page.get_by_label("Start recording")).to_have_count(0)
    show(page, "map")
    expect(page.get_by_label("Upload a PMTiles file")).to_have_count(0)
    page.locator("section[data-view='map'] .map-canvas").click(position={"x": 300, "y": 300})
    expect(page.get_by_text("Mark this place")).to_have_count(0)
    show(page, "link")
    expect(page.locator("section[data-view='link'] [data-role='receiver']")).to_be_visible()
    expect(page.get_by_label("Serial port")).to_have_count(0)
    # A request that a page hides can be sent all the same.
    for path in ("/recordings/forged", "/maps/forged"):
        status = page.evaluate(
            "(path) => fetch(path, {method: 'PUT', body: 'x'}).then((answer) => answer.status)",
            path,
        )
        assert status == 403
    socket = folder / "mavgate" / "run.sock"
    aircraft = request(socket, "status", timeout_s=WAIT_MS / 1000)["aircraft"]
    assert [one["mark"] for one in aircraft] == [None, None]


def test_page_finds_a_gateway_that_was_killed_and_started_again(
    page: Page, folder: Path, gateways: list[Process]
) -> None:
    chips = page.locator(".chips")
    expect(chips.get_by_text("link", exact=True)).to_be_visible()
    gateways[0].end(signal.SIGKILL)
    expect(chips.get_by_text(re.compile(r"silent for \d+ s"))).to_be_visible()
    gateways.append(Process(folder, "demo", "--plain", "--no-panel"))
    expect(chips.get_by_text("link", exact=True)).to_be_visible(timeout=START_LIMIT_MS)
    before = page.evaluate("mavgate.state.time_us")
    page.wait_for_function(f"mavgate.state.time_us > {before}")
