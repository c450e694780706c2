from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.analysis.metrics import (
    euler_rad,
    heading_error_rad,
    inclination_error_rad,
    mean_abs,
    position_error_m,
    rms,
    rotation_error,
    total_error_rad,
    worst,
)
from tests.analysis.flights import short_flight, true_track


def quats(rotation: Rotation) -> np.ndarray:
    return np.atleast_2d(rotation.as_quat(scalar_first=True))


def test_nan_is_left_out_of_means() -> None:
    values = np.array([3.0, np.nan, -4.0])
    assert rms(values) == pytest.approx(np.sqrt(12.5))
    assert mean_abs(values) == 3.5
    assert worst(values) == 4.0
    assert all(np.isnan(f(np.array([np.nan]))) for f in (rms, mean_abs, worst))


@pytest.mark.parametrize("seed", range(3))
def test_rotation_error_splits_into_heading_and_inclination(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Rotation.random(20, rng=rng)
    turn = Rotation.from_euler("z", rng.uniform(-3.0, 3.0, (20, 1)))
    axis = np.column_stack([rng.normal(size=(20, 2)), np.zeros(20)])
    angle = rng.uniform(0.01, 1.5, 20)
    lean = Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=1)[:, None] * angle[:, None])
    only_turned = rotation_error(quats(turn * truth), quats(truth))
    assert heading_error_rad(only_turned) == pytest.approx(turn.as_rotvec()[:, 2])
    assert inclination_error_rad(only_turned) == pytest.approx(np.zeros(20), abs=1e-7)
    # Both signs of a quaternion are the same attitude.
    both = rotation_error(-quats(lean * turn * truth), quats(truth))
    assert inclination_error_rad(both) == pytest.approx(angle)
    assert total_error_rad(both) == pytest.approx((lean * turn).magnitude())


def test_euler_angles_equal_those_of_scipy(rng: np.random.Generator) -> None:
    rotation = Rotation.random(50, rng=rng)
    expected = rotation.as_euler("ZYX")[:, ::-1]
    assert euler_rad(quats(rotation)) == pytest.approx(expected)


def test_position_error_is_north_east_up() -> None:
    track = true_track(short_flight())
    lat_deg, lon_deg = track.lat_deg + 1e-5, track.lon_deg - 1e-5
    moved = replace(track, lat_deg=lat_deg, lon_deg=lon_deg, alt_amsl_m=track.alt_amsl_m + 2.0)
    error = position_error_m(moved, track)
    assert error[0] == pytest.approx([1.106, -1.103, 2.0], abs=2e-3)
