"""Measure what the vehicle costs: processor time per IMU sample and per message.

    python tools/bench_vehicle.py

Feeds twenty seconds of samples at three rates and prints processor time. The baseline, in the same
run, is pymavlink packing one ATTITUDE_QUATERNION.
"""

import sys
import time
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gateway.units import US_PER_S
from gateway.vehicle.telemetry.messages import attitude_quaternion
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.vehicle.samples import FIX, STATE, sample_at, state_at

SECONDS = 20
PACKS = 20_000


def pack_us() -> float:
    """Time the bare encoding of one message."""
    mav = mavlink.MAVLink(None, 1, 1)
    began_s = time.process_time()
    for _ in range(PACKS):
        attitude_quaternion(STATE).pack(mav)
    return (time.process_time() - began_s) / PACKS * 1e6


def main() -> None:
    """Print the table."""
    print(f"baseline: one message built and packed {pack_us():.1f} us")
    for rate_hz in (60, 200, 1000):
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
        print(
            f"{rate_hz:4d} samples/s: {used_s / len(samples) * 1e6:5.1f} us a sample, "
            f"{100 * used_s / SECONDS:.2f} % of a core, {sent / SECONDS:.0f} messages/s"
        )


if __name__ == "__main__":
    main()
