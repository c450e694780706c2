"""Moments as people write them."""

import pytest

from gateway.recordings.moment import Moment, parse_moment, time_us_of

DAY_US = 86_400_000_000


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("80", Moment(80.0)),
        ("80.5s", Moment(80.5)),
        ("1:20", Moment(80.0)),
        ("1:02:03.25", Moment(3723.25)),
        ("+10", Moment(10.0, relative=True)),
        ("-0:30", Moment(-30.0, relative=True)),
        (" 0 ", Moment(0.0)),
        ("1970-01-02T00:00:00Z", Moment(time_us=DAY_US)),
        ("1970-01-02", Moment(time_us=DAY_US)),
        ("1970-01-02T02:00:00+02:00", Moment(time_us=DAY_US)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_moment_is_parsed_in_every_notation(text: str, moment: Moment) -> None:
    assert parse_moment(text) == moment


@pytest.mark.parametrize(
    "text",
    ["", "soon", "1:2:3:4", "--5", "1:", "2026-13-01", "nan", "inf", "1e3", "1e400", "9" * 400,
     "9999-99-99T00:00:00Z"],
)  # fmt: skip
def test_invalid_moment_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"invalid time.*use 80, 1:20 or 2026-06-11T14:25:30Z"):
        parse_moment(text)


def test_moment_is_converted_to_the_time_of_the_recording() -> None:
    assert time_us_of(parse_moment("1:20"), 1_000) == 80_001_000
    assert time_us_of(parse_moment("1970-01-02"), 1_000) == DAY_US
