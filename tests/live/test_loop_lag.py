from gateway.live.service import LagReport, LoopLag

S = 1_000_000


def call(lag: LoopLag, now_us: int, due_us: int) -> LagReport:
    lag.expect(due_us)
    return lag.update(now_us)


def test_short_delays_are_normal() -> None:
    lag = LoopLag()
    for step in range(1000):
        due_us = step * S // 10
        report = call(lag, due_us + (50_000 if step % 5 == 0 else 1_000), due_us)
        assert (report.stalled_us, report.changed) == (0, False)
    assert not lag.is_slow


def test_stall_at_the_start_is_normal() -> None:
    lag = LoopLag()
    call(lag, 0, 0)
    report = call(lag, 4 * S, 2 * S)
    assert (report.stalled_us, report.changed) == (2 * S, False)


def test_stall_is_reported_once_until_a_minute_without_one() -> None:
    lag = LoopLag()
    call(lag, 0, 0)
    report = call(lag, 13 * S, 10 * S)
    assert (report.stalled_us, report.changed, lag.longest_us) == (3 * S, True, 3 * S)
    report = call(lag, 16 * S, 15 * S)
    assert (report.stalled_us, report.changed, lag.longest_us) == (1 * S, False, 3 * S)
    changes = [call(lag, step * S, step * S).changed for step in range(17, 120)]
    assert changes.count(True) == 1
    assert not lag.is_slow


def test_many_short_delays_mean_that_the_computer_is_too_slow() -> None:
    lag = LoopLag()
    changes = []
    for step in range(100):
        due_us = step * S // 2
        changes.append(call(lag, due_us + 300_000, due_us).changed)
    assert changes.count(True) == 1
    assert lag.is_slow
