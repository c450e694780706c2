"""Answers of a vehicle behind a slow link are kept for further stations, and dropped in time."""

import struct
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.answers import answer_cache, live_answers
from gateway.answers.answer_cache import AnswerCache
from gateway.answers.live_answers import LiveAnswers
from gateway.records import Incoming, Outgoing
from gateway.vehicle.services.ftp import ACK, Opcode, Packet
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
    request_item,
    upload,
)
from tests.kit.mavlink import KEY, frame_with, numbered, packed, read_back

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
        self.first = GroundStation(self, clock)
        self.second = GroundStation(self, clock, client_id=8, system_id=254)
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
            incoming.client_id,
            frame_of(incoming.frame),
            now_us,
            [RADIO],
            may_answer=self.may_answer,
        )
        if passed is not None:
            self.up.append(self.mav.decode(bytearray(passed.data)))
            answers += self._receive(self._ask(passed.data, now_us))
        return answers

    def poll(self, now_us: int) -> list[Outgoing]:
        return self.cache.poll(now_us)

    def ask(self, message: Any, *, signed: bool = False) -> tuple[list[Outgoing], bool]:
        """Ask the cache as a station; return its answers, and whether it passes the request on."""
        frame = frame_of(packed(message, 255, 190, signing=SIGNING if signed else None))
        answers, passed = self.cache.handle(7, frame, self.clock.now_us, [RADIO], may_answer=True)
        assert passed in (None, frame)
        return answers, passed is not None

    def kept(self) -> str:
        return self.cache.describe(RADIO, 1, self.clock.now_us)

    def passed(self) -> list[str]:
        """Return the kinds of messages that went over the link since the last call."""
        found = [message.get_type() for message in self.up]
        self.up.clear()
        return found

    def _ask(self, data: bytes, now_us: int) -> list[Any]:
        """Return all answers of the vehicle, of a list too."""
        found = self.vehicle.handle(Incoming(RADIO, data, trusted=True), now_us)
        for turn in range(35):
            found += self.vehicle.poll(now_us + turn * 10_000)
        kept = ("PARAM_VALUE", "MISSION_", "COMMAND_ACK", "AUTOPILOT_VERSION", "FILE_", "COMPON")
        frames = [each for each in found if isinstance(each, Outgoing)]
        return [each for each in frames if MESSAGE_NAMES[each.message_id].startswith(kept)]

    def _receive(self, sent: Iterable[Outgoing]) -> list[Outgoing]:
        found = []
        for each in sent:
            frame = frame_of(each.frame)
            message = self.mav.decode(bytearray(each.frame))
            if self.loses(message):
                continue
            again = self.cache.add(RADIO, "radio", frame, self.clock.now_us)
            found.append(Outgoing(each.frame, each.message_id))
            if again is not None:
                self.up.append(self.mav.decode(bytearray(again.data)))
                found += self._receive(self._ask(again.data, self.clock.now_us))
        return found


@pytest.fixture
def link(clock: ManualClock) -> CachedLink:
    clock.now_us = 100_000_000
    return CachedLink(clock)


ITEMS = [item(i) for i in range(3)]
OTHER_ITEMS = [item(i, param1=9.0) for i in range(3)]


def value(name: bytes, number: float, count: int = 1, index: int = 0) -> Any:
    return mavlink.MAVLink_param_value_message(name, number, 9, count, index)


def request_value(name: str, index: int = -1) -> Any:
    return mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), index)


def request_list(component: int = 1, system: int = 1) -> Any:
    return mavlink.MAVLink_param_request_list_message(system, component)


def test_second_station_gets_parameters_and_missions_without_the_link(link: CachedLink) -> None:
    values = load_parameters(link.first)
    items = {kind: [item(i, kind) for i in range(5)] for kind in (MISSION, FENCE)}
    items[FENCE] = [item(i, FENCE, param1=5.0, z=0.0) for i in range(5)]
    for kind, sent in items.items():
        assert upload(link.first, sent, kind) == mavlink.MAV_MISSION_ACCEPTED
    link.first.request(VERSION)
    link.up.clear()
    assert load_parameters(link.second) == values
    for kind, sent in items.items():
        assert [content(each) for each in download(link.second, kind)] == [*map(content, sent)]
    assert kinds(link.second.request(VERSION)) == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert link.up == []
    text = link.cache.describe(RADIO, 1, link.clock.now_us + 4_000_000)
    assert f"parameters ({len(values)}) 4 s" in text
    assert "mission (5)" in text


def test_downloaded_mission_is_kept_and_its_end_is_passed_on(link: CachedLink) -> None:
    link.may_answer = False
    upload(link.first, ITEMS)
    link.cache.drop(RADIO)
    link.report(31_000)
    link.may_answer = True
    download(link.first)
    assert link.passed()[-1] == "MISSION_ACK"
    assert len(download(link.second)) == 3
    assert link.passed() == []


def test_end_of_a_download_is_passed_on_if_its_mission_was_dropped(link: CachedLink) -> None:
    upload(link.first, ITEMS)
    link.first.send(mavlink.MAVLink_mission_request_list_message(1, 1))
    assert link.passed()[-1] != "MISSION_REQUEST_LIST"
    restart(link)
    download(link.first)
    assert link.passed()[-1] == "MISSION_ACK"


def test_written_parameter_is_kept_when_it_is_confirmed(link: CachedLink) -> None:
    name = next(iter(load_parameters(link.first)))
    before = load_parameters(link.second)[name]
    link.loses = lambda message: message.get_type() == "PARAM_VALUE"
    link.second.set_parameter(name, before)
    link.loses = lambda _: False
    for passed in (["PARAM_SET", "PARAM_REQUEST_READ"], []):
        assert [m.param_value for m in link.first.send(request_value(name))] == [before]
        assert link.passed()[-2:] == passed


@pytest.mark.parametrize("lost", ["", "MISSION_ACK"])
def test_upload_replaces_a_mission_when_it_is_accepted(link: CachedLink, lost: str) -> None:
    upload(link.first, ITEMS)
    link.loses = lambda message: message.get_type() == lost
    upload(link.second, [item(i) for i in range(4)])
    link.loses = lambda _: False
    link.up.clear()
    assert len(download(link.first)) == 4
    assert bool(link.up) == bool(lost)


def restart(link: CachedLink) -> None:
    link.clock.advance(3.0)
    link.report(2_000)


def fly_on(link: CachedLink) -> None:
    for _ in range(20):
        link.clock.advance(1.0)
        link.report(30_000 + (link.clock.now_us - 100_000_000) // 1000)


def report_version(link: CachedLink) -> None:
    for version in (1, 2):
        fields = [version, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 7]
        link.down(mavlink.MAVLink_autopilot_version_message(*fields))


def write_file(link: CachedLink) -> None:
    client = FtpClient(link.second)
    client.ask(mavlink.MAV_FTP_OPCODE_CREATEFILE, b"@MISSION/mission.dat")


EVENTS: dict[str, tuple[Callable[[CachedLink], object], bool]] = {
    "flight goes on": (fly_on, True),
    "parameters are stored": (lambda link: link.second.send(command(245, 1)), True),
    "restart": (restart, False),
    "timeout": (lambda link: link.clock.advance(11.0), False),
    "another version": (report_version, False),
    "file is written": (write_file, False),
    "calibration": (lambda link: link.second.send(command(241, 1)), False),
    "group of parameters is switched on": (lambda link: link.down(value(b"NEW", 1.0, 3)), False),
}


@pytest.mark.parametrize(("event", "is_kept"), EVENTS.values(), ids=EVENTS)
def test_event_decides_whether_answers_stay_valid(
    link: CachedLink, event: Callable[[CachedLink], object], is_kept: bool
) -> None:
    load_parameters(link.first)
    event(link)
    link.up.clear()
    link.first.inbox.clear()
    load_parameters(link.first)
    assert (link.up == []) == is_kept


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
    link: CachedLink, before: tuple[int, ...], after: tuple[int, ...], kept: set[int]
) -> None:
    """MISSION_CURRENT has ids that pymavlink's definition lacks."""
    upload(link.first, ITEMS)
    upload(link.first, [item(i, FENCE, param1=3.0, z=0.0) for i in range(3)], FENCE)
    for total, *ids in (before, after):
        current = frame_with(42, struct.pack("<HHBBIII", 0, total, 0, 0, *ids))
        assert link.cache.add(RADIO, "radio", frame_of(current), link.clock.now_us) is None
    names = {MISSION: "mission", FENCE: "fence"}
    assert {kind for kind, name in names.items() if name in link.kept()} == kept


def test_mission_is_dropped_when_home_moves(link: CachedLink) -> None:
    upload(link.first, ITEMS)
    for x, is_kept in ((5, True), (5, True), (6, False)):
        link.down(mavlink.MAVLink_home_position_message(x, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
        assert ("mission" in link.kept()) == is_kept


def checksum(number: float) -> Any:
    return value(b"_HASH_CHECK", number, 3, 0xFFFF)


@pytest.mark.parametrize("same", [True, False])
def test_list_is_checked_by_the_checksum_where_one_is_offered(link: CachedLink, same: bool) -> None:
    """The vehicle here offers none: it is sent in its name."""
    link.down(checksum(4.0))
    load_parameters(link.first)
    link.up.clear()
    found = link.second.ask(request_list(0), "PARAM_VALUE")
    assert found[0].param_id == "_HASH_CHECK"
    assert [(m.get_type(), m.param_id) for m in link.up] == [("PARAM_REQUEST_READ", "_HASH_CHECK")]
    link.down(checksum(4.0 if same else 5.0))
    assert link.passed()[1:] == ([] if same else ["PARAM_REQUEST_LIST"])


def test_list_for_all_components_is_passed_on_if_others_have_parameters(link: CachedLink) -> None:
    load_parameters(link.first)
    link.down(value(b"CAM", 1.0), component=100)
    link.up.clear()
    for component, passed in ((1, []), (0, ["PARAM_REQUEST_LIST"])):
        link.second.send(request_list(component))
        assert link.passed() == passed


@pytest.mark.parametrize("path", [b"@PARAM/param.pck?withdefaults=1", b"/general.json"])
def test_file_of_metadata_is_read_once_over_the_link(link: CachedLink, path: bytes) -> None:
    read = FtpClient(link.first).read(path)
    link.up.clear()
    assert FtpClient(link.second).read(path) == read
    assert link.up == []
    is_packed = path.startswith(b"@PARAM")
    link.first.set_parameter("TUN_ORDER", 3)
    assert (FtpClient(link.second).open(path).session, len(link.up)) == (0, 1 + is_packed)


ONE_ID = (255, 190)


@pytest.mark.parametrize("sessions", [(0, 1), (0, 0)], ids=str)
@pytest.mark.parametrize("first_sequence", [40, 1])
def test_files_that_stations_of_one_id_read_at_once_are_not_mixed(
    link: CachedLink, sessions: tuple[int, int], first_sequence: int
) -> None:
    """Frames of the vehicle reach both; only numbers and sessions distinguish their requests.

    A vehicle with one session opens the second file in place of the first one.
    """
    paths = (b"/a.json", b"/b.json")
    numbers = [first_sequence, 1]
    askers = []

    def ask(reader: int, opcode: int, session: int = 0, data: bytes = b"") -> None:
        packet = Packet(numbers[reader], session, opcode, len(data), 0, 0, 0, data)
        numbers[reader] += 1
        sent = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, packet.encode())
        frame = frame_of(packed(sent, *ONE_ID))
        link.cache.handle(20 + reader, frame, 0, [RADIO], may_answer=False)
        pending.append((reader, packet))

    def answer(data: bytes, session: int) -> None:
        _, packet = pending.pop(0)
        reply = packet.answer(ACK, session, data)
        sent = mavlink.MAVLink_file_transfer_protocol_message(0, *ONE_ID, reply.encode())
        frame = frame_of(packed(sent))
        askers.append(link.cache.asker(RADIO, frame))
        link.cache.add(RADIO, "radio", frame, 0)

    pending: list[tuple[int, Packet]] = []
    for reader in (0, 1):
        ask(reader, Opcode.OPEN_FILE_RO, data=paths[reader])
    for reader in (0, 1):
        answer(struct.pack("<I", 1), sessions[reader])
    for reader in (0, 1):
        ask(reader, Opcode.READ_FILE, sessions[reader])
    for reader in (0, 1):
        answer(b"ab"[reader : reader + 1], sessions[reader])
    kept = link.cache._entries[RADIO, 1].live.files
    files = {path: kept.get(path.decode()) for path in paths}
    if first_sequence == 1:
        assert files == {paths[0]: None, paths[1]: None}
    elif sessions == (0, 0):
        assert files == {paths[0]: None, paths[1]: b"b"}
    else:
        assert files == {paths[0]: b"a", paths[1]: b"b"}
    opened = [20, 21] if first_sequence == 40 else [None, None]
    read = [20, 21] if first_sequence == 40 or sessions == (0, 1) else [None, None]
    assert askers == opened + read


def test_vehicles_of_one_id_on_two_links_are_distinguished(link: CachedLink) -> None:
    link.down(value(b"ONE", 1.0))
    link.cache.add(50, "other", frame_of(packed(value(b"TWO", 2.0))), link.clock.now_us)
    request = frame_of(packed(request_list(), *ONE_ID))
    boot = mavlink.MAVLink_attitude_message(90_000, 0, 0, 0, 0, 0, 0)
    link.cache.add(50, "other", frame_of(packed(boot)), link.clock.now_us)
    for client_id, links, name in (7, [RADIO], "ONE"), (8, [50], "TWO"), (9, [50, RADIO], "TWO"):
        now_us = link.clock.now_us
        answers, _ = link.cache.handle(client_id, request, now_us, links, may_answer=True)
        answers += link.cache.poll(now_us + 1_000_000)
        assert [read_back(each.frame).param_id for each in answers] == [name]
    link.cache.remove_client(50)
    assert link.cache.describe(50, 1, 0) == ""
    # The vehicle returns from another port, and another vehicle after it.
    link.cache.add(51, "other", frame_of(packed(boot)), link.clock.now_us)
    assert "parameters (1)" in link.cache.describe(51, 1, 0)
    link.cache.remove_client(51)
    boot.time_boot_ms = 95_000
    link.cache.add(52, "other", frame_of(packed(boot)), link.clock.now_us)
    link.clock.advance(1.0)
    boot.time_boot_ms = 200_000
    link.cache.add(52, "other", frame_of(packed(boot)), link.clock.now_us)
    assert link.cache.describe(52, 1, 0) == ""


def test_file_whose_end_is_known_but_not_its_middle_is_left_to_the_vehicle(
    link: CachedLink,
) -> None:
    client = FtpClient(link.first)
    session = client.open(b"/general.json").session
    for offset in (0, 10**6):
        client.ask(Opcode.READ_FILE, session=session, offset=offset, size=100)
    link.up.clear()
    FtpClient(link.second).open(b"/general.json")
    assert len(link.up) == 1


def test_other_file_and_its_session_are_left_to_the_vehicle(link: CachedLink) -> None:
    FtpClient(link.first).read(b"/general.json")
    client = FtpClient(link.second)
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
    link.down(value(b"ONE", 1.0))
    found, is_passed = link.ask(request_list(), signed=station_signs)
    assert (len(found) == 1, not is_passed) == (is_answered, is_answered)
    if vehicle_signs and is_answered:
        assert read_back(found[0].frame, KEY).param_id == "ONE"


def test_station_that_bypasses_the_cache_still_invalidates_it(link: CachedLink) -> None:
    name = next(iter(load_parameters(link.first)))
    link.may_answer = False
    link.loses = lambda message: message.get_type() == "PARAM_VALUE"
    link.second.set_parameter(name, 1.0)
    link.may_answer, link.loses = True, lambda _: False
    link.up.clear()
    link.first.send(request_value(name))
    assert len(link.up) == 1


def test_kept_bytes_and_vehicles_are_bounded(
    link: CachedLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_answers, "MAX_BYTES", 400)
    monkeypatch.setattr(answer_cache, "MAX_VEHICLES", 3)
    for index in range(100):
        link.down(value(b"P%d" % index, 1.0, 100, index))
    assert sum(not link.ask(request_value(f"P{index}"))[1] for index in range(100)) == 11
    for system in range(2, 9):
        frame = numbered(system, 0, value(b"P", 1.0))
        link.cache.add(RADIO, "radio", frame, link.clock.now_us + system)
    now_us = link.clock.now_us
    assert [i for i in range(9) if link.cache.describe(RADIO, i, now_us)] == [6, 7, 8]


def test_damaged_or_foreign_requests_are_passed_on(link: CachedLink) -> None:
    for message in (request_list(1, system=2), request_list(100)):
        assert link.ask(message) == ([], True)


def test_confirmation_without_index_keeps_the_index_of_a_parameter(link: CachedLink) -> None:
    for index in range(3):
        link.down(value(b"P%d" % index, index, 3, index))
    link.down(value(b"P1", 8.0, 3, 0xFFFF))
    [answer], is_passed = link.ask(request_value("", 1))
    read = read_back(answer.frame)
    assert (read.param_id, read.param_index, read.param_value, is_passed) == ("P1", 1, 8.0, False)


def test_upload_is_kept_without_the_items_of_another_station(link: CachedLink) -> None:
    for message in (count(3, MISSION), *ITEMS[:2]):
        link.first.send(message)
    for message in OTHER_ITEMS:
        link.second.send(message)
    assert kinds(link.first.send(ITEMS[2])) == ["MISSION_ACK"]
    assert [content(each) for each in download(link.second)] == [*map(content, ITEMS)]


def test_mission_of_a_download_that_an_upload_interrupts_is_not_mixed(link: CachedLink) -> None:
    upload(link.first, ITEMS)
    link.may_answer = False
    link.first.send(mavlink.MAVLink_mission_request_list_message(1, 1, MISSION))
    for seq in (0, 1):
        link.first.send(request_item(seq, MISSION))
    upload(link.second, OTHER_ITEMS)
    link.first.send(request_item(2, MISSION))
    link.may_answer = True
    assert [content(each) for each in download(link.second)] == [*map(content, OTHER_ITEMS)]


def test_parameter_that_changes_while_no_more_can_be_kept_is_not_answered(
    link: CachedLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = load_parameters(link.first)
    name = next(iter(values))
    monkeypatch.setattr(live_answers, "MAX_BYTES", 0)
    link.down(value(name.encode(), 7.5, len(values), 0xFFFF))
    link.up.clear()
    link.first.send(request_value(name))
    assert link.passed() == ["PARAM_REQUEST_READ"]


def test_items_of_unfinished_transfers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_answers, "MAX_BYTES", 1000)
    live = LiveAnswers(1)
    for kind in (77, MISSION):
        live.add(numbered(1, 0, mavlink.MAVLink_mission_count_message(255, 0, 65535, kind)), 0)
        for i in range(100):
            live.add(numbered(1, 0, item(i, mission_type=kind)), 0)
    assert live.size == pytest.approx(1025, abs=25)
