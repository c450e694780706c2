"""Signatures of a site with a passphrase: unsigned, forged and replayed frames."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet.frame_translation import MAX_STREAMS, WINDOW_TICKS, SiteSignatures
from gateway.vehicle.requests import EPOCH_2015_US, TICK_US, TICKS_PER_S
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.kit.mavlink import packed

KEY = bytes(range(32))
NOW_TICKS = 1_000_000_000
NOW_US = NOW_TICKS * TICK_US
MINUTE_TICKS = 60 * 100_000
"""In units of 10 us."""


def signed(timestamp: int, *, link: int = 1, system: int = 1, key: bytes = KEY) -> MavFrame:
    message = mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0)
    return frame_of(packed(message, system, signing=(key, link, timestamp)))


@pytest.fixture
def site() -> SiteSignatures:
    return SiteSignatures(KEY, EPOCH_2015_US)


def test_unsigned_frame_is_rejected(site: SiteSignatures) -> None:
    message: Any = mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0)
    for version in (1, 2):
        assert site.check(frame_of(packed(message, version=version)), NOW_US) == "unsigned"


def test_frame_of_another_passphrase_is_rejected_and_begins_no_stream(site: SiteSignatures) -> None:
    assert site.check(signed(NOW_TICKS + 9, key=bytes(32)), NOW_US) == "forged"
    assert site.check(signed(NOW_TICKS), NOW_US) == ""


@pytest.mark.parametrize("age_s", [0, 1, 4, 60, 86_400])
def test_recorded_frame_is_rejected_at_any_later_time(site: SiteSignatures, age_s: int) -> None:
    frame = signed(NOW_TICKS)
    assert site.check(frame, NOW_US) == ""
    later_ticks = NOW_TICKS + age_s * TICKS_PER_S
    assert site.check(signed(later_ticks + 1), later_ticks * TICK_US) == ""
    assert site.check(frame, later_ticks * TICK_US) == "replayed"


@pytest.mark.parametrize(
    ("age_ticks", "rejection"),
    [(MINUTE_TICKS, ""), (MINUTE_TICKS + 1, "replayed"), (-(10**9), "")],
)
def test_first_frame_of_a_stream_is_at_most_a_minute_old(
    site: SiteSignatures, age_ticks: int, rejection: str
) -> None:
    """A recorded frame is rejected after a restart of the fleet, too."""
    assert site.check(signed(NOW_TICKS - age_ticks), NOW_US) == rejection


def test_frame_overtaken_by_newer_ones_is_accepted_once_within_the_window(
    site: SiteSignatures,
) -> None:
    assert site.check(signed(NOW_TICKS), NOW_US) == ""
    late = signed(NOW_TICKS - WINDOW_TICKS + 1)
    assert site.check(late, NOW_US) == ""
    assert site.check(late, NOW_US) == "replayed"
    assert site.check(signed(NOW_TICKS - WINDOW_TICKS), NOW_US) == "replayed"


def test_streams_are_independent_and_bounded(site: SiteSignatures) -> None:
    for link in range(4):
        assert site.check(signed(NOW_TICKS, link=link), NOW_US) == ""
    assert site.check(signed(NOW_TICKS, system=2), NOW_US) == ""
    for number in range(MAX_STREAMS - 5):
        frame = signed(NOW_TICKS, link=4 + number % 250, system=3 + number // 250)
        assert site.check(frame, NOW_US) == ""
    assert site.check(signed(NOW_TICKS, link=3, system=200), NOW_US) == "replayed"


def test_memory_of_a_window_is_bounded(site: SiteSignatures) -> None:
    for second in range(100):
        for step in range(10):
            ticks = NOW_TICKS + second * TICKS_PER_S + step
            assert site.check(signed(ticks), NOW_US) == ""
    [window] = site._windows.values()
    assert len(window.seen) <= 2 * 10 * (WINDOW_TICKS // TICKS_PER_S + 1)


def test_renewed_signature_is_genuine_and_keeps_link_and_timestamp(site: SiteSignatures) -> None:
    frame = signed(NOW_TICKS, link=7)
    changed = site.renewed(frame.data[:-13], frame)
    assert changed == frame.data
    assert site.is_genuine(frame_of(changed))
