"""Samples and their truth, whole and in pieces."""

import dataclasses

import msgspec
import numpy as np
import pytest

from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.sensors import DeviceClock
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S
from tools.simulated_flight import SimulatedFlight, fly

SETTINGS = SimulatorSettings()


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return fly(SETTINGS)


def columns(samples: object) -> dict[str, np.ndarray]:
    fields = {f.name: getattr(samples, f.name) for f in dataclasses.fields(samples)}
    return {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}


class TestSamples:
    def test_samples_have_the_rates_of_their_sensors(self, flight: SimulatedFlight) -> None:
        assert len(flight.imu.time_s) == pytest.approx(21_800, abs=4)
        assert flight.imu.mag_new.mean() == pytest.approx(0.75, abs=0.001)
        assert len(flight.baro.time_s) == pytest.approx(5450, abs=2)
        assert len(flight.gps.time_s) == 1090

    def test_inertial_samples_follow_truth(self, flight: SimulatedFlight) -> None:
        errors, imu = flight.errors, flight.imu
        face_up = np.array([1.0, -1.0, -1.0])
        accel_s = imu.accel_b_mps2 * face_up - errors.accel_bias_mps2
        off = accel_s @ np.transpose(errors.accel_matrix) * face_up - imu.truth.accel_b_mps2
        assert np.abs(off.mean(axis=0)).max() < 0.03
        assert 0.3 < off.std() < 0.6, "mostly the motor's shaking"
        off = imu.gyro_b_radps - errors.gyro_bias_radps * face_up - imu.truth.rate_b_radps
        assert np.abs(off.mean(axis=0)).max() < 0.005

    def test_magnetometer_follows_truth(self, flight: SimulatedFlight) -> None:
        errors, imu = flight.errors, flight.imu
        face_up = np.array([1.0, -1.0, -1.0])
        off_s = imu.mag_b_ut * face_up - errors.mag_hard_iron_ut
        field_b = off_s @ np.transpose(errors.mag_soft_iron) * face_up
        norms = np.linalg.norm(field_b[imu.mag_new], axis=1)
        magnetometer = SimulatedAircraft(flight.settings, 0).imu.magnetometer
        np.testing.assert_allclose(norms, np.linalg.norm(magnetometer.field_n_ut), atol=2.0)
        assert np.isnan(imu.mag_b_ut[~imu.mag_new]).all()
        assert (imu.flags[imu.mag_new] & ImuFlags.MAG_NEW).all()
        age_s = imu.time_s - imu.mag_time_s
        assert (age_s >= 0.0).all()
        assert age_s.max() < 1.0 / 75.0 + 1e-5

    def test_fixes_have_latency_and_small_errors(self, flight: SimulatedFlight) -> None:
        gps = flight.gps
        latency_s = gps.time_s - gps.valid_time_s
        assert 0.13 <= latency_s.min() < latency_s.max() <= 0.19
        truth = flight.trajectory.truth_at(gps.valid_time_s)
        fixed = gps.has_fix
        north_m = np.radians(gps.lat_deg - truth.lat_deg)[fixed] * 6_336_000.0
        assert 0.3 < north_m.std() < 1.6
        assert np.abs(north_m).max() < 4.0
        vel_off = (gps.vel_n_mps - truth.vel_n_mps)[fixed]
        assert 0.03 < vel_off[:, :2].std() < 0.12
        assert (gps.unix_us % 200_000 == 0).all()
        assert (np.diff(gps.itow_ms) == 200).all()

    def test_fixes_are_missing_before_first_fix_and_in_outages(
        self, flight: SimulatedFlight
    ) -> None:
        gps = flight.gps
        assert not gps.has_fix[gps.valid_time_s < 5.0].any()
        for start_s, length_s in SETTINGS.gps_outages_s:
            inside = (gps.valid_time_s >= start_s) & (gps.valid_time_s < start_s + length_s)
            assert not gps.has_fix[inside].any()
            before = gps.h_acc_m[gps.valid_time_s < start_s][-1]
            assert gps.h_acc_m[gps.valid_time_s >= start_s + length_s][0] > 3.0 * before
        assert (~gps.has_fix).sum() == 5 * (5 + 10 + 3)
        assert not gps.time_valid[0]
        assert gps.time_valid[-1]

    @pytest.mark.parametrize("rate_hz", [60, 200, 1000])
    def test_imu_samples_follow_set_rate(self, rate_hz: int) -> None:
        settings = msgspec.structs.replace(SETTINGS, imu_rate_hz=rate_hz)
        imu = fly(settings, duration_s=4.0).imu
        assert len(imu.time_s) == pytest.approx(4 * rate_hz, abs=1)
        assert imu.mag_new.sum() == pytest.approx(4 * min(rate_hz, 75), abs=1)


class TestPieces:
    @pytest.mark.parametrize("sensor", ["imu", "baro", "gps"])
    def test_pieces_equal_whole_flight(self, sensor: str) -> None:
        whole = columns(getattr(SimulatedAircraft(SETTINGS), sensor).take(24.0))
        sampler = getattr(SimulatedAircraft(SETTINGS), sensor)
        pieces = [columns(sampler.take(until)) for until in (0.003, 0.003, 7.0, 7.5, 24.0)]
        for name, values in whole.items():
            joined = np.concatenate([piece[name] for piece in pieces])
            np.testing.assert_array_equal(joined, values, err_msg=name)

    def test_seeds_and_aircraft_differ(self) -> None:
        def start(seed: int, index: int) -> np.ndarray:
            settings = msgspec.structs.replace(SETTINGS, seed=seed)
            return SimulatedAircraft(settings, index).imu.take(2.0).accel_raw

        first = start(1, 0)
        np.testing.assert_array_equal(first, start(1, 0))
        assert (first != start(2, 0)).any()
        assert (first != start(1, 1)).any()

    def test_receiver_stays_on_in_second_flight(self) -> None:
        gps = SimulatedAircraft(SETTINGS).gps.take(2.0 * FLIGHT_S)
        assert (np.diff(gps.valid_time_s) > 0.19).all()
        again = (gps.valid_time_s >= FLIGHT_S) & (gps.valid_time_s < FLIGHT_S + 5.0)
        assert gps.has_fix[again].all(), "the receiver stays on between flights"


class TestRecords:
    def test_records_are_ordered_and_complete(self, flight: SimulatedFlight) -> None:
        records = list(flight.records())
        times = [record.time_us for record in records]
        assert times == sorted(times)
        kinds = {k: [r for r in records if isinstance(r, k)] for k in (ImuRaw, BaroRaw, GpsFix)}
        assert [len(found) for found in kinds.values()] == [
            len(flight.imu.time_s), len(flight.baro.time_s), len(flight.gps.time_s)
        ]  # fmt: skip
        fix = kinds[GpsFix][300]
        assert fix.fix_type is GpsFixType.FIX_3D
        assert fix.lat_dege7 == round(flight.gps.lat_deg[300] * 1e7)
        assert kinds[ImuRaw][5].accel_raw == tuple(flight.imu.accel_raw[5])
        assert kinds[BaroRaw][5].pressure_pa == flight.baro.pressure_pa[5]


@pytest.mark.parametrize("skew_ppm", [-200.0, 0.0, 1500.0])
def test_device_clock_converts_both_ways_with_skew(skew_ppm: float) -> None:
    clock = DeviceClock(1_000_000, skew_ppm)
    assert clock.at(0.0) == 1_000_000
    assert clock.at(1000.0) == pytest.approx(1_001_000_000 + 1000 * skew_ppm, abs=1)
    shown_us = np.array([clock.at(t) for t in (0.5, 2000.0)])
    np.testing.assert_allclose(clock.true_s(shown_us), [0.5, 2000.0], atol=2e-6)
