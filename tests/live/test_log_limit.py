"""The log is bounded whatever happens, and tells how much it left out."""

import logging

from gateway.live.log_limit import BURST, LogLimit


def line(
    text: str, second: float, lineno: int = 1, error: Exception | None = None
) -> logging.LogRecord:
    info = (type(error), error, error.__traceback__) if error else None
    record = logging.LogRecord("here", logging.INFO, "place.py", lineno, "%s", (text,), info)
    record.created = second
    return record


def test_a_kind_has_a_few_lines_at_once_and_then_one_a_second() -> None:
    limit = LogLimit()
    told = [limit.filter(line(f"n {n}", 1000.0 + n / 1000)) for n in range(5000)]
    assert sum(told) == BURST + 4
    assert all(told[:BURST])


def test_the_next_line_tells_how_many_were_left_out() -> None:
    limit = LogLimit()
    for n in range(BURST + 7):
        limit.filter(line(f"n {n}", 1000.0))
    record = line("at last", 1001.0)
    assert limit.filter(record)
    assert record.getMessage() == "at last (and 7 more like it, not logged)"
    after = line("and then", 1002.0)
    assert limit.filter(after)
    assert after.getMessage() == "and then"


def test_kinds_do_not_silence_each_other() -> None:
    limit = LogLimit()
    for n in range(1000):
        limit.filter(line(f"n {n}", 1000.0))
    assert limit.filter(line("elsewhere", 1000.0, lineno=2))


def fail(where: int) -> Exception:
    try:
        if where:
            int("here")
        int("there")
    except ValueError as error:
        return error
    raise AssertionError


def test_errors_are_told_apart_by_where_they_came_from() -> None:
    """The loop logs every error of a callback at one place of its own."""
    limit = LogLimit()
    for _ in range(1000):
        limit.filter(line("Exception in callback", 1000.0, error=fail(0)))
    assert not limit.filter(line("Exception in callback", 1000.0, error=fail(0)))
    assert limit.filter(line("Exception in callback", 1000.0, error=fail(1)))


def test_a_clock_that_is_set_back_silences_nothing() -> None:
    limit = LogLimit()
    for n in range(BURST):
        assert limit.filter(line(f"n {n}", 1_000_000.0))
    assert not limit.filter(line("too many", 1_000_000.0))
    told = [limit.filter(line("back then", 1000.0 + n)) for n in range(5)]
    assert sum(told) >= 4
