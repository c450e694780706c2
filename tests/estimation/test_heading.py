"""Heading where field, gyroscope or receiver are imperfect; parts of the filter run as Python."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from gateway.estimation.columns import GPS_DECLINATION, GPS_STRENGTH
from gateway.estimation.eskf.filter import start
from gateway.estimation.eskf.magnetometer import (
    NORM_ERROR,
    field_weight,
    raise_hard_iron,
    update_hard_iron,
)
from gateway.estimation.eskf.predict import rate_of
from gateway.estimation.eskf.settings import EskfSettings, make_gains
from gateway.estimation.eskf.state import ATT, GYRO_BIAS, HARD_IRON, State
from gateway.estimation.eskf.update import update_rest
from gateway.estimation.record import as_vec, new_record
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.geometry.geomagnetism import magnetic_field
from gateway.records import NavFlags
from tests.estimation.samples import LAT_DEG, LON_DEG, G, fix, imu, times
from tools.flights import read_flight

GAINS = make_gains(EskfSettings(), ReferenceSettings())
DIP_RAD = math.radians(60.0)
STRENGTH_UT = 46.0


def started(dip_rad: float = DIP_RAD, strength_ut: float = STRENGTH_UT) -> State:
    """Return a levelled state below an Earth model's field, which the compass shows as given."""
    s = new_record(State)
    start(s, GAINS)
    s.started = 1
    s.earth_dip_rad, s.earth_norm_ut = DIP_RAD, STRENGTH_UT
    s.field_n[0] = strength_ut * math.cos(dip_rad)
    s.field_n[2] = strength_ut * math.sin(dip_rad)
    return s


@pytest.mark.parametrize(
    ("dip_deg", "strength_ut", "expected_ut"),
    [(60.0, 46.0, None), (62.0, 47.0, None), (60.0, 61.0, 15.0), (80.0, 46.0, 15.7)],
)
def test_field_unlike_the_model_raises_hard_iron_and_heading_variance(
    dip_deg: float, strength_ut: float, expected_ut: float | None
) -> None:
    s = started(math.radians(dip_deg), strength_ut)
    before = s.P.copy()
    raise_hard_iron(s)
    if expected_ut is None:
        np.testing.assert_array_equal(s.P, before)
        return
    tolerance_ut = NORM_ERROR * STRENGTH_UT
    assert math.sqrt(s.P[HARD_IRON, HARD_IRON]) == pytest.approx(expected_ut, abs=tolerance_ut)
    # A compass that shows hard iron east of the horizontal field is off by their ratio.
    heading_rad = math.sqrt(s.P[HARD_IRON + 1, HARD_IRON + 1]) / math.hypot(*s.field_n[:2])
    assert s.P[ATT + 2, ATT + 2] > 0.5 * heading_rad**2


def test_field_unlike_the_model_has_little_weight_before_a_usual_one_is_known() -> None:
    s = started()
    assert field_weight(s, GAINS, STRENGTH_UT, DIP_RAD, 0.01) == pytest.approx(1.0)
    assert field_weight(s, GAINS, 1.2 * STRENGTH_UT, DIP_RAD, 0.01) < 0.1
    assert field_weight(s, GAINS, STRENGTH_UT, DIP_RAD - 0.2, 0.01) < 0.1
    s.earth_norm_ut = math.nan
    assert field_weight(s, GAINS, 1.2 * STRENGTH_UT, DIP_RAD, 0.01) == 1.0


@pytest.mark.parametrize("heading_rad", [0.0, 1.0])
def test_norm_in_turns_gives_the_hard_iron_whatever_the_heading(heading_rad: float) -> None:
    s, hard_iron = started(), np.array([4.0, -3.0, 2.0])
    s.q_nb[0], s.q_nb[3] = math.cos(heading_rad / 2), math.sin(heading_rad / 2)
    rng = np.random.default_rng(2)
    for _ in range(3000):
        axis = rng.normal(size=3)
        mag = STRENGTH_UT * axis / np.linalg.norm(axis) + hard_iron
        update_hard_iron(s, GAINS, tuple(mag.tolist()), 1.0, 0.1)
    np.testing.assert_allclose(s.hard_iron_b, hard_iron, atol=0.5)
    np.testing.assert_allclose(s.q_nb, [math.cos(heading_rad / 2), 0, 0, math.sin(heading_rad / 2)])


def test_rate_at_rest_far_from_a_known_bias_changes_it_little() -> None:
    found: dict[float, float] = {}
    for std_degps in (0.05, 1.0):
        s = started()
        s.P[GYRO_BIAS + 2, GYRO_BIAS + 2] = math.radians(std_degps) ** 2
        s.gyro_mean[2] = math.radians(-1.0)
        update_rest(s, GAINS)
        found[std_degps] = math.degrees(s.gyro_bias_b[2])
    assert found[0.05] == pytest.approx(0.0, abs=0.03)
    assert found[1.0] == pytest.approx(-1.0, abs=0.05)


def test_scale_error_does_not_change_the_rate_of_a_bias() -> None:
    s = started()
    s.gyro_bias_b[:] = 0.1, -0.05, 0.02
    s.gyro_scale_b[:] = 0.02, 0.03, -0.02
    assert rate_of(s, as_vec(s.gyro_bias_b)) == (0.0, 0.0, 0.0)


def test_position_without_heading_moves_on_between_fixes() -> None:
    estimator: Any = make_estimator(EstimationSettings(reference=ReferenceSettings()))
    speed_mps, states = 12.0, []
    for t in times(20.0):
        if t % 1_000_000 == 0:
            estimator.update_gps(fix(t, north_m=speed_mps * (t * 1e-6 - 0.15), vel=(12.0, 0, 0)))
        states.append((t, estimator.update_imu(imu(t, (0.0, 0.0, -G)))))
    for t, state in states[200:]:
        assert NavFlags.HEADING_VALID not in state.flags
        north_m = math.radians(state.lat_deg - LAT_DEG) * 6.37e6
        assert north_m == pytest.approx(speed_mps * t * 1e-6, abs=1.5)


@pytest.mark.parametrize("declination", ["", " declination_deg=7.0"])
def test_flight_without_declination_has_that_of_the_model(tmp_path: Path, declination: str) -> None:
    path = tmp_path / "flight.csv"
    table = pd.DataFrame(
        {"time_s": [0.0, 0.01], "ax": 0.0, "ay": 0.0, "az": -G, "gx": 0.0, "gy": 0.0, "gz": 0.0}
        | {"gps_lat": [LAT_DEG, math.nan], "gps_lon": LON_DEG, "gps_alt_m": 500.0}
        | {"gps_time_s": 0.0, "gps_vn": 0.0, "gps_ve": 0.0, "gps_vd": 0.0}
    )
    path.write_text(f"# flight{declination}\n{table.to_csv(index=False)}")
    flight = read_flight(path)
    model = magnetic_field(LAT_DEG, LON_DEG, 500.0, 2027.5)
    expected_rad = math.radians(7.0) if declination else model.declination_rad
    assert flight.log.gps[0, GPS_DECLINATION] == pytest.approx(expected_rad)
    assert flight.log.gps[0, GPS_STRENGTH] == pytest.approx(model.strength_ut)
