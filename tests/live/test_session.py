"""The decisions of a session, also with a disk that fails."""

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
MUCH = 10**12
ALWAYS = RecordingSettings(mode="always")
STARTED = Announce(is_trouble=False, text=f"Recording {NAME}")
ENDED = Announce(is_trouble=False, text=f"Recording {NAME} ended")


def poll(
    session: Session, now_us: int = 0, size: int = 0, free: int = MUCH, *, jumped: bool = False
) -> list[SessionAction]:
    return session.poll(now_us, UNIX_US, size, free, jumped=jumped)


def recording(settings: RecordingSettings = ALWAYS) -> Session:
    session = Session(settings)
    session.start()
    assert poll(session) == [OpenPart(NAME, 1)]
    assert session.opened(0) == [STARTED]
    return session


def test_names_are_in_utc_and_sort_by_time() -> None:
    assert session_name(UNIX_US) == NAME
    assert part_stem(NAME, 3) == f"{NAME}_03"


@pytest.mark.parametrize("name", ["first flight", "Ünal-3", "a.b_c", "x" * 100])
def test_valid_name_is_accepted(name: str) -> None:
    assert check_name(name) == name


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a\0", "-rf", "x" * 101, "a."])
def test_unsafe_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="not a name"):
        check_name(name)


@pytest.mark.parametrize(
    ("mode", "in_flight", "expected"),
    [
        ("manual", False, False),
        ("manual", True, False),
        ("in_flight", False, False),
        ("in_flight", True, True),
        ("always", False, True),
    ],
)
def test_mode_decides_without_a_command(mode: str, in_flight: bool, expected: bool) -> None:
    session = Session(RecordingSettings(mode=mode))
    session.set_in_flight(in_flight)
    assert session.wanted is expected
    assert bool(poll(session)) is expected


def test_commands_override_the_mode_until_the_next_flight() -> None:
    session = Session(RecordingSettings(mode="in_flight"))
    session.set_in_flight(True)
    session.stop()
    assert not session.wanted
    session.set_in_flight(False)
    session.set_in_flight(True)
    assert session.wanted


def test_stop_closes_the_part() -> None:
    session = recording()
    session.stop()
    assert poll(session) == [
        ClosePart(),
        ENDED,
    ]
    assert session.state is SessionState.IDLE
    assert poll(session) == []


@pytest.mark.parametrize(("now_us", "size"), [(0, 2_000_001), (61_000_000, 0)])
def test_large_or_old_parts_are_followed_by_the_next(now_us: int, size: int) -> None:
    session = recording(RecordingSettings(mode="always", rotate_mb=2, rotate_min=1))
    assert poll(session, size=2_000_000) == []
    assert poll(session, now_us, size) == [ClosePart(), OpenPart(NAME, 2)]
    assert session.opened(now_us) == []


def test_wrong_clock_corrects_the_times_and_keeps_the_announced_name() -> None:
    session = recording()
    actions = session.poll(60_000_000, UNIX_US + 86_460_000_000, 0, MUCH, jumped=True)
    assert actions == [ClosePart(), CorrectTimes(), OpenPart(NAME, 2)]


def test_full_disk_blocks_recording_until_there_is_space() -> None:
    session = recording(RecordingSettings(mode="always", free_floor_mb=100))
    closing, announcement = poll(session, free=99_000_000)
    assert closing == ClosePart()
    assert announcement == Announce(
        is_trouble=True, text="Recording stopped: less than 100 MB free"
    )
    assert poll(session, RETRY_US - 1) == []
    assert poll(session, RETRY_US, free=110_000_000) == []
    assert poll(session, RETRY_US, free=130_000_000) == [OpenPart(NAME, 2)]
    assert session.opened(RETRY_US) == [STARTED]


def test_repeated_failure_is_announced_once_and_uses_no_part_number() -> None:
    session = Session(ALWAYS)
    assert poll(session) == [OpenPart(NAME, 1)]
    assert len(session.failed("read-only disk", 0)) == 1
    assert poll(session, RETRY_US) == [OpenPart(NAME, 1)]
    assert session.failed("read-only disk", RETRY_US) == []
    assert len(session.failed("no such directory", RETRY_US)) == 1


def test_failed_write_closes_the_part_and_retries_in_a_new_one() -> None:
    session = recording()
    assert session.failed("disk full", 5)[0] == ClosePart()
    assert session.state is SessionState.BLOCKED
    assert poll(session, 5 + RETRY_US) == [OpenPart(NAME, 2)]


def test_stop_ends_a_blocked_recording() -> None:
    session = recording()
    session.failed("disk full", 0)
    session.stop()
    assert poll(session) == [ENDED]
    assert session.state is SessionState.IDLE
    assert poll(session, 10 * RETRY_US) == []


def test_no_part_is_opened_on_a_full_disk() -> None:
    session = Session(ALWAYS)
    (announcement,) = poll(session, free=0)
    assert isinstance(announcement, Announce)
    assert announcement.is_trouble
    assert poll(session, RETRY_US) == [OpenPart(NAME, 1)]


def test_retry_needs_some_space_even_without_a_floor() -> None:
    session = recording(RecordingSettings(mode="always", free_floor_mb=0))
    session.failed("disk is full", 0)
    assert poll(session, RETRY_US, free=900_000) == []
    assert poll(session, RETRY_US, free=1_100_000) == [OpenPart(NAME, 2)]


def test_command_retries_a_blocked_recording_at_once() -> None:
    session = Session(ALWAYS)
    poll(session)
    session.failed("read-only disk", 0)
    assert poll(session, 1) == []
    session.start()
    assert session.state is not SessionState.BLOCKED
    assert poll(session, 2) == [OpenPart(NAME, 1)]
