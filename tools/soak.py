"""Run `mavgate run` for long with disturbances of its computer, and report gaps of every stream.

A simulated receiver feeds the gateway over a pseudo-terminal. At random times, which may coincide,
the process is stopped, the port is disconnected, the disk of the recordings is full, or the civil
clock steps. The longest gap of each message is printed with the disturbances during it. A gap of
more than 7 s that exceeds its disturbances by more than 2 s ends the program with status 1.

The full disk, a small tmpfs, needs root; the clock steps need a C compiler. Without these, the
disturbances are omitted.
"""

import argparse
import asyncio
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
from rich.progress import Progress

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.cli.live.demo import made_ahead
from gateway.live.pty_port import PtyPort
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from tests.kit.process import Process
from tests.ports import free_port

MAX_GAP_S = 7.0
MAX_UNEXPLAINED_S = 2.0
MAX_DISTURBANCE_S = 5.0
REOPENING_S = 1.5
"""Longest time to find a lost port, which the gateway searches at least every second."""
DISK = "8m"
STREAMS = (
    "HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "VFR_HUD", "HIGHRES_IMU",
    "GPS_RAW_INT", "SCALED_PRESSURE", "SYS_STATUS",
)  # fmt: skip
CLOCK = Path(__file__).resolve().parent.parent / "tests/end_to_end/wrong_clock.c"

CONFIG = """
[serial]
port = "{port}"

[hub]
endpoints = ["udp:127.0.0.1:{client}"]

[recording]
mode = "always"
folder = "{recordings}"
free_floor_mb = 0
rotate_mb = 1
"""


@dataclass(slots=True)
class Disturbance:
    """One disturbance, in seconds since the start."""

    name: str
    begin_s: float
    end_s: float

    def overlaps(self, gap: "Gap") -> bool:
        """Return whether the disturbance, or the search for the port after it, overlaps a gap."""
        return self.begin_s < gap.end_s and self.end_s + REOPENING_S > gap.begin_s


@dataclass(slots=True)
class Gap:
    """A time without a message."""

    begin_s: float = 0.0
    end_s: float = 0.0

    @property
    def length_s(self) -> float:
        """Duration of the gap."""
        return self.end_s - self.begin_s

    def unexplained_s(self, during: list[Disturbance]) -> float:
        """Return the part of the gap that no disturbance covers."""
        left_s, now_s = 0.0, self.begin_s
        for disturbance in sorted(during, key=lambda d: d.begin_s):
            left_s += max(0.0, disturbance.begin_s - now_s)
            reopening_s = REOPENING_S if disturbance.name == "port pulled" else 0.0
            now_s = max(now_s, disturbance.end_s + reopening_s)
        return left_s + max(0.0, self.end_s - now_s)


@dataclass
class Listener(asyncio.DatagramProtocol):
    """A client that notes the arrival of each message, and texts."""

    begin_s: float
    last_s: dict[int, float] = field(default_factory=dict)
    gaps: dict[int, list[Gap]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    texts: list[str] = field(default_factory=list)

    def datagram_received(self, data: bytes, _address: object) -> None:
        """Note the messages of one datagram."""
        now_s = time.monotonic() - self.begin_s
        while len(data) >= 12:
            message_id = int.from_bytes(data[7:10], "little")
            if message_id == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                text = data[11 : min(10 + data[1], 61)].partition(b"\0")[0].decode()
                self.texts.append(f"{now_s:8.1f} {text}")
            self.note(message_id, now_s)
            data = data[12 + data[1] :]

    def note(self, message_id: int, now_s: float) -> None:
        """Count a message and store a gap before it."""
        self.counts[message_id] = self.counts.get(message_id, 0) + 1
        self._keep_gap(message_id, now_s)
        self.last_s[message_id] = now_s

    def finish(self) -> None:
        """Store the gap of each message that has not been received again."""
        now_s = time.monotonic() - self.begin_s
        for message_id in self.last_s:
            self._keep_gap(message_id, now_s)

    def _keep_gap(self, message_id: int, now_s: float) -> None:
        gap = Gap(self.last_s.get(message_id, now_s), now_s)
        if gap.length_s > 1.0:
            self.gaps.setdefault(message_id, []).append(gap)


class Receiver:
    """The simulated receiver on a device that is connected repeatedly under one name."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self._frames = made_ahead(simulate(SimulatorSettings(), 0).frames())
        self._begin_s = time.monotonic()
        self._port: PtyPort | None = None

    def plug(self) -> None:
        """Connect the device; the nodes' clocks have continued."""
        elapsed_s = time.monotonic() - self._begin_s
        self._port = PtyPort(self._from(elapsed_s))
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(self._port.path)
        self._port.start()

    def _from(self, begin_s: float) -> Iterator[TimedFrame]:
        for frame in self._frames:
            if frame.time_s >= begin_s:
                yield replace(frame, time_s=frame.time_s - begin_s)

    def pull(self) -> None:
        """Disconnect the device."""
        assert self._port is not None
        self._port.close()
        self._link.unlink(missing_ok=True)


class Gateway:
    """The process under test, with the means to disturb it."""

    def __init__(self, folder: Path, client_port: int) -> None:
        self.folder = folder
        self.disk = folder / "disk"
        self.disk.mkdir()
        self.has_disk = self._mount()
        self.clock = folder / "clock_off"
        self.receiver = Receiver(folder / "receiver")
        environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
        library = self._clock_library()
        if library is not None:
            environment |= {"LD_PRELOAD": str(library), "CLOCK_OFF_FILE": str(self.clock)}
        self.has_clock = library is not None
        config = CONFIG.format(port=folder / "receiver", client=client_port, recordings=self.disk)
        self._running = Process(folder, "run", "--plain", config=config, env=environment)
        self.process = self._running.process

    def _mount(self) -> bool:
        if os.geteuid() != 0:
            return False
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(self.disk)]
        return subprocess.run(mount, check=False, capture_output=True).returncode == 0

    def _clock_library(self) -> Path | None:
        compiler = shutil.which("cc")
        if compiler is None:
            return None
        library = self.folder / "clock.so"
        subprocess.run(
            [compiler, "-shared", "-fPIC", "-o", str(library), str(CLOCK), "-ldl"], check=True
        )
        return library

    async def disturb(self, kind: str, rng: np.random.Generator) -> None:
        """Disturb it for a while."""
        if kind == "stopped":
            self.process.send_signal(signal.SIGSTOP)
            await asyncio.sleep(rng.uniform(0.3, MAX_DISTURBANCE_S))
            self.process.send_signal(signal.SIGCONT)
        elif kind == "port pulled":
            self.receiver.pull()
            await asyncio.sleep(rng.uniform(0.2, MAX_DISTURBANCE_S))
            self.receiver.plug()
        elif kind == "disk full":
            filler = self.disk / "filler"
            with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                while True:
                    file.write(b"\0" * 65536)
            await asyncio.sleep(rng.uniform(1.0, MAX_DISTURBANCE_S))
            filler.unlink()
            for old in sorted(self.disk.rglob("*.*"))[:-4]:
                old.unlink()
        elif kind == "clock step":
            self.clock.write_text(str(int(rng.integers(-7200, 7200))))
            await asyncio.sleep(1.0)

    def close(self) -> None:
        """End it."""
        self.process.send_signal(signal.SIGCONT)
        self._running.end()
        self.receiver.pull()
        if self.has_disk:
            subprocess.run(["umount", "--lazy", str(self.disk)], check=False)


async def soak(options: argparse.Namespace) -> int:
    """Run, print the gaps, and return the exit status."""
    rng = np.random.default_rng(options.seed)
    port = free_port()
    begin_s = time.monotonic()
    listener = Listener(begin_s)
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: listener, local_addr=("127.0.0.1", port)
    )
    folder = Path(tempfile.mkdtemp(prefix="mavgate-soak-"))
    gateway = Gateway(folder, port)
    kinds = ["stopped", "port pulled"]
    kinds += ["disk full"] * gateway.has_disk + ["clock step"] * gateway.has_clock
    found: list[Disturbance] = []

    async def repeat(kind: str) -> None:
        while True:
            await asyncio.sleep(rng.exponential(options.every * len(kinds)))
            start_s = time.monotonic() - begin_s
            await gateway.disturb(kind, rng)
            found.append(Disturbance(kind, start_s, time.monotonic() - begin_s))

    try:
        gateway.receiver.plug()
        tasks = [asyncio.create_task(repeat(kind)) for kind in kinds]
        with Progress() as progress:
            task = progress.add_task("soaking", total=options.seconds)
            while (elapsed_s := time.monotonic() - begin_s) < options.seconds:
                progress.update(task, completed=elapsed_s)
                await asyncio.sleep(1.0)
        for running in tasks:
            if running.done():
                running.result()
            running.cancel()
        listener.finish()
    finally:
        gateway.close()
        transport.close()
    return judge(listener, found, folder)


def judge(listener: Listener, found: list[Disturbance], folder: Path) -> int:
    """Print the longest gap of every stream with its causes, and every gap above the limit."""
    status = 0
    print(f"{len(found)} disturbances; files in {folder}; its log has the stepped clock")
    print(f"{'message':22} {'count':>8} {'gap s':>7} {'at s':>8} {'unexplained s':>14}  cause")
    for name in STREAMS:
        message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
        count = listener.counts.get(message_id, 0)
        gaps = sorted(listener.gaps.get(message_id, []), key=lambda gap: -gap.length_s)
        status |= not count
        for index, gap in enumerate(gaps):
            during = [d for d in found if d.overlaps(gap)]
            left_s = gap.unexplained_s(during)
            is_failure = gap.length_s > MAX_GAP_S and left_s > MAX_UNEXPLAINED_S
            status |= is_failure
            if index == 0 or is_failure:
                cause = ", ".join(f"{d.name} {d.end_s - d.begin_s:.1f} s" for d in during)
                figures = f"{gap.length_s:7.1f} {gap.begin_s:8.1f} {left_s:14.1f}"
                print(f"{name:22} {count:8} {figures}  {cause or 'none'}")
    print("texts:", *listener.texts[-40:], sep="\n  ")
    return int(status)


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--every", type=float, default=20.0, help="mean time between disturbances")
    parser.add_argument("--seed", type=int, default=1)
    raise SystemExit(asyncio.run(soak(parser.parse_args())))


if __name__ == "__main__":
    main()
