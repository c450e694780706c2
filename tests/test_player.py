"""The player whole, on the event loop: what reaches a client, and what it is answered."""

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

import gateway.player
from gateway.cli.recorded.play import steer
from gateway.config import GatewaySettings
from gateway.hub.hub import SENDS_AT_ONCE
from gateway.live import player_edge
from gateway.player import PlayerDaemon, PlayPlan, endpoints_beyond
from gateway.recordings.files import FlightError
from gateway.recordings.opening import lay_out, open_flights
from gateway.records import Incoming, Outgoing
from gateway.vehicle.recorded_vehicle import RecordedAction
from gateway.wire.frame_editing import renumbered
from gateway.wire.mavlink_splitter import frame_of
from gateway.wire.recorded_frames import RecordedFrame
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, qgroundcontrol
from tests.kit.hub import Station
from tests.kit.mavlink import STATION, Sender
from tests.kit.process import until
from tests.kit.recordings import records_of, write_tlog
from tests.ports import free_port
from tests.recordings import test_autopilot_record
from tests.recordings.flights import OPTIONS
from tests.recordings.formats import flown

pytestmark = pytest.mark.io

PARAMETERS = 26
LIMIT_S = 60
END_US = 1 << 62
DENIED, UNSUPPORTED = 2, 3


def recording(step_us: int = 1) -> list[RecordedFrame]:
    """Vehicle 3 sends its parameters, and station 255 arms it."""
    vehicle, station = Sender(3), Sender(255, STATION)
    beat = mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)
    parameters = [
        mavlink.MAVLink_param_value_message(f"P{i}".encode(), i, 9, PARAMETERS, i)
        for i in range(PARAMETERS)
    ]
    arm = station.pack(mavlink.MAVLink_command_long_message(3, 1, 400, 0, 1, *[0] * 6))
    frames = [*map(vehicle.pack, [beat, *parameters]), arm, vehicle.pack(beat)]
    return records_of(frames, step_us)


class PlayedTo(Station):
    """A station, and the frames that it has received."""

    def __init__(self) -> None:
        super().__init__(None, socket.SOCK_DGRAM, (255, STATION))
        self.frames: list[bytes] = []

    @property
    def url(self) -> str:
        return f"udp:127.0.0.1:{self.port}"

    async def until(self, count: int) -> None:
        while len(self.frames) < count:
            self.frames.append(await self.receive())


@pytest.fixture
def station() -> Iterator[PlayedTo]:
    station = PlayedTo()
    yield station
    station.socket.close()


Make = Callable[..., PlayerDaemon]


@pytest.fixture
async def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Make]:
    """Make players of a recording to some endpoints; they are closed at the end."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with ExitStack() as opened:

        def make(
            *urls: str,
            records: list[RecordedFrame] | None = None,
            log: Path | None = None,
            **plan: Any,
        ) -> PlayerDaemon:
            path = log or write_tlog(tmp_path / "a.tlog", records or recording())
            flights = open_flights([path], OPTIONS, opened)
            played = lay_out(flights, with_commands=plan.get("with_commands", False))
            daemon = PlayerDaemon(settings_of(*urls), played, PlayPlan(**plan), ["a.tlog"])
            opened.callback(daemon.close)
            # A log is open until its end has been read.
            opened.callback(lambda: [None for _ in iter(lambda: daemon._player.prepare(END_US), 1)])
            return daemon

        yield make


def settings_of(*endpoints: str) -> GatewaySettings:
    settings = GatewaySettings()
    return msgspec.structs.replace(
        settings,
        hub=msgspec.structs.replace(settings.hub, endpoints=endpoints, ping_interval_s=0.0),
    )


@pytest.mark.parametrize("with_commands", [False, True], ids=["without", "with commands"])
async def test_commands_of_stations_are_played_only_on_request(
    make: Make, station: PlayedTo, with_commands: bool
) -> None:
    await make(station.url, with_commands=with_commands).start()
    wanted = [r.frame for r in recording()]
    if not with_commands:
        # The parameters are an answer; without it the second heartbeat follows the first.
        wanted = [wanted[0], renumbered(frame_of(wanted[-1]), 1).data]
    await station.until(len(wanted))
    assert station.frames == wanted


async def test_recorded_high_latency_messages_are_played(make: Make, station: PlayedTo) -> None:
    vehicle = Sender(3)
    frames = [vehicle.pack(mavlink.MAVLink_high_latency2_message(*[i] * 27)) for i in range(5)]
    await make(station.url, records=records_of(frames, 1)).start()
    await station.until(len(frames))
    assert station.frames == frames


def test_commands_to_other_machines_need_confirmation(make: Make) -> None:
    urls = ("udp:127.0.0.1:14550", "tcp:[::1]:5760")
    others = [
        *("udp:tablet.example:14550", "udp-listen:0.0.0.0:14550", "serial:/dev/ttyUSB0:57600"),
        *("udp-broadcast:127.255.255.255:14550", "tcp:drone.example:5760"),
    ]
    assert endpoints_beyond(settings_of(*urls, *others).hub) == others
    urls = (*urls, others[0])
    with pytest.raises(ValueError, match="unless the user confirms"):
        make(*urls, with_commands=True)
    make(*urls, with_commands=True, commands_anywhere=True)
    make(*urls)


async def test_all_parameters_arrive_with_consecutive_sequence_numbers(
    make: Make, station: PlayedTo
) -> None:
    daemon = make(station.url)
    await daemon.start()
    await station.until(2)
    station.frames.clear()
    station.send(station.sender.pack(mavlink.MAVLink_param_request_list_message(3, 1)))
    await station.until(PARAMETERS)
    daemon.edge.seek("0")
    daemon.edge.resume()
    await station.until(PARAMETERS + 2)
    answers = [mavlink.MAVLink(None).decode(bytearray(f)) for f in station.frames[:PARAMETERS]]
    assert [(m.param_id, m.param_count) for m in answers] == [
        (f"P{i}", PARAMETERS) for i in range(PARAMETERS)
    ]
    # What was played before ended with 1; the answers go on from there.
    assert [f[4] for f in station.frames[:PARAMETERS]] == list(range(2, 2 + PARAMETERS))
    # Recorded frames are shifted by the number of answers from then on.
    assert [f[4] for f in station.frames[PARAMETERS:]] == [PARAMETERS, PARAMETERS + 1]


class Played:
    """The answering components of a player, as one vehicle for the scripted ground station."""

    def __init__(self, daemon: PlayerDaemon) -> None:
        self._parts = daemon._vehicles
        self.system_id = self._parts[0].system_id

    def handle(self, incoming: Incoming, now_us: int) -> list[RecordedAction]:
        return [action for part in self._parts for action in part.handle(incoming, now_us)]

    def poll(self, now_us: int) -> list[RecordedAction]:
        return [action for part in self._parts for action in part.poll(now_us)]

    def next_due_us(self) -> int | None:
        due = (part.next_due_us() for part in self._parts)
        return min((us for us in due if us is not None), default=None)


def log_of(name: str, folder: Path) -> Path:
    """Write a flight by ArduPilot, PX4, or as a tlog of the former with a camera and modes."""
    path = folder / name
    if path.suffix == ".ulg":
        return flown.write(path, test_autopilot_record.px4_log())
    written = test_autopilot_record.write(folder / "flight.bin")
    if path.suffix == ".bin":
        return written
    records = test_autopilot_record.translated(written)
    camera, beat = Sender(7, 100), mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
    versions = [mavlink.MAVLink_autopilot_version_message(32, 1, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8,
                                                          0, 0, 1)]  # fmt: skip
    frames = [Sender(7).pack(each) for each in versions]
    frames += [camera.pack(each) for each in (beat, *camera_messages())]
    return write_tlog(path, [*records_of(frames, 1), *records])


def camera_messages() -> list[Any]:
    lens = mavlink.MAVLink_camera_information_message
    storage = mavlink.MAVLink_storage_information_message
    image = mavlink.MAVLink_camera_image_captured_message
    return [
        lens(5, [0] * 32, [0] * 32, 1, 24.0, 0, 0, 1920, 1080, 0, 0, 0, b""),
        *(storage(5, number, 2, 2, 64.0, 1.0, 63.0, 0, 0) for number in (1, 2)),
        *(image(5, 0, 1, 0, 0, 0, 0, [1, 0, 0, 0], n, 1, b"") for n in range(4)),
    ]


ARDUPILOT_MODES = 28
READY = {
    "flight.bin": (ARDUPILOT_MODES, 3, (2, 0, 0), []),
    "flight.ulg": (26, 1, (0, 0, 0), []),
    "flight.tlog": (ARDUPILOT_MODES, 3, (2, 0, 0), [100]),
}
"""Number of modes and parameters, of items of plans, and the cameras."""


@pytest.mark.parametrize("one_by_one", [True, False], ids=["one by one", "all at once"])
@pytest.mark.parametrize("name", READY)
def test_qgroundcontrol_becomes_ready(
    make: Make, tmp_path: Path, clock: ManualClock, name: str, one_by_one: bool
) -> None:
    daemon = make(log=log_of(name, tmp_path), paused=True)
    station = GroundStation(cast(Any, Played(daemon)), clock)
    daemon._player.step(0, 3)
    station.inbox += [mavlink.MAVLink(None).decode(bytearray(f)) for f in daemon._player.held()]
    began_us = clock.now_us
    ready = qgroundcontrol(station, one_by_one=one_by_one)
    found = (len(ready.modes), len(ready.parameters), ready.plans, ready.cameras)
    assert found == READY[name]
    assert clock.now_us - began_us < 2_000_000


REQUESTS = {
    "storage 2": (100, 261, (2,), [2]),
    "every storage": (100, 261, (0,), [1, 2]),
    "storage that is not there": (100, 261, (3,), DENIED),
    "image 2": (100, 263, (2, 0), [2]),
    "images from 1 to 2": (100, 263, (1, 2), [1, 2]),
    "images from 2 on": (100, 263, (2, -1), [2, 3]),
    "every image": (100, 263, (-1, 0), [0, 1, 2, 3]),
    "image that is not there": (100, 263, (9,), DENIED),
    "camera that a camera drives": (100, 259, (1,), DENIED),
    "version of a camera": (100, 148, (), UNSUPPORTED),
    "telemetry before it is played": (1, 1, (), mavlink.MAV_RESULT_TEMPORARILY_REJECTED),
    "parameters as messages": (1, 22, (), UNSUPPORTED),
}
"""Component, message and parameters of a request; the numbers of the answers, or the result."""


def test_request_selects_by_its_parameters(make: Make, tmp_path: Path, clock: ManualClock) -> None:
    daemon = make(log=log_of("flight.tlog", tmp_path), paused=True)
    station = GroundStation(cast(Any, Played(daemon)), clock)
    for name, (component, message_id, params, expected) in REQUESTS.items():
        ack, *found = station.command(512, message_id, *params, target=(7, component))
        numbers = [getattr(m, "storage_id", getattr(m, "image_index", None)) for m in found]
        assert (numbers or ack.result) == expected, name
        older = {261: 525, 263: 2002}.get(message_id)
        if older is not None and len(params) == 1:
            ack, *found = station.command(older, *params, target=(7, component))
            assert (len(found) or ack.result) == (len(numbers) or ack.result), name


def test_instances_of_telemetry_are_those_played_last(
    make: Make, tmp_path: Path, clock: ManualClock
) -> None:
    daemon = make(log=log_of("flight.bin", tmp_path), paused=True)
    station = GroundStation(cast(Any, Played(daemon)), clock)
    while not daemon._player.newest(7 << 8 | 1, mavlink.MAVLINK_MSG_ID_VFR_HUD):
        daemon._player.step(0, 10)
    for wanted, expected in ((0, [0, 1]), (1, [1]), (2, [])):
        _, *found = station.command(512, mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, wanted)
        assert [m.id for m in found] == expected


async def test_answer_is_sent_after_the_batch_before_it(make: Make, station: PlayedTo) -> None:
    daemon = make(station.url, paused=True)
    await daemon.start()
    played = [record.frame for record in recording()[: PARAMETERS + 1]]
    daemon._send(played)
    assert daemon._hub.counters().published == SENDS_AT_ONCE < len(played)
    daemon._perform([Outgoing(played[-1], 22, 1)])
    await station.until(len(played) + 1)
    assert [frame[4] for frame in station.frames] == list(range(len(played) + 1))


async def test_keys_steer_the_player(make: Make, station: PlayedTo) -> None:
    daemon = make(station.url, records=recording(step_us=10_000_000), paused=True)
    await daemon.start()
    for key, state, speed, loop in (
        ("space", "playing", 1.0, False),
        ("+", "playing", 2.0, False),
        ("=", "playing", 4.0, False),
        ("-", "playing", 2.0, False),
        ("l", "playing", 2.0, True),
        ("space", "paused", 2.0, True),
        (".", "paused", 2.0, True),
        ("x", "paused", 2.0, True),
    ):
        steer(daemon, key)
        status = daemon.edge.status()
        assert (status.state, status.speed, status.loop) == (state, speed, loop), key
    steer(daemon, "home")
    for key, position_s in (("up", 60), ("right", 70), ("left", 60), ("down", 0), ("left", 0)):
        steer(daemon, key)
        assert daemon.edge.status().position_s == position_s
    for _ in range(20):
        steer(daemon, "+")
    assert daemon.edge.status().speed == 100.0
    assert not daemon.ended.is_set()
    steer(daemon, "q")
    assert daemon.ended.is_set()


async def test_endpoint_whose_name_is_unknown_ends_the_playback(
    make: Make, station: PlayedTo
) -> None:
    with pytest.raises(FlightError, match=r"nothing can be sent to udp:nowhere.invalid:14550: \w"):
        await make("udp:nowhere.invalid:14550").start()
    daemon = make("udp:nowhere.invalid:1", station.url)
    await daemon.start()
    await station.until(1)
    assert len(daemon.troubles()) == 1


async def test_port_without_a_listener_is_named_at_once(make: Make) -> None:
    urls = f"udp:127.0.0.1:{free_port()}", f"tcp:127.0.0.1:{free_port()}"
    daemon = make(*urls)
    await daemon.start()
    await until(lambda: len(daemon.troubles()) == len(urls), 0.01)
    assert {trouble.rpartition(": ")[0] for trouble in daemon.troubles()} == {*urls}


def test_end_does_not_wait_for_a_name(
    make: Make, monkeypatch: pytest.MonkeyPatch, station: PlayedTo
) -> None:
    resolve, answered, given_up = socket.getaddrinfo, threading.Event(), []

    def slow(host: str, *args: Any, **kwargs: Any) -> Any:
        if host == "slow.example":
            given_up.append(answered.wait(LIMIT_S))
        return resolve("127.0.0.1", *args, **kwargs)

    async def play() -> None:
        daemon = make("udp:slow.example:1", station.url)
        await daemon.start()
        daemon.close()

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    monkeypatch.setattr(gateway.player, "READY_S", 0.05)
    asyncio.run(play())
    assert given_up == [], "the look-up still waits"
    answered.set()


@pytest.mark.parametrize("plan", [{"paused": True}, {}], ids=["before the start", "at the end"])
async def test_idle_player_repeats_the_state_without_gaps_in_the_numbers(
    make: Make, station: PlayedTo, plan: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player_edge, "HOLD_US", 10_000)
    monkeypatch.setattr(player_edge, "LONGEST_WAIT_S", 0.005)
    await make(station.url, **plan).start()
    await station.until(3 if plan else 5)
    read = [frame_of(frame) for frame in station.frames]
    assert {frame.message_id for frame in read} == {mavlink.MAVLINK_MSG_ID_HEARTBEAT}
    first = read[0].sequence
    assert [frame.sequence for frame in read] == [(first + i) % 256 for i in range(len(read))]
