"""A gateway with its panel as processes, and a real Chromium to look at it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Page, Playwright

from tests.kit import process

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
START_LIMIT_MS = 60_000
WAIT_MS = 60_000
"""Longest wait for a state of the page, ms: a busy machine is slow, and no test sleeps."""
DESKTOP = {"width": 1080, "height": 680}
"""Small: the processor draws every pixel."""
FEW_FRAMES = """
const next_frame = requestAnimationFrame.bind(window);
const waiting = new Set();
window.requestAnimationFrame = (draw) => {
  const id = setTimeout(() => next_frame((now_ms) => waiting.delete(id) && draw(now_ms)), 80);
  waiting.add(id);
  return id;
};
window.cancelAnimationFrame = (id) => waiting.delete(id);
"""
"""Lets a page draw about ten frames a second, since the processor draws them."""

CONFIG = """
aircraft_folder = "{folder}/aircraft"
[hub]
endpoints = ["udp-listen:127.0.0.1:0?name=clients"]
[recording]
folder = "{folder}/recordings"
mode = "manual"
[simulator]
vehicles = 2
gps_first_fix_s = 0.5
imu_rate_hz = 25
baro_rate_hz = 5
[vehicle.rates]
attitude_quaternion_hz = 5
attitude_hz = 5
global_position_int_hz = 5
vfr_hud_hz = 5
highres_imu_hz = 5
[panel]
port = 0
tiles_folder = "{folder}/tiles"
map_styles = [
  {{name = "Field", url = "{folder}/field.mbtiles", max_zoom = 18}},
  {{name = "Other", url = "{folder}/other.mbtiles", max_zoom = 18}},
]
"""
CONFIG_WITHOUT_MAP = """
aircraft_folder = "{folder}/aircraft"
[hub]
endpoints = []
[recording]
folder = "{folder}/recordings"
[panel]
port = 0
tiles_folder = "{folder}/tiles"
map_styles = []
"""

needs_chromium = pytest.mark.skipif(
    not CHROMIUM.exists(),
    reason=f"no {CHROMIUM}: sudo apt-get install --no-install-recommends chromium",
)


def launch(playwright: Playwright) -> Browser:
    return playwright.chromium.launch(
        executable_path=str(CHROMIUM), args=ARGUMENTS, timeout=START_LIMIT_MS
    )


class Process(process.Process):
    """A `mavgate` command with a panel."""

    def __init__(self, folder: Path, *arguments: str, config: str = CONFIG) -> None:
        super().__init__(folder, *arguments, config=config.format(folder=folder))


def open_page(browser: Browser, link: str, view: str = "flight", script: str = "") -> Page:
    """Open the page, wait for an aircraft, and show a view; a script runs before those of it."""
    page = browser.new_page(viewport=DESKTOP)
    page.set_default_timeout(WAIT_MS)
    page.add_init_script(FEW_FRAMES + script)
    page.goto(link)
    # A click before the handshake waits for it, and may come after a later one.
    page.wait_for_function(
        "window.did_handshake && mavgate.state && mavgate.state.lat_deg !== null"
    )
    show(page, view)
    return page


@contextmanager
def opened(browser: Browser, link: str) -> Iterator[Page]:
    """Open the page; none of its scripts may fail until it is closed."""
    page = open_page(browser, link)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    yield page
    page.close()
    assert troubles == []


def show(page: Page, view: str) -> Locator:
    """Show a view by its key; return its element."""
    button = page.locator(f".rail button[data-view='{view}']")
    if not button.is_visible():
        page.get_by_role("button", name="More", exact=True).click()
    button.click()
    section = page.locator(f"section[data-view='{view}']")
    section.wait_for(state="visible")
    return section


def choose(page: Page, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def box_of(element: Locator) -> FloatRect:
    """Return where a visible element is on the page."""
    box = element.bounding_box()
    assert box is not None
    return box


def download(page: Page, button: Locator, folder: Path) -> Path:
    """Click a button; return the file that is downloaded, under the name that the page gives it."""
    # The command of an export has a lower priority than all other tests.
    with page.expect_download(timeout=5 * START_LIMIT_MS) as waiting:
        button.click()
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path
