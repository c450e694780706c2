"""Measure recordings: opening and seeking, replay, and the cost of recording.

Each figure is compared with pymavlink's `mavlogfile`, which MAVProxy and mavlogdump use, in the
same run, on the same file. No network is needed.

    python tools/bench_flightlog.py [--messages 1000000] [--json FILE]
"""

import argparse
import asyncio
import contextlib
import json
import math
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from gateway.clock import GatewayClock, unix_time_us
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.live.player_edge import PlayerEdge
from gateway.live.recorder import Recorder
from gateway.live.session import RecordingSettings
from gateway.recordings.opening import TlogFile
from gateway.recordings.play import AS_FAST_AS_POSSIBLE, Player, Track
from gateway.recordings.table import TableHeader
from gateway.recordings.tlog import encode_record
from gateway.records import (
    FusedSample,
    ImuFlags,
    ImuRaw,
    ImuSample,
    NavFlags,
    NavState,
    NodeId,
    Outgoing,
)
from gateway.wire.mavlink_splitter import message_id_of

START_US = 1_781_187_930_000_000
STEP_US = 7_000
SEEKS = 100
CLIENTS = 4
REPLAYED = 200_000
RECORDED = 100_000
FUSED = 20_000


def make_frames(count: int) -> list[bytes]:
    """Pack the mix of messages that the gateway sends."""
    mav = mavlink.MAVLink(None, 1, 1)
    frames = []
    for i in range(count):
        message = (
            mavlink.MAVLink_attitude_quaternion_message(7 * i, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            mavlink.MAVLink_attitude_message(7 * i, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            mavlink.MAVLink_global_position_int_message(7 * i, i, i, i, i, 1, 2, 3, 4),
            mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3),
        )[i % 4]
        frames.append(bytes(message.pack(mav)))
        mav.seq = (mav.seq + 1) % 256
    return frames


def write_tlog(path: Path, count: int) -> None:
    """Write a tlog of `count` messages."""
    frames = make_frames(1024)
    with path.open("wb") as file:
        for begin in range(0, count, 1024):
            piece = (
                encode_record(START_US + i * STEP_US, frames[i % 1024])
                for i in range(begin, min(begin + 1024, count))
            )
            file.write(b"".join(piece))


def flight_frames(second: int, imu_hz: int = 10) -> list[bytes]:
    """Pack the frames that the gateway sends in one second at its default rates, in 50 steps.

    `imu_hz` is 10 or 50.
    """
    mav = mavlink.MAVLink(None, 1, 1)
    frames = []
    for step in range(50):
        ms, x = 1000 * second + 20 * step, math.sin(second + step / 50)
        q = (1.0, 0.1 * x, 0.2, 0.3)
        messages = [
            mavlink.MAVLink_attitude_quaternion_message(ms, *q, 0.4, 0.5, x),
            mavlink.MAVLink_attitude_message(ms, 0.1, x, 0.3, 0.4, 0.5, 0.6),
        ]
        if step % 5 and imu_hz == 50:
            accel, gyro, mag = (0.1, x, -9.81), (0.01 * x, 0.02, 0.03), (0.2, 0.01, 0.4)
            air = (950.0 + x, 0.0, 500.0, 21.5)
            messages.append(
                mavlink.MAVLink_highres_imu_message(1000 * ms, *accel, *gyro, *mag, *air, 511)
            )
        if step % 5 == 0:
            place = (471_000_000 + ms, 85_000_000 - ms, 500_000, 60_000)
            accel, gyro, mag = (0.1, x, -9.81), (0.01 * x, 0.02, 0.03), (0.2, 0.01, 0.4)
            air = (950.0 + x, 0.0, 500.0, 21.5)
            messages += [
                mavlink.MAVLink_global_position_int_message(ms, *place, 100, 50, 10, 9000),
                mavlink.MAVLink_vfr_hud_message(20.0, 20.0, 90, 50, 500.0, x),
                mavlink.MAVLink_highres_imu_message(1000 * ms, *accel, *gyro, *mag, *air, 511),
                mavlink.MAVLink_scaled_pressure_message(ms, 950.0 + x, 0.0, 2150),
            ]
        if step % 10 == 0:
            fix = (3, 471_000_000 + ms, 85_000_000 - ms, 500_000, 80, 120, 2000, 9000, 12)
            messages.append(mavlink.MAVLink_gps_raw_int_message(1000 * ms, *fix))
        if step == 0:
            messages.append(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
        frames += [bytes(message.pack(mav)) for message in messages]
    return frames


def write_flight(path: Path, count: int, imu_hz: int = 10) -> None:
    """Write the tlog of a flight, of at least `count` messages."""
    written, second = 0, 0
    with path.open("wb") as file:
        while written < count:
            frames = flight_frames(second, imu_hz)
            begin_us, step_us = START_US + second * 1_000_000, 1_000_000 // len(frames)
            file.writelines(encode_record(begin_us + i * step_us, f) for i, f in enumerate(frames))
            written, second = written + len(frames), second + 1


def cpu_of(*command: str) -> float:
    """Run a program and return its processor time."""
    return run_of(*command)["cpu_s"]


def measure_files(folder: Path, count: int) -> dict[str, float]:
    """Convert and summarise a flight; the baseline, mavlogdump, prints one of its messages."""
    path, table = folder / "flight.tlog", folder / "flight.csv"
    write_flight(path, count)
    mavgate = (sys.executable, "-m", "gateway.cli")
    dump = str(Path(sys.executable).with_name("mavlogdump.py"))
    # The first run is not measured, since it may write bytecode files.
    write_flight(folder / "tiny.tlog", 1000)
    cpu_of(*mavgate, "convert", str(folder / "tiny.tlog"), "-o", str(folder / "tiny.csv"))
    found = {
        "messages": count,
        "convert_to_csv_cpu_s": cpu_of(*mavgate, "convert", str(path), "-o", str(table)),
        "info_cpu_s": cpu_of(*mavgate, "info", str(path)),
        "help_cpu_s": cpu_of(*mavgate, "--help"),
        "mavlogdump_to_csv_cpu_s": cpu_of(
            *(sys.executable, dump, "--format", "csv", "--types", "HIGHRES_IMU", str(path))
        ),
    }
    # An autopilot's log on which all estimators run.
    sampled = folder / "sampled.tlog"
    write_flight(sampled, count, imu_hz=50)
    for name, command, ending in (
        ("mcap", "convert", ".mcap"), ("fuse", "fuse", ".csv"), ("page", "report", ".html"),
        ("anonymise", "convert", ".tlog"),
    ):  # fmt: skip
        option = ("--anonymise",) if name == "anonymise" else ()
        out = str(folder / f"{name}{ending}")
        figures = run_of(*mavgate, command, str(sampled), "-o", out, *option)
        found |= {f"{name}_{unit}": figures[unit] for unit in ("cpu_s", "memory_mb")}
    with table.open() as lines:
        found["rows"] = sum(not line.startswith("#") for line in lines) - 1
    return found


HOLE = 2 << 30
"""Bytes of zeros in a sparse file."""


def run_of(*command: str) -> dict[str, float]:
    """Run a program; return its duration, and processor time and peak memory of it and its own."""
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return {
        "s": time.perf_counter() - begin,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "memory_mb": usage.ru_maxrss / 1024,
    }


def measure_edits(folder: Path, count: int) -> dict[str, float]:
    """Filter, cut, merge and renumber a flight; the baseline is mavlogdump's filter."""
    path, out = folder / "flight.tlog", str(folder / "out.tlog")
    if not path.exists():
        write_flight(path, count)
    mavgate = (sys.executable, "-m", "gateway.cli", "convert", "-o", out, "--force", str(path))
    dump = (sys.executable, str(Path(sys.executable).with_name("mavlogdump.py")), "-q", "-o", out)
    sparse = folder / "sparse.tlog"
    with path.open("rb") as file:
        data = file.read(1 << 20)
    with sparse.open("wb") as file:
        file.write(data)
        file.seek(HOLE, os.SEEK_CUR)
        file.write(data)
    runs = {
        "filter": (*mavgate, "--without", "ATTITUDE"),
        "cut": (*mavgate, "--from", "10"),
        "renumber": (*mavgate, "--as", "1:2"),
        "merge_with_itself": (*mavgate, str(path), "--merge"),
        "sparse_2_gb": (*mavgate[:-1], str(sparse), "--without", "ATTITUDE"),
        "mavlogdump_filter": (*dump, "--nottypes", "ATTITUDE", str(path)),
    }
    found: dict[str, float] = {"messages": count}
    for name, command in runs.items():
        figures = run_of(*command)
        found |= {f"{name}_{unit}": figure for unit, figure in figures.items()}
        if not name.startswith("sparse"):
            found[f"{name}_frames_per_s"] = count / figures["s"]
    return found


def timed(job: Callable[[], Any]) -> tuple[float, Any]:
    """Run a job; return its duration and its result."""
    begin = time.perf_counter()
    result = job()
    return time.perf_counter() - begin, result


MEMORY = """
import gc, json, sys
from pathlib import Path
from gateway.recordings.opening import TlogFile

def memory_kb():
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {row[0].rstrip(":"): int(row[1]) for row in lines if row[0][:2] in ("Vm", "Rs")}

tiny = TlogFile(Path(sys.argv[1]))
gc.collect()
Path("/proc/self/clear_refs").write_text("5")
before = memory_kb()
long = TlogFile(Path(sys.argv[2]))
after = memory_kb()
own, peak = (after["RssAnon"] - before["RssAnon"]) / 1024, (after["VmHWM"] - before["VmRSS"]) / 1024
print(json.dumps({"memory_kept_mb": own, "memory_at_most_with_the_mapped_file_mb": peak}))
"""


def memory_of_opening(path: Path) -> dict[str, float]:
    """Measure in a process that has opened only a tiny file, so that no freed memory is reused.

    The kernel's record of the peak is reset before.
    """
    tiny = path.with_name("tiny.tlog")
    write_tlog(tiny, 16)
    command = [sys.executable, "-c", MEMORY, str(tiny), str(path)]
    found: dict[str, float] = json.loads(subprocess.check_output(command))
    return found


def measure_index(path: Path, count: int) -> dict[str, float]:
    """Open and seek, ours and pymavlink's."""
    # Read the file into the page cache for all programs.
    TlogFile(path).close()
    open_s, file = timed(lambda: TlogFile(path))
    assert file.index.count == count
    track = Track(file)
    places = np.random.default_rng(1).integers(0, count, SEEKS).tolist()

    def seek_all() -> None:
        for place in places:
            track.seek(START_US + place * STEP_US)
            assert track.peek_us() == START_US + place * STEP_US

    seek_s = timed(seek_all)[0] / SEEKS
    file.close()
    peer_s, _ = timed(lambda: read_until(path, START_US + count // 2 * STEP_US))
    mapped_s, mapped = timed(lambda: mavutil.mavmmaplog(str(path)))
    mapped.close()
    return {
        "messages": count,
        "open_s": open_s,
        "seek_s": seek_s,
        **memory_of_opening(path),
        "mavlogfile_open_and_seek_to_the_middle_s": peer_s,
        "times_faster_than_mavlogfile": peer_s / (open_s + seek_s),
        "mavmmaplog_open_s": mapped_s,
        "times_faster_than_mavmmaplog": mapped_s / open_s,
    }


def read_until(path: Path, time_us: int) -> None:
    """Seek like `mavlogfile`: by reading up to the time."""
    log = mavutil.mavlogfile(str(path))
    while (message := log.recv_msg()) is not None:
        if round(message._timestamp * 1e6) >= time_us:  # noqa: SLF001
            break
    log.close()


class Counter:
    """Clients in a separate process that count received datagrams."""

    def __init__(self) -> None:
        self.sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(CLIENTS)]
        for place in self.sockets:
            place.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
            place.bind(("127.0.0.1", 0))
        self.ports = [place.getsockname()[1] for place in self.sockets]
        self._read, self._write = os.pipe()
        self.process = os.fork()
        if self.process == 0:
            self._count()

    def _count(self) -> None:
        """Count, in the child, until a second without data."""
        got = 0
        while True:
            ready, _, _ = select.select(self.sockets, [], [], 1.0 if got else 60.0)
            if not ready:
                break
            for place in ready:
                with contextlib.suppress(BlockingIOError):
                    while True:
                        place.recv(2048, socket.MSG_DONTWAIT)
                        got += 1
        os.write(self._write, str(got).encode())
        os._exit(0)

    def result(self) -> int:
        """Return the number of received datagrams."""
        got = int(os.read(self._read, 32))
        os.waitpid(self.process, 0)
        for place in self.sockets:
            place.close()
        return got


def measure_replay(path: Path) -> dict[str, float]:
    """Play as fast as possible to UDP clients; the baseline is a loop that only sends."""
    counter = Counter()
    sent_s, sent = asyncio.run(play_all(path, counter.ports))
    delivered = counter.result()
    plain = Counter()
    frames = make_frames(1024)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as place:

        def send_all() -> None:
            for i in range(sent):
                for port in plain.ports:
                    place.sendto(frames[i % 1024], ("127.0.0.1", port))

        plain_s = timed(send_all)[0]
    plain.result()
    return {
        "clients": CLIENTS,
        "messages": sent,
        "messages_per_s": sent / sent_s,
        "datagrams_per_s": CLIENTS * sent / sent_s,
        "share_delivered": delivered / (CLIENTS * sent),
        "plain_sendto_loop_messages_per_s": sent / plain_s,
    }


async def play_all(path: Path, ports: list[int]) -> tuple[float, int]:
    """Play a tlog to the ports; return the duration and the number of frames sent."""
    clock = GatewayClock()
    hub = Hub(
        HubSettings(endpoints=tuple(f"udp:127.0.0.1:{port}" for port in ports)),
        lambda _: None,
        clock,
    )
    hub.start()
    file = TlogFile(path)
    ended = asyncio.Event()
    player = Player([Track(file)], clock(), speed=AS_FAST_AS_POSSIBLE)

    def emit(frames: Iterable[bytes]) -> None:
        hub.send_all(Outgoing(frame, message_id_of(frame)) for frame in frames)

    edge = PlayerEdge(player, emit, clock, on_end=ended.set)
    begin = time.perf_counter()
    edge.start()
    await ended.wait()
    elapsed = time.perf_counter() - begin
    hub.close()
    file.close()
    return elapsed, player.sent


def measure_recording(folder: Path) -> dict[str, float]:
    """Record frames and fused samples; the time of the disk is reported separately."""
    return asyncio.run(record_all(folder))


async def record_all(folder: Path) -> dict[str, float]:
    """Measure the cost of one frame and of one sample on the event loop."""
    settings = RecordingSettings(folder=str(folder), mode="always", free_floor_mb=0)
    recorder = Recorder(
        settings, GatewayClock(), unix_time_us, lambda _: TableHeader(), lambda _, __: None
    )
    recorder.start()
    await recorder.settle()
    frames = make_frames(1024)
    cpu = time.thread_time()
    for i in range(RECORDED):
        recorder.frame(frames[i % 1024])
    frame_s = (time.thread_time() - cpu) / RECORDED
    await recorder.settle()
    samples = [make_sample(i) for i in range(1024)]
    cpu = time.thread_time()
    for i in range(FUSED):
        recorder.flight(samples[i % 1024])
    sample_s = (time.thread_time() - cpu) / FUSED
    await recorder.settle()
    recorder.close()
    sizes = {path.suffix: path.stat().st_size for path in folder.iterdir()}
    return {
        "us_per_frame": frame_s * 1e6,
        "bytes_per_frame": sizes[".tlog"] / RECORDED,
        "us_per_sample": sample_s * 1e6,
        "bytes_per_sample": sizes[".csv"] / FUSED,
    }


def make_sample(i: int) -> FusedSample:
    """Make a sample with floats of full length, like real ones."""
    x = math.sin(i) / 3
    v = (x, x * x, -x)
    raw = ImuRaw(
        *(10_000 * i, NodeId(1, 0), 10_000 * i, (i, -i, 4096), (i, i, i), (1, 2, 3)),
        *(500, 8, 500, 1090, ImuFlags.MAG_NEW),
    )
    sample = ImuSample(10_000 * i, v, v, v, 21.5 + x, ImuFlags.MAG_NEW)
    q = (math.cos(x), math.sin(x), x, x)
    flags = NavFlags.ATTITUDE_VALID
    state = NavState(10_000 * i, q, v, 47.0 + x, 8.0 + x, 430.0 + x, v, v, v, v, flags)
    return FusedSample(1, raw, sample, state)


def show(title: str, figures: dict[str, float]) -> None:
    """Print one group of figures."""
    print(title)
    for name, value in figures.items():
        text = f"{value:,}" if isinstance(value, int) else f"{value:,.6g}"
        print(f"  {name.replace('_', ' '):<45}{text:>15}")


def main() -> None:
    """Measure and print all, and write the figures to a file if requested."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--files", action="store_true", help="only convert and summarise")
    parser.add_argument("--edits", action="store_true", help="only make tlogs of tlogs")
    args = parser.parse_args()
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory(prefix="mavgate-bench-") as name:
        folder = Path(name)
        if not args.files:
            results["edits"] = measure_edits(folder, args.messages)
            show("Tlogs made of tlogs", results["edits"])
        if args.edits:
            return
        results["files"] = measure_files(folder, args.messages)
        show("Files: processor time of each command", results["files"])
        if args.files:
            return
        short = folder / "short.tlog"
        write_tlog(short, REPLAYED)
        results["replay"] = measure_replay(short)
        show("Replay as fast as possible to UDP clients", results["replay"])
        results["recording"] = measure_recording(folder / "recordings")
        show("Recording: processor time on the event loop", results["recording"])
        long = folder / "long.tlog"
        write_tlog(long, args.messages)
        results["index"] = measure_index(long, args.messages)
        show("Open and seek", results["index"])
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
