"""Measure the processor time of an IMU sample from serial bytes to MAVLink frames.

    python -m tools.bench_vehicle

Feeds twenty seconds of samples at three rates, first to the whole pipeline (bytes of a receiver in,
frames out, no sockets), then to the vehicle alone, and prints processor time. The baseline, in the
same run, is pymavlink packing one ATTITUDE_QUATERNION.

A running gateway sleeps between the samples, and a processor that has slept, or has run another
program, is slow at first: its caches are cold. So both baseline and pipeline are also measured with
a sleep before each message and each sample.
"""

import time
from itertools import islice

from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.units import US_PER_S
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.records import FIX, STATE, sample_at, state_at
from tools.bench_latency import frames

RATES_HZ = (60, 200, 1000)
SECONDS = 20
PACKS = 20_000
LONGEST_WAIT_US = 100_000
"""Maximum interval of polls, as in the daemon."""
SLEEP_S = 0.0007
"""Sleep before each sample: about the rest of a millisecond."""
SLEEPING_SECONDS = 3
"""Duration of the runs with sleeps."""


def pack_us(packs: int, sleep_s: float = 0.0) -> float:
    """Measure the encoding of one message."""
    mav = mavlink.MAVLink(None, 1, 1)
    used_s = 0.0
    for _ in range(packs):
        if sleep_s:
            time.sleep(sleep_s)
        began_s = time.process_time()
        values = (1000, *STATE.q_nb, *STATE.rate_b_radps, (0.0, 0.0, 0.0, 0.0))
        mavlink.MAVLink_attitude_quaternion_message(*values).pack(mav)
        used_s += time.process_time() - began_s
    return used_s / packs * 1e6


def run_pipeline(rate_hz: int, seconds: int, sleep_s: float = 0.0) -> tuple[float, int]:
    """Feed the receiver's bytes and poll; return the processor time and the number of frames."""
    pipeline = Pipeline(PipelineSettings(AircraftSettings()))
    pipeline.connect("bench")
    line = list(islice(frames(rate_hz), (seconds + 1) * rate_hz))
    now_us = due_us = sent = 0
    slept_s = began_s = 0.0
    for number, frame in enumerate(line):
        if number == rate_hz:
            # The first second loads machine code and sends the messages of the start.
            sent, slept_s, began_s = 0, 0.0, time.process_time()
        if sleep_s:
            before_s = time.process_time()
            time.sleep(sleep_s)
            slept_s += time.process_time() - before_s
        now_us += US_PER_S // rate_hz
        sent += len(pipeline.feed(frame, now_us).frames)
        if due_us <= now_us:
            sent += len(pipeline.poll(now_us).frames)
            due_us = min(pipeline.next_due_us(), now_us + LONGEST_WAIT_US)
    return time.process_time() - began_s - slept_s, sent


def show(rate_hz: int, seconds: int, used_s: float, sent: int) -> None:
    """Print one line of the table."""
    print(
        f"{rate_hz:6d} samples/s: {used_s / (seconds * rate_hz) * 1e6:5.1f} us a sample, "
        f"{100 * used_s / seconds:5.2f} % of a core, {sent / seconds:.0f} messages/s"
    )


def main() -> None:
    """Print the table."""
    print(f"baseline: one message built and packed {pack_us(PACKS):.1f} us")
    print("the whole pipeline:")
    for rate_hz in RATES_HZ:
        show(rate_hz, SECONDS, *run_pipeline(rate_hz, SECONDS))
    fastest, packs = max(RATES_HZ), SLEEPING_SECONDS * max(RATES_HZ)
    print(f"after a sleep each: one message built and packed {pack_us(packs, SLEEP_S):.1f} us")
    print("the whole pipeline after a sleep each:")
    show(fastest, SLEEPING_SECONDS, *run_pipeline(fastest, SLEEPING_SECONDS, SLEEP_S))
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
        show(rate_hz, SECONDS, used_s, sent)


if __name__ == "__main__":
    main()
