import math

import pytest

from gateway.vehicle import encoding

UNKNOWN = [
    (encoding.uint8, 255, 0, 254),
    (encoding.uint16, 65535, 0, 65534),
    (encoding.int16, 0, -32768, 32767),
    (encoding.int32, 0, -(2**31), 2**31 - 1),
    (encoding.uint32, 0, 0, 2**32 - 1),
]


@pytest.mark.parametrize(("fit", "unknown", "low", "high"), UNKNOWN)
def test_ends_and_unknown(fit: object, unknown: int, low: int, high: int) -> None:
    assert fit(math.nan) == unknown
    assert fit(-math.inf) == fit(-1e300) == low
    assert fit(math.inf) == fit(1e300) == high
    assert fit(12.5001) == 13
    assert isinstance(fit(12.2), int)


def test_a_field_without_a_mark_uses_its_whole_range() -> None:
    assert encoding.uint16(1e9, unknown=0) == 65535


@pytest.mark.parametrize(
    ("deg", "cdeg", "whole"),
    [(0.0, 0, 0), (-0.001, 0, 0), (359.999, 0, 0), (-90.0, 27000, 270), (180.0, 18000, 180)],
)
def test_compass(deg: float, cdeg: int, whole: int) -> None:
    assert encoding.compass_cdeg(math.radians(deg)) == cdeg
    assert encoding.compass_deg(math.radians(deg)) == whole


def test_unknown_compass() -> None:
    assert encoding.compass_cdeg(math.nan) == 65535
