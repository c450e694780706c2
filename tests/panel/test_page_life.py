"""The page through what happens to it: other widths, roles, aircraft, a gateway that dies."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from gateway.edges.operator.control_socket import request
from gateway.panel.serving.page_lock import hash_password
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
    pytest.mark.xdist_group("panel"),
]
expect.set_options(timeout=WAIT_MS)

TWO = CONFIG.replace("[simulator]", "[simulator]\nvehicles = 2")
LOCKED = CONFIG.replace(
    "[panel]",
    f'[panel]\npassword = "{hash_password("tower")}"\nviewer_password = "{hash_password("look")}"',
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


def test_several_aircraft_are_told_apart_and_chosen(
    browser: Browser, tmp_path: Path, processes: list[Process]
) -> None:
    processes.append(Process(tmp_path, "demo", "--plain", config=TWO))
    page = open_page(browser, processes[0].link(), "map")
    page.wait_for_function("Object.keys(mavgate.vehicles).length === 2")
    expect(page.locator("section[data-view='map'] .craft")).to_have_count(2)
    page.get_by_label("Aircraft", exact=True).click()
    page.get_by_role("option", name="Plane 2").click()
    page.wait_for_function("mavgate.state.system_id === 2")
    page.close()


def test_viewer_looks_and_does_not_touch(
    browser: Browser, tmp_path: Path, processes: list[Process]
) -> None:
    processes.append(Process(tmp_path, "demo", "--plain", config=LOCKED))
    link = processes[0].link()
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(link)
    page.get_by_label("Password").fill("wrong")
    page.get_by_text("Open the panel").click()
    expect(page.get_by_role("alert")).to_contain_text("not the password")
    page.get_by_label("Password").fill("look")
    page.get_by_text("Open the panel").click()
    expect(page.locator(".head").get_by_text("viewer")).to_be_visible()
    page.wait_for_function("mavgate.state && mavgate.state.lat_deg !== null")
    show(page, "recordings")
    expect(page.locator("[data-role='recorder']")).to_have_text("idle")
    expect(page.get_by_label("Start recording")).to_have_count(0)
    show(page, "map")
    page.locator("section[data-view='map'] .map-canvas").click(position={"x": 300, "y": 300})
    expect(page.get_by_text("Mark this place")).to_have_count(0)
    # What a page hides can be asked for all the same.
    status = page.evaluate(
        "fetch('/recordings/forged', {method: 'PUT', body: 'x'}).then((answer) => answer.status)"
    )
    assert status == 403
    (aircraft,) = request(tmp_path / "mavgate" / "run.sock", "status")["aircraft"]
    assert aircraft["mark"] is None
    page.close()


@pytest.mark.parametrize("width", [1440, 1024, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_view_fits_its_width(
    browser: Browser, demo: Process, width: int, scheme: str
) -> None:
    page = open_page(browser, demo.link(), color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 844})
    expect(page.locator("body")).to_have_class(re.compile(f"body--{scheme}"))
    for number, key in enumerate(("flight", "map", "link", "recordings"), 1):
        page.keyboard.press(str(number))
        expect(page.locator(f"section[data-view='{key}']")).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        panel = page.locator(f"section[data-view='{key}']")
        assert panel.evaluate("(element) => element.scrollWidth") <= width
    page.close()


def test_units_are_those_that_were_chosen(browser: Browser, demo: Process) -> None:
    page = open_page(browser, demo.link(), "map")
    page.get_by_label("Units").click()
    page.get_by_role("option", name="aviation").click()
    page.wait_for_function("mavgate.show('speed', 100)[1] === 'kt'")
    expect(page.locator("section[data-view='map'] .key.circle")).to_contain_text("ft")
    page.close()
