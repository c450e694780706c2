"""The log is bounded whatever happens, and reports how many lines it left out."""

import logging

import pytest

from gateway.live.log_limit import BURST, LogLimit
from tests.conftest import ManualClock


@pytest.fixture
def limit(clock: ManualClock) -> LogLimit:
    clock.advance(1000.0)
    return LogLimit(lambda: clock.now_us / 1e6)


def line(text: str, lineno: int = 1, error: Exception | None = None) -> logging.LogRecord:
    info = (type(error), error, error.__traceback__) if error else None
    return logging.LogRecord("here", logging.INFO, "place.py", lineno, "%s", (text,), info)


def test_burst_passes_then_one_line_per_second(limit: LogLimit, clock: ManualClock) -> None:
    passed = []
    for n in range(5000):
        passed.append(limit.filter(line(f"n {n}")))
        clock.advance(0.001)
    assert sum(passed) == BURST + 4
    assert all(passed[:BURST])


def test_next_line_reports_how_many_were_suppressed(limit: LogLimit, clock: ManualClock) -> None:
    for n in range(BURST + 7):
        limit.filter(line(f"n {n}"))
    clock.advance(1.0)
    record = line("at last")
    assert limit.filter(record)
    assert record.getMessage() == "at last (and 7 more like it, not logged)"
    clock.advance(1.0)
    after = line("and then")
    assert limit.filter(after)
    assert after.getMessage() == "and then"


def test_endless_repetition_is_logged_every_second(limit: LogLimit, clock: ManualClock) -> None:
    passed = []
    for _ in range(600):
        passed.append(sum(limit.filter(line("again")) for _ in range(10)))
        clock.advance(1.0)
    assert passed[:2] == [10, 10]
    assert set(passed[2 * BURST :]) == {1}


def fail(where: int) -> Exception:
    try:
        if where:
            int("here")
        int("there")
    except ValueError as error:
        return error
    raise AssertionError


def test_errors_of_different_code_positions_are_limited_separately(limit: LogLimit) -> None:
    """The loop logs every error of a callback at one code position of its own."""
    assert limit.filter(line("elsewhere", lineno=2))
    for _ in range(1000):
        limit.filter(line("Exception in callback", error=fail(0)))
    assert not limit.filter(line("Exception in callback", error=fail(0)))
    assert limit.filter(line("Exception in callback", error=fail(1)))


@pytest.mark.parametrize("step_s", [-7200.0, 7200.0], ids=["backwards", "forwards"])
def test_step_of_the_wall_clock_suppresses_no_line(
    limit: LogLimit, clock: ManualClock, step_s: float
) -> None:
    for n in range(100):
        record = line(f"status {n}")
        record.created = 1e9 + n * (step_s + 10.0)
        assert limit.filter(record)
        clock.advance(10.0)
