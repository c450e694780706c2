"""Measure the panel: datagram in to drawn in the browser, CPU, memory, and what the gateway feels.

A vehicle of this tool's own sends attitude and position at 25 Hz to a `mavgate panel`; one message
carries the time at which it was sent (as VFR_HUD's climb, which only passes through), and the page
notes how late it is once the frame that shows it is drawn. Then the gateway's own latency from the
serial byte to the datagram is measured with and without a panel and its viewer, in turns.
"""

import argparse
import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bench_latency import await_answer, cpu_seconds, exchange, frames, free_port
from playwright.sync_api import Browser, Page, sync_playwright
from pymavlink.dialects.v20 import common as mavlink

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
RATE_HZ = 25
VIEWERS = (1, 5)
GATEWAY_HZ = 200
TURNS = 3
START_S = 180.0
SETTLE_MS = 3000

WATCH = """
window.late_ms = [];
mavgate.subscribe((state) => {
  const sent_s = state?.climb_mps;
  if (!sent_s || sent_s === window.last_s) return;
  window.last_s = sent_s;
  requestAnimationFrame(() => setTimeout(() =>
    window.late_ms.push(performance.timeOrigin + performance.now() - (EPOCH + sent_s * 1000))));
});
"""


class Vehicle(threading.Thread):
    """Sends what an aircraft sends, with the time in it."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.epoch_ms = time.time() * 1000
        self._port = port
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._ended = threading.Event()

    def run(self) -> None:
        """Send until the end."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.connect(("127.0.0.1", self._port))
        begin, count = time.monotonic(), 0
        while not self._ended.wait(max(0.0, begin + count / RATE_HZ - time.monotonic())):
            for message in self._messages(count):
                with contextlib.suppress(ConnectionRefusedError):
                    sock.send(message.pack(self._mav))
            count += 1
        sock.close()

    def end(self) -> None:
        """Stop sending."""
        self._ended.set()
        self.join()

    def _messages(self, count: int) -> Iterator[mavlink.MAVLink_message]:
        if count % RATE_HZ == 0:
            yield mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3)
        turn = count / 100
        yield mavlink.MAVLink_attitude_message(0, np.sin(turn), 0.1, turn % 3, 0.0, 0.0, 0.0)
        place = (470_000_000 + count * 5, 80_000_000, 500_000, 100_000, 1400, 0, 0, 9000)
        yield mavlink.MAVLink_global_position_int_message(0, *place)
        sent_s = (time.time() * 1000 - self.epoch_ms) / 1000
        yield mavlink.MAVLink_vfr_hud_message(14.0, 14.0, 90, 0, 500.0, sent_s)


@contextlib.contextmanager
def running(*arguments: str, folder: Path) -> Iterator[tuple[subprocess.Popen, str]]:
    """Run a command that prints the panel's link, until the end of the block."""
    log = folder / f"{time.monotonic_ns()}.log"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", *arguments],
            stdout=output, stderr=output, env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
        )  # fmt: skip
    try:
        until = time.monotonic() + START_S
        while not (link := re.search(r"panel: (http://\S+)", log.read_text())):
            if time.monotonic() > until or process.poll() is not None:
                raise SystemExit(log.read_text())
            time.sleep(0.1)
        yield process, link[1]
    finally:
        process.terminate()
        process.wait(20)


def memory_mb(pid: int) -> float:
    """Return how much memory a process holds."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", text)[1]) / 1000


def open_pages(browser: Browser, link: str, count: int) -> list[Page]:
    """Open the page several times and wait for the aircraft."""
    pages = [browser.new_page(viewport={"width": 1024, "height": 768}) for _ in range(count)]
    for page in pages:
        page.goto(link)
        page.wait_for_function("mavgate.state && mavgate.state.lat_deg !== null", timeout=60_000)
    return pages


def measure_page(browser: Browser, folder: Path, seconds: float) -> list[dict]:
    """Measure delay, CPU and memory with one viewer and with several."""
    port = free_port()
    config = folder / "panel.toml"
    config.write_text("[panel]\nmap_styles = []\n")
    found = []
    connect = f"udp-listen:127.0.0.1:{port}"
    options = ("panel", "--connect", connect, "--port", "0", "--config", str(config))
    with running(*options, folder=folder) as (process, link):
        vehicle = Vehicle(port)
        vehicle.start()
        for count in VIEWERS:
            pages = open_pages(browser, link, count)
            pages[0].wait_for_timeout(SETTLE_MS)
            pages[0].evaluate(WATCH.replace("EPOCH", str(vehicle.epoch_ms)))
            cpu, begin = cpu_seconds(process.pid), time.monotonic()
            memory = memory_mb(process.pid)
            pages[0].wait_for_timeout(seconds * 1000)
            late_ms = pages[0].evaluate("window.late_ms")
            share = (cpu_seconds(process.pid) - cpu) / (time.monotonic() - begin)
            p50, p99 = np.percentile(late_ms, [50, 99])
            found.append(
                {
                    "viewers": count,
                    "drawn": len(late_ms),
                    "drawn_hz": len(late_ms) / seconds,
                    "p50_ms": float(p50),
                    "p99_ms": float(p99),
                    "cpu_percent": 100 * share,
                    "memory_mb": memory_mb(process.pid),
                    "memory_growth_mb": memory_mb(process.pid) - memory,
                }
            )
            print(found[-1])
            for page in pages:
                page.close()
        vehicle.end()
    return found


def measure_gateway(browser: Browser, folder: Path, seconds: float) -> dict:
    """Measure the gateway's own delay without a panel and with one that is looked at, in turns."""
    master, slave = os.openpty()
    tty.setraw(slave)
    port, source = free_port(), frames(GATEWAY_HZ)
    config = folder / "gateway.toml"
    config.write_text(
        f'aircraft_folder = "{folder}/aircraft"\n[hub]\nendpoints = ["udp:127.0.0.1:{port}"]\n'
        f"[vehicle.rates]\nattitude_quaternion_hz = 1000\n"
        f'[recording]\nfolder = "{folder}/recordings"\n[panel]\nport = 0\nmap_styles = []\n'
    )
    command = ["run", "--plain", "--config", str(config), "--port", os.ttyname(slave)]
    late: dict[str, list[float]] = {"without": [], "with": []}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))
        sock.setblocking(False)
        gateway = subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", *command],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
        )  # fmt: skip
        try:
            await_answer(gateway, master, sock, source, GATEWAY_HZ)
            for _ in range(TURNS):
                late["without"] += exchange(master, sock, source, GATEWAY_HZ, seconds)
                with running("panel", "--config", str(config), folder=folder) as (_, link):
                    page = browser.new_page()
                    page.goto(link)
                    exchange(master, sock, source, GATEWAY_HZ, SETTLE_MS / 1000)
                    late["with"] += exchange(master, sock, source, GATEWAY_HZ, seconds)
                    page.close()
        finally:
            gateway.terminate()
            gateway.wait(20)
    p99 = {key: float(np.percentile(values, 99)) for key, values in late.items()}
    result = {"p99_us": p99, "ratio": p99["with"] / p99["without"]}
    print(result)
    return result


def main() -> None:
    """Measure all and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="per figure; 3600 for memory")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        found = {
            "page": measure_page(browser, Path(folder), options.seconds),
            "gateway": measure_gateway(browser, Path(folder), options.seconds / TURNS),
        }
        browser.close()
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
