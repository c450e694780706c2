import numpy as np
import pytest

from gateway.analysis.signals import allan_deviation, longest_rest, power_density
from tests.analysis.flights import short_flight

RATE_HZ = 100.0


def test_white_noise_has_a_flat_spectrum(rng: np.random.Generator) -> None:
    frequency, density = power_density(rng.normal(0.0, 2.0, (60_000, 3)), RATE_HZ)
    assert frequency[0] > 0.0
    assert density.mean(axis=0) == pytest.approx([2.0 * 4.0 / RATE_HZ] * 3, rel=0.03)


def test_spectrum_of_a_sine_peaks_at_its_frequency() -> None:
    t = np.arange(3000) / RATE_HZ
    frequency, density = power_density(np.outer(np.sin(2 * np.pi * 12.5 * t), [1, 1, 1]), RATE_HZ)
    assert frequency[density[:, 0].argmax()] == pytest.approx(12.5)


def test_averaging_white_noise_falls_by_the_root(rng: np.random.Generator) -> None:
    tau, deviation = allan_deviation(rng.normal(0.0, 1.0, (40_000, 3)), RATE_HZ)
    assert deviation[0] == pytest.approx([1.0] * 3, rel=0.03)
    near_1_s = int(np.argmin(np.abs(tau - 1.0)))
    expected = 1.0 / np.sqrt(tau[near_1_s] * RATE_HZ)
    assert deviation[near_1_s] == pytest.approx([expected] * 3, rel=0.15)


def test_a_ramp_rises_with_the_averaging_time() -> None:
    """A rate ramp of slope s gives s * tau / sqrt(2)."""
    x = np.outer(np.arange(4000) / RATE_HZ * 0.5, [1, 1, 1])
    tau, deviation = allan_deviation(x, RATE_HZ)
    assert deviation[:, 0] == pytest.approx(0.5 * tau / np.sqrt(2.0))


def test_too_short_a_log_has_no_deviation() -> None:
    tau, deviation = allan_deviation(np.zeros((3, 3)), RATE_HZ)
    assert (len(tau), deviation.shape) == (0, (0, 3))


def test_the_rest_before_take_off_is_found() -> None:
    flight = short_flight()
    rest = longest_rest(flight.imu.accel_b_mps2, flight.imu.gyro_b_radps, flight.rate_hz)
    assert flight.time_s[rest.start] < 1.0
    assert 9.0 < flight.time_s[rest.stop - 1] < 15.0


def test_a_flight_without_rest_has_none(rng: np.random.Generator) -> None:
    moving = rng.normal(0.0, 1.0, (500, 3))
    rest = longest_rest(moving, moving, RATE_HZ)
    assert rest.stop == rest.start
