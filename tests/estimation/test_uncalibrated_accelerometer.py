"""An accelerometer that nobody has calibrated, which each sample says."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gateway.estimation.columns import ACCEL, ACCEL_UNCALIBRATED
from tools.flights import Flight, simulated_flight
from tools.score_estimators import OWN, attitude_scores
from tools.score_honesty import share, two_sigma

NAMES = ("complementary", "eskf")
BIASES_MPS2 = np.array([[0.5, -0.4, 0.6], [-0.4, -0.5, -0.5], [0.6, 0.3, 0.8]])
"""Within the tolerance of an MPU6050, or a little beyond."""
CALIBRATED_S = 110.0


@cache
def flown(seed: int) -> Flight:
    return simulated_flight(seed, calibrated=True)


def off_level(seed: int) -> Flight:
    """Fly with a bias of which nothing says that it may be there."""
    flight = flown(seed)
    imu = flight.log.imu.copy()
    imu[:, ACCEL : ACCEL + 3] += BIASES_MPS2[seed % len(BIASES_MPS2)]
    return replace(flight, log=replace(flight.log, imu=imu))


def marked(flight: Flight, where: np.ndarray | slice = slice(None)) -> Flight:
    imu = flight.log.imu.copy()
    imu[where, ACCEL_UNCALIBRATED] = 1.0
    return replace(flight, log=replace(flight.log, imu=imu))


def honesty(name: str, flights: list[Flight]) -> tuple[float, float]:
    """Tell the tilt in deg rms and its share within two sigma."""
    outs = [OWN[name](flight) for flight in flights]
    tilts = [
        attitude_scores(f, out[:, :4])["inclination"] for f, out in zip(flights, outs, strict=True)
    ]
    shares = [share(two_sigma(f, out)["tilt"]) for f, out in zip(flights, outs, strict=True)]
    return float(np.sqrt(np.mean(np.square(tilts)))), float(np.mean(shares))


@pytest.mark.parametrize("name", NAMES)
def test_its_bias_is_found_with_gps(name: str) -> None:
    flights = [off_level(seed) for seed in (51, 52, 53)]
    tilt_deg, within = honesty(name, [marked(flight) for flight in flights])
    unmarked_deg, _ = honesty(name, flights)
    assert tilt_deg < 1.4
    assert tilt_deg < 0.85 * unmarked_deg
    assert within > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_what_has_none_flies_as_well(name: str) -> None:
    tilt_deg, within = honesty(name, [marked(flown(seed)) for seed in (51, 52, 53)])
    assert tilt_deg < 0.8
    assert within > 0.95


@pytest.mark.parametrize("name", NAMES)
def test_it_is_told_without_gps(name: str) -> None:
    flights = [
        marked(f.with_gps(np.zeros(len(f.log.gps), bool))) for f in map(off_level, (51, 52, 53))
    ]
    _, within = honesty(name, flights)
    assert within > 0.9


@pytest.mark.parametrize("name", NAMES)
def test_a_bias_that_was_found_is_forgotten_once_it_is_calibrated(name: str) -> None:
    flight, true = off_level(51), flown(51)
    later = flight.log.imu_time_us > CALIBRATED_S * 1e6
    imu = np.where(later[:, None], true.log.imu, flight.log.imu)
    flight = marked(replace(flight, log=replace(flight.log, imu=imu)), ~later)
    flight = replace(flight, counts=later)
    tilt_deg, within = honesty(name, [flight])
    assert tilt_deg < 1.0
    assert within > 0.9
