"""Frames with other ids, and the signatures of a site with a passphrase."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet.frame_translation import FrameTranslation
from gateway.fleet.id_map import LAST_ID, LEFT_OUT, IdMap, SiteVehicle
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_signing import (
    EPOCH_2015_US,
    MAX_WINDOWS,
    TICK_US,
    TICKS_PER_S,
    WINDOW_TICKS,
    WindowVerifier,
)
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.kit import mavlink as kit
from tests.kit.mavlink import read_back
from tests.kit.memory import size_of

KEY = bytes(range(32))


def packed(message: Any, system_id: int, *, v1: bool = False, key: bytes | None = None) -> bytes:
    signing = None if key is None else (key, 3, 123_456)
    return kit.packed(message, system_id, version=1 if v1 else 2, signing=signing)


def translation(key: bytes | None = None, limit: int = LAST_ID) -> FrameTranslation:
    """Two sites have an aircraft 1 each; ours is the second, so that it is 2 here."""
    ids = IdMap(per_site=limit)
    ids.id_of("a", 1)
    ids.id_of("b", 1)
    ids.id_of("b", 30)
    signatures = None if key is None else WindowVerifier(key, EPOCH_2015_US)
    return FrameTranslation("b", ids, signatures)


def from_site(there: FrameTranslation, frame: bytes, now_us: int = 0) -> bytes | None:
    given = there.from_site(frame_of(frame), now_us)
    return None if given is None else given.data


def to_site(there: FrameTranslation, frame: bytes) -> tuple[int, bytes] | None:
    found = there.to_site(frame_of(frame), 0)
    return None if found is None else (found[0], found[1].data)


def shown(there: FrameTranslation, frame: bytes) -> Any:
    """Return the message of the site as the stations here get it."""
    return read_back(from_site(there, frame) or b"")


def sent(there: FrameTranslation, frame: bytes, key: bytes | None = None) -> Any:
    """Return the message of a station here as the vehicle 1 of the site gets it."""
    system_id, changed = to_site(there, frame) or (0, b"")
    assert system_id == 1
    return read_back(changed, key)


def attitude() -> Any:
    return mavlink.MAVLink_attitude_message(5, 0.5, 0, 0, 0, 0, 0.25)


def command(target: int) -> Any:
    return mavlink.MAVLink_command_long_message(target, 1, 400, 0, 1, 0, 0, 0, 0, 0, 7)


@pytest.mark.parametrize("v1", [False, True], ids=["MAVLink 2", "MAVLink 1"])
def test_sender_from_the_site_and_target_to_it_are_translated(v1: bool) -> None:
    there = translation()
    got = shown(there, packed(attitude(), 1, v1=v1))
    assert (got.get_srcSystem(), got.roll, got.yawspeed) == (2, 0.5, 0.25)
    got = sent(there, packed(command(2), 255, v1=v1))
    assert (got.target_system, got.get_srcSystem()) == (1, 255)
    assert (got.command, got.param7) == (400, 7)


@pytest.mark.parametrize("value", [0.0, -2.0, float("nan"), 255.0, 1e30])
def test_parameter_that_names_no_vehicle_is_unchanged(value: float) -> None:
    message = mavlink.MAVLink_command_long_message(
        2, 1, mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE, 0, 2, 2, value, 2, 0, 0, 0
    )
    got = sent(translation(), packed(message, 255))
    assert (got.param1, got.param2, got.param4) == (1, 2, 2)
    assert got.param3 == pytest.approx(value, nan_ok=True)


@pytest.mark.parametrize(
    ("message", "sender", "target"),
    [
        (mavlink.MAVLink_command_ack_message(400, 0, 0, 0, 255, 190), (1, 2), 255),
        (mavlink.MAVLink_command_ack_message(400, 0), (1, 2), 0),
        (command(1), (30, 30), 2),
    ],
    ids=["answer to a station", "zeros cut off by MAVLink 2", "another vehicle of the site"],
)
def test_target_of_a_frame_from_the_site_is_translated_within_the_site_only(
    message: Any, sender: tuple[int, int], target: int
) -> None:
    got = shown(translation(), packed(message, sender[0]))
    assert (got.get_srcSystem(), got.target_system) == (sender[1], target)


def test_broadcast_of_a_station_is_unchanged() -> None:
    beat = packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 255)
    assert to_site(translation(), beat) == (0, beat)


def test_frame_without_a_change_passes_byte_for_byte() -> None:
    there = FrameTranslation("a", IdMap({SiteVehicle("a", 1): 1}))
    frame = packed(attitude(), 1, key=KEY)
    assert from_site(there, frame) is frame


class TestSigned:
    def test_signature_is_renewed_with_the_same_timestamp(self) -> None:
        frame = packed(attitude(), 1, key=KEY)
        got = from_site(translation(KEY), frame)
        assert got is not None
        assert read_back(got, KEY).get_srcSystem() == 2
        assert got[-13:-6] == frame[-13:-6]

    def test_target_of_a_frame_to_the_site_is_translated(self) -> None:
        assert sent(translation(KEY), packed(command(2), 255, key=KEY), KEY).target_system == 1

    @pytest.mark.parametrize("offset", [-1, -10, 15])
    def test_forged_frame_is_dropped_and_counted(self, offset: int) -> None:
        there = translation(KEY)
        assert from_site(there, changed(packed(attitude(), 1, key=KEY), offset, 1)) is None
        assert to_site(there, changed(packed(command(2), 255, key=KEY), offset, 1)) is None
        assert there.counters["forged"] == 2


def changed(frame: bytes, offset: int, bits: int) -> bytes:
    data = bytearray(frame)
    data[offset] ^= bits
    return bytes(data)


@pytest.mark.parametrize(
    ("frame", "cause"),
    [
        (packed(attitude(), 1, key=KEY), "signed"),
        (changed(packed(attitude(), 1), 9, 0xF4), "unknown"),
        (packed(attitude(), 0), "unmapped"),
        (packed(attitude(), 2), "unmapped"),
    ],
    ids=["signed without a passphrase", "unknown message", "system 0", "system without an id"],
)
def test_frame_that_cannot_be_translated_is_dropped_and_counted(frame: bytes, cause: str) -> None:
    there = translation(limit=2)
    assert from_site(there, frame) is None
    assert there.counters[cause] == 1
    assert 0 not in there.traffic


def test_command_for_an_id_passed_to_another_site_is_not_sent_to_the_former() -> None:
    """Site b has an aircraft 30 of its own, which had the id 30 here, too."""
    ids = IdMap()
    there = FrameTranslation("b", ids)
    assert ids.id_of("b", 30) == 30
    assert to_site(there, packed(command(30), 255)) is not None
    ids.set_by_hand("a", 1, 30)
    assert to_site(there, packed(command(30), 255)) is None
    assert sent(FrameTranslation("a", ids), packed(command(30), 255)).target_system == 1


@pytest.mark.parametrize("own_id", [LEFT_OUT, 7])
def test_command_for_an_id_without_a_vehicle_is_not_sent_to_its_former_vehicle(own_id: int) -> None:
    ids = IdMap()
    there = FrameTranslation("b", ids)
    assert ids.id_of("b", 30) == 30
    if own_id == LEFT_OUT:
        ids.leave_out("b", 30)
    else:
        ids.set_by_hand("b", 30, own_id)
    assert to_site(there, packed(command(30), 255)) is None


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ((250, 251, 254, 255, 0, 3, 3), 4),
        ((254, 1, 255, 0, 2, 3), 0),
        ((10, 12, 11, 13, 200, 201), 0),
    ],
    ids=["gaps", "a text overtakes", "a restart"],
)
def test_loss_is_counted_by_sequence_numbers(numbers: tuple[int, ...], lost: int) -> None:
    there = translation()
    for number in numbers:
        from_site(there, kit.packed(attitude(), sequence=number), number)
    assert (there.traffic[1].frames, there.traffic[1].lost) == (len(numbers), lost)


NOW_TICKS = 1_000_000_000
NOW_US = NOW_TICKS * TICK_US
MINUTE_TICKS = 60 * 100_000
"""In units of 10 us."""


def signed(timestamp: int, *, link: int = 1, system: int = 1, key: bytes = KEY) -> MavFrame:
    message = mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0)
    return frame_of(kit.packed(message, system, signing=(key, link, timestamp)))


@pytest.fixture
def site() -> WindowVerifier:
    return WindowVerifier(KEY, EPOCH_2015_US)


LATER_TICKS = NOW_TICKS + 86_400 * TICKS_PER_S
RECORDED = signed(NOW_TICKS)
UNSIGNED: Any = mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    "received",
    [
        [(frame_of(kit.packed(UNSIGNED, version=n)), NOW_TICKS, "unsigned") for n in (1, 2)],
        [(signed(NOW_TICKS + 9, key=bytes(32)), NOW_TICKS, "forged"), (RECORDED, NOW_TICKS, "")],
        [(RECORDED, NOW_TICKS, ""), (RECORDED, NOW_TICKS, "replayed")],
        [(RECORDED, NOW_TICKS, ""), (signed(LATER_TICKS + 1), LATER_TICKS, ""),
         (RECORDED, LATER_TICKS, "replayed")],
        # A recorded frame is rejected after a restart of the fleet, too.
        [(signed(NOW_TICKS - MINUTE_TICKS), NOW_TICKS, "")],
        [(signed(NOW_TICKS - MINUTE_TICKS - 1), NOW_TICKS, "replayed")],
        [(signed(NOW_TICKS + 10**9), NOW_TICKS, "")],
        [(RECORDED, NOW_TICKS, ""),
         *((signed(NOW_TICKS - WINDOW_TICKS + 1), NOW_TICKS, word) for word in ("", "replayed")),
         (signed(NOW_TICKS - WINDOW_TICKS), NOW_TICKS, "replayed")],
    ],
    ids=["unsigned", "forged", "repeated at once", "repeated a day later", "a minute old",
         "too old", "from the future", "overtaken"],
)  # fmt: skip
def test_frame_is_accepted_once_and_only_with_a_fresh_signature(
    site: WindowVerifier, received: list[tuple[MavFrame, int, str]]
) -> None:
    for number, (frame, now_ticks, rejection) in enumerate(received):
        assert site.check(frame, now_ticks * TICK_US) == rejection, number


def test_streams_are_independent_and_bounded(site: WindowVerifier) -> None:
    for link in range(4):
        assert site.check(signed(NOW_TICKS, link=link), NOW_US) == ""
    assert site.check(signed(NOW_TICKS, system=2), NOW_US) == ""
    for number in range(MAX_WINDOWS - 5):
        frame = signed(NOW_TICKS, link=4 + number % 250, system=3 + number // 250)
        assert site.check(frame, NOW_US) == ""
    assert site.check(signed(NOW_TICKS, link=3, system=200), NOW_US) == "replayed"


def test_memory_of_a_window_is_bounded(site: WindowVerifier) -> None:
    ticks = (s * TICKS_PER_S + step for s in range(100) for step in range(10))
    assert {site.check(signed(NOW_TICKS + each), NOW_US) for each in ticks} == {""}
    assert size_of(site) < 20_000


def test_renewed_signature_is_genuine_and_keeps_link_and_timestamp(site: WindowVerifier) -> None:
    frame = signed(NOW_TICKS, link=7)
    changed = edit_frame(frame, fields={"roll": 1.0}, sign=site.renewal(frame))
    assert changed is not None
    assert site.is_genuine(changed)
    assert changed.data[-13:-6] == frame.data[-13:-6]
