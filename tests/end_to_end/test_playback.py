"""Recordings read and played to mavlogdump, MAVProxy, MAVSDK and a bare client."""

import asyncio
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from pymavlink.dialects.v20 import common as mavlink

from gateway.live.control_socket import request
from gateway.wire.recorded_frames import RecordedFrame
from tests.end_to_end.processes import HOME, NEAR_DEG, Client, Gateway, MavProxy, mavsdk_system
from tests.kit.mavlink import Sender
from tests.kit.process import START_LIMIT_S, Process
from tests.kit.recordings import START_US, make_tlog
from tests.ports import free_port

pytestmark = [pytest.mark.io, pytest.mark.slow]

LAT_DEG, LON_DEG = 47.1, 8.5
SECONDS = 60


def make_flight() -> list[RecordedFrame]:
    """Make what a foreign vehicle (system 3) sends while it flies north."""
    sender, records = Sender(3), []
    for i in range(SECONDS * 10):
        lat, lon = round(LAT_DEG * 1e7) + 10 * i, round(LON_DEG * 1e7)
        messages = [
            mavlink.MAVLink_attitude_quaternion_message(100 * i, 1.0, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_global_position_int_message(
                100 * i, lat, lon, 430_000, 0, 100, 0, 0, 0
            ),
        ]
        if i % 10 == 0:
            messages += [
                mavlink.MAVLink_heartbeat_message(1, mavlink.MAV_AUTOPILOT_GENERIC, 128, 0, 4, 3),
                mavlink.MAVLink_home_position_message(
                    lat, lon, 430_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
                ),
            ]
        time_us = START_US + 100_000 * i
        records += [RecordedFrame(time_us, sender.pack(message)) for message in messages]
    return records


RECORDS = make_flight()


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    path = tmp_path / "flight.tlog"
    path.write_bytes(make_tlog(RECORDS))
    return path


class Playing(Process):
    """A running `mavgate play`."""

    def __init__(self, folder: Path, *arguments: str, port: int = 0) -> None:
        self.port = port or free_port()
        self.socket = folder / "mavgate" / "play.sock"
        endpoint = ("--endpoint", f"udp:127.0.0.1:{self.port}")
        super().__init__(folder, "play", *arguments, *endpoint, config="", stdin=subprocess.PIPE)


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Playing]]:
    started: list[Playing] = []

    def start(*arguments: str, port: int = 0) -> Playing:
        started.append(Playing(tmp_path, *arguments, port=port))
        return started[-1]

    yield start
    for playing in started:
        playing.process.kill()
        playing.process.communicate()


def test_client_gets_every_frame_unchanged(
    tlog: Path, play: Callable[..., Playing], connect: Callable[..., Client]
) -> None:
    port = free_port()
    client = connect(port)
    playing = play(str(tlog), "--speed", "50", port=port)
    frames = [client.sock.recv(2048) for _ in RECORDS]
    # The hub may send a heartbeat before the telemetry of the same batch.
    assert sorted(frames) == sorted(record.frame for record in RECORDS)
    assert playing.process.wait(START_LIMIT_S) == 0


def test_attached_player_ends_when_its_parent_ends(
    tlog: Path, play: Callable[..., Playing], connect: Callable[..., Client]
) -> None:
    port = free_port()
    client = connect(port)
    playing = play(str(tlog), "--loop", "--attached", port=port)
    assert client.sock.recv(2048)
    assert playing.process.poll() is None
    assert playing.process.stdin is not None
    playing.process.stdin.close()
    assert playing.process.wait(START_LIMIT_S) == 0


def test_two_recordings_are_played_as_two_vehicles(
    tlog: Path, play: Callable[..., Playing], connect: Callable[..., Client]
) -> None:
    port = free_port()
    client = connect(port)
    play(str(tlog), str(tlog), "--id", "3", "--id", "7", "--speed", "10", port=port)
    systems: set[int] = set()
    while systems != {3, 7}:
        systems |= {message.get_srcSystem() for message in client.receive()}


async def position_by_mavsdk(port: int) -> tuple[float, float]:
    """Return latitude and longitude as MAVSDK reports them."""
    async with mavsdk_system(port) as system:
        telemetry = TelemetryAsync(system)
        position = await anext(telemetry.subscribe_position())
    return position.latitude_deg, position.longitude_deg


def latitude_by_mavproxy(proxy: MavProxy, system: int) -> float:
    """Return the latitude as MAVProxy reports it."""
    proxy.until(rf"Detected vehicle {system}:1")
    found = proxy.until(r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+)", "status GLOBAL_POSITION_INT")
    return int(found[1]) / 1e7


def test_recorded_vehicle_is_seen_answers_and_is_paused_and_moved(
    tlog: Path,
    play: Callable[..., Playing],
    connect: Callable[..., Client],
    start_mavproxy: Callable[[int], MavProxy],
) -> None:
    port = free_port()
    client = connect(port)
    playing = play(str(tlog), "--loop", "--from", "0:10", port=port)
    _, address = client.sock.recvfrom(2048)
    client.send(mavlink.MAVLink_param_request_list_message(3, 1), address[1])
    seen = client.until(lambda seen: "PARAM_ERROR" in seen)
    assert seen["PARAM_ERROR"].get_srcSystem() == 3
    number = mavlink.MAV_CMD_GET_HOME_POSITION
    home = mavlink.MAVLink_command_long_message(3, 1, number, 0, 0, 0, 0, 0, 0, 0, 0)
    client.send(home, address[1])
    seen = client.until(lambda seen: {"COMMAND_ACK", "HOME_POSITION"} <= seen.keys())
    assert seen["COMMAND_ACK"].result == mavlink.MAV_RESULT_ACCEPTED
    client.sock.close()
    assert asyncio.run(position_by_mavsdk(port)) == pytest.approx((LAT_DEG, LON_DEG), abs=0.01)
    proxy = start_mavproxy(port)
    assert latitude_by_mavproxy(proxy, 3) == pytest.approx(LAT_DEG, abs=0.01)
    proxy.process.kill()
    proxy.process.wait()
    client = connect(port)
    client.until(lambda seen: "HOME_POSITION" in seen)
    assert request(playing.socket, "play.pause")["state"] == "paused"
    status = request(playing.socket, "seek", {"to": "0:30"})
    assert status["position_s"] == pytest.approx(30.0)
    wanted = round(LAT_DEG * 1e7) + 10 * 10 * 40 - 10
    seen = client.until(lambda seen: getattr(seen.get("GLOBAL_POSITION_INT"), "lat", 0) == wanted)
    assert seen["HEARTBEAT"].get_srcSystem() == 3


def test_mavproxy_recording_is_seen_by_mavproxy_and_mavsdk(
    start_gateway: Callable[..., Gateway],
    start_mavproxy: Callable[[int], MavProxy],
    play: Callable[..., Playing],
    tmp_path: Path,
) -> None:
    gateway = start_gateway("demo")
    recorder = start_mavproxy(gateway.port)
    # Six seconds of flight hold several heartbeats, by which the players' clients find the vehicle.
    recorder.until(
        r"GLOBAL_POSITION_INT \{time_boot_ms : ([6-9]\d{3}|\d{5})", "status GLOBAL_POSITION_INT"
    )
    # StatusText to end, it writes what it still holds; the closed input wakes its keyboard thread.
    recorder.process.terminate()
    recorder.process.communicate(timeout=START_LIMIT_S)
    gateway.end()
    recorded = (tmp_path / "mav.tlog").rename(tmp_path / "recorded.tlog")
    playing = play(str(recorded), "--loop")
    latitude, _ = asyncio.run(position_by_mavsdk(playing.port))
    assert latitude == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    proxy = start_mavproxy(playing.port)
    assert latitude_by_mavproxy(proxy, 1) == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
