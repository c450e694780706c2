"""Samples of a simulated aircraft, whole and in pieces, and the payloads of its nodes."""

import dataclasses
from itertools import takewhile
from typing import Any

import msgspec
import numpy as np
import pytest

from gateway.records import ImuFlags
from gateway.simulator.flight import START_UNIX_US, SimulatedAircraft
from gateway.simulator.node import gps_payloads, nodes_of, pack_baro
from gateway.simulator.sensors import DeviceClock
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S
from gateway.wire import payloads as wire
from tools.simulated_flight import SimulatedFlight, fly

SETTINGS = SimulatorSettings()
SECONDS = 20.0


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return fly(SETTINGS)


def columns(samples: Any) -> dict[str, np.ndarray]:
    if dataclasses.is_dataclass(samples):
        return {f.name: getattr(samples, f.name) for f in dataclasses.fields(samples)}
    return samples._asdict()


@pytest.mark.parametrize("rate_hz", [60, 100, 200, 1000])
def test_samples_have_the_rates_of_their_sensors(rate_hz: int) -> None:
    flight = fly(msgspec.structs.replace(SETTINGS, imu_rate_hz=rate_hz), duration_s=4.0)
    imu = flight.imu
    assert len(imu.time_s) == pytest.approx(4 * rate_hz, abs=1)
    is_new = (imu.flags & ImuFlags.MAG_NEW) != 0
    assert is_new.sum() == pytest.approx(4 * min(rate_hz, 75), abs=1)
    assert not np.diff(imu.mag_raw, axis=0)[~is_new[1:]].any(), "held until the next one"
    assert (len(flight.baro.time_s), len(flight.gps.time_s)) == (pytest.approx(100, abs=1), 20)


def test_fixes_have_latency_and_small_errors(flight: SimulatedFlight) -> None:
    gps = flight.gps
    valid_s = (gps.unix_us - START_UNIX_US) * 1e-6
    latency_s = gps.time_s - valid_s
    assert 0.13 <= latency_s.min() < latency_s.max() <= 0.19
    truth = flight.trajectory.truth_at(valid_s)
    fixed = gps.has_fix
    north_m = np.radians(gps.lat_deg - truth.lat_deg)[fixed] * 6_336_000.0
    assert 0.3 < north_m.std() < 1.6
    assert np.abs(north_m).max() < 4.0
    vel_off = (gps.vel_n_mps - truth.vel_n_mps)[fixed]
    assert 0.03 < vel_off[:, :2].std() < 0.12
    assert (gps.unix_us % 200_000 == 0).all()
    assert (np.diff(gps.itow_ms) == 200).all()


def test_fixes_are_missing_before_first_fix_and_in_outages(flight: SimulatedFlight) -> None:
    gps = flight.gps
    valid_s = (gps.unix_us - START_UNIX_US) * 1e-6
    assert not gps.has_fix[valid_s < 5.0].any()
    for start_s, length_s in SETTINGS.gps_outages_s:
        inside = (valid_s >= start_s) & (valid_s < start_s + length_s)
        assert not gps.has_fix[inside].any()
        before = gps.h_acc_m[valid_s < start_s][-1]
        assert gps.h_acc_m[valid_s >= start_s + length_s][0] > 3.0 * before
    assert (~gps.has_fix).sum() == 5 * (5 + 10 + 3)
    assert (gps.time_valid[0], gps.time_valid[-1]) == (False, True)


@pytest.mark.parametrize("sensor", ["imu", "baro", "gps"])
def test_pieces_equal_whole_flight(sensor: str) -> None:
    whole = columns(getattr(SimulatedAircraft(SETTINGS), sensor).take(24.0))
    sampler = getattr(SimulatedAircraft(SETTINGS), sensor)
    pieces = [columns(sampler.take(until)) for until in (0.003, 0.003, 7.0, 7.5, 24.0)]
    for name, values in whole.items():
        joined = np.concatenate([piece[name] for piece in pieces])
        np.testing.assert_array_equal(joined, values, err_msg=name)


def test_seeds_and_aircraft_differ() -> None:
    def start(seed: int, index: int) -> np.ndarray:
        settings = msgspec.structs.replace(SETTINGS, seed=seed)
        return SimulatedAircraft(settings, index).imu.take(2.0).accel_raw

    first = start(1, 0)
    np.testing.assert_array_equal(first, start(1, 0))
    assert (first != start(2, 0)).any()
    assert (first != start(1, 1)).any()


def test_receiver_stays_on_in_second_flight() -> None:
    gps = SimulatedAircraft(SETTINGS).gps.take(2.0 * FLIGHT_S)
    valid_s = (gps.unix_us - START_UNIX_US) * 1e-6
    assert (np.diff(valid_s) > 0.19).all()
    again = (valid_s >= FLIGHT_S) & (valid_s < FLIGHT_S + 5.0)
    assert gps.has_fix[again].all(), "the receiver stays on between flights"


def test_nodes_send_the_samples_and_their_status_in_order() -> None:
    imu, gps = (
        [*takewhile(lambda sent: sent.time_s < SECONDS, node.sent())]
        for node in nodes_of(SimulatedAircraft(SETTINGS), SETTINGS)
    )
    aircraft = SimulatedAircraft(SETTINGS)
    baro, gps_samples = aircraft.baro.take(SECONDS), aircraft.gps.take(SECONDS)
    fixes = gps_payloads(gps_samples, aircraft.gps_clock, SETTINGS.geoid_separation_m)
    for sent, kinds, expected in (
        (imu, wire.BaroPayload, [*pack_baro(baro)]),
        (gps, wire.GpsFixPayload | wire.GpsQualityPayload, [*fixes]),
    ):
        assert sent == sorted(sent, key=lambda each: each.time_s)
        found = [each for each in sent if isinstance(each.payload, kinds)]
        assert found == expected[: len(found)]
        assert len(found) > 190
    status = [each.payload for each in imu if isinstance(each.payload, wire.NodeStatusPayload)]
    assert len(status) == 20
    assert (status[0].sensors_present, status[0].sample_rate_hz) == (0b0111, 100)
    qualities = [s.payload for s in gps if isinstance(s.payload, wire.GpsQualityPayload)]
    assert (qualities[0].utc, qualities[0].h_acc_cm) == (None, 9999)
    assert qualities[-1].utc is not None
    assert qualities[-1].geoid_separation_cm == 2300


@pytest.mark.parametrize("skew_ppm", [-200.0, 0.0, 1500.0])
def test_device_clock_converts_both_ways_with_skew(skew_ppm: float) -> None:
    clock = DeviceClock(1_000_000, skew_ppm)
    assert clock.at(0.0) == 1_000_000
    assert clock.at(1000.0) == pytest.approx(1_001_000_000 + 1000 * skew_ppm, abs=1)
    shown_us = np.array([clock.at(t) for t in (0.5, 2000.0)])
    np.testing.assert_allclose(clock.true_s(shown_us), [0.5, 2000.0], atol=2e-6)
