import math

import numpy as np
import pytest

from gateway.estimation.paper import PaperEstimator, PaperSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import from_euler, rotate_inverse, to_euler
from gateway.records import ImuSample, NavFlags, NavState, Vec3
from tests.estimation.samples import LAT_DEG, LON_DEG, G, fix, imu, times

NO_DECLINATION = ReferenceSettings(gps_latency_s=0.0, declination="fixed")


def make(reference: ReferenceSettings = NO_DECLINATION, **settings: object) -> PaperEstimator:
    return PaperEstimator(PaperSettings(**settings), reference)


def run(estimator: PaperEstimator, samples: list[ImuSample]) -> NavState:
    for sample in samples:
        state = estimator.update_imu(sample)
    return state


def tilted(roll: float, pitch: float) -> Vec3:
    return rotate_inverse(from_euler(roll, pitch, 0.0), (0.0, 0.0, -G))


def metres(state: NavState) -> tuple[float, float]:
    return displacement_m(LAT_DEG, LON_DEG, state.lat_deg, state.lon_deg, 500.0)


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.5, -0.3), (-1.2, 0.9), (3.0, 0.2)])
def test_first_attitude_is_tilt_of_accelerometer(roll: float, pitch: float) -> None:
    state = run(make(), [imu(0, tilted(roll, pitch))])
    assert to_euler(state.q_nb)[:2] == pytest.approx((roll, pitch))
    assert NavFlags.ATTITUDE_VALID in state.flags
    assert NavFlags.HEADING_VALID not in state.flags
    assert math.isnan(state.lat_deg)


class TestGainEnds:
    @pytest.mark.parametrize(("gain", "euler_rad"), [(1.0, (0.2, 0.0, 0.0)), (0.0, (0.3, 0.1))])
    def test_gyro_gain_selects_sensor(self, gain: float, euler_rad: tuple[float, ...]) -> None:
        samples = [imu(t, tilted(0.3, 0.1), (0.2, 0.0, 0.0)) for t in times(1.01)]
        state = run(make(alpha_gyro=gain), [imu(0), *samples[1:]])
        found = to_euler(state.q_nb)[: len(euler_rad)]
        assert found == pytest.approx(euler_rad, abs=1e-9)

    @pytest.mark.parametrize(("gain", "north_m", "north_mps"), [(0.0, 7.0, 4.0), (1.0, 0.0, 0.0)])
    def test_position_and_velocity_gains_select_fix_or_integration(
        self, gain: float, north_m: float, north_mps: float
    ) -> None:
        estimator = make(alpha_accel=gain, beta_velocity=gain)
        run(estimator, [imu(t) for t in times(0.5)])
        estimator.update_gps(fix(500_000))
        estimator.update_gps(fix(510_000, north_m=7.0, vel=(4.0, 0.0, 0.0)))
        state = run(estimator, [imu(510_000)])
        assert metres(state)[0] == pytest.approx(north_m, abs=0.1)
        assert state.vel_n_mps[0] == pytest.approx(north_mps, abs=1e-9)


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 179.0, -179.0, -45.0])
def test_tilted_compass_gives_true_heading_with_declination(yaw_deg: float) -> None:
    yaw, declination = math.radians(yaw_deg), math.radians(5.0)
    q = from_euler(0.4, -0.2, yaw)
    north = (20.0 * math.cos(declination), 20.0 * math.sin(declination), 40.0)
    mag, accel = rotate_inverse(q, north), rotate_inverse(q, (0.0, 0.0, -G))
    reference = ReferenceSettings(declination="fixed", declination_deg=5.0)
    state = run(make(reference), [imu(t, accel, mag=mag) for t in times(5.0)])
    difference = math.remainder(to_euler(state.q_nb)[2] - yaw, 2.0 * math.pi)
    assert difference == pytest.approx(0.0, abs=1e-6)
    assert NavFlags.HEADING_VALID in state.flags


def test_dead_reckoning_between_fixes_removes_gravity() -> None:
    estimator = make()
    q = from_euler(0.0, 0.0, math.pi / 2.0)
    north = (25.0, 0.0, 40.0)
    still = [imu(t, mag=rotate_inverse(q, north)) for t in times(1.0)]
    run(estimator, still)
    estimator.update_gps(fix(1_000_000))
    # The nose points east: one second of forward acceleration gives a displacement east.
    moving = [imu(1_000_000 + t, (1.0, 0.0, -G), mag=None) for t in times(1.0)]
    gyro_only = make(alpha_gyro=1.0)
    gyro_only.restore(estimator.snapshot())
    state = run(gyro_only, moving)
    # The low-pass delays the acceleration by some 20 ms.
    assert metres(state) == pytest.approx((0.0, 0.5), abs=0.04)
    assert state.vel_n_mps == pytest.approx((0.0, 1.0, 0.0), abs=0.04)


def test_latency_moves_fix_forward_by_its_velocity() -> None:
    estimator = make(ReferenceSettings(gps_latency_s=0.5, declination="fixed"), beta_velocity=0.0)
    run(estimator, [imu(0)])
    estimator.update_gps(fix(0, vel=(10.0, -20.0, 2.0)))
    state = run(estimator, [imu(0)])
    assert metres(state) == pytest.approx((5.0, -10.0), abs=0.02)
    assert state.alt_amsl_m == pytest.approx(499.0)


def test_missing_gps_velocity_is_derived_from_two_positions() -> None:
    estimator = make(alpha_accel=0.0)
    run(estimator, [imu(0)])
    unknown = (math.nan, math.nan, math.nan)
    estimator.update_gps(fix(0, vel=unknown))
    estimator.update_gps(fix(1_000_000, north_m=3.0, east_m=4.0, vel=unknown, alt_m=501.0))
    state = run(estimator, [imu(0)])
    assert state.vel_n_mps == pytest.approx((3.0, 4.0, -1.0), abs=0.03)


def test_blending_at_every_sample_holds_position_at_fix() -> None:
    ends = {}
    for blend in ("at_fix", "every_sample"):
        estimator = make(alpha_gyro=1.0, blend=blend)
        run(estimator, [imu(0)])
        estimator.update_gps(fix(0, vel=(10.0, 0.0, 0.0)))
        ends[blend] = metres(run(estimator, [imu(t) for t in times(1.01)]))[0]
    assert ends["at_fix"] == pytest.approx(10.0, abs=0.02)
    assert ends["every_sample"] < 0.1


def noisy_rest(
    rng: np.random.Generator, bias: Vec3, begin_us: int, long_s: float
) -> list[ImuSample]:
    """Samples at rest, with noise and a gyroscope bias."""
    return [
        imu(
            begin_us + t,
            tuple(rng.normal((0, 0, -G), 0.03).tolist()),
            tuple(rng.normal(bias, math.radians(0.1)).tolist()),
        )
        for t in times(long_s)
    ]


BIAS = (math.radians(3.0), math.radians(-2.0), math.radians(1.0))


class TestGyroscopeBias:
    def test_bias_is_mean_rate_at_rest(self, rng: np.random.Generator) -> None:
        estimator = make()
        run(estimator, noisy_rest(rng, BIAS, 0, 20.0))
        estimator.update_gps(fix(20_000_000, vel=(20.0, 0.0, 0.0)))
        still = [imu(20_000_000 + t, gyro=BIAS) for t in times(60.0)]
        state = run(estimator, still)
        assert state.rate_b_radps == pytest.approx((0.0, 0.0, 0.0), abs=math.radians(0.05))
        assert to_euler(state.q_nb)[:2] == pytest.approx((0.0, 0.0), abs=math.radians(1.0))

    def test_bias_is_not_estimated_in_motion(self, rng: np.random.Generator) -> None:
        estimator, rate = make(), BIAS
        run(estimator, noisy_rest(rng, (0.0, 0.0, 0.0), 0, 5.0))
        for second in range(5, 15):
            estimator.update_gps(fix(second * 1_000_000, vel=(20.0, 0.0, 0.0)))
            state = run(estimator, noisy_rest(rng, rate, second * 1_000_000, 1.0))
        assert state.rate_b_radps == pytest.approx(rate, abs=math.radians(0.5))

    def test_bias_follows_change_between_rests(self, rng: np.random.Generator) -> None:
        estimator = make()
        run(estimator, noisy_rest(rng, BIAS, 0, 20.0))
        run(estimator, [imu(20_000_000 + t, gyro=(1.0, 0.0, 0.0)) for t in times(1.0)])
        state = run(estimator, noisy_rest(rng, (0.0, 0.0, 0.0), 21_000_000, 20.0))
        assert state.rate_b_radps == pytest.approx((0.0, 0.0, 0.0), abs=5e-3)
        assert NavFlags.ATTITUDE_VALID in state.flags


def test_two_minutes_of_circling_keep_attitude_errors_small() -> None:
    """In a coordinated turn at 20 m/s the specific force is that of level flight."""
    bank, speed_mps = math.radians(30.0), 20.0
    turn_radps = G * math.tan(bank) / speed_mps
    estimator, worst = make(), 0.0
    run(estimator, [imu(0, tilted(bank, 0.0))])
    rate = rotate_inverse(from_euler(bank, 0.0, 0.0), (0.0, 0.0, turn_radps))
    for t in times(120.0):
        yaw = turn_radps * t * 1e-6
        q = from_euler(bank, 0.0, yaw)
        if t % 1_000_000 == 0:
            course = (speed_mps * math.cos(yaw), speed_mps * math.sin(yaw), 0.0)
            estimator.update_gps(fix(t, vel=course))
        mag = rotate_inverse(q, (20.0, 0.0, 40.0)) if t % 100_000 == 0 else None
        state = estimator.update_imu(imu(t, (0.0, 0.0, -G / math.cos(bank)), rate, mag=mag))
        roll, pitch, found = to_euler(state.q_nb)
        off = (roll - bank, pitch, math.remainder(found - yaw, 2.0 * math.pi))
        worst = max(worst, *map(abs, off))
    assert math.degrees(worst) < 6.5, math.degrees(worst)


def test_zero_field_does_not_change_heading() -> None:
    estimator = make()
    east = run(estimator, [imu(t, mag=(0.0, -20.0, 40.0)) for t in times(0.5)])
    state = run(estimator, [imu(500_000, mag=(0.0, 0.0, 0.0))])
    assert to_euler(state.q_nb) == pytest.approx(to_euler(east.q_nb))


@pytest.mark.parametrize("jump_us", [5_000_000, -5_000_000])
def test_time_jump_is_not_integrated(jump_us: int) -> None:
    estimator = make(alpha_gyro=1.0)
    run(estimator, [imu(10_000_000 + t) for t in times(0.5)])
    state = run(estimator, [imu(10_500_000 + jump_us, gyro=(1.0, 0.0, 0.0))])
    assert to_euler(state.q_nb)[0] == pytest.approx(0.0, abs=1e-9)
    assert state.time_us == 10_500_000 + jump_us


def test_position_is_not_valid_after_long_dead_reckoning() -> None:
    estimator = make()
    run(estimator, [imu(0)])
    estimator.update_gps(fix(0))
    assert NavFlags.POSITION_VALID in run(estimator, [imu(5_000_000)]).flags
    assert NavFlags.POSITION_VALID not in run(estimator, [imu(40_000_000)]).flags
