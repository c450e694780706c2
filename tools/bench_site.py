"""Measure one real site of a fleet: from the serial byte to the ground station.

`mavgate run` reads IMU frames from a pseudo-terminal and sends the ATTITUDE_QUATERNION of each to
its own clients over UDP and TCP and, over Zenoh, a router and a `mavgate fleet`, to a third ground
station. All three get the same frames in the same run, so that the first two are the baseline.
Latency is from this process's clock before it writes the frame to the same clock when it reads the
datagram. The measurement is repeated while a recording of the site is fetched.

`--outage S` kills the router in a third part, and starts it again S seconds later; printed are the
frames that each client lost, got twice or got late, and the memory of site and fleet before and
during the outage.
"""

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import sys
import tempfile
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tools.bench_fleet import SETTLE_S, Station, end, free_locator, start, start_router, wait_for
from tools.bench_hub import resident_kib
from tools.bench_latency import frames

WAYS = ("UDP, plain hub", "TCP, plain hub", "fleet")
DIRECT, FLEET = WAYS[0], WAYS[2]
SETTLED = 100
"""Successive frames that all three must receive before the measurement."""
START_LIMIT_S = 120.0
DRAIN_S = 1.0
BEFORE_S, AFTER_S = 5.0, 10.0
"""Measured time before and after the outage."""
LATE_US = 1e6
"""Delay from which a frame counts as late."""
RECORDING_BYTES = 2 << 30
PIECES = ".bench_01.tlog.part"

CONFIG = """
[hub]
endpoints = [
    "udp:127.0.0.1:{udp}", "tcp-listen:127.0.0.1:{tcp}", "zenoh:{locator}?site=field&trusted=yes",
]

[recording]
mode = "manual"
folder = "{recordings}"

[vehicle.rates]
attitude_quaternion_hz = 1000
"""


@dataclass(frozen=True)
class WayFigures:
    """Frames that one ground station received in one part."""

    part: str
    way: str
    sent: int
    lost: int
    twice: int
    late: int
    p50_us: float
    p99_us: float


class Field:
    """The site, its line, its three ground stations, the router and the fleet."""

    def __init__(self, folder: Path, rate_hz: int, stack: contextlib.ExitStack) -> None:
        self.home, self.locator, self._rate_hz = folder, free_locator(), rate_hz
        self._frames = frames(rate_hz)
        self._line, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._line, False)
        self.router = start_router(self.locator)
        stack.callback(lambda: end(self.router))
        direct, far = (Station(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION) for _ in range(2))
        self.fleet = start(
            *("-m", "gateway.cli", "fleet", "--connect", self.locator, "--site", "field"),
            *("--endpoint", f"udp:127.0.0.1:{far.port}"),
            home=folder,
        )
        stack.callback(end, self.fleet)
        wait_for(folder / "mavgate" / "fleet.sock")
        recordings = folder / "recordings"
        recordings.mkdir()
        with (recordings / "bench_01.tlog").open("wb") as file:
            file.truncate(RECORDING_BYTES)
        tcp = int(free_locator().rpartition(":")[2])
        config = folder / "bench.toml"
        config.write_text(
            CONFIG.format(udp=direct.port, tcp=tcp, locator=self.locator, recordings=recordings)
        )
        words = ("run", "--plain", "--config", str(config), "--port", os.ttyname(slave))
        self.site = start("-m", "gateway.cli", *words)
        stack.callback(end, self.site)
        self.stations = {DIRECT: direct, FLEET: far}
        self._await([DIRECT])
        near = socket.create_connection(("127.0.0.1", tcp))
        near.setblocking(False)
        self.stations[WAYS[1]] = Station(direct.message_id, sock=near)
        self._await(list(WAYS))

    def feed(
        self, part: str, seconds: float, events: list[tuple[float, Callable[[], None]]]
    ) -> list[WayFigures]:
        """Write frames for some time, run what is due, and return the figures of each station."""
        for station in self.stations.values():
            station.got.clear()
        written: list[int] = []
        begin = time.monotonic()
        for count in range(round(seconds * self._rate_hz)):
            self._read_until(begin + count / self._rate_hz)
            while events and events[0][0] <= count / self._rate_hz:
                events.pop(0)[1]()
            written.append(time.monotonic_ns())
            os.write(self._line, next(self._frames))
        self._read_until(time.monotonic() + DRAIN_S)
        direct = self.stations[DIRECT].got
        if len(direct) != len(written):
            raise RuntimeError(f"{len(written)} frames gave {len(direct)} datagrams")
        times = {vehicle_ms: ns for (vehicle_ms, _), ns in zip(direct, written, strict=True)}
        return [figures(part, way, times, self.stations[way].got) for way in WAYS]

    def _read_until(self, when_s: float) -> None:
        sockets = [station.sock for station in self.stations.values()]
        while True:
            # A sleep to the end would end too late.
            ready = select.select(sockets, [], [], max(0.0, when_s - time.monotonic() - 2e-4))[0]
            for station in self.stations.values():
                if station.sock in ready:
                    station.read()
            if time.monotonic() >= when_s:
                return

    def _await(self, ways: list[str]) -> None:
        limit, got = time.monotonic() + START_LIMIT_S, self.stations
        while any(len(got[way].got) < SETTLED for way in ways):
            if time.monotonic() > limit or self.site.poll() is not None:
                raise RuntimeError(f"nothing comes by {ways}")
            # The line is full until the site reads it.
            with contextlib.suppress(BlockingIOError):
                os.write(self._line, next(self._frames))
            self._read_until(time.monotonic() + 1 / self._rate_hz)
        self._read_until(time.monotonic() + SETTLE_S)


def figures(part: str, way: str, written: dict[int, int], got: list[tuple[int, int]]) -> WayFigures:
    """Compare the received with the written frames, by the vehicle's time in them."""
    late_us = [(ns - written[key]) / 1000 for key, ns in got if key in written]
    return WayFigures(
        part=part,
        way=way,
        sent=len(written),
        lost=len(written.keys() - {key for key, _ in got}),
        twice=len(got) - len({key for key, _ in got}),
        late=sum(each > LATE_US for each in late_us) + len(got) - len(late_us),
        p50_us=float(np.percentile(late_us, 50)),
        p99_us=float(np.percentile(late_us, 99)),
    )


def with_fetch(site: Field, seconds: float) -> tuple[list[WayFigures], float]:
    """Measure while a recording is fetched; also return the rate of the fetch, bytes a second."""
    words = ("fleet", "recordings", "get", "field", "bench", "-o", str(site.home / "fetched"))
    fetch = start("-m", "gateway.cli", *words, home=site.home)
    part = site.home / "fetched" / PIECES
    try:
        wait_for(part)
        before = part.stat().st_size
        found = site.feed("while a recording is fetched", seconds, [])
        if fetch.poll() is not None:
            raise RuntimeError("the fetch has ended")
        return found, (part.stat().st_size - before) / (seconds + DRAIN_S)
    finally:
        end(fetch)


def through_an_outage(site: Field, outage_s: float) -> tuple[list[WayFigures], list[str]]:
    """Kill the router, start it again, and measure memory."""
    processes = {"site": site.site, "fleet": site.fleet}
    memory: dict[str, list[int]] = {name: [] for name in processes}
    returned: list[float] = []

    def look() -> None:
        for name, process in processes.items():
            memory[name].append(resident_kib(process.pid))

    def kill() -> None:
        site.router.send_signal(signal.SIGKILL)

    def restart() -> None:
        end(site.router)
        site.router = start_router(site.locator)
        returned.append(time.monotonic_ns())

    whole_s = BEFORE_S + outage_s + AFTER_S
    events: list[tuple[float, Callable[[], None]]] = [(float(s), look) for s in range(int(whole_s))]
    events += [(BEFORE_S, kill), (BEFORE_S + outage_s, restart)]
    found = site.feed(
        f"router gone for {outage_s:.0f} s", whole_s, sorted(events, key=lambda event: event[0])
    )
    lines = [
        f"{name}: {kib[0] / 1024:.1f} MiB before, {max(kib) / 1024:.1f} at most"
        for name, kib in memory.items()
    ]
    first = min(ns for _, ns in site.stations[FLEET].got if ns > returned[0])
    lines.append(f"fleet: frames {(first - returned[0]) / 1e9:.1f} s after the router's start")
    return found, lines


def show(rows: list[WayFigures], rate_hz: int) -> Iterator[Table]:
    """Yield the figures as tables."""
    table = Table(title=f"serial byte to ground station, {rate_hz} frames/s, loopback", box=None)
    for column in ("part", "way", "sent", "lost", "twice", "late", "p50 µs", "p99 µs"):
        table.add_column(column, justify="left" if column in ("part", "way") else "right")
    for row in rows:
        cells = (row.part, row.way, row.sent, row.lost, row.twice, row.late)
        table.add_row(*map(str, cells), f"{row.p50_us:,.0f}", f"{row.p99_us:,.0f}")
    yield table


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rate", type=int, default=60, help="IMU frames a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each part")
    parser.add_argument("--outage", type=float, default=0.0, help="seconds without a router")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    options = parser.parse_args()
    console = Console(width=120)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        site = Field(Path(folder), options.rate, stack)
        rows = site.feed("quiet", options.seconds, [])
        fetched, rate = with_fetch(site, options.seconds)
        rows += fetched
        lines = [f"fetched at {rate / 1e6:.1f} MB/s"]
        if options.outage:
            found, more = through_an_outage(site, options.outage)
            rows, lines = rows + found, lines + more
    for each in show(rows, options.rate):
        console.print(each)
    for line in lines:
        console.print(line)
    if options.json:
        report = {"rows": [asdict(row) for row in rows], "lines": lines}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
