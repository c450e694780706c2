"""Find pauses of the gateway's loop in a demo, while ground stations connect and disconnect.

    python -m tools.bench_pauses --minutes 60

The demo simulates aircraft, records all data in files that are soon full, serves metrics, and has
clients over UDP and TCP that send every request of a ground station's start, stay for some seconds
and leave. Printed are the longest turns of its loop, without the time used by the machine: first
until all aircraft send, then during telemetry. The baseline, which runs at the same time, is a loop
that does the same work in every turn.
"""

import asyncio
import contextlib
import os
import random
import sys
import tempfile
import urllib.request
from multiprocessing.connection import Connection
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from gateway.analysis.processes import begin_copy
from gateway.cli.live.demo import calibrated_aircraft, made_ahead
from gateway.cli.live.run import loop_comes_first
from gateway.clock import unix_time_us
from gateway.compiled.entry_point import load_entry_points
from gateway.config import load
from gateway.live.daemon import Daemon
from gateway.simulator.receiver import simulate
from gateway.vehicle.services.ftp import Opcode
from tests.kit.ground_station import command, ftp_request, to_vehicle
from tests.kit.mavlink import STATION, Sender
from tests.ports import free_ports
from tools.harness import PYTHON, arguments, running, show, write_json
from tools.turns import LONG_US, TurnWatch, even_turns

CONFIG = """
aircraft_folder = "{folder}"
[hub]
endpoints = ["udp-listen:127.0.0.1:{udp}", "tcp-listen:127.0.0.1:{tcp}", "udp:localhost:9"]
metrics_port = {metrics}
idle_timeout_s = 5.0
[recording]
mode = "always"
folder = "{folder}/recordings"
rotate_mb = 1.0
[simulator]
vehicles = {vehicles}
"""
"""Everything that may delay the loop; a file of 1 MB is full several times a minute."""
STATIONS = 6
"""Number of stations at a time."""
LONGEST_STAY_S = 8.0
SCRAPE_S = 5.0
Rows = list[tuple[object, ...]]
HEADS = ("loop", "own ms", "of ms", "at s", "longest callback", "turns", f"above {LONG_US:.0f} µs")


def questions() -> list[bytes]:
    """Encode the requests of a ground station at its start."""
    station = Sender(200, STATION)
    messages = [
        to_vehicle("PARAM_REQUEST_LIST"),
        to_vehicle("MISSION_REQUEST_LIST", 0),
        command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
        command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000),
        ftp_request(Opcode.OPEN_FILE_RO, b"/general.json"),
        ftp_request(Opcode.BURST_READ_FILE),
    ]
    return [station.heartbeat(), *map(station.pack, messages)]


async def visit_udp(port: int, stay_s: float) -> None:
    """Connect by UDP, send the requests, and leave."""
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=("127.0.0.1", port)
    )
    for question in questions():
        transport.sendto(question)
    for _ in range(round(stay_s)):
        await asyncio.sleep(1.0)
        transport.sendto(Sender(200, STATION).heartbeat())
    transport.close()


async def visit_tcp(port: int, stay_s: float) -> None:
    """Do the same by TCP."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.writelines(questions())
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(stay_s):
            while await reader.read(65536):
                pass
    writer.close()


async def visit_all(udp: int, tcp: int, metrics: int) -> None:
    """Run stations one after another, some at a time, and read the gateway's metrics."""

    async def come_and_go() -> None:
        while True:
            stay_s = random.uniform(0.5, LONGEST_STAY_S)
            try:
                await random.choice((visit_udp(udp, stay_s), visit_tcp(tcp, stay_s)))
            except OSError:
                await asyncio.sleep(0.5)

    async def scrape() -> None:
        url = f"http://127.0.0.1:{metrics}/metrics"
        while True:
            await asyncio.sleep(SCRAPE_S)
            await asyncio.to_thread(lambda: urllib.request.urlopen(url, timeout=5).read())

    await asyncio.gather(scrape(), *(come_and_go() for _ in range(STATIONS)))


async def fly(config: Path, watch: TurnWatch, seconds: float) -> Rows:
    """Run the daemon as `mavgate demo` does; return its longest turns."""
    settings = load(config)
    line = made_ahead(simulate(settings.simulator, unix_time_us()).frames())
    daemon = Daemon(settings, calibrated_aircraft(settings), lambda: settings, line)
    with loop_comes_first(daemon.start):
        watch.restart()
        try:
            while len(daemon.snapshot().aircraft) < settings.simulator.vehicles:
                await asyncio.sleep(0.1)
            print(f"longest turn of the start: {watch.longest().own_us / 1e3:.2f} ms")
            watch.restart()
            await asyncio.sleep(seconds)
            return rows_of("gateway", watch)
        finally:
            daemon.close()


def rows_of(name: str, watch: TurnWatch) -> Rows:
    """Return the longest turns of a loop as rows."""
    return [
        (name, turn.own_us / 1e3, turn.wall_us / 1e3, turn.at_s, turn.longest, watch.turns,
         watch.long_turns)
        for turn in sorted(watch.worst, reverse=True)
    ]  # fmt: skip


def send_even_turns(seconds: float, to: Connection) -> None:
    """Send the results of the baseline."""
    to.send(rows_of("even turns", even_turns(seconds)))


def main() -> None:
    """Run, and print the results."""
    parser = arguments(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--vehicles", type=int, default=2)
    parser.add_argument("--stations", type=int, nargs=3, help="only run the stations, to ports")
    options = parser.parse_args()
    if options.stations:
        asyncio.run(visit_all(*options.stations))
    udp, tcp, metrics = ports = free_ports(3)
    load_entry_points()
    with tempfile.TemporaryDirectory() as folder:
        # A separate control socket, not that of a gateway that runs on this machine.
        os.environ["XDG_RUNTIME_DIR"] = folder
        config, vehicles = Path(folder) / "gateway.toml", options.vehicles
        config.write_text(
            CONFIG.format(folder=folder, udp=udp, tcp=tcp, metrics=metrics, vehicles=vehicles)
        )
        baseline, watch = begin_copy(send_even_turns, 60.0 * options.minutes), TurnWatch()
        stations = (PYTHON, "-m", "tools.bench_pauses", "--stations", *map(str, ports))
        with (
            running(*stations) as clients,
            asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner,
        ):
            rows = runner.run(fly(config, watch, 60.0 * options.minutes))
            if clients.poll() is not None:
                sys.exit("the stations have ended")
        rows += baseline.recv()
    show(f"turns of {options.minutes:g} min, {options.vehicles} aircraft", HEADS, rows)
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
