"""Measure the panel: delay from datagram to drawing, CPU, memory, and the effect on the gateway.

A simulated vehicle sends attitude and position at 25 Hz to a `mavgate panel`; one message contains
its time of sending (in the climb of VFR_HUD, which is not changed), and the page notes the delay
once the frame that shows it is drawn. Then the gateway's latency from the serial byte to the
datagram is measured, in turn without a panel, with a panel and a viewer that draws elsewhere, and
with a browser that draws on the gateway's own cores. The memory of an hour is that of the panel's
stored state, fed with simulated time.
"""

import contextlib
import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright
from pymavlink.dialects.v20 import common as mavlink

from gateway.panel.panel_server import make_parts
from gateway.panel.panel_settings import PanelSettings
from tests.kit.process import Process
from tests.ports import free_port
from tools.bench_latency import Line, moments
from tools.harness import MAVGATE, Figures, arguments, cpu_s, memory_mb, show, write_json

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
READ = """
const socket = new WebSocket(`ws://${location.host}/telemetry`);
socket.onmessage = () => socket.send("1");
null;
"""
"""A client that receives like a page but draws nothing: a viewer on another machine."""
RATE_HZ = 25
VIEWERS = (1, 5)
GATEWAY_HZ = 200
TURNS = 3
SETTLE_S = 3.0
MINUTES = (10, 20, 40, 60, 80, 120)
"""Minutes after which memory is measured; the path is full after 67."""
GOAL_P99_MS = 100
GOAL_RATIO = 1.1
GOAL_CLICK_MS = 200

WATCH = """
window.late_ms = [];
mavgate.subscribe((state) => {
  const sent_s = state?.climb_mps;
  if (!sent_s || sent_s === window.last_s) return;
  window.last_s = sent_s;
  requestAnimationFrame(() => setTimeout(() =>
    window.late_ms.push(performance.timeOrigin + performance.now() - (EPOCH + sent_s * 1000))));
});
null; // An evaluation that ends in a function would call it, and so end the subscription.
"""


CLICK = """
(view) => new Promise((resolve) => {
  const begin = performance.now();
  document.querySelector(`.rail button[data-view='${view}']`).click();
  const section = document.querySelector(`section[data-view='${view}']`);
  const look = () => requestAnimationFrame(
    section.hidden ? look : () => resolve(performance.now() - begin));
  look();
})
"""
CLICKS = 5
"""Number of clicks on each view."""


class Vehicle(threading.Thread):
    """Sends the messages of an aircraft, with the time in them."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.epoch_ms = time.time() * 1000
        self.port = port
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._ended = threading.Event()

    def run(self) -> None:
        """Send until the end."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.connect(("127.0.0.1", self.port))
        begin, count = time.monotonic(), 0
        while not self._ended.wait(max(0.0, begin + count / RATE_HZ - time.monotonic())):
            for message in self.messages(count):
                with contextlib.suppress(ConnectionRefusedError):
                    sock.send(message.pack(self._mav))
            count += 1
        sock.close()

    def end(self) -> None:
        """Stop sending."""
        self._ended.set()
        self.join()

    def messages(self, count: int) -> Iterator[mavlink.MAVLink_message]:
        """Make the messages of one step."""
        if count % RATE_HZ == 0:
            yield mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3)
        turn = count / 100
        yield mavlink.MAVLink_attitude_message(0, np.sin(turn), 0.1, turn % 3, 0.0, 0.0, 0.0)
        place = (470_000_000 + count * 5, 80_000_000, 500_000, 100_000, 1400, 0, 0, 9000)
        yield mavlink.MAVLink_global_position_int_message(0, *place)
        sent_s = (time.time() * 1000 - self.epoch_ms) / 1000
        yield mavlink.MAVLink_vfr_hud_message(14.0, 14.0, 90, 0, 500.0, sent_s)


def open_pages(browser: Browser, link: str, count: int) -> list[Page]:
    """Open the page several times and wait for the aircraft."""
    pages = [browser.new_page(viewport={"width": 1024, "height": 768}) for _ in range(count)]
    for page in pages:
        page.goto(link)
        page.wait_for_function("mavgate.state && mavgate.state.lat_deg !== null", timeout=60_000)
    return pages


@contextlib.contextmanager
def panel_of_vehicle(folder: Path) -> Iterator[tuple[Process, Vehicle]]:
    """Run a panel and the vehicle that sends to it."""
    vehicle = Vehicle(free_port())
    vehicle.start()
    words = ("panel", "--connect", f"udp-listen:127.0.0.1:{vehicle.port}", "--tcp-port", "0")
    with Process(folder, *words, config="[panel]\nmap_styles = []\n") as panel:
        yield panel, vehicle
    vehicle.end()


def measure_page(browser: Browser, folder: Path, seconds: float) -> list[Figures]:
    """Measure delay, CPU and memory with one viewer and with several."""
    found = []
    with panel_of_vehicle(folder) as (panel, vehicle):
        pid, link = panel.process.pid, panel.link()
        for count in VIEWERS:
            pages = open_pages(browser, link, count)
            pages[0].wait_for_timeout(1000 * SETTLE_S)
            pages[0].evaluate(WATCH.replace("EPOCH", str(vehicle.epoch_ms)))
            begin_cpu_s, begin_s, before_mb = cpu_s(pid), time.monotonic(), memory_mb(pid)
            pages[0].wait_for_timeout(seconds * 1000)
            late_ms = pages[0].evaluate("window.late_ms")
            share = (cpu_s(pid) - begin_cpu_s) / (time.monotonic() - begin_s)
            p50, p99 = map(float, np.percentile(late_ms, [50, 99]))
            after_mb = memory_mb(pid)
            found.append(
                {
                    "viewers": count, "drawn_hz": len(late_ms) / seconds, "p50_ms": p50,
                    "p99_ms": p99, "cpu_percent": 100 * share, "memory_mb": after_mb,
                    "memory_growth_mb": after_mb - before_mb,
                }
            )  # fmt: skip
            for page in pages:
                page.close()
    return found


def measure_clicks(browser: Browser, folder: Path) -> Figures:
    """Measure the time from a click in the rail until the view is drawn."""
    with panel_of_vehicle(folder) as (panel, _):
        (page,) = open_pages(browser, panel.link(), 1)
        views = page.locator(".rail button[data-view]").evaluate_all(
            "all => all.map((b) => b.dataset.view)"
        )
        for view in views:
            page.locator(f".rail button[data-view='{view}']").click()
            page.locator(f"section[data-view='{view}'] > *").first.wait_for()
        times_ms = [page.evaluate(CLICK, view) for _ in range(CLICKS) for view in views]
        page.close()
    p50, p95 = map(float, np.percentile(times_ms, [50, 95]))
    return {"p50_ms": p50, "p95_ms": p95, "longest_ms": max(times_ms)}


def measure_gateway(browser: Browser, folder: Path, seconds: float) -> Figures:
    """Measure the gateway's p99 without a panel and with an open page, in turn."""
    config = folder / "gateway.toml"
    config.write_text(
        f'aircraft_folder = "{folder}/aircraft"\n'
        f"[vehicle.rates]\nattitude_quaternion_hz = 1000\n"
        f'[recording]\nfolder = "{folder}/recordings"\n[panel]\nport = 0\nmap_styles = []\n'
    )
    words = ("run", "--plain", "--config", str(config), "--port", "{line}")
    command = ["env", f"XDG_RUNTIME_DIR={folder}", *MAVGATE, *words]
    command += ["--endpoint", "udp:127.0.0.1:{port}"]
    late: dict[str, list[float]] = {"without": [], "read": [], "drawn": []}
    sent = moments(GATEWAY_HZ, 1)
    ended = 0.0

    def turn(for_s: float) -> list[float]:
        """Exchange frames after a pause in which the node's frames were not read."""
        nonlocal ended
        for _ in range(round((time.perf_counter() - ended) * GATEWAY_HZ)):
            next(sent)
        found = line.exchange(GATEWAY_HZ, for_s)
        ended = time.perf_counter()
        return found

    line = Line(command, sent, is_gateway=True)
    try:
        line.await_answer(GATEWAY_HZ)
        ended = time.perf_counter()
        for _ in range(TURNS):
            turn(SETTLE_S)
            late["without"] += turn(seconds)
            with Process(folder, "panel", config=config.read_text()) as panel:
                link = panel.link()
                for key, path in (("read", "web/icon.svg"), ("drawn", "")):
                    page = browser.new_page()
                    page.goto(link + path)
                    if key == "read":
                        page.evaluate(READ)
                    turn(SETTLE_S)
                    late[key] += turn(seconds)
                    page.close()
    finally:
        line.close()
    p99 = {key: float(np.percentile(values, 99)) for key, values in late.items()}
    return p99 | {"ratio": p99["read"] / p99["without"]}


def measure_hours() -> list[Figures]:
    """Measure the memory of the panel for one aircraft at 25 Hz, after each of `MINUTES`."""
    parts = make_parts(PanelSettings(), Path(), None, None)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    reader = mavlink.MAVLink(None)
    vehicle, found = Vehicle(0), []
    for count in range(MINUTES[-1] * 60 * RATE_HZ + 1):
        if count % (60 * RATE_HZ) == 0 and (minute := count // (60 * RATE_HZ)) in MINUTES:
            found.append({"minute": minute, "memory_mb": memory_mb(os.getpid())})
        for message in vehicle.messages(count):
            decoded = reader.decode(bytearray(message.pack(sender)))
            parts.fleet.update(decoded, count * 1_000_000 // RATE_HZ)
    return found


def show_all(found: dict[str, Any]) -> None:
    """Print the figures as tables, each with its goal."""
    show(
        f"datagram in to drawn in the browser, {RATE_HZ} Hz; "
        f"goal: p99 at most {GOAL_P99_MS} ms with one viewer",
        ("viewers", "drawn Hz", "p50 ms", "p99 ms", "panel's CPU %", "MB", "grown MB"),
        [row.values() for row in found["page"]],
    )
    show(
        f"click to drawn view; goal: below {GOAL_CLICK_MS} ms",
        ("p50 ms", "p95 ms", "longest ms"),
        [found["clicks"].values()],
    )
    show(
        f"the gateway's own delay, p99; goal: ratio at most {GOAL_RATIO}",
        ("without a panel µs", "with it and a viewer µs", "drawn here too µs", "ratio"),
        [found["gateway"].values()],
    )
    show(
        "memory of the state of one aircraft",
        ("min", "MB"),
        [row.values() for row in found["hours"]],
    )


def main() -> None:
    """Measure all and print it."""
    options = arguments(__doc__, seconds=20.0).parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        found = {
            "page": measure_page(browser, Path(folder), options.seconds),
            "clicks": measure_clicks(browser, Path(folder)),
            "gateway": measure_gateway(browser, Path(folder), options.seconds / TURNS),
            "hours": measure_hours(),
        }
        browser.close()
    show_all(found)
    write_json(options, found)


if __name__ == "__main__":
    main()
