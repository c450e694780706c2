"""A short simulated flight, made once for all tests of the analysis."""

from dataclasses import replace
from functools import cache

import numpy as np

from gateway.analysis.case import Case, make_case
from gateway.analysis.flight import Flight, FlightTrack
from gateway.analysis.simulated import simulated_flight
from gateway.simulator.simulator_settings import SimulatorSettings

DURATION_S = 40.0


@cache
def short_flight(duration_s: float = DURATION_S) -> Flight:
    settings = SimulatorSettings(imu_rate_hz=50, gps_outages_s=((28.0, 3.0),))
    return simulated_flight(settings, duration_s=duration_s)


@cache
def short_case() -> Case:
    return make_case(short_flight())


def true_track(flight: Flight) -> FlightTrack:
    """Return the exact truth of a simulated flight."""
    assert flight.reference is not None
    assert flight.reference.is_exact
    return flight.reference.track


def with_imu(flight: Flight, **columns: np.ndarray) -> Flight:
    """Replace columns of the IMU samples."""
    samples = flight.samples
    return replace(flight, samples=replace(samples, imu=replace(samples.imu, **columns)))
