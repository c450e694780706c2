"""The decisions of a session, also with a disk that fails."""

from collections.abc import Callable
from typing import Any

import pytest

from gateway.live.session import (
    RETRY_US,
    Announce,
    ClosePart,
    CorrectTimes,
    OpenPart,
    RecordingSettings,
    Session,
    SessionAction,
    SessionState,
    part_stem,
    session_name,
)
from gateway.recordings.index import check_name

UNIX_US = 1_781_187_930_000_000
NAME = "20260611-142530"
STARTED = Announce(is_trouble=False, text=f"Recording {NAME}")
ENDED = Announce(is_trouble=False, text=f"Recording {NAME} ended")
FULL = Announce(is_trouble=True, text="Recording stopped: less than 100 MB free")
NOT_STARTED = Announce(is_trouble=True, text="Recording not started: less than 200 MB free")
OPEN_1, OPEN_2, OPEN_3 = (OpenPart(NAME, number) for number in (1, 2, 3))
Step = tuple[Callable[[Session], list[SessionAction] | None], list[SessionAction] | None]


def polled(now_us: int = 0, size: int = 0, free: int = 10**12, **how: Any) -> Any:
    return lambda session: session.poll(now_us, UNIX_US, size, free, **how)


def opened(now_us: int = 0) -> Any:
    return lambda session: session.opened(now_us)


def failed(reason: str, now_us: int = 0) -> Any:
    return lambda session: session.failed(reason, now_us)


def trouble(text: str) -> Announce:
    return Announce(is_trouble=True, text=f"Recording {text}")


BEGUN: list[Step] = [(polled(), [OPEN_1]), (opened(), [STARTED])]
TRANSCRIPTS: dict[str, tuple[dict[str, float], list[Step]]] = {
    "stop closes the part": (
        {},
        [*BEGUN, (Session.stop, None), (polled(), [ClosePart(), ENDED]), (polled(), [])],
    ),
    "large part is followed by the next": (
        {"rotate_mb": 2},
        [*BEGUN, (polled(size=2_000_000), []), (polled(size=2_000_001), [ClosePart(), OPEN_2]),
         (opened(), [])],
    ),
    "old part is followed by the next": (
        {"rotate_min": 1},
        [*BEGUN, (polled(59_000_000), []), (polled(61_000_000), [ClosePart(), OPEN_2])],
    ),
    "wrong clock corrects the times once per part and keeps the name": (
        {"rotate_mb": 2},
        [*BEGUN, (polled(60, jumped=True), [ClosePart(), CorrectTimes(), OPEN_2]), (opened(60), []),
         (polled(61, jumped=True), []), (polled(62, 2_000_001), [ClosePart(), OPEN_3]),
         (opened(62), []),
         (polled(63, jumped=True), [ClosePart(), CorrectTimes(), OpenPart(NAME, 4)])],
    ),
    "full disk blocks until there is space": (
        {"free_floor_mb": 100},
        [*BEGUN, (polled(free=99_000_000), [ClosePart(), FULL]), (polled(RETRY_US - 1), []),
         (polled(RETRY_US, free=110_000_000), []), (polled(RETRY_US, free=130_000_000), [OPEN_2]),
         (opened(RETRY_US), [STARTED])],
    ),
    "no part is opened on a full disk": (
        {}, [(polled(free=0), [NOT_STARTED]), (polled(RETRY_US), [OPEN_1])],
    ),
    "retry needs some space even without a floor": (
        {"free_floor_mb": 0},
        [*BEGUN, (failed("disk is full"), [ClosePart(), trouble("stopped: disk is full")]),
         (polled(RETRY_US, free=900_000), []), (polled(RETRY_US, free=1_100_000), [OPEN_2])],
    ),
    "repeated failure is announced once and uses no part number": (
        {},
        [(polled(), [OPEN_1]), (failed("read-only disk"), [trouble("not started: read-only disk")]),
         (polled(RETRY_US), [OPEN_1]), (failed("read-only disk", RETRY_US), []),
         (failed("no folder", RETRY_US), [trouble("not started: no folder")])],
    ),
    "failed write is retried in the next part": (
        {},
        [*BEGUN, (failed("disk full", 5), [ClosePart(), trouble("stopped: disk full")]),
         (polled(5 + RETRY_US - 1), []), (polled(5 + RETRY_US), [OPEN_2])],
    ),
    "stop ends a blocked recording": (
        {},
        [*BEGUN, (failed("disk full"), [ClosePart(), trouble("stopped: disk full")]),
         (Session.stop, None), (polled(), [ENDED]), (polled(10 * RETRY_US), [])],
    ),
    "command retries a blocked recording at once": (
        {},
        [(polled(), [OPEN_1]), (failed("read-only disk"), [trouble("not started: read-only disk")]),
         (polled(1), []), (Session.start, None), (polled(2), [OPEN_1])],
    ),
}  # fmt: skip
"""Settings, and events with the actions that each must cause."""


@pytest.mark.parametrize("name", TRANSCRIPTS)
def test_events_cause_actions(name: str) -> None:
    settings, steps = TRANSCRIPTS[name]
    session = Session(RecordingSettings(mode="always", **settings))
    for number, (event, actions) in enumerate(steps):
        assert event(session) == actions, number
    assert (session.state is SessionState.IDLE) == name.startswith("stop")


def test_mode_decides_without_a_command() -> None:
    for mode, states in {
        "manual": {False: False, True: False},
        "in_flight": {False: False, True: True},
        "always": {False: True},
    }.items():
        for in_flight, expected in states.items():
            session = Session(RecordingSettings(mode=mode))
            session.set_in_flight(in_flight)
            assert session.wanted is expected, mode
            assert bool(polled()(session)) is expected, mode


def test_commands_override_the_mode_until_the_next_flight() -> None:
    session = Session(RecordingSettings(mode="in_flight"))
    session.set_in_flight(True)
    session.stop()
    assert not session.wanted
    session.set_in_flight(False)
    session.set_in_flight(True)
    assert session.wanted


def test_names_are_in_utc_sort_by_time_and_are_safe() -> None:
    assert session_name(UNIX_US) == NAME
    assert part_stem(NAME, 3) == f"{NAME}_03"
    for name in ("first flight", "Ünal-3", "a.b_c", "x" * 100):
        assert check_name(name) == name
    for name in ("", "../x", "a/b", ".hidden", "a\0", "-rf", "x" * 101, "a."):
        with pytest.raises(ValueError, match="not a name"):
            check_name(name)
