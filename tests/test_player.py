"""The player whole, on the event loop: what reaches a client, and what it is answered."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

import gateway.player
from gateway.cli.recorded.play import print_plan, steer
from gateway.config import GatewaySettings
from gateway.hub.hub import SENDS_AT_ONCE
from gateway.player import PlayerDaemon, PlayPlan, endpoints_beyond
from gateway.recordings.files import FlightError
from gateway.recordings.opening import lay_out, open_flights
from gateway.recordings.tlog import TlogRecord
from gateway.records import Outgoing
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.mavlink import STATION, Sender
from tests.kit.recordings import START_US, make_tlog
from tests.ports import free_port
from tests.recordings.flights import OPTIONS

pytestmark = pytest.mark.io

PARAMETERS = 26
LIMIT_S = 60


def recording(step_us: int = 1) -> list[TlogRecord]:
    """Vehicle 3 sends its parameters, and station 255 arms it."""
    vehicle, station = Sender(3), Sender(255, STATION)
    said: list[tuple[Any, Any]] = [(vehicle, mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))]
    said += [
        (vehicle, mavlink.MAVLink_param_value_message(f"P{i}".encode(), i, 9, PARAMETERS, i))
        for i in range(PARAMETERS)
    ]
    arm = mavlink.MAVLink_command_long_message(3, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    said += [(station, arm), (vehicle, mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))]
    records = []
    for i, (who, message) in enumerate(said):
        records.append(TlogRecord(START_US + i * step_us, who.pack(message)))
    return records


class Station:
    """A bare client on the event loop."""

    def __init__(self) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.bind(("127.0.0.1", 0))
        self.sock.setblocking(False)
        self.mav = mavlink.MAVLink(None, 255, 190)
        self.frames: list[bytes] = []
        self.peer: Any = None

    @property
    def url(self) -> str:
        return f"udp:127.0.0.1:{self.sock.getsockname()[1]}"

    async def until(self, count: int) -> None:
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(LIMIT_S):
            while len(self.frames) < count:
                frame, self.peer = await loop.sock_recvfrom(self.sock, 2048)
                self.frames.append(frame)

    def send(self, message: Any) -> None:
        self.sock.sendto(message.pack(self.mav), self.peer)


@pytest.fixture
def station() -> Iterator[Station]:
    station = Station()
    yield station
    station.sock.close()


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ExitStack]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "a.tlog").write_bytes(make_tlog(recording()))
    with ExitStack() as stack:
        yield stack


def settings_of(*endpoints: str) -> GatewaySettings:
    settings = GatewaySettings()
    return msgspec.structs.replace(
        settings,
        hub=msgspec.structs.replace(settings.hub, endpoints=endpoints, ping_interval_s=0.0),
    )


def make_daemon(
    folder: Path, opened: ExitStack, settings: GatewaySettings, **plan: Any
) -> PlayerDaemon:
    flights = open_flights([folder / "a.tlog"], OPTIONS, opened)
    played = lay_out(flights, with_commands=plan.get("with_commands", False))
    return PlayerDaemon(settings, played, PlayPlan(**plan), ["a.tlog"])


@pytest.mark.parametrize("with_commands", [False, True])
async def test_commands_of_stations_are_played_only_on_request(
    tmp_path: Path, opened: ExitStack, station: Station, with_commands: bool
) -> None:
    daemon = make_daemon(tmp_path, opened, settings_of(station.url), with_commands=with_commands)
    await daemon.start()
    wanted = [r.frame for r in recording()]
    if not with_commands:
        # The parameters are an answer; without it the second heartbeat follows the first.
        edited = edit_frame(frame_of(wanted[-1]), sequence=1)
        assert edited is not None
        wanted = [wanted[0], edited.data]
    await station.until(len(wanted))
    daemon.close()
    assert station.frames == wanted


async def test_recorded_high_latency_messages_are_played(
    tmp_path: Path, opened: ExitStack, station: Station
) -> None:
    vehicle = Sender(3)
    records = [
        TlogRecord(START_US + i, vehicle.pack(mavlink.MAVLink_high_latency2_message(*[i] * 27)))
        for i in range(5)
    ]
    (tmp_path / "a.tlog").write_bytes(make_tlog(records))
    daemon = make_daemon(tmp_path, opened, settings_of(station.url))
    await daemon.start()
    await station.until(len(records))
    daemon.close()
    assert station.frames == [record.frame for record in records]


@pytest.mark.parametrize(
    "url",
    [
        "udp:tablet.example:14550",
        "udp-listen:0.0.0.0:14550",
        "udp-broadcast:127.255.255.255:14550",
        "serial:/dev/ttyUSB0:57600",
        "tcp:drone.example:5760",
    ],
)
def test_commands_to_other_machines_need_confirmation(
    tmp_path: Path, opened: ExitStack, url: str
) -> None:
    settings = settings_of("udp:127.0.0.1:14550", "tcp:[::1]:5760", url)
    assert endpoints_beyond(settings.hub) == [url]
    with pytest.raises(ValueError, match="yes"):
        make_daemon(tmp_path, opened, settings, with_commands=True)
    make_daemon(tmp_path, opened, settings, with_commands=True, commands_anywhere=True)
    make_daemon(tmp_path, opened, settings)


async def test_all_parameters_arrive_with_consecutive_sequence_numbers(
    tmp_path: Path, opened: ExitStack, station: Station
) -> None:
    daemon = make_daemon(tmp_path, opened, settings_of(station.url))
    await daemon.start()
    await station.until(2)
    station.frames.clear()
    station.send(mavlink.MAVLink_param_request_list_message(3, 1))
    await station.until(PARAMETERS)
    daemon.edge.seek("0")
    daemon.edge.resume()
    await station.until(PARAMETERS + 2)
    daemon.close()
    answers = [mavlink.MAVLink(None).decode(bytearray(f)) for f in station.frames[:PARAMETERS]]
    assert [(m.param_id, m.param_count) for m in answers] == [
        (f"P{i}", PARAMETERS) for i in range(PARAMETERS)
    ]
    # What was played before ended with 1; the answers go on from there.
    assert [f[4] for f in station.frames[:PARAMETERS]] == list(range(2, 2 + PARAMETERS))


async def test_answer_is_sent_after_the_batch_before_it(
    tmp_path: Path, opened: ExitStack, station: Station
) -> None:
    daemon = make_daemon(tmp_path, opened, settings_of(station.url), paused=True)
    await daemon.start()
    played = [record.frame for record in recording()[: PARAMETERS + 1]]
    daemon._send(played)
    assert daemon._hub.counters().published == SENDS_AT_ONCE < len(played)
    daemon._perform([Outgoing(played[-1], 22, 1)])
    await station.until(len(played) + 1)
    daemon.close()
    assert [frame[4] for frame in station.frames] == list(range(len(played) + 1))


async def test_keys_steer_the_player(tmp_path: Path, opened: ExitStack, station: Station) -> None:
    (tmp_path / "a.tlog").write_bytes(make_tlog(recording(step_us=10_000_000)))
    daemon = make_daemon(tmp_path, opened, settings_of(station.url), paused=True)
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
    daemon.close()


async def test_endpoint_whose_name_is_unknown_ends_the_playback(
    tmp_path: Path, opened: ExitStack, station: Station
) -> None:
    daemon = make_daemon(tmp_path, opened, settings_of("udp:nowhere.invalid:14550"))
    with pytest.raises(FlightError, match=r"nothing can be sent to udp:nowhere.invalid:14550: \w"):
        await daemon.start()
    daemon.close()
    daemon = make_daemon(tmp_path, opened, settings_of("udp:nowhere.invalid:1", station.url))
    await daemon.start()
    await station.until(1)
    assert len(daemon.troubles()) == 1
    daemon.close()


async def test_port_without_a_listener_is_named_at_once(tmp_path: Path, opened: ExitStack) -> None:
    urls = f"udp:127.0.0.1:{free_port()}", f"tcp:127.0.0.1:{free_port()}"
    daemon = make_daemon(tmp_path, opened, settings_of(*urls))
    await daemon.start()
    async with asyncio.timeout(LIMIT_S):
        while len(daemon.troubles()) < len(urls):
            await asyncio.sleep(0.01)
    assert {trouble.rpartition(": ")[0] for trouble in daemon.troubles()} == {*urls}
    daemon.close()


def test_end_does_not_wait_for_a_name(
    tmp_path: Path, opened: ExitStack, monkeypatch: pytest.MonkeyPatch, station: Station
) -> None:
    resolve, answered, given_up = socket.getaddrinfo, threading.Event(), []

    def slow(host: str, *args: Any, **kwargs: Any) -> Any:
        if host == "slow.example":
            given_up.append(answered.wait(LIMIT_S))
        return resolve("127.0.0.1", *args, **kwargs)

    async def play() -> None:
        daemon = make_daemon(tmp_path, opened, settings_of("udp:slow.example:1", station.url))
        await daemon.start()
        daemon.close()

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    monkeypatch.setattr(gateway.player, "READY_S", 0.05)
    asyncio.run(play())
    assert given_up == [], "the look-up still waits"
    answered.set()


@pytest.mark.parametrize("plan", [{"paused": True}, {}], ids=["before the start", "at the end"])
async def test_idle_player_repeats_the_state_without_gaps_in_the_numbers(
    tmp_path: Path, opened: ExitStack, station: Station, plan: dict[str, Any]
) -> None:
    daemon = make_daemon(tmp_path, opened, settings_of(station.url), **plan)
    await daemon.start()
    recorded = 0 if plan else 2
    await station.until(recorded + 3)
    daemon.close()
    read = [frame_of(frame) for frame in station.frames]
    assert {frame.message_id for frame in read} == {mavlink.MAVLINK_MSG_ID_HEARTBEAT}
    assert [frame.sequence for frame in read] == [
        (read[0].sequence + i) % 256 for i in range(len(read))
    ]


@pytest.mark.parametrize(
    ("endpoints", "text"),
    [
        (("udp:127.0.0.1:14550", "tcp-listen:127.0.0.1:5760"),
         "playing a.tlog as vehicle 3 to udp:127.0.0.1:14550, tcp-listen:127.0.0.1:5760"),
        ((), "playing a.tlog as vehicle 3 to nobody: no endpoint is set"),
    ],
)  # fmt: skip
def test_vehicles_and_endpoints_are_printed(
    tmp_path: Path,
    opened: ExitStack,
    capsys: pytest.CaptureFixture[str],
    endpoints: tuple[str, ...],
    text: str,
) -> None:
    flights = open_flights([tmp_path / "a.tlog"], OPTIONS, opened)
    print_plan(["a.tlog"], lay_out(flights, with_commands=False), endpoints)
    assert " ".join(capsys.readouterr().out.split()) == text
