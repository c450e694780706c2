"""Measure what an IMU sample costs: processor time from serial bytes to MAVLink frames.

    python tools/bench_vehicle.py

Feeds twenty seconds of samples at three rates, first to the whole pipeline (bytes of a receiver in,
frames out, no sockets), then to the vehicle alone, and prints processor time. The baseline, in the
same run, is pymavlink packing one ATTITUDE_QUATERNION.
"""

import sys
import time
from itertools import islice
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gateway.aircraft import AircraftSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.records import Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.telemetry.messages import attitude_quaternion
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.vehicle.samples import FIX, STATE, sample_at, state_at
from tools.bench_latency import frames

RATES_HZ = (60, 200, 1000)
SECONDS = 20
PACKS = 20_000
LONGEST_WAIT_US = 100_000
"""As the daemon: it polls at the latest so long after the last time."""


def pack_us() -> float:
    """Time the bare encoding of one message."""
    mav = mavlink.MAVLink(None, 1, 1)
    began_s = time.process_time()
    for _ in range(PACKS):
        attitude_quaternion(STATE).pack(mav)
    return (time.process_time() - began_s) / PACKS * 1e6


def run_pipeline(rate_hz: int) -> tuple[float, int]:
    """Feed the receiver's bytes, and every message due; return the time used and the frames."""
    pipeline = Pipeline(PipelineSettings(AircraftSettings()))
    pipeline.connect("bench")
    line = list(islice(frames(rate_hz), (SECONDS + 1) * rate_hz))
    now_us = due_us = sent = 0
    began_s = 0.0
    for number, frame in enumerate(line):
        if number == rate_hz:
            # The first second loads machine code and says how everything begins.
            sent, began_s = 0, time.process_time()
        now_us += US_PER_S // rate_hz
        actions = pipeline.feed(frame, now_us)
        if due_us <= now_us:
            actions += pipeline.poll(now_us)
            due_us = min(pipeline.next_due_us(), now_us + LONGEST_WAIT_US)
        sent += sum(isinstance(action, Outgoing) for action in actions)
    return time.process_time() - began_s, sent


def show(rate_hz: int, used_s: float, sent: int) -> None:
    """Print one line of the table."""
    print(
        f"{rate_hz:6d} samples/s: {used_s / (SECONDS * rate_hz) * 1e6:5.1f} us a sample, "
        f"{100 * used_s / SECONDS:5.2f} % of a core, {sent / SECONDS:.0f} messages/s"
    )


def main() -> None:
    """Print the table."""
    print(f"baseline: one message built and packed {pack_us():.1f} us")
    print("the whole pipeline:")
    for rate_hz in RATES_HZ:
        show(rate_hz, *run_pipeline(rate_hz))
    print("the vehicle alone:")
    for rate_hz in RATES_HZ:
        vehicle = Vehicle(VehicleSettings(), 1)
        vehicle.on_gps(FIX, 0)
        times = range(0, SECONDS * US_PER_S, US_PER_S // rate_hz)
        samples = [(state_at(t), sample_at(t)) for t in times]
        sent = 0
        began_s = time.process_time()
        for state, sample in samples:
            now_us = state.time_us
            sent += len(vehicle.on_state(state, sample, now_us))
            if vehicle.next_due_us() <= now_us:
                sent += len(vehicle.poll(now_us))
        used_s = time.process_time() - began_s
        show(rate_hz, used_s, sent)


if __name__ == "__main__":
    main()
