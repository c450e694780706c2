"""The flight is one motion: every quantity is the others' derivative or integral."""

import math

import msgspec
import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.spatial.transform import Rotation

from gateway.geometry import geodesy
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, Trajectory, Truth
from gateway.units import STANDARD_GRAVITY_MPS2

STEP_S = 0.002


def fly(seed: int = 1, **changes: float) -> Trajectory:
    settings = msgspec.structs.replace(SimulatorSettings(), **changes)
    return Trajectory(settings, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return fly()


@pytest.fixture(scope="module")
def truth(trajectory: Trajectory) -> Truth:
    return trajectory.truth_at(np.arange(0.0, FLIGHT_S, STEP_S))


def euler_deg(truth: Truth) -> np.ndarray:
    yaw_pitch_roll = Rotation.from_quat(truth.q_nb, scalar_first=True).as_euler("ZYX", degrees=True)
    return yaw_pitch_roll[:, ::-1]


class TestConsistency:
    def test_specific_force_without_gravity_integrates_to_velocity(self, truth: Truth) -> None:
        force_n = Rotation.from_quat(truth.q_nb, scalar_first=True).apply(truth.accel_b_mps2)
        accel_n = force_n + np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
        vel = cumulative_simpson(accel_n, dx=STEP_S, axis=0, initial=0.0)
        np.testing.assert_allclose(vel, truth.vel_n_mps, atol=1e-6)

    def test_velocity_integrates_to_position(self, truth: Truth) -> None:
        pos = cumulative_simpson(truth.vel_n_mps, dx=STEP_S, axis=0, initial=0.0)
        np.testing.assert_allclose(pos, truth.pos_n_m, atol=1e-6)

    def test_body_rate_integrates_to_attitude(self, trajectory: Trajectory) -> None:
        # The rate at the middle of a step turns the attitude from its start to its end.
        step_s = 0.001
        edges = trajectory.truth_at(np.arange(110.0, 130.0, step_s))
        middles = trajectory.truth_at(edges.time_s[:-1] + 0.5 * step_s)
        steps = Rotation.from_rotvec(middles.rate_b_radps * step_s)
        attitude = Rotation.from_quat(edges.q_nb[0], scalar_first=True)
        for k in range(len(steps)):
            attitude = attitude * steps[k]
        error = (attitude.inv() * Rotation.from_quat(edges.q_nb[-1], scalar_first=True)).magnitude()
        assert math.degrees(error) < 0.001

    def test_degrees_agree_with_metres(self, truth: Truth) -> None:
        for k in range(0, len(truth.time_s), 5000):
            here_deg = float(truth.lat_deg[k]), float(truth.lon_deg[k])
            north_m, east_m = geodesy.displacement_m(-7.7656, 110.3728, *here_deg, 133.0)
            assert north_m == pytest.approx(truth.pos_n_m[k, 0], abs=1e-3)
            assert east_m == pytest.approx(truth.pos_n_m[k, 1], abs=1e-3)
            assert truth.alt_amsl_m[k] == pytest.approx(110.0 - truth.pos_n_m[k, 2])

    def test_quaternions_have_unit_norm_and_no_jump(self, truth: Truth) -> None:
        np.testing.assert_allclose(np.linalg.norm(truth.q_nb, axis=1), 1.0, atol=1e-12)
        assert np.abs(np.diff(truth.q_nb, axis=0)).max() < 0.003

    def test_attitude_alone_is_the_same(self, trajectory: Trajectory, truth: Truth) -> None:
        np.testing.assert_array_equal(trajectory.attitude_at(truth.time_s), truth.q_nb)


class TestFlight:
    def test_begins_and_ends_at_rest(self, truth: Truth) -> None:
        resting = (truth.time_s < 11.0) | (truth.time_s > FLIGHT_S - 5.0)
        np.testing.assert_allclose(truth.vel_n_mps[resting], 0.0, atol=1e-6)
        np.testing.assert_allclose(truth.rate_b_radps[resting], 0.0, atol=1e-6)
        gravity = np.broadcast_to((0.0, 0.0, -STANDARD_GRAVITY_MPS2), (resting.sum(), 3))
        np.testing.assert_allclose(truth.accel_b_mps2[resting], gravity, atol=1e-6)

    def test_second_flight_equals_the_first(self, trajectory: Trajectory) -> None:
        times = np.linspace(0.0, FLIGHT_S, 40, endpoint=False)
        first, second = trajectory.truth_at(times), trajectory.truth_at(times + FLIGHT_S)
        np.testing.assert_allclose(second.pos_n_m, first.pos_n_m, atol=1e-9)
        np.testing.assert_array_equal(second.time_s, times + FLIGHT_S)

    def test_loads_speeds_and_angles_suit_a_small_aircraft(self, truth: Truth) -> None:
        roll, pitch, _ = euler_deg(truth).T
        airborne = -truth.pos_n_m[:, 2] > 5.0
        load = np.linalg.norm(truth.accel_b_mps2, axis=1) / STANDARD_GRAVITY_MPS2
        assert load.min() > 0.4
        assert load.max() < 2.5
        assert 40.0 < np.abs(roll).max() < 52.0
        assert np.abs(pitch).max() < 25.0
        assert 60.0 < -truth.pos_n_m[:, 2].min() < 120.0
        assert truth.airspeed_mps[airborne].min() > 11.0
        assert np.degrees(np.abs(truth.rate_b_radps)).max() < 150.0
        assert truth.pos_n_m[:, 2].max() < 1e-3, "underground"

    def test_turns_both_ways_in_coordination(self) -> None:
        """Without gusts a steady turn satisfies `tan(bank) = speed * turn rate / g`."""
        calm = fly(gust_mps=0.0, wind_mps=0.0).truth_at(np.arange(30.0, 150.0, 0.02))
        roll = np.radians(euler_deg(calm)[:, 0])
        course = np.unwrap(np.arctan2(calm.vel_n_mps[:, 1], calm.vel_n_mps[:, 0]))
        turn = np.gradient(course, 0.02)
        expected = np.arctan2(calm.airspeed_mps * turn, STANDARD_GRAVITY_MPS2)
        steady = np.abs(np.gradient(expected, 0.02)) < math.radians(1.0)
        for sign in (-1.0, 1.0):
            turning = steady & (sign * turn > math.radians(10.0))
            assert turning.sum() > 300
            off_deg = np.degrees(roll - expected)[turning]
            assert abs(off_deg.mean()) < 1.0
            assert off_deg.std() < 2.5

    @pytest.mark.parametrize("wind_from_deg", [0.0, 100.0, 250.0])
    @pytest.mark.parametrize("wind_mps", [0.0, 5.0])
    def test_flight_ends_at_home_in_any_wind(self, wind_mps: float, wind_from_deg: float) -> None:
        wind = {"wind_mps": wind_mps, "wind_from_deg": wind_from_deg, "gust_mps": 1.5}
        windy = fly(int(wind_from_deg), **wind)
        end = windy.truth_at(np.array([FLIGHT_S - 1e-6]))
        np.testing.assert_allclose(end.pos_n_m, 0.0, atol=1e-3)

    def test_equal_seeds_give_equal_flights(self) -> None:
        times = np.arange(0.0, FLIGHT_S, 1.0)
        one, same, other = (fly(seed).truth_at(times).pos_n_m for seed in (5, 5, 6))
        np.testing.assert_array_equal(one, same)
        assert np.abs(one - other).max() > 1.0
