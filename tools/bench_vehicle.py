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
from collections.abc import Callable
from functools import partial
from itertools import islice

from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.units import US_PER_S
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.records import FIX, STATE, sample_at, state_at
from tools.bench_latency import frames
from tools.harness import arguments, show, write_json

RATES_HZ = (60, 200, 1000)
PACKS = 20_000
LONGEST_WAIT_US = 100_000
"""Maximum interval of polls, as in the daemon."""
SLEEP_S = 0.0007
"""Sleep before each sample: about the rest of a millisecond."""
SLEEPING_SECONDS = 3
"""Duration of the runs with sleeps."""

Run = Callable[[int, int], tuple[float, int]]


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


def run_vehicle(rate_hz: int, seconds: int) -> tuple[float, int]:
    """Update the vehicle alone, and poll it; return as `run_pipeline`."""
    vehicle = Vehicle(VehicleSettings(), 1)
    vehicle.on_gps(FIX, 0)
    times = range(0, seconds * US_PER_S, US_PER_S // rate_hz)
    samples = [(state_at(t), sample_at(t)) for t in times]
    sent = 0
    began_s = time.process_time()
    for state, sample in samples:
        sent += len(vehicle.on_state(state, sample, state.time_us))
        if vehicle.next_due_us() <= state.time_us:
            sent += len(vehicle.poll(state.time_us))
    return time.process_time() - began_s, sent


def main() -> None:
    """Print the tables."""
    options = arguments(__doc__, seconds=20).parse_args()
    fastest = max(RATES_HZ)
    runs: list[tuple[str, int, int, Run]]
    runs = [("pipeline", rate, options.seconds, run_pipeline) for rate in RATES_HZ]
    runs += [("after a sleep", fastest, SLEEPING_SECONDS, partial(run_pipeline, sleep_s=SLEEP_S))]
    runs += [("vehicle alone", rate, options.seconds, run_vehicle) for rate in RATES_HZ]
    rows: list[tuple[object, ...]] = []
    for part, rate_hz, seconds, run in runs:
        used_s, sent = run(rate_hz, seconds)
        us, share = 1e6 * used_s / (seconds * rate_hz), 100 * used_s / seconds
        rows.append((part, rate_hz, us, share, sent / seconds))
    packing = pack_us(PACKS), pack_us(SLEEPING_SECONDS * fastest, SLEEP_S)
    rows += [("message packed", "", packing[0]), ("message packed after a sleep", "", packing[1])]
    show("processor time", ("part", "samples/s", "µs each", "% of a core", "messages/s"), rows)
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
