import math

import pytest

from gateway.geometry.geomagnetism import magnetic_field, year_of


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "declination_deg", "dip_deg", "strength_ut"),
    [
        (-37.8, 144.9, 11.9, -68.5, 60.0),
        (48.1, 11.6, 4.5, 64.5, 49.0),
        (0.0, 120.0, -0.2, -15.1, 41),
    ],
    ids=["Melbourne", "Munich", "equator"],
)
def test_field_equals_published_values(
    lat_deg: float, lon_deg: float, declination_deg: float, dip_deg: float, strength_ut: float
) -> None:
    field = magnetic_field(lat_deg, lon_deg, 0.0, 2025.0)
    assert math.degrees(field.declination_rad) == pytest.approx(declination_deg, abs=0.6)
    assert math.degrees(field.inclination_rad) == pytest.approx(dip_deg, abs=0.6)
    assert field.strength_ut == pytest.approx(strength_ut, rel=0.02)


def test_year_of_unix_time() -> None:
    assert year_of(1_735_689_600_000_000) == pytest.approx(2025.0, abs=0.003)
    assert year_of(None) == 2027.5
