"""Measure the start-up time of the gateway, and of ground stations with it.

    python tools/time_start_up.py
    python tools/time_start_up.py --gateway
    python tools/time_start_up.py --radio

Prints the CPU time of `mavgate --help` and `status`, the best of five; then, for `mavgate run` on a
simulated receiver, the time, CPU time and memory from its call to its first datagram and to its
first attitude. The baselines are an empty Python program, and `mavlogdump.py --help`.

Then it starts the demo and prints elapsed times, s: the scripted QGroundControl over UDP and TCP,
with MAVLink 1 and 2, the best of five each; and MAVProxy from its heartbeat to the last parameter.
The baseline is the round trip of one PING.

With `--radio` the station is on a serial radio instead: a pseudo-terminal that carries 57,600 Bd
each way, with the telemetry of the demo. It reads the description of the parameters by MAVLink FTP
like QGroundControl, both files by bursts, and sends all its requests. The baseline is the same with
the description as plain JSON, computed from its size at the measured rate.
"""

import argparse
import contextlib
import lzma
import os
import re
import resource
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.units import BITS_PER_BYTE
from gateway.vehicle.services.ftp import ACK, Opcode, Packet, decode_packet
from tests.end_to_end.processes import Client, Gateway, MavProxy
from tests.end_to_end.station import Station
from tests.end_to_end.test_ground_stations import CONFIG
from tests.kit.ground_station import qgroundcontrol
from tests.kit.process import START_LIMIT_S

REPEATS = 5
START_UNIX_US = 1_781_187_930_000_000
BAUD = 57_600
FTP_DATA_BYTES = 239
LOST_S = 1.0
RADIO_CONFIG = """
[hub]
endpoints = ["serial:{device}:{baud}", "udp:127.0.0.1:{{port}}"]

[simulator]
gps_first_fix_s = 0.5
"""


def cpu_of(*arguments: str) -> float:
    """Measure the processor time of a Python program; the best of some runs."""
    found = []
    for _ in range(REPEATS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(found)


def process_figures(pid: int) -> str:
    """Return the processor time and the memory of a process and its ended children."""
    text = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    own, waited = (sum(map(int, text[k : k + 2])) / os.sysconf("SC_CLK_TCK") for k in (11, 13))
    status = Path(f"/proc/{pid}/status").read_text()
    resident_mb = int(re.findall(r"VmRSS:\s+(\d+)", status)[0]) / 1024
    return f"CPU {own:.2f} s (and {waited:.2f} s of children), {resident_mb:.0f} MB"


def feed(master: int, frames: Iterable[TimedFrame], began_s: float) -> Iterator[float]:
    """Write the receiver's frames at their own time, and yield the seconds until each.

    Frames that do not fit because earlier ones are unread are dropped.
    """
    for frame in frames:
        while (early_s := began_s + frame.time_s - time.monotonic()) > 0.0:
            yield early_s
        if select.select([], [master], [], 0.0)[1]:
            os.write(master, frame.data)


def time_run(folder: Path) -> None:
    """Print the time and cost of a gateway's start with a connected receiver."""
    master, slave = os.openpty()
    tty.setraw(slave)
    frames = simulate(SimulatorSettings(gps_first_fix_s=0.5), START_UNIX_US).frames()
    began_s = time.monotonic()
    gateway = Gateway(folder, "run", "--port", os.ttyname(slave), config=CONFIG)
    client = Client(gateway.port)
    wanted = ["HEARTBEAT", "ATTITUDE"]
    try:
        for early_s in feed(master, frames, began_s):
            if not select.select([client.sock], [], [], early_s)[0]:
                continue
            names = {message.get_type() for message in client.receive()}
            while wanted and wanted[0] in names:
                print(
                    f"mavgate run to {wanted.pop(0)}: "
                    f"{time.monotonic() - began_s:.2f} s, {process_figures(gateway.process.pid)}"
                )
            if not wanted:
                break
    finally:
        gateway.end()
        client.sock.close()
        os.close(master)
        os.close(slave)


def time_gateway(folder: Path) -> None:
    """Print the costs of small commands and starts, and of the baselines."""
    mavgate, dump = ("-m", "gateway.cli"), str(Path(sys.executable).with_name("mavlogdump.py"))
    print(f"python -c pass: CPU {cpu_of('-c', 'pass'):.2f} s")
    print(f"mavlogdump.py --help: CPU {cpu_of(dump, '--help'):.2f} s")
    print(f"mavgate --help: CPU {cpu_of(*mavgate, '--help'):.2f} s")
    gateway = Gateway(folder, "demo", config=CONFIG)
    try:
        connect(socket.SOCK_STREAM, gateway.listen_port, 2).close()
        print(f"mavgate status: CPU {cpu_of(*mavgate, 'status'):.2f} s")
    finally:
        gateway.end()
    time_run(folder)


def connect(kind: int, port: int, version: int) -> Station:
    """Connect to the gateway as soon as it listens and has a vehicle."""
    deadline_s = time.monotonic() + START_LIMIT_S
    while time.monotonic() < deadline_s:
        try:
            station = Station.connect(kind, port, version)
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
    """Measure the elapsed time of a function, s."""
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
    """Print the time in which MAVProxy loads all parameters."""
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


class Radio:
    """A pseudo-terminal and a socket, with a line of limited bandwidth between them."""

    def __init__(self, baud: int) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.device = os.ttyname(self.slave)
        self.station_side, self._inner = socket.socketpair()
        self._inner.setblocking(False)
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        began_s, carried, up = time.monotonic(), 0, b""
        while not self._ended.wait(0.005):
            room = int((time.monotonic() - began_s) * self._bytes_per_s) - carried
            carried += room
            with contextlib.suppress(BlockingIOError):
                self._inner.send(os.read(self.master, room))
            with contextlib.suppress(BlockingIOError):
                up += self._inner.recv(4096)
            up = up[os.write(self.master, up[:room]) :]

    def close(self) -> None:
        """End the line."""
        self._ended.set()
        self._thread.join()
        self._inner.close()
        os.close(self.master)
        os.close(self.slave)


def ftp_packets(messages: list[Any]) -> list[Packet]:
    """Return the FTP packets among some messages."""
    found = (m for m in messages if m.get_type() == "FILE_TRANSFER_PROTOCOL")
    return [decode_packet(bytes(message.payload)) for message in found]


def read_file(station: Station, path: bytes) -> bytes:
    """Read a file by MAVLink FTP in bursts, with a new request after the end or loss of a burst."""
    sequence = 0

    def ask(opcode: int, session: int, data: bytes = b"", **fields: int) -> list[Packet]:
        nonlocal sequence
        sequence += 1
        size, offset = fields.get("size", len(data)), fields.get("offset", 0)
        packet = Packet(sequence, session, opcode, size, 0, 0, offset, data)
        message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, packet.encode())
        return ftp_packets(station.ask(message, "FILE_TRANSFER_PROTOCOL"))

    [opened] = ask(Opcode.OPEN_FILE_RO, 0, path)
    if opened.opcode != ACK:
        raise SystemExit(f"{path.decode()} cannot be read")
    (size,) = struct.unpack("<I", opened.data)
    content = b""
    while len(content) < size:
        pieces = ask(
            Opcode.BURST_READ_FILE, opened.session, size=FTP_DATA_BYTES, offset=len(content)
        )
        heard_s = time.monotonic()
        while len(content) < size and time.monotonic() - heard_s < LOST_S:
            for piece in pieces:
                if piece.offset == len(content):
                    content += piece.data[: piece.size]
                    heard_s = time.monotonic()
            if len(content) < size:
                pieces = ftp_packets(station.wait(0.005))
    ask(Opcode.TERMINATE_SESSION, opened.session)
    return content


def time_radio(folder: Path) -> None:
    """Print the time in which a station on a serial radio loads parameters and description."""
    radio = Radio(BAUD)
    config = RADIO_CONFIG.format(device=radio.device, baud=BAUD)
    gateway = Gateway(folder, "demo", config=config)
    station = Station(radio.station_side)
    try:
        station.until_heard()
        station.wait(5.0)  # telemetry settles at the rate of the line
        files: dict[str, bytes] = {}
        general_s = timed(lambda: files.update(general=read_file(station, b"/general.json")))
        described_s = timed(
            lambda: files.update(parameters=read_file(station, b"/parameter.json.xz"))
        )
        asked_s = timed(lambda: qgroundcontrol(station))
    finally:
        gateway.end()
        radio.close()
        station.close()
    packed, plain = len(files["parameters"]), len(lzma.decompress(files["parameters"]))
    print(f"general.json, {len(files['general'])} bytes: {general_s:.1f} s")
    print(f"parameter.json.xz, {packed} bytes: {described_s:.1f} s")
    print(f"other questions, parameters and missions: {asked_s:.1f} s")
    print(f"ready after {general_s + described_s + asked_s:.1f} s at {BAUD} Bd")
    plain_s = general_s + described_s * plain / packed + asked_s
    print(f"with {plain} bytes of plain JSON: {plain_s:.1f} s")


def main() -> None:
    """Start the demo, measure, stop it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gateway", action="store_true", help="only the gateway's own start")
    parser.add_argument("--radio", action="store_true", help="only a station on a serial radio")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        if options.radio:
            time_radio(Path(folder))
            return
        time_gateway(Path(folder))
        if options.gateway:
            return
        gateway = Gateway(Path(folder), "demo", config=CONFIG)
        try:
            time_stations(gateway.listen_port)
            time_mavproxy(gateway.port, Path(folder))
        finally:
            gateway.end()


if __name__ == "__main__":
    main()
