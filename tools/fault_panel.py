"""Measure the effect of hostile clients of the panel on its operator.

A `mavgate panel` with passwords shows a vehicle of this tool. For each fault, the operator loads
the page repeatedly, first in a quiet run and then while clients misbehave: without a login, or
logged in as a viewer. Targets: the panel's memory grows by at most 50 MB, the page answers within
one second, and no file descriptor is lost. The clients take processor time on the same cores.

    .venv/bin/python tools/fault_panel.py            # three minutes; --only WORD for some
"""

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import websockets
from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.panel.access import COOKIE
from gateway.panel.logins import hash_password
from tests.kit.process import Process
from tests.ports import free_port
from tools.bench_panel import Vehicle, memory_mb

MEMORY_MB = 50.0
ANSWER_S = 1.0
PAUSE_S = 0.4
"""Interval of the operator's requests."""
SETTLE_S = 25.0
"""Pause after a fault: longer than any timeout of the panel for an incomplete request."""
OPERATOR, VIEWER = "operator's", "viewer's"
MB = bytes(1 << 20)
OPERATE = """
import json, sys, time
import httpx
link, cookie, seconds, pause = sys.argv[1:]
until, times_ms = time.monotonic() + float(seconds), []
while time.monotonic() < until:
    begin = time.monotonic()
    answer = httpx.get(link, headers={"cookie": cookie}, timeout=60.0)
    assert answer.status_code == 200, answer.status_code
    times_ms.append(1000 * (time.monotonic() - begin))
    time.sleep(float(pause))
print(json.dumps(times_ms))
"""
"""Program of the operator, which runs as a separate process like a browser."""
Fault = Callable[[], Awaitable[None]]
"""Runs until it is cancelled."""
CONFIG = """
[recording]
folder = "{folder}/recordings"
[panel]
port = 0
map_styles = []
password = "{operator}"
viewer_password = "{viewer}"
"""


@dataclass
class Figures:
    """Results of one fault."""

    quiet_p50_ms: float
    quiet_max_ms: float
    p50_ms: float
    max_ms: float
    grown_mb: float
    descriptors_lost: int

    @property
    def holds(self) -> bool:
        """Whether all targets are met."""
        return (
            self.max_ms <= ANSWER_S * 1000
            and self.grown_mb <= MEMORY_MB
            and self.descriptors_lost <= 0
        )


class PanelBench:
    """A panel with its process and address, its operator, and misbehaving clients."""

    def __init__(self, pid: int, link: str) -> None:
        self.pid = pid
        self.link = link.rstrip("/")
        parts = urlsplit(link)
        self.host, self.port = str(parts.hostname), int(parts.port or 0)
        self.cookies: dict[str, str] = {}

    async def log_in(self) -> None:
        """Open a session for the operator and one for a viewer."""
        for password in (OPERATOR, VIEWER):
            async with httpx.AsyncClient(base_url=self.link) as client:
                await client.post("/login", data={"password": password})
                self.cookies[password] = f"{COOKIE}={client.cookies[COOKIE]}"

    def client(self, password: str = "") -> httpx.AsyncClient:
        """Return a client that is logged in, or not."""
        headers = {"cookie": self.cookies[password]} if password else {}
        return httpx.AsyncClient(base_url=self.link, headers=headers, timeout=60.0)

    def websocket(self, path: str) -> "websockets.connect":
        """Return a connection of the viewer."""
        headers = {"cookie": self.cookies[VIEWER]}
        url = f"ws://{self.host}:{self.port}{path}"
        return websockets.connect(url, additional_headers=headers, max_size=None)

    def descriptors(self) -> int:
        """Count the open descriptors of the panel."""
        return sum(1 for _ in Path(f"/proc/{self.pid}/fd").iterdir())

    async def operate(self, seconds: float) -> tuple[list[float], float]:
        """Load the page repeatedly; return the times in ms, and the panel's peak memory in MB."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", OPERATE, self.link, self.cookies[OPERATOR]),
            *(str(seconds), str(PAUSE_S)),
            stdout=asyncio.subprocess.PIPE,
        )
        reading = asyncio.create_task(process.communicate())
        peak_mb = 0.0
        while not reading.done():
            peak_mb = max(peak_mb, memory_mb(self.pid))
            await asyncio.sleep(0.05)
        times_ms = json.loads((await reading)[0])
        return times_ms, peak_mb

    async def measure(self, fault: Fault, seconds: float) -> Figures:
        """Measure a quiet run and one with a fault."""
        quiet_ms, _ = await self.operate(seconds / 2)
        memory, descriptors = memory_mb(self.pid), self.descriptors()
        trouble = asyncio.create_task(_until(fault, seconds))
        times_ms, peak_mb = await self.operate(seconds)
        await trouble
        until = time.monotonic() + SETTLE_S
        while self.descriptors() > descriptors and time.monotonic() < until:
            await asyncio.sleep(PAUSE_S)
        return Figures(
            statistics.median(quiet_ms),
            max(quiet_ms),
            statistics.median(times_ms),
            max(times_ms),
            peak_mb - memory,
            self.descriptors() - descriptors,
        )

    async def silent(self, *, count: int = 300, sent: bytes = b"") -> None:
        """Open connections that send nothing, or an incomplete header."""
        streams = []
        for _ in range(count):
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection(self.host, self.port)
                writer.write(sent)
                streams.append((reader, writer))
        try:
            await asyncio.Event().wait()
        finally:
            for _, writer in streams:
                writer.close()

    async def endless_headers(self) -> None:
        """Send headers without an end on several connections."""
        line = b"x: " + bytes(8000).replace(b"\0", b"y") + b"\r\n"

        async def one() -> None:
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection(self.host, self.port)
                    writer.write(b"GET / HTTP/1.1\r\n")
                    while not writer.is_closing():
                        writer.write(line)
                        await writer.drain()
                        await asyncio.sleep(0.001)
                    writer.close()

        await asyncio.gather(*(one() for _ in range(16)))

    async def logins(self) -> None:
        """Try a hundred wrong passwords at once, repeatedly."""
        async with self.client() as client:
            while True:
                await asyncio.gather(
                    *(client.post("/login", data={"password": f"p{n}"}) for n in range(100)),
                    return_exceptions=True,
                )

    async def huge_bodies(self) -> None:
        """Send large bodies to login and to the REST API, without a login and as a viewer."""

        async def chunks() -> AsyncIterator[bytes]:
            for _ in range(200):
                yield MB

        while True:
            for password, path in (("", "/login"), (VIEWER, "/v1/mavlink"), (VIEWER, "/x")):
                async with self.client(password) as client:
                    with contextlib.suppress(httpx.HTTPError):
                        await client.post(path, content=chunks())

    async def websocket_flood(self) -> None:
        """Send megabytes over WebSockets as a viewer, and read nothing back."""

        async def one(path: str) -> None:
            while True:
                with contextlib.suppress(websockets.WebSocketException, OSError):
                    async with self.websocket(path) as stream:
                        while True:
                            await stream.send(MB[:-1024])

        await asyncio.gather(*(one(p) for p in ("/v1/ws/mavlink", "/telemetry") * 4))

    async def slow_readers(self) -> None:
        """Subscribe to everything as a viewer, and read nothing."""
        async with contextlib.AsyncExitStack() as opened:
            for _ in range(20):
                stream = await opened.enter_async_context(self.websocket("/v1/ws/mavlink"))
                stream.transport.pause_reading()
                opened.callback(stream.transport.abort)
            await asyncio.Event().wait()

    async def filters(self) -> None:
        """Ask for message names by regular expressions that take long to compile."""

        async def one(number: int) -> None:
            for turn in range(1000):
                path = f"/v1/ws/mavlink?filter={'.' * 280}{number}x{turn}"
                with contextlib.suppress(websockets.WebSocketException, OSError):
                    async with self.websocket(path):
                        pass

        await asyncio.gather(*(one(n) for n in range(10)))

    async def downloads(self) -> None:
        """Begin downloads as a viewer, and break them off."""
        while True:
            async with self.client(VIEWER) as client:
                with contextlib.suppress(httpx.HTTPError):
                    async with client.stream("GET", "/recordings/large") as answer:
                        async for _ in answer.aiter_raw(1024):
                            break

    async def uploads(self) -> None:
        """Break off uploads of the operator."""
        head = (
            "PUT /recordings/up HTTP/1.1\r\nhost: {host}\r\ncookie: {cookie}\r\n"
            "content-length: 90000000\r\n\r\n"
        ).format(host=f"{self.host}:{self.port}", cookie=self.cookies[OPERATOR])
        while True:
            _, writer = await asyncio.open_connection(self.host, self.port)
            writer.write(head.encode() + MB)
            with contextlib.suppress(OSError):
                await writer.drain()
            writer.transport.abort()
            await asyncio.sleep(0.02)

    async def abandoned_pages(self) -> None:
        """Load the page as a viewer repeatedly, without the scripts in it."""
        async with self.client(VIEWER) as client:
            while True:
                await client.get("/")


async def _until(fault: Fault, seconds: float) -> None:
    """Run a fault for some time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await fault()


def faults_of(bench: PanelBench) -> dict[str, Fault]:
    """Return the faults by name."""
    partial_header = b"GET / HTTP/1.1\r\nhost: x"
    return {
        "300 silent connections": bench.silent,
        "300 incomplete headers": partial(bench.silent, sent=partial_header),
        "16 headers without an end": bench.endless_headers,
        "100 parallel wrong passwords": bench.logins,
        "bodies of 200 MB": bench.huge_bodies,
        "viewer sends megabytes over WebSockets": bench.websocket_flood,
        "20 subscribers that read nothing": bench.slow_readers,
        "regular expressions of the greatest size": bench.filters,
        "downloads broken off": bench.downloads,
        "uploads broken off": bench.uploads,
        "pages loaded and abandoned": bench.abandoned_pages,
    }


async def measure(pid: int, link: str, seconds: float, only: str) -> dict[str, Figures]:
    """Measure all faults against one panel."""
    bench = PanelBench(pid, link)
    await bench.log_in()
    await bench.operate(seconds / 2)
    found = {}
    for name, fault in faults_of(bench).items():
        if only in name:
            found[name] = await bench.measure(fault, seconds)
            print(f"{name}: measured", file=sys.stderr)
    return found


def show(found: dict[str, Figures]) -> None:
    """Print the figures."""
    title = "the operator's page, and the panel's memory and descriptors"
    table = Table(title=title, box=box.SIMPLE_HEAD)
    table.add_column("fault")
    for column in ("quiet ms", "max", "with it ms", "max", "grown MB", "descriptors lost", "holds"):
        table.add_column(column, justify="right")
    for name, f in found.items():
        figures = (f.quiet_p50_ms, f.quiet_max_ms, f.p50_ms, f.max_ms, f.grown_mb)
        row = [f"{figure:.1f}" for figure in figures]
        table.add_row(name, *row, str(f.descriptors_lost), "yes" if f.holds else "no")
    targets = f"targets: at most {ANSWER_S * 1000:.0f} ms, {MEMORY_MB:.0f} MB, no descriptor"
    Console(width=120).print(table, targets)


def main() -> None:
    """Run all faults."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each fault")
    parser.add_argument("--only", metavar="WORD", default="", help="faults with this word")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "recordings").mkdir()
        (folder / "recordings" / "large_01.tlog").write_bytes(os.urandom(40_000_000))
        hashes = {"operator": hash_password(OPERATOR), "viewer": hash_password(VIEWER)}
        port, config = free_port(), CONFIG.format(folder=folder, **hashes)
        command = ("panel", "--connect", f"udp-listen:127.0.0.1:{port}")
        with Process(folder, *command, config=config) as panel:
            vehicle = Vehicle(port)
            vehicle.start()
            found = asyncio.run(
                measure(panel.process.pid, panel.link(), options.seconds, options.only)
            )
            vehicle.end()
    show(found)
    if options.json:
        figures = {name: asdict(each) for name, each in found.items()}
        report = {"load": os.getloadavg(), "faults": figures}
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    if not all(each.holds for each in found.values()):
        sys.exit(1)


if __name__ == "__main__":
    main()
