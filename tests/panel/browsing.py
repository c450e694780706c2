"""A gateway with its panel as processes, and a real Chromium to look at it."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from playwright.sync_api import Browser, Page, Playwright

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
Found = TypeVar("Found")
START_LIMIT_S = 60.0
"""A start takes some seconds of a busy machine."""
START_LIMIT_MS = 60_000
WAIT_MS = 60_000
"""What is on the page by then, or not: a busy machine is slow, and nothing here sleeps."""
DESKTOP = {"width": 1440, "height": 900}

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
[panel]
port = 0
tiles_folder = "{folder}/tiles"
map_styles = [
  {{name = "Field", url = "{folder}/field.mbtiles", max_zoom = 4}},
  {{name = "Other", url = "{folder}/other.mbtiles", max_zoom = 4}},
]
"""

needs_chromium = pytest.mark.skipif(
    not CHROMIUM.exists(),
    reason=f"no {CHROMIUM}: sudo apt-get install --no-install-recommends chromium",
)


def launch(playwright: Playwright) -> Browser:
    return playwright.chromium.launch(
        executable_path=str(CHROMIUM), args=ARGUMENTS, timeout=START_LIMIT_MS
    )


class Process:
    """A `mavgate` command that runs until it is ended."""

    def __init__(self, folder: Path, *arguments: str, config: str = CONFIG) -> None:
        file = folder / "gateway.toml"
        file.write_text(config.format(folder=folder))
        self.log = folder / f"{arguments[0]}-{time.monotonic_ns()}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gateway.cli", *arguments, "--config", str(file)],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | {"XDG_RUNTIME_DIR": str(folder), "COLUMNS": "200"},
            )

    def until(self, pattern: str) -> re.Match[str]:
        """Wait until the output holds a pattern."""
        return wait_for(lambda: re.search(pattern, self.log.read_text()), self.log.read_text)

    def link(self) -> str:
        """Wait for the page's address."""
        return self.until(r"panel: (https?://\S+)")[1]

    def end(self, how: signal.Signals = signal.SIGTERM) -> None:
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            self.process.wait(WAIT_MS / 1000)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(5)


def wait_for(look: Callable[[], Found | None], describe: Callable[[], str]) -> Found:
    """Look again and again until there is something."""
    deadline = time.monotonic() + START_LIMIT_S
    while not (found := look()):
        assert time.monotonic() < deadline, f"not in {START_LIMIT_S:.0f} s:\n{describe()}"
        time.sleep(0.05)
    return found


def open_page(browser: Browser, link: str, view: str = "flight", **options: object) -> Page:
    """Open the page, wait for an aircraft, and show a view."""
    page = browser.new_page(viewport=DESKTOP, **options)  # type: ignore[arg-type]
    page.set_default_timeout(WAIT_MS)
    page.goto(link)
    # A click before the handshake waits for it, and may come after a later one.
    page.wait_for_function(
        "window.did_handshake && mavgate.state && mavgate.state.lat_deg !== null"
    )
    show(page, view)
    return page


def show(page: Page, view: str) -> None:
    """Show a view by its key."""
    button = page.locator(f".rail button[data-view='{view}']")
    button.click()
    page.locator(f"section[data-view='{view}']").wait_for(state="visible")
