"""The latency out of motion alone, on simulated flights whose latency is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.alignment.gps_latency import estimate_latency
from gateway.estimation.kernel import SampleLog
from tools.flights import Flight, read_flight, simulated_flight

TOLD_S = 0.16


@pytest.fixture(scope="module", params=[21, 22, 23])
def flight(request: pytest.FixtureRequest) -> Flight:
    return simulated_flight(request.param, calibrated=request.param % 2 == 1)


def delayed(log: SampleLog, by_s: float) -> SampleLog:
    return replace(log, gps_time_us=log.gps_time_us + round(by_s * 1e6))


def between(log: SampleLog, begin_s: float, end_s: float) -> SampleLog:
    kept = (log.gps_time_us > begin_s * 1e6) & (log.gps_time_us < end_s * 1e6)
    return replace(log, gps_time_us=log.gps_time_us[kept], gps=log.gps[kept])


@pytest.mark.slow
@pytest.mark.parametrize("latency_s", [0.05, 0.15, 0.3])
def test_the_latency_is_found(flight: Flight, latency_s: float) -> None:
    found = estimate_latency(delayed(flight.log, latency_s - TOLD_S))
    assert found is not None
    assert found.latency_s == pytest.approx(latency_s, abs=0.015)
    assert found.std_s < 0.01


@pytest.mark.slow
def test_without_a_manoeuvre_it_is_unknown(flight: Flight) -> None:
    assert estimate_latency(between(flight.log, 0.0, 13.0)) is None


@pytest.mark.slow
def test_without_velocities_it_is_unknown(flight: Flight) -> None:
    gps = flight.log.gps.copy()
    gps[:, 4:7] = np.nan
    assert estimate_latency(replace(flight.log, gps=gps)) is None
    assert estimate_latency(between(flight.log, 0.0, 0.0)) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "latency_s"), [("arduplane_testlog2", 0.28), ("px4_f450_glitch", 0.3)]
)
def test_real_flights(data_dir: Path, name: str, latency_s: float) -> None:
    """What their makers tell is of the position; a velocity may be some hundredths earlier."""
    log = read_flight(data_dir / f"{name}.csv.gz").log
    found = estimate_latency(log)
    if found is not None:
        assert found.latency_s == pytest.approx(latency_s, abs=0.05)
    later = estimate_latency(delayed(log, 0.1))
    assert (found is None) == (later is None)
    if found is not None and later is not None:
        assert later.latency_s - found.latency_s == pytest.approx(0.1, abs=0.005)
