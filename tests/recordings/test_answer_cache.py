"""Answers of a vehicle behind a slow link are kept for further stations, and dropped in time."""

import struct
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings import answer_cache, live_answers
from gateway.recordings.answer_cache import AnswerCache
from gateway.recordings.live_answers import LiveAnswers
from gateway.records import Incoming, Outgoing
from gateway.vehicle.services.ftp import Opcode
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.mavlink_signing import FrameSigner, SigningClock
from gateway.wire.mavlink_splitter import frame_of
from tests.conftest import ManualClock
from tests.kit.ground_station import (
    FENCE,
    MISSION,
    FtpClient,
    GroundStation,
    command,
    content,
    count,
    download,
    item,
    kinds,
    load_parameters,
    of_kind,
    request_item,
    upload,
)
from tests.kit.mavlink import KEY, packed

RADIO = 99
"""Client that leads to the vehicle."""
NAME = "TUN_CUTOFF_HZ"
VERSION = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
SIGNING = (KEY, 3, 10_000_000_000)


class CachedLink:
    """A vehicle behind a slow link with a cache before it, with the verbs of a vehicle."""

    system_id = 1

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.vehicle = Vehicle(VehicleSettings(), 1)
        signer = FrameSigner(SigningClock(1_500_000_000_000_000))
        signer.shared_key = KEY
        self.cache = AnswerCache(signer)
        self.up: list[Any] = []
        """Messages that went over the link to the vehicle."""
        self.loses: Callable[[Any], bool] = lambda _: False
        """Whether a message of the vehicle is lost."""
        self.may_answer = True
        self.signs = False
        self.next_due_us = self.cache.next_due_us
        self.remove_client = self.cache.remove_client
        self.mav = mavlink.MAVLink(None)
        self.report(30_000)

    def report(self, boot_ms: int) -> list[Outgoing]:
        """Let the vehicle send its time since the start."""
        return self.down(mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0))

    def down(self, message: Any, component: int = 1) -> list[Outgoing]:
        """Let the vehicle send a message."""
        frame = packed(message, 1, component, signing=SIGNING if self.signs else None)
        return self._receive([Outgoing(frame, message.get_msgId())])

    def handle(self, incoming: Incoming, now_us: int) -> list[Outgoing]:
        answers, passed = self.cache.handle(
            incoming.client_id, frame_of(incoming.frame), now_us, may_answer=self.may_answer
        )
        if passed is not None:
            self.up.append(self.mav.decode(bytearray(passed.data)))
            answers += self._receive(self._ask(passed.data, now_us))
        return answers

    def poll(self, now_us: int) -> list[Outgoing]:
        return self.cache.poll(now_us)

    def _ask(self, data: bytes, now_us: int) -> list[Any]:
        """Return all answers of the vehicle, of a list too."""
        found = self.vehicle.handle(Incoming(RADIO, data, trusted=True), now_us)
        for turn in range(35):
            found += self.vehicle.poll(now_us + turn * 10_000)
        kept = ("PARAM_VALUE", "MISSION_", "COMMAND_ACK", "AUTOPILOT_VERSION", "FILE_", "COMPON")
        return [
            each
            for each in found
            if isinstance(each, Outgoing) and (MESSAGE_NAMES[each.message_id]).startswith(kept)
        ]

    def _receive(self, sent: Iterable[Outgoing]) -> list[Outgoing]:
        found = []
        for each in sent:
            frame = frame_of(each.frame)
            message = self.mav.decode(bytearray(each.frame))
            if self.loses(message):
                continue
            again = self.cache.add(frame, self.clock.now_us)
            found.append(Outgoing(each.frame, each.message_id))
            if again is not None:
                self.up.append(self.mav.decode(bytearray(again.data)))
                found += self._receive(self._ask(again.data, self.clock.now_us))
        return found


@pytest.fixture
def link(clock: ManualClock) -> CachedLink:
    clock.now_us = 100_000_000
    return CachedLink(clock)


@pytest.fixture
def first(link: CachedLink, clock: ManualClock) -> GroundStation:
    return GroundStation(link, clock)


@pytest.fixture
def second(link: CachedLink, clock: ManualClock) -> GroundStation:
    return GroundStation(link, clock, client_id=8, system_id=254)


def test_second_station_gets_parameters_and_missions_without_the_link(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    values = load_parameters(first)
    items = {kind: [item(i, kind) for i in range(5)] for kind in (MISSION, FENCE)}
    items[FENCE] = [item(i, FENCE, param1=5.0, z=0.0) for i in range(5)]
    for kind, sent in items.items():
        assert upload(first, sent, kind) == mavlink.MAV_MISSION_ACCEPTED
    first.request(VERSION)
    link.up.clear()
    assert load_parameters(second) == values
    for kind, sent in items.items():
        assert [content(each) for each in download(second, kind)] == [*map(content, sent)]
    assert kinds(second.request(VERSION)) == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert link.up == []
    text = link.cache.describe(1, link.clock.now_us + 4_000_000)
    assert f"parameters ({len(values)}) 4 s" in text
    assert "mission (5)" in text


def test_downloaded_mission_is_kept_and_its_end_is_passed_on(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    link.may_answer = False
    upload(first, [item(i) for i in range(3)])
    link.cache.remove(1)
    link.report(31_000)
    link.may_answer = True
    download(first)
    assert [each.get_type() for each in link.up][-1] == "MISSION_ACK"
    link.up.clear()
    assert len(download(second)) == 3
    assert link.up == []


def test_end_of_a_download_is_passed_on_if_its_mission_was_dropped(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    upload(first, [item(i) for i in range(3)])
    first.send(mavlink.MAVLink_mission_request_list_message(1, 1))
    assert [each.get_type() for each in link.up][-1] != "MISSION_REQUEST_LIST"
    restart(link)
    download(first)
    assert [each.get_type() for each in link.up][-1] == "MISSION_ACK"


def test_written_parameter_is_kept_when_it_is_confirmed(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    name = next(iter(load_parameters(first)))
    before = load_parameters(second)[name]
    link.loses = lambda message: message.get_type() == "PARAM_VALUE"
    second.set_parameter(name, before)
    link.loses = lambda _: False
    read = mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1)
    for passed in (["PARAM_SET", "PARAM_REQUEST_READ"], []):
        assert [m.param_value for m in first.send(read)] == [before]
        assert [each.get_type() for each in link.up[-2:]] == passed
        link.up.clear()


@pytest.mark.parametrize("lost", ["", "MISSION_ACK"])
def test_upload_replaces_a_mission_when_it_is_accepted(
    link: CachedLink, first: GroundStation, second: GroundStation, lost: str
) -> None:
    upload(first, [item(i) for i in range(3)])
    link.loses = lambda message: message.get_type() == lost
    upload(second, [item(i) for i in range(4)])
    link.loses = lambda _: False
    link.up.clear()
    assert len(download(first)) == 4
    assert bool(link.up) == bool(lost)


def restart(link: CachedLink) -> None:
    link.clock.now_us += 3_000_000
    link.report(2_000)


def fly_on(link: CachedLink) -> None:
    for _ in range(20):
        link.clock.now_us += 1_000_000
        link.report(30_000 + (link.clock.now_us - 100_000_000) // 1000)


def fall_silent(link: CachedLink) -> None:
    link.clock.now_us += 11_000_000


def report_version(link: CachedLink) -> None:
    for version in (1, 2):
        fields = [version, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 7]
        link.down(mavlink.MAVLink_autopilot_version_message(*fields))


def write_file(link: CachedLink) -> None:
    client = FtpClient(GroundStation(link, link.clock))
    client.ask(mavlink.MAV_FTP_OPCODE_CREATEFILE, b"@MISSION/mission.dat")


def calibrate(link: CachedLink) -> None:
    GroundStation(link, link.clock).send(command(241, 1))


def store(link: CachedLink) -> None:
    GroundStation(link, link.clock).send(command(245, 1))


def switch_group_on(link: CachedLink) -> None:
    link.down(mavlink.MAVLink_param_value_message(b"NEW", 1.0, 9, 3, 0))


@pytest.mark.parametrize(
    ("event", "is_kept"),
    [
        (fly_on, True),
        (store, True),
        (restart, False),
        (fall_silent, False),
        (report_version, False),
        (write_file, False),
        (calibrate, False),
        (switch_group_on, False),
    ],
)
def test_event_decides_whether_answers_stay_valid(
    link: CachedLink, first: GroundStation, event: Callable[[CachedLink], None], is_kept: bool
) -> None:
    load_parameters(first)
    event(link)
    link.up.clear()
    first.inbox.clear()
    load_parameters(first)
    assert (link.up == []) == is_kept


def current(total: int, *ids: int) -> bytes:
    """Return MISSION_CURRENT with the ids that pymavlink's definition lacks."""
    payload = struct.pack("<HHBBIII", 0, total, 0, 0, *ids)
    head = bytes((0xFD, len(payload), 0, 0, 0, 1, 1, 42, 0, 0)) + payload
    return head + struct.pack("<H", mavlink.x25crc(bytearray(head[1:]) + b"\x1c").crc)


@pytest.mark.parametrize(
    ("before", "after", "kept"),
    [
        ((3, 7, 8, 9), (3, 7, 8, 9), {MISSION, FENCE}),
        ((3, 7, 8, 9), (3, 6, 8, 9), {FENCE}),
        ((3, 7, 8, 9), (3, 7, 1, 9), {MISSION}),
        ((3, 0, 0, 0), (4, 0, 0, 0), {FENCE}),
    ],
)
def test_mission_whose_id_changes_is_dropped(
    link: CachedLink,
    first: GroundStation,
    before: tuple[int, ...],
    after: tuple[int, ...],
    kept: set[int],
) -> None:
    upload(first, [item(i) for i in range(3)])
    upload(first, [item(i, FENCE, param1=3.0, z=0.0) for i in range(3)], FENCE)
    for ids in (before, after):
        assert link.cache.add(frame_of(current(*ids)), link.clock.now_us) is None
    text = link.cache.describe(1, link.clock.now_us)
    assert {kind for kind, name in ((MISSION, "mission"), (FENCE, "fence")) if name in text} == kept


def test_mission_is_dropped_when_home_moves(link: CachedLink, first: GroundStation) -> None:
    upload(first, [item(i) for i in range(3)])
    for x, is_kept in ((5, True), (5, True), (6, False)):
        link.down(mavlink.MAVLink_home_position_message(x, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
        assert ("mission" in link.cache.describe(1, link.clock.now_us)) == is_kept


def checksum(value: float) -> Any:
    return mavlink.MAVLink_param_value_message(b"_HASH_CHECK", value, 5, 3, 0xFFFF)


@pytest.mark.parametrize("same", [True, False])
def test_list_is_checked_by_the_checksum_where_one_is_offered(
    link: CachedLink, first: GroundStation, second: GroundStation, same: bool
) -> None:
    """The vehicle here offers none: it is sent in its name."""
    link.down(checksum(4.0))
    load_parameters(first)
    link.up.clear()
    found = second.ask(mavlink.MAVLink_param_request_list_message(1, 0), "PARAM_VALUE")
    assert found[0].param_id == "_HASH_CHECK"
    assert [(m.get_type(), m.param_id) for m in link.up] == [("PARAM_REQUEST_READ", "_HASH_CHECK")]
    link.down(checksum(4.0 if same else 5.0))
    assert [m.get_type() for m in link.up[1:]] == ([] if same else ["PARAM_REQUEST_LIST"])


def test_list_for_all_components_is_passed_on_if_others_have_parameters(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    load_parameters(first)
    link.down(mavlink.MAVLink_param_value_message(b"CAM", 1.0, 9, 1, 0), component=100)
    link.up.clear()
    second.send(mavlink.MAVLink_param_request_list_message(1, 1))
    assert link.up == []
    second.send(mavlink.MAVLink_param_request_list_message(1, 0))
    assert [m.get_type() for m in link.up] == ["PARAM_REQUEST_LIST"]


@pytest.mark.parametrize("path", [b"@PARAM/param.pck?withdefaults=1", b"/general.json"])
def test_file_of_metadata_is_read_once_over_the_link(
    link: CachedLink, first: GroundStation, second: GroundStation, path: bytes
) -> None:
    read = FtpClient(first).read(path)
    link.up.clear()
    assert FtpClient(second).read(path) == read
    assert link.up == []
    is_packed = path.startswith(b"@PARAM")
    first.set_parameter("TUN_ORDER", 3)
    assert (FtpClient(second).open(path).session, len(link.up)) == (0, 1 + is_packed)


def test_file_whose_end_is_known_but_not_its_middle_is_left_to_the_vehicle(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    client = FtpClient(first)
    session = client.open(b"/general.json").session
    for offset in (0, 10**6):
        client.ask(Opcode.READ_FILE, session=session, offset=offset, size=100)
    link.up.clear()
    FtpClient(second).open(b"/general.json")
    assert len(link.up) == 1


def test_other_file_and_its_session_are_left_to_the_vehicle(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    FtpClient(first).read(b"/general.json")
    client = FtpClient(second)
    client.open(b"/general.json")
    link.up.clear()
    client.open(b"/parameters.json")
    client.ask(Opcode.READ_FILE, session=0, size=100)
    assert len(link.up) == 2


@pytest.mark.parametrize(
    ("vehicle_signs", "station_signs", "is_answered"),
    [(True, True, True), (True, False, False), (False, False, True), (False, True, False)],
)
def test_signed_vehicle_is_answered_for_with_its_signature_only(
    link: CachedLink, vehicle_signs: bool, station_signs: bool, is_answered: bool
) -> None:
    link.signs = vehicle_signs
    link.report(30_500)
    link.down(mavlink.MAVLink_param_value_message(b"ONE", 1.0, 9, 1, 0))
    listing = mavlink.MAVLink_param_request_list_message(1, 1)
    request = packed(listing, 255, 190, signing=SIGNING if station_signs else None)
    found, passed = link.cache.handle(7, frame_of(request), link.clock.now_us, may_answer=True)
    assert (len(found) == 1, passed is None) == (is_answered, is_answered)
    if vehicle_signs and is_answered:
        reader = mavlink.MAVLink(None)
        reader.signing.secret_key, reader.signing.timestamp = KEY, 1
        assert reader.decode(bytearray(found[0].frame)).param_id == "ONE"


def test_station_that_bypasses_the_cache_still_invalidates_it(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    name = next(iter(load_parameters(first)))
    link.may_answer = False
    link.loses = lambda message: message.get_type() == "PARAM_VALUE"
    second.set_parameter(name, 1.0)
    link.may_answer, link.loses = True, lambda _: False
    link.up.clear()
    first.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    assert len(link.up) == 1


def test_kept_bytes_and_vehicles_are_bounded(
    link: CachedLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_answers, "MAX_BYTES", 400)
    monkeypatch.setattr(answer_cache, "MAX_VEHICLES", 3)
    for index in range(100):
        link.down(mavlink.MAVLink_param_value_message(f"P{index}".encode(), 1.0, 9, 100, index))
    assert link.cache._entries[1].live.size < 500
    for system in range(2, 9):
        frame = packed(mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0), system)
        link.cache.add(frame_of(frame), link.clock.now_us + system)
    assert list(link.cache._entries) == [6, 7, 8]


def test_damaged_or_foreign_requests_are_passed_on(link: CachedLink) -> None:
    for message in (
        mavlink.MAVLink_param_request_list_message(2, 1),
        mavlink.MAVLink_param_request_list_message(1, 100),
    ):
        frame = frame_of(packed(message, 255, 190))
        found = link.cache.handle(7, frame, link.clock.now_us, may_answer=True)
        assert found == ([], frame)


def test_confirmation_without_index_keeps_the_index_of_a_parameter(link: CachedLink) -> None:
    values = [mavlink.MAVLink_param_value_message(b"P%d" % i, i, 9, 3, i) for i in range(3)]
    for message in values:
        link.down(message)
    link.down(mavlink.MAVLink_param_value_message(b"P1", 8.0, 9, 3, 0xFFFF))
    request = mavlink.MAVLink_param_request_read_message(1, 1, b"", 1)
    frame = frame_of(packed(request, 255, 190))
    [answer], passed = link.cache.handle(7, frame, link.clock.now_us, may_answer=True)
    [read] = of_kind([answer], "PARAM_VALUE")
    assert (read.param_id, read.param_index, read.param_value, passed) == ("P1", 1, 8.0, None)


def test_upload_is_kept_without_the_items_of_another_station(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    sent = [item(i) for i in range(3)]
    first.send(count(3, MISSION))
    for each in sent[:2]:
        first.send(each)
    for i in range(3):
        second.send(item(i, param1=9.0))
    assert kinds(first.send(sent[2])) == ["MISSION_ACK"]
    assert [content(each) for each in download(second)] == [*map(content, sent)]


def test_mission_of_a_download_that_an_upload_interrupts_is_not_mixed(
    link: CachedLink, first: GroundStation, second: GroundStation
) -> None:
    upload(first, [item(i) for i in range(3)])
    link.may_answer = False
    first.send(mavlink.MAVLink_mission_request_list_message(1, 1, MISSION))
    for seq in (0, 1):
        first.send(request_item(seq, MISSION))
    sent = [item(i, param1=9.0) for i in range(3)]
    upload(second, sent)
    first.send(request_item(2, MISSION))
    link.may_answer = True
    assert [content(each) for each in download(second)] == [*map(content, sent)]


def test_parameter_that_changes_while_no_more_can_be_kept_is_not_answered(
    link: CachedLink, first: GroundStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = load_parameters(first)
    name = next(iter(values)).encode()
    monkeypatch.setattr(live_answers, "MAX_BYTES", 0)
    link.down(mavlink.MAVLink_param_value_message(name, 7.5, 9, len(values), 0xFFFF))
    link.up.clear()
    first.send(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))
    assert kinds(link.up) == ["PARAM_REQUEST_READ"]


def test_items_of_unfinished_transfers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_answers, "MAX_BYTES", 1000)
    live = LiveAnswers(1)
    for kind in (77, MISSION):
        live.add(frame_of(packed(mavlink.MAVLink_mission_count_message(255, 0, 65535, kind))), 0)
        for i in range(100):
            live.add(frame_of(packed(item(i, mission_type=kind))), 0)
    assert live.size == pytest.approx(1025, abs=25)
