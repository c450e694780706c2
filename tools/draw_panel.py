"""Draw docs/pictures/panel_flight.png and flight_page.png, in a real Chromium.

The first shows the panel on the simulated flight, the second a flight as one file.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import ViewportSize, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tests.panel.browsing import CONFIG_WITHOUT_MAP, Process, launch

PICTURES = Path(__file__).resolve().parent.parent / "docs" / "pictures"
START_S = 180.0
AIRBORNE_M = 60.0
AS_WITH_A_GRAPHICS_CARD = """
const extension = WebGLRenderingContext.prototype.getExtension;
WebGLRenderingContext.prototype.getExtension = function (name) {
  return name === "WEBGL_debug_renderer_info" ? null : extension.call(this, name);
};
"""
"""Hides the renderer's name, since the page draws 3D with less detail if the processor renders."""
SIZE: ViewportSize = {"width": 1440, "height": 900}


def draw_flight_page() -> None:
    """Make a page of a recorded flight, and take a screenshot."""
    target = PICTURES / "flight_page.png"
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_file = Path(folder, "flight.html")
        flight = PICTURES.parents[1] / "tests" / "golden" / "take_off.csv.gz"
        command = [sys.executable, "-m", "gateway.cli", "page", str(flight), "-o", str(page_file)]
        subprocess.run(command, check=True)
        browser = launch(playwright)
        page = browser.new_page(viewport=SIZE, color_scheme="dark")
        page.add_init_script(AS_WITH_A_GRAPHICS_CARD)
        page.goto(page_file.as_uri())
        page.locator("input[type=range]").focus()
        for _ in range(11):
            page.keyboard.press("ArrowRight")
        page.wait_for_timeout(3000)
        page.screenshot(path=target)
        browser.close()
    print(target)


def draw_panel() -> None:
    """Wait until an aircraft of the demo is airborne, and take a screenshot of the flight view."""
    target = PICTURES / "panel_flight.png"
    with (
        tempfile.TemporaryDirectory() as folder,
        Process(Path(folder), "demo", "--plain", config=CONFIG_WITHOUT_MAP) as demo,
        sync_playwright() as playwright,
    ):
        browser = launch(playwright)
        page = browser.new_page(viewport=SIZE, color_scheme="dark")
        page.add_init_script(AS_WITH_A_GRAPHICS_CARD)
        page.goto(demo.link())
        page.wait_for_function(
            f"mavgate.state && mavgate.state.alt_home_m > {AIRBORNE_M}", timeout=START_S * 1000
        )
        page.locator(".rail button[data-view='flight']").click()
        page.wait_for_timeout(4000)
        page.screenshot(path=target)
        browser.close()
    print(target)


if __name__ == "__main__":
    draw_flight_page()
    draw_panel()
