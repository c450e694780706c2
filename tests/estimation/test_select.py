"""The choice of an estimator."""

from typing import Any

import pytest

from gateway.estimation.eskf.settings import EskfSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from tests.estimation.samples import imu, times


def test_unknown_estimator_is_refused() -> None:
    assert EstimationSettings().estimator == "eskf"
    with pytest.raises(ValueError, match="choose eskf, paper"):
        EstimationSettings(estimator="kalman")


@pytest.mark.parametrize(("tolerance", "disturbed"), [(0.1, 1), (0.5, 0)])
def test_field_norm_tolerance_reaches_the_filter(tolerance: float, disturbed: int) -> None:
    settings = EstimationSettings(eskf=EskfSettings(field_norm_tolerance=tolerance))
    estimator: Any = make_estimator(settings)
    for time_us in times(10.0):
        strength = 1.0 if time_us < 9_000_000 else 4.0 / 3.0
        estimator.update_imu(imu(time_us, mag=(21.0 * strength, 0.0, 43.0 * strength)))
    assert estimator.state.mag_disturbed == disturbed
