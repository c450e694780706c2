"""The latency out of motion alone, on simulated flights whose latency is known."""

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import Aircraft, AircraftSettings
from gateway.estimation.alignment.latency_of_log import estimate_latency
from gateway.estimation.columns import ACCEL, GPS_VEL
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.recordings.fuse import with_reference
from gateway.records import Outgoing
from gateway.simulator.flight import fly
from gateway.simulator.simulator_settings import SimulatorSettings
from tools.flights import Flight, read_flight, simulated_flight
from tools.score_estimators import attitude_scores

TOLD_S = 0.16
FILTERS = ("complementary", "eskf")
STATUSTEXT = mavlink.MAVLINK_MSG_ID_STATUSTEXT


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
@pytest.mark.parametrize("latency_s", [0.05, 0.16, 0.4])
def test_noise_moves_it_no_further_than_told(
    flight: Flight, rng: np.random.Generator, latency_s: float
) -> None:
    """Noise puts the lowest point of a manoeuvre that says little anywhere, on average midway."""
    log = delayed(flight.log, latency_s - TOLD_S)
    imu, gps = log.imu.copy(), log.gps.copy()
    imu[:, ACCEL : ACCEL + 3] += rng.normal(0.0, 1.0, (len(imu), 3))
    gps[:, GPS_VEL : GPS_VEL + 3] += rng.normal(0.0, 0.1, (len(gps), 3))
    found = estimate_latency(replace(log, imu=imu, gps=gps))
    assert found is not None
    assert abs(found.latency_s - latency_s) < 2.5 * found.std_s
    assert found.std_s < 0.011


@pytest.mark.slow
def test_without_a_manoeuvre_it_is_unknown(flight: Flight) -> None:
    assert estimate_latency(between(flight.log, 0.0, 13.0)) is None


@pytest.mark.slow
def test_without_velocities_it_is_unknown(flight: Flight) -> None:
    gps = flight.log.gps.copy()
    gps[:, 4:7] = np.nan
    assert estimate_latency(replace(flight.log, gps=gps)) is None
    assert estimate_latency(between(flight.log, 0.0, 0.0)) is None


def first_seconds(log: SampleLog, seconds: float) -> SampleLog:
    imu, baro, gps = (
        times_us <= seconds * 1e6
        for times_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us)
    )
    return SampleLog(
        imu_time_us=log.imu_time_us[imu],
        imu=log.imu[imu],
        baro_time_us=log.baro_time_us[baro],
        baro_alt_m=log.baro_alt_m[baro],
        gps_time_us=log.gps_time_us[gps],
        gps=log.gps[gps],
    )


def fused(name: str, flight: Flight, set_s: float) -> tuple[np.ndarray, float]:
    """Run a filter with a latency that is set; return its states and the latency in use at last."""
    reference = msgspec.structs.replace(flight.reference, gps_latency_s=set_s)
    estimator = make_estimator(EstimationSettings(estimator=name, reference=reference))
    assert isinstance(estimator, KernelEstimator)
    return estimator.run(flight.log), estimator.gps_latency_s[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_corrects_what_is_set_wrong(flight: Flight, name: str) -> None:
    late = flight.log.imu_time_us > 0.6 * flight.log.imu_time_us[-1]
    flight = replace(flight, counts=flight.counts & late)
    right, kept_s = fused(name, flight, TOLD_S)
    assert kept_s == TOLD_S
    wrong, found_s = fused(name, flight, 0.3)
    assert found_s == pytest.approx(TOLD_S, abs=0.015)
    right_deg = attitude_scores(flight, right[:, :4])["heading"]
    assert attitude_scores(flight, wrong[:, :4])["heading"] < right_deg + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_keeps_what_is_set_until_a_manoeuvre(flight: Flight, name: str) -> None:
    straight = replace(flight, log=between(flight.log, 0.0, 13.0))
    assert fused(name, straight, 0.3)[1] == 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_python_finds_what_machine_code_does(name: str) -> None:
    flight = simulated_flight(21, calibrated=True)
    estimator = make_estimator(EstimationSettings(estimator=name, reference=flight.reference))
    assert isinstance(estimator, KernelEstimator)
    log = first_seconds(flight.log, 45.0)
    machine, found = estimator.run(log), estimator.state
    assert found.found_information > 0.0
    kernels = estimator._kernels
    python = {k: getattr(kernels, k).__wrapped__ for k in ("begin", "run")}
    estimator._kernels = replace(kernels, **python)
    estimator.reset()
    np.testing.assert_allclose(estimator.run(log), machine, rtol=1e-6, atol=1e-6)
    assert estimator.state.found_latency_s == pytest.approx(found.found_latency_s, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "off_deg"), [("complementary", 2.0), ("eskf", 1.5)])
def test_a_real_fixed_wing_set_to_the_default(data_dir: Path, name: str, off_deg: float) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    out, used_s = fused(name, flight, 0.15)
    assert used_s == pytest.approx(0.28, abs=0.05)
    assert attitude_scores(flight, out[:, :4])["yaw"] < off_deg


@pytest.mark.slow
def test_the_ground_stations_are_told_once() -> None:
    aircraft = Aircraft(1, with_reference(AircraftSettings(), gps_latency_s=0.3))
    reader = mavlink.MAVLink(None)
    records = fly(SimulatorSettings(seed=41)).records()
    actions = [action for record in records for action in aircraft.take(record, record.time_us)]
    sent = [action for action in actions if isinstance(action, Outgoing)]
    texts = [
        reader.decode(bytearray(one.frame)).text for one in sent if one.message_id == STATUSTEXT
    ]
    [text] = [text for text in texts if "gps_latency_s" in text]
    assert re.fullmatch(r"GPS is 0\.1\d s late, not 0\.30: set gps_latency_s", text)


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
