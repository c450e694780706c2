"""Properties of filters and signals: response, spectrum, Allan deviation."""

import numpy as np
import pytest
from scipy import signal

from gateway.analysis.signals import (
    allan_deviation,
    apply,
    compare,
    longest_rest,
    power_density,
    response,
)
from gateway.estimation.paper import PaperSettings
from tests.analysis.flights import short_flight

SETTINGS = PaperSettings()


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_butterworth_is_3_db_down_at_the_cutoff_and_flat_below(rate_hz: float) -> None:
    table = compare(SETTINGS, rate_hz).set_index("filter")
    assert table.loc["butterworth", "gain at cutoff, dB"] == pytest.approx(-3.01, abs=0.02)
    assert table.loc["butterworth", "ripple, dB"] == pytest.approx(0.0, abs=1e-6)
    assert table.loc["chebyshev", "ripple, dB"] == pytest.approx(1.0, abs=0.01)
    assert table.loc["butterworth", "step overshoot, %"] < 6.0
    assert table.loc["chebyshev", "step overshoot, %"] > 12.0
    assert (table["time a sample, ns"] > 0.0).all()


def test_group_delay_is_negative_slope_of_phase() -> None:
    frequency_hz, gain_db, phase_deg, delay_ms = response("butterworth", SETTINGS, 1000.0)
    slope = -np.gradient(np.radians(phase_deg), 2.0 * np.pi * frequency_hz)
    middle = slice(20, -20)
    assert delay_ms[middle] == pytest.approx(1e3 * slope[middle], rel=0.02)
    assert gain_db[0] == pytest.approx(0.0, abs=1e-6)


def test_low_pass_equals_scipy_butterworth(rng: np.random.Generator) -> None:
    x = rng.normal(size=(300, 3))
    b, a = signal.butter(2, 10.0, fs=100.0)
    expected = signal.lfilter(b, a, x - x[0], axis=0) + x[0]
    assert apply("butterworth", SETTINGS, 100.0, x) == pytest.approx(expected)


RATE_HZ = 100.0


def test_spectrum_of_a_sine_in_white_noise(rng: np.random.Generator) -> None:
    noise = rng.normal(0.0, 2.0, (60_000, 3))
    frequency, density = power_density(noise, RATE_HZ)
    assert frequency[0] > 0.0
    assert density.mean(axis=0) == pytest.approx([2.0 * 4.0 / RATE_HZ] * 3, rel=0.03)
    sine = 3.0 * np.sin(2 * np.pi * 12.5 * np.arange(60_000) / RATE_HZ)
    frequency, density = power_density(noise + sine[:, np.newaxis], RATE_HZ)
    assert frequency[density[:, 0].argmax()] == pytest.approx(12.5)


def test_allan_deviation_of_white_noise_falls_with_root_of_time(rng: np.random.Generator) -> None:
    tau, deviation = allan_deviation(rng.normal(0.0, 1.0, (40_000, 3)), RATE_HZ)
    assert deviation[0] == pytest.approx([1.0] * 3, rel=0.03)
    near_1_s = int(np.argmin(np.abs(tau - 1.0)))
    expected = 1.0 / np.sqrt(tau[near_1_s] * RATE_HZ)
    assert deviation[near_1_s] == pytest.approx([expected] * 3, rel=0.15)


def test_allan_deviation_of_rate_ramp_rises_with_averaging_time() -> None:
    """A rate ramp of slope s gives s * tau / sqrt(2); three samples are too few."""
    x = np.outer(np.arange(4000) / RATE_HZ * 0.5, [1, 1, 1])
    tau, deviation = allan_deviation(x, RATE_HZ)
    assert deviation[:, 0] == pytest.approx(0.5 * tau / np.sqrt(2.0))
    tau, deviation = allan_deviation(x[:3], RATE_HZ)
    assert (len(tau), deviation.shape) == (0, (0, 3))


def test_longest_rest_is_before_take_off_and_empty_in_motion(rng: np.random.Generator) -> None:
    flight = short_flight()
    rest = longest_rest(flight.imu.accel_b_mps2, flight.imu.gyro_b_radps, flight.rate_hz)
    assert flight.time_s[rest.start] < 1.0
    assert 9.0 < flight.time_s[rest.stop - 1] < 15.0
    moving = rng.normal(0.0, 1.0, (500, 3))
    rest = longest_rest(moving, moving, RATE_HZ)
    assert rest.stop == rest.start
