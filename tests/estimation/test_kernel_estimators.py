"""Estimators give the same bits live, offline and in pieces, and survive invalid data."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from gateway.compiled import address_of, record_at
from gateway.estimation import columns as col
from gateway.estimation.kernel import ESKF, CompiledEstimator, KernelEstimator, Kernels, SampleLog
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings, Estimator, make_estimator
from gateway.geometry.geodesy import displacement_m
from gateway.records import BaroSample, GpsFix, GpsFixType, ImuSample, NavFlags, NavState
from tests.estimation.samples import ALT_M, LAT_DEG, LON_DEG, NAV_VELS, G, fix, imu, times

Items = list[ImuSample | BaroSample | GpsFix]

REFERENCE = ReferenceSettings(gps_latency_s=0.2)
MAG = (21.0, 1.3, 43.0)
"""About the field at the position of the tests, uT."""


@pytest.fixture
def estimator() -> KernelEstimator:
    made = make_estimator(EstimationSettings(reference=REFERENCE))
    assert isinstance(made, KernelEstimator)
    return made


@pytest.fixture(params=["eskf", "paper"])
def either(request: pytest.FixtureRequest) -> Estimator:
    return make_estimator(EstimationSettings(estimator=request.param, reference=REFERENCE))


def still(start_us: int, seconds: float, seed: int = 1) -> list[ImuSample]:
    rng = np.random.default_rng(seed)
    return [
        imu(
            start_us + t,
            tuple(rng.normal((0, 0, -G), 0.02).tolist()),
            tuple(rng.normal(0, 0.002, 3).tolist()),
            tuple(rng.normal(MAG, 0.3).tolist()) if t % 50_000 == 0 else None,
        )
        for t in times(seconds)
    ]


def events(seconds: float, seed: int) -> Items:
    """Half at rest, then turning and climbing wildly, with fixes and barometer."""
    rng = np.random.default_rng(seed)
    out: Items = []
    for sample in still(0, seconds, seed):
        t = sample.time_us
        if t % 40_000 == 0:
            alt_m = ALT_M + float(rng.normal(0, 0.3))
            out.append(BaroSample(t, 95_000.0, 20.0, alt_m))
        if t > 1_000_000 and t % 200_000 == 0:
            moved = max(0.0, t * 1e-6 - seconds / 2)
            out.append(fix(t, 3.0 * moved, -2.0 * moved, (3.0, -2.0, -0.5) if moved else (0, 0, 0)))
        if t * 1e-6 > seconds / 2:
            sample = replace(sample, gyro_b_radps=tuple(rng.normal(0.1, 0.4, 3).tolist()))
        out.append(sample)
    return out


def feed(estimator: Estimator, items: Items) -> list[NavState]:
    states = []
    for item in items:
        if isinstance(item, ImuSample):
            states.append(estimator.update_imu(item))
        elif isinstance(item, BaroSample):
            estimator.update_baro(item)
        else:
            estimator.update_gps(item)
    return states


def as_log(estimator: KernelEstimator, items: Items) -> SampleLog:
    kinds = (ImuSample, BaroSample, GpsFix)
    imus, baros, fixes = ([i for i in items if isinstance(i, kind)] for kind in kinds)
    return SampleLog(
        imu_time_us=np.array([i.time_us for i in imus]),
        imu=np.array([col.imu_row(i) for i in imus]).reshape(-1, col.IMU_COLUMNS),
        baro_time_us=np.array([b.time_us for b in baros]),
        baro_alt_m=np.array([b.alt_pressure_m for b in baros]),
        gps_time_us=np.array([f.time_us for f in fixes]),
        gps=np.array([estimator.fix_row(f) for f in fixes]).reshape(-1, col.GPS_COLUMNS),
    )


def off_m(state: NavState) -> tuple[float, float]:
    return displacement_m(LAT_DEG, LON_DEG, state.lat_deg, state.lon_deg, ALT_M)


def as_rows(states: list[NavState]) -> np.ndarray:
    return np.array([col.nav_row(state) for state in states])


def test_log_and_samples_give_the_same_bits(estimator: KernelEstimator) -> None:
    items = events(8.0, 5)
    live = as_rows(feed(estimator, items))
    estimator.reset()
    offline = estimator.run(as_log(estimator, items))
    assert offline.shape == (len(live), col.NAV_COLUMNS)
    np.testing.assert_array_equal(offline, live)


def test_record_is_read_and_written_at_its_address(estimator: KernelEstimator) -> None:
    feed(estimator, events(1.0, 6))
    state: Any = estimator.state
    record = record_at(address_of(state), state.dtype)
    for name in state.dtype.names:
        np.testing.assert_array_equal(np.asarray(getattr(record, name)), state[name])
    record.time_s, record.q_nb[2] = 7.5, 0.25
    assert (state.time_s, state.q_nb[2]) == (7.5, 0.25)


class InPython:
    """A kernel that is not compiled."""

    def __init__(self, kernel: Any) -> None:
        self.bound = partial(partial, kernel.__wrapped__)

    def __call__(self, *arguments: float) -> None:
        self.bound(*arguments)()


def test_python_agrees_with_machine_code(estimator: KernelEstimator) -> None:
    """Powers are rounded differently, so the last bits may differ."""
    items = events(4.0, 5)
    in_python = Kernels(ESKF.state, *map(InPython, ESKF[1:]))
    found = feed(CompiledEstimator(in_python, estimator.gains, REFERENCE), items)
    machine = feed(estimator, items)
    np.testing.assert_allclose(as_rows(found), as_rows(machine), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_split_run_equals_one_run(either: Estimator, seed: int) -> None:
    items = events(8.0, seed)
    whole = as_rows(feed(either, items))
    either.reset()
    cut = len(items) * (seed + 1) // 4
    first = feed(either, items[:cut])
    kept = either.snapshot()
    feed(either, items[cut : cut + 50])
    either.restore(kept)
    np.testing.assert_array_equal(as_rows(first + feed(either, items[cut:])), whole)
    np.testing.assert_allclose(np.linalg.norm(whole[:, col.NAV_QUAT : 4], axis=1), 1.0, atol=1e-12)


def test_rest_is_detected_and_reported(estimator: KernelEstimator) -> None:
    state = feed(estimator, still(0, 4.0))[-1]
    assert NavFlags.AT_REST | NavFlags.ATTITUDE_VALID | NavFlags.USING_MAG in state.flags
    assert NavFlags.HEADING_VALID not in state.flags
    assert math.isnan(state.lat_deg)


def test_fix_gives_position_and_true_north(estimator: KernelEstimator) -> None:
    items = [*still(0, 2.0), fix(2_000_000), *still(2_000_000, 1.0)]
    state = feed(estimator, items)[-1]
    valid = NavFlags.POSITION_VALID | NavFlags.HEADING_VALID | NavFlags.USING_GPS
    assert valid in state.flags
    assert (state.lat_deg, state.lon_deg) == pytest.approx((LAT_DEG, LON_DEG), abs=1e-5)
    assert state.alt_amsl_m == pytest.approx(ALT_M, abs=1.0)
    # Calibrated field due magnetic north (atan2(1.3, 21)), declination about 3.5 deg east.
    heading_deg = math.degrees(2.0 * math.atan2(state.q_nb[3], state.q_nb[0]))
    assert heading_deg == pytest.approx(3.5 - math.degrees(math.atan2(1.3, 21.0)), abs=1.5)


class TestInvalidData:
    def finite(self, states: list[NavState]) -> bool:
        rows = as_rows(states)
        return bool(np.isfinite(rows[:, :4]).all() and np.isfinite(rows[1:, col.NAV_LAT]).all())

    @pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30, 1e300, -500.0])
    def test_invalid_samples_are_left_out_and_reported(self, either: Estimator, bad: float) -> None:
        feed(either, [*still(0, 3.0), fix(3_000_000)])
        change = {"accel_b_mps2": (bad, 0.0, bad), "gyro_b_radps": (bad, bad, 0.0)}
        broken = [replace(s, **change, mag_b_ut=(bad,) * 3) for s in still(3_000_000, 0.5)]
        states = feed(either, broken)
        assert self.finite(states)
        assert NavFlags.SENSOR_FAULT | NavFlags.DEGRADED in states[-1].flags
        after = feed(either, still(3_500_000, 1.0))[-1]
        assert NavFlags.SENSOR_FAULT not in after.flags
        assert after.q_nb[0] > 0.99
        assert math.hypot(*after.vel_n_mps) < 1.0

    def test_invalid_first_sample_gives_no_attitude(self, either: Estimator) -> None:
        state = either.update_imu(imu(0, (math.nan, 0.0, 0.0)))
        assert NavFlags.ATTITUDE_VALID not in state.flags
        assert NavFlags.SENSOR_FAULT in state.flags
        assert state.q_nb == (1.0, 0.0, 0.0, 0.0)

    def test_late_sample_does_not_change_attitude(self, either: Estimator) -> None:
        before = feed(either, [*still(0, 3.0), fix(3_000_000), *still(3_000_000, 0.1)])[-1]
        late = either.update_imu(imu(1_000_000, gyro=(9.0, 9.0, 9.0)))
        np.testing.assert_allclose(late.q_nb, before.q_nb, rtol=0.0, atol=1e-15)

    @pytest.mark.parametrize("repeats", [False, True])
    def test_lost_samples_are_not_reported_as_sensor_fault(
        self, estimator: KernelEstimator, repeats: bool
    ) -> None:
        items = still(0, 3.0)
        feed(estimator, [*items, fix(3_000_000)])
        for lost_s in (0.3, 0.6, 5.0):
            before = items[-1]
            items = still(estimator.state.time_us + round(lost_s * 1e6), 1.0)
            if repeats:
                items[0] = replace(items[0], gyro_b_radps=before.gyro_b_radps)
            states = feed(estimator, items)
            assert not [each for each in states if NavFlags.SENSOR_FAULT in each.flags]

    @pytest.mark.parametrize("jump_us", [5_000_000, -60_000_000])
    def test_time_jump_leaves_states_finite_and_gps_in_use(
        self, either: Estimator, jump_us: int
    ) -> None:
        start = 100_000_000
        feed(either, [*still(start, 3.0), fix(start + 3_000_000), *still(start + 3_000_000, 1.0)])
        later = start + 4_000_000 + jump_us
        items = still(later, 3.0)
        states = feed(either, [*items[:100], fix(later + 1_000_000), *items[100:]])
        assert self.finite(states)
        assert states[-1].q_nb[0] > 0.99
        assert NavFlags.USING_GPS | NavFlags.POSITION_VALID in states[100].flags

    def test_stuck_gyroscope_is_reported_until_recovery(self, estimator: KernelEstimator) -> None:
        feed(estimator, still(0, 3.0))
        stuck = [replace(s, gyro_b_radps=(0.3, 0.0, 0.0)) for s in still(3_000_000, 6.0)]
        states = feed(estimator, stuck)
        assert NavFlags.SENSOR_FAULT in states[-1].flags
        recovered = feed(estimator, still(9_000_000, 30.0))
        assert NavFlags.SENSOR_FAULT not in recovered[-1].flags
        assert recovered[-1].q_nb[0] > 0.99

    def test_gps_glitch_of_300_m_is_rejected_and_reported(self, estimator: KernelEstimator) -> None:
        items: Items = []
        for sample in still(0, 12.0):
            t = sample.time_us
            if t % 200_000 == 0 and t > 1_000_000:
                items.append(fix(t, east_m=300.0 * (6_000_000 < t < 10_000_000)))
            items.append(sample)
        states = feed(estimator, items)
        assert max(math.hypot(*off_m(state)) for state in states[200:]) < 5.0
        assert NavFlags.GPS_REJECTED in states[900].flags
        assert NavFlags.GPS_REJECTED not in states[-1].flags


def test_outage_is_reported_and_reset_discards_fixes(either: Estimator) -> None:
    feed(either, [*still(0, 3.0), fix(3_000_000)])
    states = feed(either, still(3_000_000, 5.0))
    assert NavFlags.USING_GPS in states[50].flags
    dead = NavFlags.DEAD_RECKONING | NavFlags.DEGRADED | NavFlags.POSITION_VALID
    assert dead in states[-1].flags
    again = feed(either, [fix(8_000_000), *still(8_000_000, 0.1)])[-1]
    assert NavFlags.USING_GPS in again.flags
    either.reset()
    state = either.update_imu(imu(0))
    assert math.isnan(state.lat_deg)
    assert state.q_nb == (1.0, 0.0, 0.0, 0.0)


def test_unusable_fix_is_ignored(either: Estimator) -> None:
    items = [imu(0), fix(0, fix_type=GpsFixType.NONE), imu(10_000)]
    assert math.isnan(feed(either, items)[-1].lat_deg)


def test_velocity_of_an_aircraft_at_rest_is_zero(estimator: KernelEstimator) -> None:
    rows = as_rows(feed(estimator, [*still(0, 3.0), fix(3_000_000), *still(3_000_000, 8.0)]))
    assert np.abs(rows[-1, NAV_VELS]).max() < 0.3
    assert int(rows[-1, col.NAV_FLAGS]) & NavFlags.AT_REST
