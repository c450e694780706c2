"""The page through what happens to it: other widths, roles, aircraft, a gateway that dies."""

import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from gateway.live.control_socket import request
from gateway.panel.access import hash_password
from tests.panel.browsing import (
    CONFIG,
    START_LIMIT_MS,
    WAIT_MS,
    Process,
    needs_chromium,
    open_page,
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


@pytest.fixture
def processes() -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.end()


def test_page_finds_a_gateway_that_was_killed_and_started_again(
    browser: Browser, tmp_path: Path, processes: list[Process]
) -> None:
    processes.append(Process(tmp_path, "demo", "--plain", "--no-panel"))
    processes[0].until("receiver on")
    processes.append(Process(tmp_path, "panel"))
    page = open_page(browser, processes[1].link())
    chips = page.locator(".chips")
    expect(chips.get_by_text("link", exact=True)).to_be_visible()
    processes[0].end(signal.SIGKILL)
    expect(chips.get_by_text(re.compile(r"silent for \d+ s"))).to_be_visible()
    processes.append(Process(tmp_path, "demo", "--plain", "--no-panel"))
    expect(chips.get_by_text("link", exact=True)).to_be_visible(timeout=START_LIMIT_MS)
    before = page.evaluate("mavgate.state.time_us")
    page.wait_for_function(f"mavgate.state.time_us > {before}")
    page.close()


def test_viewer_looks_over_tls_and_does_not_touch(
    browser: Browser, tmp_path: Path, processes: list[Process]
) -> None:
    write_certificate(tmp_path / "panel.pem", tmp_path / "panel.key")
    processes.append(Process(tmp_path, "demo", "--plain", config=LOCKED))
    link = processes[0].link()
    assert link.startswith("https://")
    page = browser.new_page(viewport={"width": 1440, "height": 900}, ignore_https_errors=True)
    page.goto(link)
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
    page.locator("section[data-view='map'] .map-canvas").click(position={"x": 300, "y": 300})
    expect(page.get_by_text("Mark this place")).to_have_count(0)
    # What a page hides can be asked for all the same.
    status = page.evaluate(
        "fetch('/recordings/forged', {method: 'PUT', body: 'x'}).then((answer) => answer.status)"
    )
    assert status == 403
    socket = tmp_path / "mavgate" / "run.sock"
    aircraft = request(socket, "status", timeout_s=WAIT_MS / 1000)["aircraft"]
    assert [one["mark"] for one in aircraft] == [None, None]
    page.close()
