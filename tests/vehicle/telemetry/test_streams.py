import math
from typing import Any

import numpy as np
import pytest

from gateway.records import NavFlags
from gateway.vehicle.telemetry.streams import OFF, Stream, interval_us
from gateway.vehicle.telemetry.telemetry import IN_AIR, ON_GROUND, UNDEFINED, Motion
from tests.kit.records import state_at


def sent(stream: Stream, times_us: np.ndarray) -> np.ndarray:
    return np.array([t for t in times_us.tolist() if stream.offer(t)])


def sample_times(
    rate_hz: float, seconds: float, jitter_us: float = 0.0, seed: int = 1
) -> np.ndarray:
    exact = np.arange(round(rate_hz * seconds)) * (1e6 / rate_hz)
    noise = np.random.default_rng(seed).uniform(-jitter_us, jitter_us, exact.size)
    return (exact + noise + 1e6).astype(np.int64)


@pytest.mark.parametrize(
    ("sample_hz", "wanted_hz"),
    [*((hz, 50) for hz in (200, 100, 60, 1000, 71.3, 50, 40, 5)), *((333, 10), (60, 10), (60, 40))],
)
def test_rate_is_the_lower_of_requested_and_sample_rate(sample_hz: float, wanted_hz: float) -> None:
    times = sample_times(sample_hz, 60.0, jitter_us=0.05e6 / sample_hz)
    found = sent(Stream(interval_us(wanted_hz)), times)
    assert found.size / 60.0 == pytest.approx(min(sample_hz, wanted_hz), rel=0.01)


@pytest.mark.parametrize("skew_ppm", [-300.0, 0.0, 300.0])
@pytest.mark.parametrize("seed", range(3))
def test_every_fourth_sample_is_sent_despite_skew_and_jitter(skew_ppm: float, seed: int) -> None:
    times = sample_times(200.0 * (1.0 + skew_ppm * 1e-6), 120.0, jitter_us=1000.0, seed=seed)
    found = np.searchsorted(times, sent(Stream(20_000), times))
    assert set(np.diff(found[50:])) == {4}


def test_gap_is_not_followed_by_a_burst() -> None:
    stream = Stream(20_000)
    times = [*range(0, 1_000_000, 10_000), *range(60_000_000, 61_000_000, 10_000)]
    late = [t for t in times if stream.offer(t) and t >= 60_000_000]
    assert (late[0], len(late)) == (60_000_000, 50)


def test_streams_keep_their_phases_after_a_gap() -> None:
    streams = [Stream(100_000), Stream(100_000)]
    for k, stream in enumerate(streams):
        stream.begin(30_000 * k)
    times = [*range(0, 500_000, 10_000), *range(5_000_000, 5_500_000, 10_000)]
    sent = [[t for t in times if stream.tick(t)] for stream in streams]
    assert set(sent[0]) & set(sent[1]) == {5_000_000}


@pytest.mark.parametrize("ask", [Stream.offer, Stream.tick])
def test_stream_of_rate_zero_sends_nothing(ask: object) -> None:
    stream = Stream(interval_us(0.0))
    assert stream.interval_us == OFF
    assert not any(ask(stream, t) for t in range(0, 10_000_000, 100_000))
    assert stream.due_us is None


def test_timed_messages_keep_their_grid_when_polled_late() -> None:
    stream = Stream(1_000_000)
    found = [t for t in range(0, 5_000_000, 70_000) if stream.tick(t)]
    assert found == [0, 1_050_000, 2_030_000, 3_010_000, 4_060_000]
    assert stream.due_us == 5_000_000


def test_new_interval_takes_effect_at_the_next_sample() -> None:
    stream = Stream(1_000_000)
    assert stream.offer(0)
    stream.change(100_000)
    found = [t for t in range(10_000, 500_000, 10_000) if stream.offer(t)]
    assert found == [10_000, 110_000, 210_000, 310_000, 410_000]


def test_samples_with_earlier_times_do_not_stop_a_stream() -> None:
    stream = Stream(20_000)
    for time_us in (100_000, 110_000, 50_000, 120_000, 0, 130_000):
        stream.offer(time_us)
    found = [t for t in range(140_000, 1_140_000, 10_000) if stream.offer(t)]
    assert len(found) == pytest.approx(50, abs=1)


def run(motion: Motion, start_s: float, seconds: float, speed: float, height: float) -> int:
    for n in range(round(seconds * 50) + 1):
        time_us = round((start_s + n / 50) * 1e6)
        state = state_at(time_us, vel_n_mps=(speed, 0.0, 0.0), alt_amsl_m=500.0 + height)
        motion.update(state, 500.0)
    return motion.landed_state


def test_landed_state_follows_a_flight() -> None:
    motion = Motion(5.0, 10.0)
    assert run(motion, 0, 1.9, 0.0, 0.0) == UNDEFINED
    assert run(motion, 2, 1, 0.0, 0.0) == ON_GROUND
    assert run(motion, 3, 10, 3.0, 0.0) == ON_GROUND, "taxiing"
    assert run(motion, 13, 1.5, 12.0, 1.0) == ON_GROUND, "a gust"
    assert run(motion, 14.5, 1, 12.0, 5.0) == IN_AIR
    assert run(motion, 20, 30, 0.5, 60.0) == IN_AIR, "hovering"
    assert run(motion, 50, 4, 0.5, 0.0) == IN_AIR, "touch and go"
    assert run(motion, 54, 4, 12.0, 5.0) == IN_AIR
    assert run(motion, 60, 6, 1.0, 0.5) == ON_GROUND


@pytest.mark.parametrize(
    ("changes", "landed_states"),
    [
        ({"flags": NavFlags.ATTITUDE_VALID}, [UNDEFINED]),
        *(
            ({"vel_n_mps": (bad, 0.0, 0.0), "alt_amsl_m": bad}, [UNDEFINED, IN_AIR])
            for bad in (math.nan, math.inf)
        ),
    ],
    ids=["no velocity", "nan", "inf"],
)
def test_unknown_motion_is_not_reported_as_on_ground(
    changes: dict[str, Any], landed_states: list[int]
) -> None:
    motion = Motion(5.0, 10.0)
    for n in range(500):
        motion.update(state_at(n * 20_000, **changes), 500.0)
    assert motion.landed_state in landed_states
