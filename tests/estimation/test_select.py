"""Settings that several estimators share reach each of them."""

import math

import pytest

from gateway.estimation.magfield import CompassSettings
from gateway.estimation.rest import RestSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from tests.estimation.samples import imu, times

ONE_DEGPS = math.radians(1.0)


@pytest.mark.parametrize("name", ["paper", "complementary", "eskf"])
@pytest.mark.parametrize(("limit_degps", "share_left"), [(6.0, (0.0, 0.2)), (0.5, (0.4, 1.0))])
def test_rest(name: str, limit_degps: float, share_left: tuple[float, float]) -> None:
    """What turns faster than any bias is no rest, and its rate is not learned."""
    rest = RestSettings(bias_limit_degps=limit_degps)
    estimator = make_estimator(EstimationSettings(estimator=name, rest=rest))
    for time_us in times(20.0):
        state = estimator.update_imu(imu(time_us, gyro=(0.0, 0.0, ONE_DEGPS)))
    assert share_left[0] <= state.rate_b_radps[2] / ONE_DEGPS <= share_left[1]


@pytest.mark.parametrize("name", ["complementary", "eskf"])
@pytest.mark.parametrize(("tolerance", "disturbed"), [(0.1, 1), (0.5, 0)])
def test_compass(name: str, tolerance: float, disturbed: int) -> None:
    """A field a third stronger is another field, or still the same."""
    compass = CompassSettings(norm_tolerance=tolerance)
    estimator = make_estimator(EstimationSettings(estimator=name, compass=compass))
    for time_us in times(10.0):
        strength = 1.0 if time_us < 9_000_000 else 4.0 / 3.0
        estimator.update_imu(imu(time_us, mag=(21.0 * strength, 0.0, 43.0 * strength)))
    assert estimator.state.mag_disturbed == disturbed
