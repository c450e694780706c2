"""The panel's connection, with a gateway and a player that are plain sockets."""

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import GatewayClock
from gateway.panel.state.commands import command_long
from gateway.panel.state.fleet import FleetState, Origin
from gateway.panel.uplink import (
    ACK_TIMEOUT_S,
    PROGRESS_TIMEOUT_S,
    SYSTEM_ID,
    CommandFailedError,
    ControlClient,
    GatewayWatch,
    Uplink,
)
from gateway.wire.mavlink_splitter import message_id_of
from tests.kit.mavlink import Sender

pytestmark = pytest.mark.io
LIMIT_S = 60.0
PLAYED = 249


def beat(system_id: int) -> bytes:
    return Sender(system_id).heartbeat()


@pytest.fixture
def sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Return the sockets of a gateway and of a player."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gateway,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as player,
    ):
        for sock in (gateway, player):
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
        yield gateway, player


@pytest.fixture
def fleet() -> FleetState:
    return FleetState()


@pytest.fixture
async def uplink(
    tmp_path: Path, fleet: FleetState, sockets: tuple[socket.socket, socket.socket]
) -> AsyncIterator[Uplink]:
    url = f"udp:127.0.0.1:{sockets[0].getsockname()[1]}"
    made = Uplink(url, fleet, ControlClient(tmp_path / "none.sock"), GatewayClock())
    made.start()
    yield made
    made.close()


async def until(holds: Callable[[], bool], send: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not holds():
            send()
            await asyncio.sleep(0.01)


def heard(sock: socket.socket) -> list[mavlink.MAVLink_message]:
    found = []
    while True:
        try:
            data = sock.recv(2048)
        except BlockingIOError:
            return found
        found.append(mavlink.MAVLink(None).decode(bytearray(data)))


async def test_played_messages_are_not_sent_to_the_gateway(
    uplink: Uplink, fleet: FleetState, sockets: tuple[socket.socket, socket.socket]
) -> None:
    gateway, player = sockets
    fleet.origins[PLAYED] = Origin("recorded", 1)
    await until(lambda: bool(uplink.playback_port), lambda: None)
    here = ("127.0.0.1", uplink.playback_port)
    await until(lambda: PLAYED in fleet.vehicles, lambda: player.sendto(beat(PLAYED), here))
    assert fleet.vehicles[PLAYED].title == "Plane 1, recorded"
    assert not uplink.is_alive
    there: list[tuple[str, int]] = []

    def answer() -> None:
        try:
            there.append(gateway.recvfrom(2048)[1])
        except BlockingIOError:
            return
        # A live one of the same number is another aircraft, and is not taken for the played.
        gateway.sendto(beat(PLAYED), there[0])
        gateway.sendto(beat(3), there[0])
        player.sendto(beat(4), here)

    await until(lambda: 3 in fleet.vehicles, answer)
    assert sorted(fleet.vehicles) == [3, PLAYED]
    heard(gateway)
    heard(player)
    for system_id in (PLAYED, 3):
        uplink.send(mavlink.MAVLink_param_request_list_message(system_id, 1))
    for sock, system_id in ((gateway, 3), (player, PLAYED)):
        seen: list[mavlink.MAVLink_message] = []
        await until(
            lambda seen=seen: any(m.get_type() == "PARAM_REQUEST_LIST" for m in seen),
            lambda sock=sock, seen=seen: seen.extend(heard(sock)),
        )
        assert {m.get_srcSystem() for m in seen} == {SYSTEM_ID}
        asked = [m.target_system for m in seen if m.get_type() == "PARAM_REQUEST_LIST"]
        assert asked == [system_id]


PROGRESS = mavlink.MAV_RESULT_IN_PROGRESS


@pytest.mark.parametrize(
    ("results", "trouble"),
    [
        ([PROGRESS, PROGRESS, mavlink.MAV_RESULT_ACCEPTED], ""),
        ([PROGRESS, PROGRESS, mavlink.MAV_RESULT_FAILED], "LOGGING_START: failed"),
        ([mavlink.MAV_RESULT_TEMPORARILY_REJECTED], "temporarily"),
        ([200], "200"),
    ],
    ids=["accepted late", "failed late", "rejected", "unknown result"],
)
async def test_command_fails_unless_accepted_and_has_a_longer_timeout_while_in_progress(
    uplink: Uplink,
    sockets: tuple[socket.socket, socket.socket],
    monkeypatch: pytest.MonkeyPatch,
    results: list[int],
    trouble: str,
) -> None:
    limits_s: list[float] = []

    def timeout(limit_s: float) -> asyncio.Timeout:
        limits_s.append(limit_s)
        return asyncio.Timeout(None)

    heard_acks: list[int] = []
    uplink.listen(lambda m: m.get_type() == "COMMAND_ACK" and heard_acks.append(m.result))
    number, vehicle = mavlink.MAV_CMD_LOGGING_START, Sender()
    # The first command is lost unless the socket is open.
    await asyncio.get_running_loop().sock_recv(sockets[0], 2048)
    monkeypatch.setattr(asyncio, "timeout", timeout)
    waits = asyncio.create_task(uplink.command(command_long(1, number)))
    while True:
        receiving = asyncio.get_running_loop().sock_recvfrom(sockets[0], 2048)
        data, here = await asyncio.wait_for(receiving, LIMIT_S)
        if message_id_of(data) == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
            break
    for result in results:
        acknowledgement = mavlink.MAVLink_command_ack_message(number, result)
        sockets[0].sendto(vehicle.pack(acknowledgement), here)
    with pytest.raises(CommandFailedError, match=trouble) if trouble else nullcontext():
        await waits
    for _ in range(20):
        await asyncio.sleep(0)
    assert heard_acks == results, "each once"
    assert limits_s == [ACK_TIMEOUT_S, *[PROGRESS_TIMEOUT_S] * (len(results) - 1)]


class Gateway:
    """Its first answer waits until the test lets it go."""

    def __init__(self) -> None:
        self.asked = 0
        self.first = asyncio.Event()

    async def ask(self, _: str) -> dict[str, Any]:
        self.asked += 1
        answer = {"number": self.asked, "recorder": None, "aircraft": []}
        if self.asked == 1:
            await self.first.wait()
        return answer


async def test_late_status_does_not_replace_a_later_one() -> None:
    gateway = Gateway()
    watch = GatewayWatch(gateway, FleetState())
    early = asyncio.create_task(watch.refresh())
    while not gateway.asked:
        await asyncio.sleep(0)
    late = asyncio.create_task(watch.refresh())
    for _ in range(10):
        await asyncio.sleep(0)
    gateway.first.set()
    await asyncio.gather(early, late)
    assert watch.status is not None
    assert watch.before is not None
    assert (watch.before["number"], watch.status["number"]) == (1, 2)


async def test_restarted_gateway_is_found_again_by_its_control_socket(
    fleet: FleetState, sockets: tuple[socket.socket, socket.socket]
) -> None:
    listeners: list[dict[str, Any]] = []
    asked: list[str] = []
    now_us = [0]

    class Control:
        async def ask(self, verb: str, **params: str) -> dict[str, Any]:
            asked.append(verb)
            if verb == "clients.add":
                listeners[:] = [{"endpoint": params["url"], "port": ports[0]}]
            return {"listeners": listeners}

    ports = [sock.getsockname()[1] for sock in sockets]
    control: Any = Control()
    clock: Any = lambda: now_us[0]  # noqa: E731
    uplink = Uplink(None, fleet, control, clock)
    uplink.start()
    for sock in sockets:
        await until(lambda sock=sock: bool(heard(sock)), lambda: None)
        listeners.clear()
        ports.reverse()
    assert asked[:3] == ["status", "clients.add", "status"]
    uplink.close()
