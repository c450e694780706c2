"""Use an installed mavgate as its user would, and print figures.

    python3 try_installed.py FOLDER [--recorded FOLDER] [--mavgate COMMAND]

Needs only Python. Flies the demo for some seconds and records it, fuses the recording, plays it,
and forwards numbered frames. Each line of the output is a name and a figure; exit code 1 if
something does not work. FOLDER gets the files; with --recorded the recording of an earlier run is
fused and played, so that the states of two machines can be compared.
"""

import argparse
import contextlib
import csv
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

FLOWN_S = 20.0
FRAMES = 5000
LIMIT_S = 120.0
"""Limit of each wait; an emulated processor needs up to a minute for a start."""
ATTITUDE_QUATERNION, NAMED_VALUE_INT, CRC_EXTRA = 31, 252, 44
TICKS = os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run each part."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recorded", type=Path, help="folder of an earlier run")
    parser.add_argument("--mavgate", default="mavgate", help="the command, with its options")
    options = parser.parse_args()
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    words = options.mavgate.split()
    print("version", run(words, "--version").strip())
    fly(words, folder)
    recorded = options.recorded or folder
    fuse(words, recorded, folder)
    play(words, recorded)
    forward(words, folder)


def fly(words: list[str], folder: Path) -> None:
    """Fly the demo, and record it."""
    options = ("--plain", "--no-panel", "--record", "--endpoint")
    with (
        socket_of_station() as station,
        running(words, folder, "demo", *options, url_of(station)) as process,
    ):
        begin_s = time.monotonic()
        wait_for(station, process)
        print(f"first_datagram_s {time.monotonic() - begin_s:.1f}")
        wait_for(station, process, message=ATTITUDE_QUATERNION)
        begin_s, begin_cpu_s, received = time.monotonic(), cpu_s(process.pid), 0
        while time.monotonic() < begin_s + FLOWN_S:
            received += attitudes_in(station.recv(2048))
        rate = received / FLOWN_S
        print(f"attitudes_per_s {rate:.1f}")
        print(f"cpu_percent {100 * (cpu_s(process.pid) - begin_cpu_s) / FLOWN_S:.1f}")
        expect(rate > 40, "the demo sends 50 attitudes a second")


def fuse(words: list[str], recorded: Path, folder: Path) -> None:
    """Fuse a recording, and compare the states with those of the machine that recorded it."""
    [table] = sorted((recorded / "recordings").glob("*.csv"))[:1]
    output = folder / "fused.csv"
    run(words, "fuse", str(table), "-o", str(output), "--force")
    reference = recorded / "fused.csv"
    if reference != output:
        difference = max_difference(reference, output)
        print(f"fused_difference {difference:.1e}")
        expect(difference <= 1e-12, "fused states equal those of the other machine within 1e-12")


def max_difference(first: Path, second: Path) -> float:
    """Return the maximum relative difference of the numbers of two tables."""
    largest = 0.0
    with first.open() as one, second.open() as other:
        for row, twin in zip(csv.reader(one), csv.reader(other), strict=True):
            for cell, same in zip(row, twin, strict=True):
                if cell != same and not cell.startswith("#"):
                    value = float(cell)
                    largest = max(largest, abs(value - float(same)) / max(abs(value), 1.0))
    return largest


def play(words: list[str], recorded: Path) -> None:
    """Play a recording as fast as possible, and count its attitudes."""
    [tlog] = sorted((recorded / "recordings").glob("*.tlog"))[:1]
    written = attitudes_in(tlog.read_bytes(), time_size=8)
    with socket_of_station() as station:
        command = [*words, "play", str(tlog), "--speed", "10", "--endpoint", url_of(station)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        received = 0
        station.settimeout(1.0)
        while process.poll() is None:
            with contextlib.suppress(TimeoutError):
                received += attitudes_in(station.recv(2048))
    print(f"attitudes_played {received} of {written}")
    expect(received == written > 0, "each recorded attitude is played")


def forward(words: list[str], folder: Path) -> None:
    """Forward numbered frames from one endpoint to another."""
    with socket_of_station() as station, socket_of_station() as vehicle:
        vehicle_url = f"udp-listen:127.0.0.1:{free_port()}"
        ends = ("--endpoint", vehicle_url, "--endpoint", url_of(station))
        config = '[serial]\nport = "none"\n'
        with running(words, folder, "run", "--plain", *ends, config=config) as process:
            vehicle.connect(("127.0.0.1", int(vehicle_url.rpartition(":")[2])))
            vehicle.settimeout(None)
            deadline_s, got = time.monotonic() + LIMIT_S, list[int]()
            while not got and time.monotonic() < deadline_s:
                vehicle_send(vehicle, heartbeat())
                vehicle_send(vehicle, numbered(0))
                got = numbers_in(station, 0.2)
            numbers_in(station, 1.0)
            received = list[int]()
            for number in range(1, FRAMES + 1):
                vehicle_send(vehicle, numbered(number))
                if number % 50 == 0:
                    # No more than the receive buffers hold, as the emulation is slower.
                    while len(received) < number and (more := numbers_in(station, 5.0, once=True)):
                        received += more
            received += numbers_in(station, 1.0)
            print(f"memory_of_router_mb {memory_mb(process.pid):.0f}")
    in_order = received == sorted(received)
    print(f"forwarded {len(received)} of {FRAMES}{'' if in_order else ', not in order'}")
    expect(received == [*range(1, FRAMES + 1)], "each frame is forwarded, in order")


def vehicle_send(vehicle: socket.socket, frame: bytes) -> None:
    """Send a frame, although the gateway may not listen yet."""
    with contextlib.suppress(ConnectionRefusedError):
        vehicle.send(frame)


def numbers_in(station: socket.socket, quiet_s: float, *, once: bool = False) -> list[int]:
    """Return the numbers received until nothing comes for some time, or of one datagram."""
    station.settimeout(quiet_s)
    numbers = list[int]()
    with contextlib.suppress(TimeoutError):
        while not (once and numbers):
            for kind, payload in frames_in(station.recv(2048)):
                if kind == NAMED_VALUE_INT:
                    numbers.append(struct.unpack_from("<i", payload.ljust(8, b"\0"), 4)[0])
    return numbers


def numbered(number: int) -> bytes:
    """Return NAMED_VALUE_INT of system 7 with a number."""
    return frame(NAMED_VALUE_INT, struct.pack("<Ii10s", 1, number, b"number"), CRC_EXTRA, number)


def heartbeat() -> bytes:
    """Return HEARTBEAT of system 7, a quadrotor."""
    return frame(0, struct.pack("<IBBBBB", 0, 2, 0, 0, 4, 3), 50, 0)


def frame(kind: int, payload: bytes, extra: int, sequence: int) -> bytes:
    """Return a frame of MAVLink 2."""
    content = struct.pack(
        "<BBBBBBHB", len(payload), 0, 0, sequence & 0xFF, 7, 1, kind & 0xFFFF, kind >> 16
    )
    content += payload
    crc = 0xFFFF
    for byte in (*content, extra):
        part = (byte ^ crc) & 0xFF
        part = (part ^ part << 4) & 0xFF
        crc = crc >> 8 ^ part << 8 ^ part << 3 ^ part >> 4
    return b"\xfd" + content + crc.to_bytes(2, "little")


def frames_in(data: bytes, *, time_size: int = 0) -> Iterator[tuple[int, bytes]]:
    """Yield message id and payload of each frame of MAVLink 2 in a datagram, or in a tlog."""
    at = time_size
    while at + 12 <= len(data) and data[at] == 0xFD:
        size = data[at + 1]
        yield int.from_bytes(data[at + 7 : at + 10], "little"), data[at + 10 : at + 10 + size]
        at += 12 + size + 13 * (data[at + 2] & 1) + time_size


def attitudes_in(data: bytes, *, time_size: int = 0) -> int:
    """Return the number of ATTITUDE_QUATERNION in a datagram, or in a tlog."""
    return sum(kind == ATTITUDE_QUATERNION for kind, _ in frames_in(data, time_size=time_size))


@contextlib.contextmanager
def running(
    words: list[str], folder: Path, *arguments: str, config: str = ""
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command with settings in a folder, and end it by Ctrl-C's signal."""
    settings = folder / f"{arguments[0]}.toml"
    settings.write_text(f'{config}[recording]\nfolder = "{folder / "recordings"}"\n')
    with (folder / f"{arguments[0]}.log").open("w") as log:
        process = subprocess.Popen(
            [*words, *arguments, "--config", str(settings)],
            stdout=log, stderr=log, env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
        )  # fmt: skip
        try:
            yield process
            process.send_signal(signal.SIGINT)
            process.wait(LIMIT_S)
        finally:
            process.kill()


def run(words: list[str], *arguments: str) -> str:
    """Run a command to its end; return its output."""
    done = subprocess.run([*words, *arguments], capture_output=True, text=True, check=False)
    expect(done.returncode == 0, f"{arguments[0]}: {done.stdout}{done.stderr}")
    return done.stdout


def socket_of_station() -> socket.socket:
    """Return a UDP socket on loopback."""
    station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    station.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
    station.bind(("127.0.0.1", 0))
    station.settimeout(LIMIT_S)
    return station


def free_port() -> int:
    """Return a UDP port that nobody uses."""
    with socket_of_station() as probe:
        return int(probe.getsockname()[1])


def url_of(station: socket.socket) -> str:
    """Return the endpoint that sends to a station."""
    return f"udp:127.0.0.1:{station.getsockname()[1]}"


def wait_for(
    station: socket.socket, process: "subprocess.Popen[bytes]", *, message: int | None = None
) -> None:
    """Wait for a datagram, with a message, of a process."""
    station.settimeout(1.0)
    deadline_s = time.monotonic() + LIMIT_S
    while True:
        expect(process.poll() is None, "the gateway runs; its log is in the folder")
        expect(time.monotonic() < deadline_s, f"the gateway sends within {LIMIT_S:.0f} s")
        with contextlib.suppress(TimeoutError):
            if any(message in (None, kind) for kind, _ in frames_in(station.recv(2048))):
                station.settimeout(LIMIT_S)
                return


def cpu_s(pid: int) -> float:
    """Return the processor time of a process and its threads, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1000


def expect(holds: bool, text: str) -> None:
    """End with exit code 1 unless something holds."""
    if not holds:
        sys.exit(f"failed: {text}")


if __name__ == "__main__":
    main()
