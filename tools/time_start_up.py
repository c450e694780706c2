"""Time how soon ground stations are through their start-up with a running `mavgate demo`.

    python tools/time_start_up.py

Starts the demo on free ports and prints seconds of wall clock: the scripted QGroundControl over UDP
and TCP, as MAVLink 1 and 2, the best of five each; and MAVProxy from its heartbeat to the last
parameter. The baseline, in the same run, is the round trip of one PING.
"""

import re
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from tests.end_to_end.processes import START_LIMIT_S, Gateway
from tests.end_to_end.station import Station
from tests.end_to_end.test_demo import MavProxy
from tests.end_to_end.test_ground_stations import CONFIG
from tests.vehicle.test_start_up import qgroundcontrol

REPEATS = 5


def connect(kind: int, port: int, version: int) -> Station:
    """Connect to the gateway as soon as it listens and has a vehicle."""
    deadline_s = time.monotonic() + START_LIMIT_S
    while time.monotonic() < deadline_s:
        try:
            station = Station(kind, port, version)
        except OSError:
            time.sleep(0.2)
            continue
        try:
            station.until_heard(1.0)
        except (AssertionError, OSError):
            station.close()
        else:
            return station
    raise SystemExit("no vehicle")


def timed(work: Callable[[], object]) -> float:
    """Measure seconds of wall clock."""
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


def time_station(station: Station) -> tuple[float, float]:
    """Measure one round trip and one start-up."""
    ping = mavlink.MAVLink_ping_message(0, 0, 0, 0)
    try:
        return timed(lambda: station.ask(ping, "PING")), timed(lambda: qgroundcontrol(station))
    finally:
        station.close()


def time_stations(port: int) -> None:
    """Print the scripted ground station's times."""
    for kind, name in ((socket.SOCK_DGRAM, "UDP"), (socket.SOCK_STREAM, "TCP")):
        for version in (2, 1):
            times = [time_station(connect(kind, port, version)) for _ in range(REPEATS)]
            pings, starts = zip(*times, strict=True)
            print(
                f"QGroundControl's questions, {name}, MAVLink {version}: {min(starts):.3f} s "
                f"(worst {max(starts):.3f} s; one ping {min(pings) * 1e3:.1f} ms)"
            )


def time_mavproxy(port: int, folder: Path) -> None:
    """Print how long MAVProxy takes to load all parameters."""
    mavproxy = MavProxy(port, folder)
    try:
        mavproxy.until(r"online system 1")
        seconds = timed(lambda: mavproxy.until(r"Received \d+ parameters"))
    finally:
        mavproxy.process.kill()
        mavproxy.process.communicate(timeout=10)
    found = re.search(r"Received (\d+) parameters", mavproxy.output)
    count = found.group(1) if found else "no"
    print(f"MAVProxy, {count} parameters: {seconds:.2f} s from its first heartbeat")


def main() -> None:
    """Start the demo, measure, stop it."""
    with tempfile.TemporaryDirectory() as folder:
        gateway = Gateway(Path(folder), "demo", config=CONFIG)
        try:
            time_stations(gateway.listen_port)
            time_mavproxy(gateway.port, Path(folder))
        finally:
            gateway.stop()


if __name__ == "__main__":
    main()
