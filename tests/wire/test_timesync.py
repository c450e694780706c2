"""Clock tracking against simulated clocks whose truth is known."""

import numpy as np
import pytest

from gateway.wire.timesync import WRAP_US, ClockTracker
from tests.kit.memory import size_of


def packets(
    rng: np.random.Generator,
    *,
    seconds: float,
    rate_hz: float = 100.0,
    skew_ppm: float = 0.0,
    offset_us: int = 5_000_000,
    start_us: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make (remote stamp, true local time, arrival): delays with a floor and heavy bursts."""
    true_us = np.arange(0, seconds * 1e6, 1e6 / rate_hz)
    remote_us = start_us + true_us * (1 + skew_ppm * 1e-6)
    queue_us = rng.exponential(1500.0, true_us.size) * (rng.random(true_us.size) < 0.7)
    arrival_us = true_us + offset_us + 300.0 + queue_us
    return remote_us.astype(np.int64) % WRAP_US, true_us + offset_us + 300.0, arrival_us.astype(int)


def observe(tracker: ClockTracker, stamps: np.ndarray, arrivals: np.ndarray) -> np.ndarray:
    """Let a tracker observe packets; return their times."""
    pairs = zip(stamps.tolist(), arrivals.tolist(), strict=True)
    return np.array([tracker.observe(stamp, arrival) for stamp, arrival in pairs])


@pytest.mark.parametrize("skew_ppm", [-50_000.0, -5000.0, -80.0, 0.0, 35.0, 5000.0, 50_000.0])
@pytest.mark.parametrize("start_us", [0, WRAP_US - 20_000_000])
@pytest.mark.parametrize("seed", range(2))
def test_offset_and_drift_are_estimated(skew_ppm: float, start_us: int, seed: int) -> None:
    """Once the window is filled, a sample is placed within 0.2 ms: a tenth of a mean queue."""
    rng = np.random.default_rng(seed)
    stamps, true_us, arrivals = packets(rng, seconds=60, skew_ppm=skew_ppm, start_us=start_us)
    tracker = ClockTracker()
    found_us = observe(tracker, stamps, arrivals)
    assert (found_us <= arrivals).all(), "no sample comes from the future"
    error_us = found_us - true_us
    settled = error_us[true_us - true_us[0] > 15e6]
    assert np.abs(settled).max() < 200.0
    assert tracker.skew_ppm == pytest.approx(skew_ppm, abs=10.0)
    assert tracker.restarts == 0


@pytest.mark.parametrize("skew_ppm", [-5000.0, 5000.0])
@pytest.mark.parametrize("seed", range(3))
def test_soonest_packet_is_chosen_after_removing_the_drift(skew_ppm: float, seed: int) -> None:
    """By its raw delay it would be the first or the last of its bucket, queued or not."""
    rng = np.random.default_rng(seed)
    stamps, true_us, _ = packets(rng, seconds=60, skew_ppm=skew_ppm, rate_hz=250.0)
    arrivals = np.maximum.accumulate(true_us + rng.exponential(2000.0, true_us.size)).astype(int)
    error_us = observe(ClockTracker(), stamps, arrivals) - true_us
    settled = error_us[true_us - true_us[0] > 15e6]
    assert np.sqrt(np.mean(settled**2)) < 6.0


@pytest.mark.parametrize("gap_s", [10, 600, 71 * 60, 3 * 3600])
def test_outage_of_any_length_is_no_restart(gap_s: int, rng: np.random.Generator) -> None:
    """The node kept counting through several wraps; its clock is still known."""
    stamps, _, arrivals = packets(rng, seconds=20, skew_ppm=40.0)
    tracker = ClockTracker()
    *_, last = observe(tracker, stamps, arrivals)
    stamp = (int(stamps[-1]) + gap_s * 1_000_040) % WRAP_US
    observed = tracker.observe(stamp, int(arrivals[-1]) + gap_s * 1_000_000)
    assert tracker.restarts == 0
    assert observed - last == pytest.approx(gap_s * 1_000_000, abs=10_000)


def test_clock_is_estimated_again_after_a_restart(rng: np.random.Generator) -> None:
    stamps, _, arrivals = packets(rng, seconds=20)
    tracker = ClockTracker()
    observe(tracker, stamps, arrivals)
    observed = tracker.observe(150_000, int(arrivals[-1]) + 400_000)
    assert tracker.restarts == 1
    assert observed == int(arrivals[-1]) + 400_000


def test_delayed_timestamp_keeps_its_own_time() -> None:
    tracker = ClockTracker()
    for step in range(100):
        tracker.observe(step * 10_000, 2_000_000 + step * 10_000)
    late = tracker.observe(500_000, 2_000_000 + 1_000_000)
    assert late == 2_500_000
    assert tracker.restarts == 0


@pytest.mark.parametrize("ahead_us", [60_000, 600_000, 1_400_000])
def test_single_timestamp_ahead_leaves_the_estimate(ahead_us: int) -> None:
    tracker = ClockTracker()
    observed = []
    for step in range(300):
        arrival_us = 2_000_000 + step * 10_000
        observed.append(tracker.observe(step * 10_000 + ahead_us * (step == 150), arrival_us))
    assert observed == [2_000_000 + step * 10_000 for step in range(300)]


def test_offset_measured_with_queued_packets_is_corrected_by_two_packets() -> None:
    tracker = ClockTracker()
    for step in range(10):
        tracker.observe(step * 10_000, 2_000_000 + 400_000 + step * 10_000)
    observed = [tracker.observe(n * 10_000, 2_000_000 + n * 10_000) for n in (100, 101, 102)]
    assert observed == [3_000_000, 3_010_000, 3_020_000]
    assert tracker.observe(1_030_000, 3_330_000) == 3_030_000, "its queue is known again"


def test_memory_is_bounded(rng: np.random.Generator) -> None:
    stamps, _, arrivals = packets(rng, seconds=120, rate_hz=200.0)
    tracker, half = ClockTracker(), len(stamps) // 2
    observe(tracker, stamps[:half], arrivals[:half])
    before = size_of(tracker)
    observe(tracker, stamps[half:], arrivals[half:])
    assert size_of(tracker) < 1.05 * before


def test_implausible_drift_is_limited(rng: np.random.Generator) -> None:
    stamps, _, arrivals = packets(rng, seconds=30, skew_ppm=12_000.0)
    tracker = ClockTracker()
    observe(tracker, stamps, arrivals)
    assert tracker.skew_ppm == pytest.approx(10_000.0, rel=0.02)


def follow(tracker: ClockTracker, begin_s: float, end_s: float, rate_hz: int = 100) -> list[int]:
    """Read packets of a clock that began 2 s after the local one, without delay."""
    steps = range(round(begin_s * rate_hz), round(end_s * rate_hz))
    times = [step * 1_000_000 // rate_hz for step in steps]
    return [tracker.observe(time_us, time_us + 2_000_000) - time_us for time_us in times]


@pytest.mark.parametrize("stall_s", [3, 20])
@pytest.mark.parametrize("buffered", [0, 1, 100])
def test_stall_of_the_local_computer_is_no_restart(stall_s: int, buffered: int) -> None:
    """The kernel keeps the first packets of a stall; the rest are lost."""
    tracker = ClockTracker()
    follow(tracker, 0.0, 20.0)
    resumed_us = (22 + stall_s) * 1_000_000
    for step in range(buffered):
        time_us = 20_000_000 + step * 10_000
        assert tracker.observe(time_us, resumed_us + step * 100) == time_us + 2_000_000
    assert set(follow(tracker, 20.1 + stall_s, 40.0 + stall_s)) == {2_000_000}
    assert (tracker.restarts, tracker.skew_ppm) == (0, pytest.approx(0.0, abs=1.0))


def test_clock_that_was_halted_is_estimated_again() -> None:
    """So does one after 1 s of operation and 20 s without power: its stamps seem to be late."""
    tracker = ClockTracker()
    follow(tracker, 0.0, 1.0)
    times = [1_200_000 + step * 10_000 for step in range(500)]
    found = [tracker.observe(time_us, time_us + 22_000_000) - time_us for time_us in times]
    assert (tracker.restarts, tracker.runs) == (0, 2)
    assert found[-1] == 22_000_000
