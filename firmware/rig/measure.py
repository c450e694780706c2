"""Print the measured table of firmware/README.md: `python -m firmware.rig.measure`.

Every figure comes from the programs as they run on the bench; the last line says how fast the
bench itself ran.
"""

import argparse
import bisect
import re
import sys
import tempfile
import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from firmware.rig.bench import PS_PER_S, PS_PER_US
from firmware.rig.boards import LORA_PARTS, Board, Parts, Setup
from firmware.rig.build import PROGRAMS, build, make
from firmware.rig.tracker import IMU_CLOCK_PPM, Tracker
from gateway.wire.framing import FrameDecoder
from gateway.wire.payloads import (
    GpsFixPayload,
    ImuPayload,
    NodeStatusPayload,
    RadioFrame,
    decode_content,
)

LOSSES: Final = (0.0, 0.1, 0.3)
STARTED_S: Final = 2.0
"""By then every board runs and the GPS receiver is configured."""
SLICE_S: Final = 0.001
START_UP_US: Final = 900
"""More than the clock starts behind the reset, less than a sample's interval."""
FLASH_BYTES, RAM_BYTES = 32_768, 2_048
SAMPLES: Final = {"imu_node": "IMU sample", "gps_node": "fix", "receiver": "packet"}
_SIZES: Final = re.compile(r"^(\w+) +flash +(\d+) bytes .*static RAM +(\d+) bytes", re.MULTILINE)


@dataclass
class Load:
    """How busy a chip was."""

    awake_cycles: int = 0
    cycles: int = 0
    worst_slice: int = 0
    loop_max_us: int = 0


@dataclass
class Run:
    """Results of one flight at one loss."""

    loss: float
    received: dict[int, int] = field(default_factory=dict)
    """Payloads by node id."""
    lost: dict[int, int] = field(default_factory=dict)
    latency_ms: list[float] = field(default_factory=list)
    """IMU samples: from the sensor to the last byte of the frame."""
    loads: dict[str, Load] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)
    retries: int = 0
    sent: int = 0
    collisions: int = 0
    processor_s: float = 0.0


@dataclass(frozen=True)
class Programs:
    """Build of the programs that is measured."""

    settings: str = ""
    mhz: int = 16
    radio: str = "nrf24"

    @property
    def frequency_hz(self) -> int:
        """The boards' clock."""
        return self.mhz * 1_000_000


def measure(programs: Programs, loss: float, seconds: float) -> Run:
    """Fly with one loss on the air."""
    folder = build(programs.settings, programs.frequency_hz, radio=programs.radio)
    parts = Parts(**LORA_PARTS) if programs.radio == "sx1276" else Parts()
    setup = Setup(seed=1, loss=loss, build=folder, frequency_hz=programs.frequency_hz, parts=parts)
    tracker = Tracker(setup)
    tracker.run_for(STARTED_S)
    run = Run(loss)
    air = tracker.setup.air
    before = (air.sent, air.collisions)
    states = {board.mcu.program.stem: _Watch(board) for board in tracker.boards}
    line: list[tuple[int, int]] = []
    start = time.process_time()
    for _ in range(round(seconds / SLICE_S)):
        line += tracker.run_for(SLICE_S)
        for watch in states.values():
            watch.look()
    run.processor_s = time.process_time() - start
    run.sent, run.collisions = air.sent - before[0], air.collisions - before[1]
    run.loads = {name: watch.load for name, watch in states.items()}
    _read_line(run, line, tracker.imu.imu.sampled_ps)
    run.events["imu_node"] = sum(ps > STARTED_S * PS_PER_S for ps in tracker.imu.imu.sampled_ps)
    tracker.close()
    return run


class _Watch:
    """Cycles that a chip spends awake, slice by slice."""

    def __init__(self, board: Board) -> None:
        self._mcu = board.mcu
        self._cycle, self._slept = board.mcu.cycle, board.mcu.slept
        self.load = Load()

    def look(self) -> None:
        cycle, slept = self._mcu.cycle, self._mcu.slept
        awake = (cycle - self._cycle) - (slept - self._slept)
        self.load.cycles += cycle - self._cycle
        self.load.awake_cycles += awake
        self.load.worst_slice = max(self.load.worst_slice, awake)
        self._cycle, self._slept = cycle, slept


def _read_line(run: Run, line: list[tuple[int, int]], sampled_ps: list[int]) -> None:
    decoder, last = FrameDecoder(), dict[int, int]()
    packets = fixes = 0
    for end_ps, byte in line:
        for event in decoder.feed(bytes([byte])) if byte == 0 else _keep(decoder, byte):
            frame = decode_content(event) if isinstance(event, bytes) else None
            if not isinstance(frame, RadioFrame):
                continue
            packets += 1
            node, seq = frame.header.node.node_id, frame.header.seq
            run.received[node] = run.received.get(node, 0) + 1
            run.lost[node] = run.lost.get(node, 0) + (seq - last.get(node, seq - 1) - 1) % 65536
            last[node] = seq
            if isinstance(frame.payload, ImuPayload):
                run.latency_ms.append(_latency_ms(frame, end_ps, sampled_ps))
            elif isinstance(frame.payload, NodeStatusPayload):
                load = run.loads["imu_node" if node == 0 else "gps_node"]
                load.loop_max_us = max(load.loop_max_us, frame.payload.loop_max_us)
                run.retries = max(run.retries, frame.payload.radio_retries)
            fixes += isinstance(frame.payload, GpsFixPayload)
    run.events.update(receiver=packets, gps_node=fixes)


def _keep(decoder: FrameDecoder, byte: int) -> list[bytes]:
    decoder.feed(bytes([byte]))
    return []


def _latency_ms(frame: RadioFrame, end_ps: int, sampled_ps: list[int]) -> float:
    stamp_ps = frame.header.node_time_us * PS_PER_US / (1 + IMU_CLOCK_PPM * 1e-6)
    at = bisect.bisect(sampled_ps, stamp_ps + START_UP_US * PS_PER_US) - 1
    return (end_ps - sampled_ps[at]) / PS_PER_S * 1e3


def program_table(programs: Programs, run: Run) -> list[str]:
    """Build the table of sizes and loads."""
    options = (
        f"SETTINGS={programs.settings}",
        f"F_CPU={programs.frequency_hz}UL",
        f"RADIO={programs.radio}",
    )
    with tempfile.TemporaryDirectory() as folder:
        said = make("all", f"BUILD={folder}", *options)
    sizes = {name: (int(flash), int(ram)) for name, flash, ram in _SIZES.findall(said)}
    rows = [
        "| program | flash | static RAM | CPU | cycles, mean | worst 1 ms | longest loop |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name in PROGRAMS:
        flash, ram = sizes[name]
        load = run.loads[name]
        share = load.awake_cycles / load.cycles
        mean = load.awake_cycles / run.events[name]
        loop = f"{load.loop_max_us} us" if load.loop_max_us else ""
        worst = f"{load.worst_slice} of {programs.mhz * 1000}"
        rows.append(
            f"| {name} | {flash} B, {100 * flash / FLASH_BYTES:.0f} % "
            f"| {ram} B, {100 * ram / RAM_BYTES:.0f} % | {100 * share:.0f} % "
            f"| {mean:.0f} a {SAMPLES[name]} | {worst} | {loop} |"
        )
    return rows


def loss_table(runs: list[Run]) -> list[str]:
    """Build the table of received samples and their latency."""
    rows = [
        "| loss | IMU node: payloads, lost | GPS node: the same | latency p50 | p99 | worst |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for run in runs:
        p50, p99 = np.percentile(run.latency_ms, [50, 99])
        nodes = " | ".join(f"{run.received[n]}, {run.lost[n]}" for n in (0, 1))
        rows.append(
            f"| {100 * run.loss:.0f} % | {nodes} "
            f"| {p50:.2f} ms | {p99:.2f} ms | {max(run.latency_ms):.2f} ms |"
        )
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure the firmware on the simulated bench.")
    parser.add_argument("--seconds", type=float, default=60.0, help="simulated time for each loss")
    parser.add_argument("--settings", default="", help='such as "-DRADIO_KBPS=250"')
    parser.add_argument("--mhz", type=int, choices=(8, 16), default=16)
    parser.add_argument("--radio", choices=("nrf24", "sx1276"), default="nrf24")
    options = parser.parse_args()
    programs = Programs(options.settings, options.mhz, options.radio)
    seconds = options.seconds
    runs = [measure(programs, loss, seconds) for loss in LOSSES]
    speed = seconds * len(runs) / sum(run.processor_s for run in runs)
    acknowledged = " with acknowledgements" if programs.radio == "nrf24" else ""
    air = f"{runs[0].sent} packets{acknowledged}, {runs[0].collisions} of them collided"
    last = f"At 0 % loss: {air}. Simulated {speed:.1f} times as fast as true time on one core."
    lines = [*program_table(programs, runs[0]), "", *loss_table(runs), "", last, ""]
    sys.stdout.write("\n".join(lines))


if __name__ == "__main__":
    main()
