"""GPS time and UTC by the leap seconds of a date."""

from datetime import UTC, datetime

import pytest

from gateway.gps_time import WEEK_US, gps_us_of_unix, unix_us_of_gps

LEAP_SECONDS = {
    "1980-01-06T00:00:00": 0,
    "1981-06-30T23:59:59": 0,
    "1981-07-01T00:00:00": 1,
    "2008-12-31T23:59:59": 14,
    "2012-07-01T00:00:00": 16,
    "2013-07-23T07:33:04": 16,
    "2016-12-31T23:59:59": 17,
    "2017-01-01T00:00:00": 18,
    "2026-06-01T00:00:00": 18,
}


@pytest.mark.parametrize(("date", "leaps"), LEAP_SECONDS.items())
def test_gps_time_is_ahead_of_utc_by_the_leap_seconds_of_its_date(date: str, leaps: int) -> None:
    civil = datetime.fromisoformat(date).replace(tzinfo=UTC)
    elapsed_s = (civil - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds()
    unix_us = round(civil.timestamp() * 1e6)
    assert gps_us_of_unix(unix_us) == (elapsed_s + leaps) * 1e6
    assert unix_us_of_gps(gps_us_of_unix(unix_us)) == unix_us


def test_week_and_time_of_week_give_utc() -> None:
    assert unix_us_of_gps(1750 * WEEK_US + 200_000_000_000) == 1_374_564_784_000_000
