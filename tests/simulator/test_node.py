"""Payloads contain the readings of the simulated sensors, at their times of sampling."""

from itertools import takewhile
from typing import Any

import numpy as np
import pytest

from gateway.records import GpsFixType, ImuFlags, NodeId
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.node import Sent, gps_payloads, nodes_of, pack_baro
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.wire import payloads as wire
from tests.kit.payloads import decode_payload
from tools.simulated_flight import fly

SETTINGS = SimulatorSettings()
SECONDS = 20.0


def sent_by(index: int) -> list[Sent]:
    node = nodes_of(SimulatedAircraft(SETTINGS), SETTINGS)[index]
    return list(takewhile(lambda sent: sent.time_s < SECONDS, node.sent()))


@pytest.fixture(scope="module")
def imu_sent() -> list[Sent]:
    return sent_by(0)


@pytest.fixture(scope="module")
def gps_sent() -> list[Sent]:
    return sent_by(1)


def of_kind(sent: list[Sent], kind: Any) -> list[Sent]:
    return [s for s in sent if isinstance(s.payload, kind)]


class TestImuNode:
    def test_imu_payloads_contain_simulated_samples(self, imu_sent: list[Sent]) -> None:
        imu = fly(SETTINGS, duration_s=SECONDS).imu
        payloads = [s.payload for s in of_kind(imu_sent, wire.ImuPayload)]
        np.testing.assert_array_equal([p.accel for p in payloads], imu.accel_raw[: len(payloads)])
        np.testing.assert_array_equal([p.gyro for p in payloads], imu.gyro_raw[: len(payloads)])
        np.testing.assert_array_equal([p.mag for p in payloads], imu.mag_raw[: len(payloads)])
        assert len(payloads) == pytest.approx(2000, abs=1)
        assert payloads[0].flags & ImuFlags.MAG_NEW
        assert (payloads[0].accel_range, payloads[0].gyro_range, payloads[0].mag_gain) == (2, 2, 1)

    def test_barometer_and_status_are_sent_at_their_rates(self, imu_sent: list[Sent]) -> None:
        baro = [s.payload for s in of_kind(imu_sent, wire.BaroPayload)]
        assert len(baro) == pytest.approx(500, abs=1)
        assert all(9_900_000 < p.pressure_centipa < 10_130_000 for p in baro)
        status = [s.payload for s in of_kind(imu_sent, wire.NodeStatusPayload)]
        assert len(status) == 20
        assert (status[0].sensors_present, status[0].sample_rate_hz) == (0b0111, 100)

    def test_node_time_is_that_of_sampling(self, imu_sent: list[Sent]) -> None:
        stamps = [s.node_time_us for s in of_kind(imu_sent, wire.ImuPayload)]
        assert set(np.diff(stamps)) == {10_000}
        times = np.array([s.time_s for s in of_kind(imu_sent, wire.ImuPayload)])
        np.testing.assert_allclose(np.diff(times), 0.01 / (1.0 + 120e-6), atol=1e-9)


class TestGpsNode:
    def test_quality_is_sent_before_its_fix(self, gps_sent: list[Sent]) -> None:
        sent = of_kind(gps_sent, wire.GpsFixPayload | wire.GpsQualityPayload)
        messages = [each.payload for each in sent]
        for quality, fix in zip(messages[::2], messages[1::2], strict=True):
            assert isinstance(quality, wire.GpsQualityPayload)
            assert isinstance(fix, wire.GpsFixPayload)
            assert quality.itow_ms == fix.itow_ms

    def test_lack_of_a_fix_is_reported(self, gps_sent: list[Sent]) -> None:
        for sent in of_kind(gps_sent, wire.GpsFixPayload):
            found = sent.time_s > 5.15
            assert sent.payload.fix_ok is found
            assert (sent.payload.fix_type is GpsFixType.FIX_3D) is found
        qualities = [s.payload for s in of_kind(gps_sent, wire.GpsQualityPayload)]
        assert (qualities[0].utc, qualities[0].h_acc_cm) == (None, 9999)
        assert qualities[-1].utc is not None
        assert qualities[-1].geoid_separation_cm == 2300

    def test_fix_is_near_simulated_position(self, gps_sent: list[Sent]) -> None:
        fix = of_kind(gps_sent, wire.GpsFixPayload)[50].payload
        assert fix.lat_dege7 == pytest.approx(-77_656_000, abs=1000)
        assert fix.lon_dege7 == pytest.approx(1_103_728_000, abs=2000)
        assert fix.alt_amsl_mm == pytest.approx(110_000, abs=8000)


def test_payloads_are_those_of_samples_taken_at_once(
    imu_sent: list[Sent], gps_sent: list[Sent]
) -> None:
    aircraft = SimulatedAircraft(SETTINGS)
    baro, gps = aircraft.baro.take(SECONDS), aircraft.gps.take(SECONDS)
    columns = (baro.time_s, baro.node_time_us, baro.pressure_pa, baro.temperature_degc)
    sent = of_kind(imu_sent, wire.BaroPayload)
    assert sent == [*pack_baro(columns)][: len(sent)]
    payloads = gps_payloads(gps, aircraft.gps_clock, SETTINGS.geoid_separation_m)
    sent = of_kind(gps_sent, wire.GpsFixPayload | wire.GpsQualityPayload)
    assert sent == [*payloads][: len(sent)]
    for node in (imu_sent, gps_sent):
        assert node == sorted(node, key=lambda sent: sent.time_s)


def test_every_payload_fits_the_radio(imu_sent: list[Sent], gps_sent: list[Sent]) -> None:
    for sent in (*imu_sent, *gps_sent):
        header = wire.Header(NodeId(31, 7), 65_535, sent.node_time_us)
        assert decode_payload(wire.encode_payload(header, sent.payload)) == (header, sent.payload)
