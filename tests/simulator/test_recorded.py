"""A recording comes out of the wire as it went in, at its own times."""

from typing import Any

import numpy as np
import pytest

from gateway.config import GatewaySettings
from gateway.pipeline import PipelineSettings
from gateway.recordings.flown import open_flown
from gateway.recordings.recorded_table import ReadOptions
from gateway.records import NAN, BaroRaw, GpsFix, ImuFlags, ImuRaw, NodeStatus, RawRecord
from gateway.simulator.recorded import RecordedFlight, in_rounds, replay
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.wire.link import Link

ROWS = 500
TIME_S = 100.0 + np.arange(ROWS) / 50.0
QUIET = SimulatorSettings(radio_loss=0.0, radio_duplicates=0.0, vehicle_id=4)


def columns(**changes: np.ndarray | None) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    new_mag = np.arange(ROWS) % 5 == 2
    new_gps = np.arange(ROWS) % 10 == 9

    def only(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.where(rows, values, np.nan)

    table = {
        "time_s": TIME_S,
        **{name: rng.normal(0.0, 3.0, ROWS) for name in ("ax", "ay", "gx", "gy", "gz")},
        "az": rng.normal(-9.8, 3.0, ROWS),
        **{name: only(new_mag, rng.normal(0.0, 30.0, ROWS)) for name in ("mx", "my", "mz")},
        "baro_alt_m": only(new_mag, rng.normal(200.0, 5.0, ROWS)),
        "gps_time_s": only(new_gps, TIME_S - 0.004),
        "gps_lat": only(new_gps, rng.normal(47.0, 0.001, ROWS)),
        "gps_lon": only(new_gps, rng.normal(8.0, 0.001, ROWS)),
        "gps_alt_m": only(new_gps, rng.normal(500.0, 3.0, ROWS)),
        **{f"gps_v{axis}": only(new_gps, rng.normal(0.0, 9.0, ROWS)) for axis in "ned"},
    }
    table |= {name: values for name, values in changes.items() if values is not None}
    return {name: v for name, v in table.items() if changes.get(name, v) is not None}


def flight_of(columns: dict[str, np.ndarray]) -> RecordedFlight:
    blank = np.full(ROWS, NAN)

    def stack(*names: str) -> np.ndarray:
        return np.column_stack([columns.get(name, blank) for name in names])

    fixes = np.isfinite(stack("gps_time_s", "gps_lat", "gps_lon")).all(axis=1)
    gps_time_s, lat_deg, lon_deg, alt_m = (
        columns.get(f"gps_{name}", blank)[fixes] for name in ("time_s", "lat", "lon", "alt_m")
    )
    return RecordedFlight(
        *(TIME_S - TIME_S[0], stack("ax", "ay", "az"), stack("gx", "gy", "gz")),
        *(stack("mx", "my", "mz"), columns.get("baro_alt_m", blank)),
        *(
            gps_time_s - TIME_S[0],
            lat_deg,
            lon_deg,
            alt_m,
            stack("gps_vn", "gps_ve", "gps_vd")[fixes],
        ),
        gps_latency_s=0.2,
    )


def fly(flight: RecordedFlight, settings: SimulatorSettings = QUIET) -> list[RawRecord]:
    link = Link()
    return [
        record
        for frame in replay(settings, flight).frames(flight.duration_s)
        for record in link.feed(frame.data, round(frame.time_s * 1e6))
    ]


def of_kind(records: list[RawRecord], kind: type) -> list[Any]:
    return [record for record in records if isinstance(record, kind)]


@pytest.fixture(scope="module")
def flight() -> RecordedFlight:
    return flight_of(columns())


@pytest.fixture(scope="module")
def records(flight: RecordedFlight) -> list[RawRecord]:
    return fly(flight)


class TestThroughTheWire:
    def test_inertial_samples_agree_within_half_a_count(
        self, flight: RecordedFlight, records: list[RawRecord]
    ) -> None:
        imu = of_kind(records, ImuRaw)
        assert len(imu) == ROWS
        accel_scale = imu[0].accel_range_g * 9.80665 / 32768
        lsb_per_dps = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}[imu[0].gyro_range_dps]
        accel = np.array([r.accel_raw for r in imu]) * accel_scale * (1, -1, -1)
        gyro = np.radians(np.array([r.gyro_raw for r in imu]) / lsb_per_dps) * (1, -1, -1)
        np.testing.assert_allclose(accel, flight.accel_b_mps2, atol=0.51 * accel_scale)
        half_count = np.radians(0.51 / lsb_per_dps)
        np.testing.assert_allclose(gyro, flight.gyro_b_radps, atol=half_count)

    def test_magnetometer_is_held(self, flight: RecordedFlight, records: list[RawRecord]) -> None:
        imu = of_kind(records, ImuRaw)
        new = np.array([bool(r.flags & ImuFlags.MAG_NEW) for r in imu])
        np.testing.assert_array_equal(new, np.isfinite(flight.mag_b_ut[:, 0]))
        scale = 100.0 / imu[0].mag_lsb_per_gauss
        field = np.array([r.mag_raw for r in imu]) * scale * (1, -1, -1)
        np.testing.assert_allclose(field[new], flight.mag_b_ut[new], atol=0.51 * scale)
        np.testing.assert_array_equal(field[3:7], np.tile(field[2], (4, 1)))

    def test_barometer_gives_its_height_back(
        self, flight: RecordedFlight, records: list[RawRecord]
    ) -> None:
        pressures = np.array([r.pressure_pa for r in of_kind(records, BaroRaw)])
        heights = (1.0 - (pressures / 101_325.0) ** (1.0 / 5.255876)) * 288.15 / 0.0065
        recorded = flight.baro_alt_m[np.isfinite(flight.baro_alt_m)]
        np.testing.assert_allclose(heights, recorded, atol=0.002)

    def test_fixes_equal_recording(self, flight: RecordedFlight, records: list[RawRecord]) -> None:
        fixes = of_kind(records, GpsFix)
        lat = [r.lat_dege7 * 1e-7 for r in fixes]
        np.testing.assert_allclose(lat, flight.gps_lat_deg, atol=1e-7)
        np.testing.assert_allclose([r.alt_amsl_m for r in fixes], flight.gps_alt_m, atol=1e-3)
        vel = [r.vel_n_mps for r in fixes]
        np.testing.assert_allclose(vel, flight.gps_vel_n_mps, atol=0.006)
        assert all(r.fix_ok and r.h_acc_m == 2.0 and r.speed_acc_mps == 0.3 for r in fixes)
        assert all(r.node.vehicle_id == 4 for r in fixes)

    def test_times_are_those_of_the_recording(
        self, flight: RecordedFlight, records: list[RawRecord]
    ) -> None:
        for kind, recorded_s in ((ImuRaw, flight.time_s), (GpsFix, flight.gps_time_s)):
            late_s = np.array([r.time_us for r in of_kind(records, kind)]) * 1e-6 - recorded_s
            assert late_s.min() >= 0.0
            assert late_s.max() < 0.02
            # Once the clocks are learned: one and the same delay of reading, radio and line.
            assert np.ptp(late_s[recorded_s > 5.0]) < 0.0001

    def test_status_contains_the_rate(self, records: list[RawRecord]) -> None:
        status = of_kind(records, NodeStatus)
        rates = {r.node.node_id: (r.sample_rate_hz, r.sensors_present) for r in status}
        assert rates == {0: (50, 0b0111), 1: (5, 0b1000)}


class TestRanges:
    @pytest.mark.parametrize(
        ("peak_mps2", "range_g"), [(15, 2), (25, 4), (60, 8), (150, 16), (900, 16)]
    )
    def test_finest_range_that_holds_a_peak_is_chosen(self, peak_mps2: float, range_g: int) -> None:
        calm, ax = np.zeros((2, ROWS))
        ax[10] = -peak_mps2
        found = fly(flight_of(columns(ax=ax, ay=calm, az=calm - 9.8)))
        imu = of_kind(found, ImuRaw)
        assert imu[0].accel_range_g == range_g
        clipped = [bool(r.flags & ImuFlags.ACCEL_CLIPPED) for r in imu]
        assert clipped == [k == 10 and peak_mps2 == 900.0 for k in range(ROWS)]

    def test_absent_sensors_are_reported(self) -> None:
        bare = {name: values for name, values in columns().items() if name[0] in "tag" and
                not name.startswith("gps")}  # fmt: skip
        found = fly(flight_of(bare))
        assert not any(isinstance(r, GpsFix | BaroRaw) for r in found)
        imu = of_kind(found, ImuRaw)
        assert imu[0].flags == ImuFlags.MAG_ABSENT | ImuFlags.BARO_ABSENT
        assert of_kind(found, NodeStatus)[0].sensors_present == 1


def test_missing_values_are_reported_as_unknown() -> None:
    table = columns(gps_vn=None, gps_alt_m=None)
    fix, *_ = of_kind(fly(flight_of(table)), GpsFix)
    assert np.isnan([fix.speed_acc_mps, fix.v_acc_m]).all()
    assert fix.h_acc_m == 2.0


@pytest.mark.io
def test_real_flight_passes_the_link_without_loss(data_dir) -> None:
    options = ReadOptions(PipelineSettings(GatewaySettings().default_aircraft))
    flight = open_flown([data_dir / "arduplane_testlog2.csv.gz"], options)
    assert flight.gps_latency_s == 0.28
    link, fixes = Link(), []
    for frame in replay(QUIET, flight).frames(60.0):
        found = link.feed(frame.data, round(frame.time_s * 1e6))
        fixes += [record for record in found if isinstance(record, GpsFix)]
    lon = np.array([fix.lon_dege7 * 1e-7 for fix in fixes])
    np.testing.assert_allclose(lon, flight.gps_lon_deg[: len(lon)], atol=1e-7)
    late_s = np.array([fix.time_us for fix in fixes]) * 1e-6 - flight.gps_time_s[: len(lon)]
    assert 0.0 < late_s.min() < late_s.max() < 0.03
    report = link.report(0, connected=True, port="")
    assert report.faults == ()
    assert report.nodes[0].lost == 0


def test_recording_repeats_without_landing(flight: RecordedFlight) -> None:
    link = Link()
    found: list[RawRecord] = []
    rounds: list[tuple[int, int]] = []
    until_s = 2.5 * flight.duration_s
    frames = replay(QUIET, flight).frames()
    for frame in in_rounds(frames, flight.duration_s, lambda n: rounds.append((n, len(found)))):
        if frame.time_s > until_s:
            break
        found.extend(link.feed(frame.data, round(frame.time_s * 1e6)))
    assert [number for number, _ in rounds] == [2, 3]
    (_, one), (_, two) = rounds
    first, second = (
        [r.accel_raw for r in of_kind(some, ImuRaw)] for some in (found[:one], found[one:two])
    )
    assert len(first) == pytest.approx(ROWS, abs=2)
    assert second[5:-5] == first[5:-5] or second[6:-5] == first[5:-6]
    nodes = link.report(round(until_s * 1e6), connected=True, port="").nodes
    assert [(node.restarts, node.lost) for node in nodes] == [(0, 0)] * 2


def test_recording_without_barometer_and_gps_repeats() -> None:
    bare = flight_of(columns(baro_alt_m=None, gps_lat=None))
    frames = replay(QUIET, bare).frames()
    assert sum(1 for _, frame in zip(range(3 * ROWS), frames, strict=False)) == 3 * ROWS
