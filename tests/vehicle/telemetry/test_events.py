import pytest

from gateway.vehicle.requests import INFO, WARNING, StatusText
from gateway.vehicle.telemetry.announcements import BUCKET, HOLD_US, Announcer
from gateway.vehicle.telemetry.health import Finding

GOOD, BAD = StatusText(INFO, "good"), StatusText(WARNING, "bad")


def track(announcer: Announcer, good: bool, now_us: int) -> list[str]:
    finding = Finding("topic", not good, GOOD if good else BAD)
    return [m.text for m in announcer.track(finding, now_us)]


def test_a_change_is_reported_once() -> None:
    announcer = Announcer()
    assert track(announcer, True, 0) == []
    assert track(announcer, False, 1) == ["bad"]
    assert track(announcer, False, 2) == []
    assert announcer.next_due_us() is None


def test_flapping_cannot_flood_and_the_last_text_is_true() -> None:
    announcer = Announcer()
    reported = []
    for n in range(10_000):
        now_us = n * 1000
        reported += track(announcer, n % 2 == 0, now_us)
        reported += [m.text for m in announcer.poll(now_us)]
    track(announcer, False, 10_000_000)
    reported += [m.text for m in announcer.poll(10_000_000 + HOLD_US)]
    assert len(reported) <= 4
    assert reported[-1] == "bad"


def test_a_change_while_held_is_reported_when_the_hold_ends() -> None:
    announcer = Announcer()
    track(announcer, False, 0)
    assert track(announcer, True, 1000) == []
    assert announcer.next_due_us() == HOLD_US
    assert announcer.poll(HOLD_US - 1) == []
    assert [m.text for m in announcer.poll(HOLD_US)] == ["good"]


def test_single_events_are_limited() -> None:
    announcer = Announcer()
    assert sum(len(announcer.say(GOOD, 0)) for _ in range(100)) == BUCKET
    assert len(announcer.say(GOOD, 500_000)) == 1
    assert announcer.say(GOOD, 500_001) == []


@pytest.mark.parametrize("size", [1, 49, 50, 51, 99, 100, 101, 199])
def test_long_texts_are_chunked(size: int) -> None:
    text = "".join(chr(ord("a") + n % 26) for n in range(size))
    found = Announcer().say(StatusText(INFO, text), 0)
    assert "".join(m.text for m in found) == text
    assert [m.chunk_seq for m in found] == list(range(len(found)))
    if size <= 50:
        assert found[0].id == 0
    else:
        assert len({m.id for m in found} - {0}) == 1
        assert len(found[-1].text) < 50
