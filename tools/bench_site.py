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

import contextlib
import os
import select
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from tests.ports import free_port
from tools.bench_fleet import SETTLE_S, START_S, Servers, Station, free_locator, wait_for
from tools.bench_latency import frames
from tools.harness import MAVGATE, SerialLine, arguments, memory_mb, port_of, show, write_json

DIRECT, TCP, FLEET = "UDP, plain hub", "TCP, plain hub", "fleet"
SETTLED = 100
"""Successive frames that all three must receive before the measurement."""
DRAIN_S = 1.0
BEFORE_S, AFTER_S = 5.0, 10.0
"""Measured time before and after the outage."""
LATE_US = 1e6
"""Delay from which a frame counts as late."""
RECORDING_BYTES = 2 << 30
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
Row = tuple[object, ...]
Events = list[tuple[float, Callable[[], object]]]


class Field:
    """The site, its line, its three ground stations, the router and the fleet."""

    def __init__(self, folder: Path, rate_hz: int, servers: Servers) -> None:
        self.home, self.locator, self.servers = folder, free_locator(), servers
        self._rate_hz, self._frames, self._line = rate_hz, frames(rate_hz), SerialLine()
        os.set_blocking(self._line.master, False)
        self.router = servers.router(self.locator)
        direct, far = (Station(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION) for _ in range(2))
        url = f"udp:127.0.0.1:{port_of(far.sock)}"
        self.fleet = servers.fleet(folder, self.locator, "field", url)
        recordings, config, tcp_port = folder / "recordings", folder / "bench.toml", free_port()
        recordings.mkdir()
        with (recordings / "bench_01.tlog").open("wb") as file:
            file.truncate(RECORDING_BYTES)
        config.write_text(
            CONFIG.format(
                udp=port_of(direct.sock), tcp=tcp_port, locator=self.locator, recordings=recordings
            )
        )
        words = ("run", "--plain", "--config", str(config), "--port", self._line.device)
        self.site = servers.start(*MAVGATE[1:], *words)
        self.stations = {DIRECT: direct, FLEET: far}
        self._await([DIRECT])
        near = socket.create_connection(("127.0.0.1", tcp_port))
        near.setblocking(False)
        self.stations[TCP] = Station(direct.message_id, sock=near)
        self._await([*self.stations])

    def feed(self, part: str, seconds: float, events: Events) -> list[Row]:
        """Write frames for some time, run what is due, and return the figures of each station."""
        for station in self.stations.values():
            station.got.clear()
        written: list[int] = []
        begin_s = time.monotonic()
        for count in range(round(seconds * self._rate_hz)):
            self._read_until(begin_s + count / self._rate_hz)
            while events and events[0][0] <= count / self._rate_hz:
                events.pop(0)[1]()
            written.append(time.monotonic_ns())
            os.write(self._line.master, next(self._frames))
        self._read_until(time.monotonic() + DRAIN_S)
        direct = self.stations[DIRECT].got
        if len(direct) != len(written):
            raise RuntimeError(f"{len(written)} frames gave {len(direct)} datagrams")
        times = {vehicle_ms: ns for (vehicle_ms, _), ns in zip(direct, written, strict=True)}
        return [(part, way, *figures(times, each.got)) for way, each in self.stations.items()]

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

    def _await(self, ways: Sequence[str]) -> None:
        limit_s, got = time.monotonic() + START_S, self.stations
        while any(len(got[way].got) < SETTLED for way in ways):
            if time.monotonic() > limit_s or self.site.poll() is not None:
                raise RuntimeError(f"nothing comes by {ways}")
            # The line is full until the site reads it.
            with contextlib.suppress(BlockingIOError):
                os.write(self._line.master, next(self._frames))
            self._read_until(time.monotonic() + 1 / self._rate_hz)
        self._read_until(time.monotonic() + SETTLE_S)


def figures(written: dict[int, int], got: list[tuple[int, int]]) -> Row:
    """Compare the received with the written frames, by the vehicle's time in them."""
    late_us = [(ns - written[key]) / 1000 for key, ns in got if key in written]
    received = {key for key, _ in got}
    late = sum(each > LATE_US for each in late_us) + len(got) - len(late_us)
    lost, twice = len(written.keys() - received), len(got) - len(received)
    return len(written), lost, twice, late, *map(float, np.percentile(late_us, [50, 99]))


def with_fetch(site: Field, seconds: float) -> tuple[list[Row], str]:
    """Measure while a recording is fetched; also return the rate of the fetch."""
    out = site.home / "fetched"
    words = ("fleet", "recordings", "get", "field", "bench", "-o", str(out))
    fetch = site.servers.start(*MAVGATE[1:], *words, home=site.home)
    part = out / ".bench_01.tlog.part"
    wait_for(part)
    before = part.stat().st_size
    rows = site.feed("while a recording is fetched", seconds, [])
    if fetch.poll() is not None:
        raise RuntimeError("the fetch has ended")
    rate = (part.stat().st_size - before) / (seconds + DRAIN_S)
    fetch.kill()
    return rows, f"fetched at {rate / 1e6:.1f} MB/s"


def through_an_outage(site: Field, outage_s: float) -> tuple[list[Row], list[str]]:
    """Kill the router, start it again, and measure memory."""
    processes = {"site": site.site, "fleet": site.fleet}
    memory: dict[str, list[float]] = {name: [] for name in processes}
    returned_ns: list[int] = []

    def look() -> None:
        for name, process in processes.items():
            memory[name].append(memory_mb(process.pid))

    def restart() -> None:
        site.router.wait()
        site.router = site.servers.router(site.locator)
        returned_ns.append(time.monotonic_ns())

    whole_s = BEFORE_S + outage_s + AFTER_S
    events: Events = [(float(s), look) for s in range(int(whole_s))]
    events += [(BEFORE_S, lambda: site.router.send_signal(signal.SIGKILL))]
    events += [(BEFORE_S + outage_s, restart)]
    rows = site.feed(
        f"router gone for {outage_s:.0f} s", whole_s, sorted(events, key=lambda e: e[0])
    )
    lines = [f"{name}: {mb[0]:.1f} MB before, {max(mb):.1f} at most" for name, mb in memory.items()]
    first_ns = min(ns for _, ns in site.stations[FLEET].got if ns > returned_ns[0])
    after_s = (first_ns - returned_ns[0]) / 1e9
    return rows, [*lines, f"fleet: frames {after_s:.1f} s after the router's start"]


def main() -> None:
    """Run the benchmark."""
    parser = arguments(__doc__, seconds=20.0)
    parser.add_argument("--rate", type=int, default=60, help="IMU frames a second")
    parser.add_argument("--outage", type=float, default=0.0, help="seconds without a router")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, Servers() as servers:
        site = Field(Path(folder), options.rate, servers)
        rows = site.feed("idle", options.seconds, [])
        fetched, rate = with_fetch(site, options.seconds)
        rows, lines = rows + fetched, [rate]
        if options.outage:
            found, more = through_an_outage(site, options.outage)
            rows, lines = rows + found, lines + more
    show(
        f"serial byte to ground station, {options.rate} frames/s, loopback",
        ("part", "way", "sent", "lost", "twice", "late", "p50 µs", "p99 µs"),
        rows,
    )
    print(*lines, sep="\n")
    write_json(options, {"rows": rows, "lines": lines})


if __name__ == "__main__":
    main()
