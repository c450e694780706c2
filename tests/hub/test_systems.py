"""Options of endpoints that select systems and renumber them, in both directions."""

import socket
from dataclasses import asdict
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.systems import WAITS, Reach, SystemTranslation
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.hub import receive
from tests.kit.mavlink import KEY, STATION, packed, read_back, signer, strict

V1, V2 = 1, 2
KINDS = {"udp": socket.SOCK_DGRAM, "tcp": socket.SOCK_STREAM}
OTHER_KEY = bytes(range(32))


def command(system: int, component: int = 1) -> Any:
    return mavlink.MAVLink_command_long_message(system, component, 400, 0, 1, 0, 0, 0, 0, 0, 7)


def attitude(time_ms: int = 5) -> Any:
    return mavlink.MAVLink_attitude_message(time_ms, 0.5, 0, 0, 0, 0, 0.25)


def heartbeat(kind: int = mavlink.MAV_TYPE_FIXED_WING, autopilot: int = 3) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


GCS = heartbeat(mavlink.MAV_TYPE_GCS, 8)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ("systems=0", "systems '0' is not an id from 1 to 255"),
        ("systems=1,x", "systems 'x' is not an id from 1 to 255"),
        ("not-systems=256", "not-systems '256' is not an id"),
        ("systems=1,2&not-systems=2", "system 2 is in both"),
        ("components=-1", "components '-1' is not an id"),
        ("as=1:11,2:11", "an id is given twice"),
        ("as=1:11,1:12", "an id is given twice"),
        ("as=11,2:12", "write as=11 for one vehicle"),
        ("as=1:", "as '' is not an id"),
    ],
)
def test_wrong_option_is_refused(options: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        parse_endpoint(f"udp:h:1?{options}")


STATION_ID, ONE, TWO = (255, STATION), (1, 1), (2, 1)
CORRECTIONS = mavlink.MAVLink_gps_rtcm_data_message(0, 0, bytes(180))
ODOMETRY = mavlink.MAVLink_vision_position_estimate_message(0, 0, 0, 0, 0, 0, 0)
ACCEPTED = mavlink.MAVLink_command_ack_message(400, 0)


@pytest.mark.parametrize("version", [V1, V2])
@pytest.mark.parametrize(
    ("options", "message", "sender", "reach", "lets_out"),
    [
        ("systems=1", command(1), STATION_ID, Reach.EVERYWHERE, True),
        ("systems=1", command(2), STATION_ID, Reach.STATIONS, False),
        ("systems=1", command(1), TWO, Reach.EVERYWHERE, True),
        ("systems=1", attitude(), ONE, Reach.DISPLAYS, True),
        ("systems=1", attitude(), TWO, Reach.NOWHERE, False),
        ("systems=1", ODOMETRY, ONE, Reach.STATIONS, True),
        ("systems=1", ACCEPTED, ONE, Reach.DISPLAYS, True),
        ("systems=1", command(255, STATION), ONE, Reach.STATIONS, True),
        ("systems=1", command(255, STATION), TWO, Reach.NOWHERE, False),
        ("systems=1", GCS, STATION_ID, Reach.EVERYWHERE, True),
        ("systems=1", CORRECTIONS, STATION_ID, Reach.NOWHERE, False),
        ("systems=1&also=GPS_RTCM_DATA", CORRECTIONS, STATION_ID, Reach.SELECTED, True),
        ("systems=1", command(0, 0), STATION_ID, Reach.NOWHERE, False),
        ("systems=1", command(0, 0), ONE, Reach.STATIONS, True),
        ("not-systems=2", command(1), STATION_ID, Reach.EVERYWHERE, True),
        ("not-systems=2", command(0), STATION_ID, Reach.STATIONS, True),
        ("not-systems=2", command(2), STATION_ID, Reach.NOWHERE, False),
        ("not-systems=2", command(255, STATION), TWO, Reach.NOWHERE, False),
        ("not-systems=2&also=VISION_POSITION_ESTIMATE", ODOMETRY, TWO, Reach.NOWHERE, False),
        ("components=1", command(3, 1), STATION_ID, Reach.EVERYWHERE, True),
        ("components=1", command(3, 154), STATION_ID, Reach.STATIONS, False),
        ("components=1", command(3, 0), STATION_ID, Reach.STATIONS, False),
        ("components=1", command(0, 0), STATION_ID, Reach.NOWHERE, False),
        (
            "components=1",
            mavlink.MAVLink_set_mode_message(3, 1, 0),
            STATION_ID,
            Reach.EVERYWHERE,
            True,
        ),
        ("components=1", command(255, STATION), (3, 154), Reach.NOWHERE, False),
    ],
)
def test_filter_lets_frames_pass_in_both_directions(
    options: str,
    message: Any,
    sender: tuple[int, int],
    reach: Reach,
    lets_out: bool,
    version: int,
) -> None:
    wanted = parse_endpoint(f"udp:h:1?{options}").systems
    frame = frame_of(packed(message, *sender, version=version))
    assert wanted.reach(frame, from_station=sender == STATION_ID) == reach
    assert wanted.lets_out(frame) == lets_out


def translation(text: str, *keys: bytes) -> SystemTranslation:
    signer = FrameSigner()
    signer.keys = dict(enumerate(keys, 50))
    return SystemTranslation(
        parse_endpoint(f"udp:h:1?as={text}").new_ids, signer.renewal, lambda: None
    )


@pytest.mark.parametrize("version", [V1, V2])
@pytest.mark.parametrize("text", ["1:11,2:12", "11"])
def test_ids_change_in_both_directions(text: str, version: int) -> None:
    ids = translation(text)
    ids.from_link(frame_of(packed(heartbeat(), 1)), 0)
    received = ids.from_link(frame_of(packed(attitude(), 1, version=version)), 0)
    assert received
    assert (read_back(received.data).get_srcSystem(), read_back(received.data).roll) == (11, 0.5)
    sent = ids.to_link(frame_of(packed(command(11), 255, version=version)))
    assert sent
    got = read_back(sent.data)
    assert (got.get_srcSystem(), got.target_system, got.param7) == (255, 1, 7)


@pytest.mark.parametrize("key", [KEY, OTHER_KEY])
def test_signed_frame_is_signed_again_with_its_own_time(key: bytes) -> None:
    signed = packed(attitude(), 1, signing=(key, 3, 123_456))
    changed = translation("1:11", OTHER_KEY, KEY).from_link(frame_of(signed), 0)
    assert changed
    assert read_back(changed.data, key).get_srcSystem() == 11
    assert changed.data[-13:-6] == signed[-13:-6]


def test_signed_frame_without_key_is_refused_with_the_reason() -> None:
    ids = translation("1:11", OTHER_KEY)
    assert ids.from_link(frame_of(packed(attitude(), 1, signing=(KEY, 3, 9))), 0) is None
    assert (ids.refused, "need their signing_passphrase" in ids.reason) == (1, True)


def test_system_with_the_new_id_of_another_is_refused_and_not_sent() -> None:
    ids = translation("1:11")
    assert ids.from_link(frame_of(packed(attitude(), 11)), 0) is None
    assert "system 11 of this link has the id of another one" in ids.reason
    # Vehicle 1 of this side would look like the link's own.
    assert ids.to_link(frame_of(packed(attitude(), 1))) is None


def test_ids_may_be_exchanged() -> None:
    ids = translation("1:2,2:1")
    for before, after in ((1, 2), (2, 1)):
        found = ids.from_link(frame_of(packed(attitude(), before)), 0)
        back = ids.to_link(frame_of(packed(attitude(), after)))
        assert found
        assert back
        assert (found.origin[0], back.origin[0]) == (after, before)


def test_one_vehicle_is_found_by_the_heartbeat_of_its_autopilot() -> None:
    ids = translation("11")
    station = frame_of(packed(GCS, 255, STATION))
    assert ids.from_link(frame_of(packed(attitude(), 1)), 0) is None
    assert ids.reason == WAITS
    assert ids.from_link(station, 0) == station
    found = ids.from_link(frame_of(packed(heartbeat(), 1)), 0)
    assert found
    assert found.origin == (11, 1)
    assert ids.reason == ""
    # Another autopilot replaces it after an outage.
    second = frame_of(packed(heartbeat(), 7))
    assert ids.from_link(second, 1) == second
    replaced = ids.from_link(second, 20_000_000)
    assert replaced
    assert replaced.origin == (11, 1)


A, B, C = "first", "second", "seat"
"""Three endpoints; the options of each are the first row of a conversation."""
SEAT = (C, GCS, 255, STATION)
"""A station at the third of them."""
ACK = mavlink.MAVLink_command_ack_message(400, 0)
ACK_TO_254 = mavlink.MAVLink_command_ack_message(400, 0, 0, 0, 254, 0)
POSE = [
    (A, heartbeat(18, 8), 3, 191), (B, heartbeat(), 3, 1), (C, heartbeat(), 2, 1), {},
    (A, ODOMETRY, 3, 191),
]  # fmt: skip
CONVERSATIONS: dict[str, list[Any]] = {
    "two vehicles with id 1 become 1 and 2": [
        ("", "as=2", ""), (A, heartbeat(), 1, 1), (B, heartbeat(), 1, 1), (A, attitude(), 1, 1),
        (B, attitude(), 1, 1), {C: [(1, 0), (2, 0), (1, 30), (2, 30)], B: [(1, 0)]},
        (C, GCS, 255, STATION), (C, command(2), 255, STATION),
        {A: [(255, 0)], B: [(255, 0), (255, 76)]}, (B, ACK, 1, 1), {C: [(2, 77)]},
    ],
    "own frames stay away from a filter and from the new id of another": [
        ("not-systems=1", "as=1:21", ""), (None, attitude(), 1, 1), {A: [], B: []},
    ],
    "answers reach a program that has asked a selected vehicle": [
        ("systems=1", "", ""), (A, heartbeat(), 1, 1), (B, heartbeat(), 2, 1),
        (C, attitude(), 254, 0), {}, (A, ACK_TO_254, 1, 1), {C: []}, (C, command(1), 254, 0), {},
        (A, ACK_TO_254, 1, 1), {C: [(1, 77)]},
        # Also a vehicle may have addressed it, and is excluded nevertheless.
        (B, command(1), 2, 1), {}, (A, command(2), 1, 1), {B: []},
    ],
    "pose of a companion reaches the endpoint of its vehicle": [
        ("systems=3", "systems=3", ""), *POSE, {B: [(3, 102)], C: []},
    ],
    "pose stays away from an endpoint of all": [("systems=3", "", ""), *POSE, {B: [], C: []}],
    "pose reaches all without options": [("", "", ""), *POSE, {B: [(3, 102)], C: [(3, 102)]}],
    "heartbeat of a station with the id of a vehicle changes nothing": [
        ("systems=1", "", ""), (A, GCS, 2, 1), (B, heartbeat(), 2, 1), {}, (A, GCS, 2, 1),
        (B, attitude(), 2, 1), {C: [(2, 30)], A: [], B: []},
    ],
    "station gets no corrections of another after its heartbeat": [
        ("", "", ""), (A, heartbeat(), 1, 1), (B, GCS, 254, STATION),
        (C, CORRECTIONS, 255, STATION), (C, GCS, 255, STATION), {}, (C, CORRECTIONS, 255, STATION),
        {A: [(255, 233)], B: []},
    ],
    "frames of an excluded system are counted": [
        ("systems=1", "", ""), (A, attitude(), 2, 1), {B: [], C: [], "unroutable": 1},
    ],
    "command to all does not reach an excluded vehicle of ours": [
        ("", "", "systems=3"), (None, heartbeat(), 1, 1), SEAT, {},
        (C, command(0, 0), 255, STATION), (C, command(1), 255, STATION), {C: [], "ours": 0},
    ],
    "telemetry of a vehicle goes to all others": [
        ("", "", ""), (A, heartbeat(), 1, 1), {}, (A, attitude(), 1, 1),
        {A: [], B: [(1, 30)], C: [(1, 30)], "ours": 0},
    ],
    "request goes to the system that it addresses, and its answer back": [
        ("", "", ""), (A, heartbeat(), 1, 1), (B, GCS, 254, STATION), SEAT, {},
        (C, command(1), 255, STATION), {A: [(255, 76)], B: [], "ours": 0},
        (A, command(255, STATION), 1, 1), {B: [], C: [(1, 76)]},
    ],
    "request to our vehicle or to an unknown system is not forwarded": [
        ("", "", ""), (None, heartbeat(), 3, 1), (A, heartbeat(), 1, 1), SEAT, {},
        (C, command(3), 255, STATION), {A: [], "ours": 1, "unroutable": 0},
        (C, command(99), 255, STATION), {A: [], "ours": 0, "unroutable": 1},
    ],
    "broadcast of a station reaches vehicles only": [
        ("", "", ""), (A, heartbeat(), 1, 1), (B, GCS, 254, STATION), {}, SEAT,
        {A: [(255, 0)], B: [], "ours": 1},
    ],
    "copies are dropped, and our own frames that return": [
        ("", "", ""), (A, heartbeat(), 1, 1), {}, (A, attitude(), 1, 1), {C: [(1, 30)]},
        # From the start it echoes: that is a second path, whose copies are dropped from then on.
        (B, attitude(), 1, 1), {A: [(1, 30)], C: [(1, 30)], "duplicates": 0},
        (A, attitude(6), 1, 1), {B: [(1, 30)], C: [(1, 30)]},
        (B, attitude(6), 1, 1), {A: [], C: [], "duplicates": 1}, (None, heartbeat(), 3, 1),
        (None, attitude(), 3, 1), {}, (C, attitude(), 3, 1),
        {A: [], B: [], "looped": 1, "ours": 0},
    ],
    "untrusted requests reach our vehicles, and a monitor, only": [
        ("trusted=no", "monitor=yes", ""), (None, heartbeat(), 3, 1), SEAT, {},
        (A, command(3), 200, STATION), {B: [(200, 76)], C: [], "ours": 1, "unroutable": 0},
        (A, command(255, STATION), 200, STATION), {B: [], C: [], "ours": 0, "unroutable": 1},
    ],
    "monitor gets all traffic, and its own frames are ignored": [
        ("", "monitor=yes&allow=HEARTBEAT", ""), (None, heartbeat(), 3, 1),
        (A, heartbeat(), 1, 1), SEAT, {}, (C, command(1), 255, STATION),
        {A: [(255, 76)], B: [(255, 76)]}, (C, command(3), 255, STATION), {B: [(255, 76)]},
        (A, attitude(), 1, 1), {B: [(1, 30)], C: [(1, 30)]}, (B, heartbeat(), 77, 1),
        (B, command(1), 77, 1), (B, command(3), 77, 1), {A: [], C: [], "ours": 0, "forwarded": 0},
    ],
    "command takes the trusted path despite a forged component": [
        ("trusted=no", "", ""), (B, heartbeat(), 1, 1), (A, heartbeat(), 1, 77),
        (A, attitude(), 1, 77), {}, (C, command(1, 77), 255, STATION), {A: [], B: [(255, 76)]},
    ],
}  # fmt: skip
"""Frames with their senders, our own without a link, and what has been received since the last
check: system and message, how many by our vehicles, or the increase of a counter."""


@pytest.mark.io
class TestHub:
    """Frames between sockets: two links with vehicles, and a station."""

    async def open(self, rig: Any, *options: str, station: str = "") -> Any:
        first, second, seat = (rig.station() for _ in range(3))
        urls = [
            f"udp:127.0.0.1:{each.port}?{text}"
            for each, text in zip((first, second, seat), (*options, station), strict=True)
        ]
        hub = await rig.open(*urls)
        for client, each in zip(hub.clients(), (first, second, seat), strict=True):
            # Every filter lets one of them pass.
            for system in (1, 2, 3):
                hub.send(rig.out(rig.sender(system).attitude(), client.client_id))
            await each.receive()
            each.received()
        return hub, first, second, seat

    async def send(self, rig: Any, *frames: tuple[Any, Any, int, int]) -> None:
        for station, message, system, component in frames:
            station.send(packed(message, system, component))
            await rig.quiet_some()
        await rig.quiet()

    def origins(self, station: Any) -> list[tuple[int, int]]:
        frames = [frame_of(data) for data in station.received()]
        return [(frame.origin[0], frame.message_id) for frame in frames]

    @pytest.mark.parametrize("rows", CONVERSATIONS.values(), ids=CONVERSATIONS)
    async def test_conversation_passes_as_the_options_allow(self, rig: Any, rows: Any) -> None:
        hub, *stations = await self.open(rig, *rows[0][:2], station=rows[0][2])
        named = dict(zip((A, B, C), stations, strict=True))
        before: dict[str, int] = {}
        for row in rows[1:]:
            if isinstance(row, dict):
                got: dict[str, Any] = {name: self.origins(each) for name, each in named.items()}
                counts = {"ours": rig.received} | asdict(hub.counters())
                got |= {name: count - before.get(name, 0) for name, count in counts.items()}
                before = counts
                assert {name: got[name] for name in row} == row
            elif row[0] is None:
                rig.publish(hub, packed(*row[1:]))
                await rig.quiet()
            else:
                await self.send(rig, (named[row[0]], *row[1:]))

    @pytest.mark.parametrize("message", [ODOMETRY, attitude()], ids=["input", "telemetry"])
    async def test_compiled_route_ends_when_an_excluded_vehicle_is_received(
        self, rig: Any, message: Any
    ) -> None:
        hub, first, second, seat = await self.open(rig, "systems=1", "")
        await self.send(rig, (first, heartbeat(), 1, 1))
        if message is ODOMETRY:
            await self.send(rig, (second, GCS, 255, STATION))
        for each in (second, seat):
            each.received()
        await self.send(rig, *[(first, message, 1, 1)] * 3)
        number = message.get_msgId()
        assert self.origins(second) == [(1, number)] * 3
        if hub.forwarding.is_compiled:
            [source, *_] = hub._clients.values()
            assert any(route.is_compiled for route in source.routes.values())
        await self.send(rig, (second, heartbeat(), 2, 1), (first, message, 1, 1))
        passes = message is not ODOMETRY and self.origins(seat)[-1] == (1, number)
        assert self.origins(second) == []
        assert passes == (message is not ODOMETRY)

    @pytest.mark.parametrize(
        ("options", "drone", "passing"),
        [
            ("", heartbeat(), [(1, 30), (2, 0), (2, 30), (2, 144)]),
            ("budget=5000", heartbeat(), []),
            ("budget=5000&also=FOLLOW_TARGET", heartbeat(), [(2, 144)]),
            ("budget=5000&systems=2,3", heartbeat(), [(2, 0), (2, 30), (2, 144)]),
            ("budget=5000", heartbeat(mavlink.MAV_TYPE_ANTENNA_TRACKER), None),
            ("budget=5000", GCS, None),
        ],
    )
    async def test_link_of_a_vehicle_with_a_capacity_gets_no_telemetry_of_others(
        self, rig: Any, options: str, drone: Any, passing: list[tuple[int, int]] | None
    ) -> None:
        hub, first, second, seat = await self.open(rig, options, "")
        follow = mavlink.MAVLink_follow_target_message(
            0, 1, 0, 0, 0, [0] * 3, [0] * 3, [1, 0, 0, 0], [0] * 3, [0] * 3, 0
        )
        radio = mavlink.MAVLink_radio_status_message(0, 0, 100, 0, 0, 0, 0)
        await self.send(rig, (first, radio, 51, 68), (first, drone, 3, 1))
        first.received()
        rig.publish(hub, rig.vehicle.attitude())
        for message in (heartbeat(), attitude(), follow):
            await self.send(rig, (second, message, 2, 1))
        expected = [(1, 30), (2, 0), (2, 30), (2, 144)] if passing is None else passing
        assert self.origins(first) == expected
        await self.send(rig, (seat, GCS, 255, STATION), (seat, command(3), 255, STATION))
        assert self.origins(first)[:1] == [(255, 0)]

    @pytest.mark.parametrize("options", ["", "budget=9000", "systems=3", "name=radio"])
    async def test_link_with_mostly_telemetry_of_others_gets_a_hint(
        self, rig: Any, options: str
    ) -> None:
        hub, first, second, _ = await self.open(rig, options, "")
        await self.send(rig, (first, heartbeat(), 3, 1), (second, heartbeat(), 2, 1))
        for _ in range(12):
            second.send(*(packed(attitude(), 2, 1) for _ in range(30)))
            await rig.quiet_some()
            first.received()
        hints = [client.hint for client in hub.clients()]
        url = f"udp:127.0.0.1:{first.port}?{options}"
        is_named = "=" not in options or options.startswith("name")
        expected = f"{url}{'&' if '?' in url else '?'}systems=3"
        assert hints[0].endswith(f"; write {expected}") == is_named
        assert [hint for hint in hints[0 if not is_named else 1 :] if hint] == []

    @pytest.mark.parametrize("kind", ["udp", "tcp"])
    async def test_own_signed_frames_are_renumbered_in_order(self, rig: Any, kind: str) -> None:
        hub = rig.hub(f"{kind}-listen:127.0.0.1:0?as=21:1&pack=0", signer=signer())
        sock = await rig.connect(hub.listening_ports()[0], KINDS[kind])
        sock.send(rig.sender(255, STATION).heartbeat())
        await rig.until(lambda: rig.received)
        rig.publish(hub, *(rig.vehicle.attitude() for _ in range(3)))
        link, got = strict(), list[Any]()
        while len(got) < 3:
            got += link.parse_buffer(await receive(sock))
        assert [each.get_srcSystem() for each in got] == [21, 21, 21]
        assert [each.get_seq() for each in got] == [got[0].get_seq() + k for k in range(3)]

    async def test_clash_of_ids_is_reported_with_the_option_that_solves_it(self, rig: Any) -> None:
        hub, first, second, _ = await self.open(rig, "", "name=radio")
        for number in range(30):
            rig.clock.now_us += 100_000
            await self.send(rig, (first, attitude(60_000 + 100 * number), 1, 1))
            await self.send(rig, (second, attitude(500_000 + 100 * number), 1, 1))
        notes = [client.note for client in hub.clients()]
        url = f"udp:127.0.0.1:{second.port}?name=radio&as=2"
        assert notes[0] == notes[2] == ""
        assert notes[1].endswith(f"; write {url}")
        hub.apply(type(hub.settings)(endpoints=(*hub.settings.endpoints[::2], url)))
        rig.clock.now_us += 40_000_000
        await self.send(rig, (first, attitude(), 1, 1), (second, heartbeat(), 1, 1))
        assert [client.note for client in hub.clients()] == ["", "", ""]

    async def test_two_links_to_one_vehicle_are_no_clash(self, rig: Any) -> None:
        hub, first, second, _ = await self.open(rig, "", "")
        for time_ms in range(60_000, 63_000, 100):
            rig.clock.now_us += 100_000
            # Each port of an autopilot has frames and sequence numbers of its own.
            await self.send(rig, (first, attitude(time_ms + 1), 1, 1))
            await self.send(rig, (second, attitude(time_ms), 1, 1))
        assert [client.note for client in hub.clients()] == ["", "", ""]

    async def test_clients_without_options_keep_their_compiled_routes(self, rig: Any) -> None:
        hub, first, second, _ = await self.open(rig, "", "as=2", station="systems=1")
        await self.send(rig, (first, heartbeat(), 1, 1), (second, heartbeat(), 1, 1))
        await self.send(rig, *[(each, attitude(), 1, 1) for each in (first, second)] * 2)
        clients = list(hub._clients.values())
        compiled = [
            any(route.is_compiled for route in client.routes.values()) for client in clients
        ]
        if hub.forwarding.is_compiled:
            assert compiled == [True, False, False]
        assert [client.is_direct for client in clients] == [True, False, True]
