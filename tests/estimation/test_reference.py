import math

import pytest
from msgspec.structs import replace

from gateway.estimation.reference import EarthField, ReferenceSettings, is_usable
from gateway.records import GpsFixType
from tests.estimation.samples import ALT_M, LAT_DEG, LON_DEG, fix


@pytest.mark.parametrize(
    ("change", "usable"),
    [
        ({}, True),
        ({"h_acc_m": math.nan}, True),
        ({"fix_ok": False}, False),
        ({"fix_type": GpsFixType.NONE}, False),
        ({"fix_type": GpsFixType.TIME_ONLY}, False),
        ({"h_acc_m": 100.0}, False),
        ({"lat_dege7": 0, "lon_dege7": 0}, False),
    ],
    ids=str,
)
def test_fix_is_usable_unless_invalid(change: dict[str, object], usable: bool) -> None:
    assert is_usable(replace(fix(0), **change), ReferenceSettings()) == usable


def test_field_is_looked_up_once_and_again_far_away() -> None:
    earth = EarthField(ReferenceSettings())
    assert math.isnan(earth.declination_rad)
    earth.update(LAT_DEG, LON_DEG, ALT_M, None)
    first = earth.field
    assert math.degrees(earth.declination_rad) == pytest.approx(3.5, abs=0.5)
    earth.update(LAT_DEG + 0.01, LON_DEG, ALT_M, None)
    assert earth.field == first
    earth.update(LAT_DEG + 1.0, LON_DEG, ALT_M, None)
    assert earth.field != first
    earth.reset()
    assert earth.field is None


def test_fixed_declination_needs_no_fix() -> None:
    earth = EarthField(ReferenceSettings(declination="fixed", declination_deg=-10.0))
    assert earth.declination_rad == pytest.approx(math.radians(-10.0))
