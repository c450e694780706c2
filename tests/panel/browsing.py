"""A real Chromium that looks at a panel."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Page, sync_playwright

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

needs_chromium = pytest.mark.skipif(
    not CHROMIUM.exists(),
    reason=f"no {CHROMIUM}: sudo apt-get install --no-install-recommends chromium",
)


def launched() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(
            executable_path=str(CHROMIUM), args=ARGUMENTS, timeout=START_LIMIT_MS
        )
        yield opened
        opened.close()


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
