"""A short simulated flight, made once for all tests of the analysis."""

from functools import cache

from gateway.analysis.case import Case, make_case
from gateway.analysis.flight_arrays import Flight
from gateway.analysis.sources import simulated_flight
from gateway.simulator.simulator_settings import SimulatorSettings

DURATION_S = 60.0


@cache
def short_flight() -> Flight:
    settings = SimulatorSettings(imu_rate_hz=50, gps_outages_s=((40.0, 3.0),))
    return simulated_flight(settings, duration_s=DURATION_S)


@cache
def short_case() -> Case:
    return make_case(short_flight())
