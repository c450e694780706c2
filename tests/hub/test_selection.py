"""A client behind `systems=1` reaches system 1 and no other, with every message of the dialect."""

import json
from collections.abc import Awaitable, Callable
from functools import cache
from typing import Any
from unittest.mock import MagicMock

import pytest
from pymavlink.dialects.v20 import all as mavlink
from wsproto import ConnectionType, WSConnection
from wsproto.events import BytesMessage, Request

from gateway.hub.hub import Hub
from gateway.hub.systems import HARMLESS, SystemFilter
from gateway.panel.rest_api import RestApi
from gateway.wire.mavlink_json import template
from gateway.wire.mavlink_messages import MESSAGE_NAMES
from gateway.wire.mavlink_splitter import MavFrame, frame_of, split_datagram, to_mavlink1
from gateway.wire.vehicle_inputs import acts
from tests.kit.hub import Rig, Station, receive
from tests.kit.mavlink import STATION, every_message, packed, sent_by
from tests.kit.messages import beat

pytestmark = pytest.mark.io

ALLOWED, EXCLUDED = 1, 2
SENDERS = ((255, STATION), (ALLOWED, 1), (EXCLUDED, STATION))
"""A station, one that uses the id of the selected vehicle, and one with that of the other."""
AT_ONCE = 40
"""Frames at a time: more would overflow the buffer of a socket."""
GCS = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
Send = Callable[[list[MavFrame]], Awaitable[None]]


messages = cache(lambda: tuple(every_message(0, ALLOWED, EXCLUDED)))


class Bench:
    """A hub with a selected and an excluded vehicle, and one client behind `systems=1`."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.vehicles = [rig.station() for _ in (ALLOWED, EXCLUDED)]
        self.got: list[set[tuple[int, tuple[int, int], int]]] = [set(), set()]
        """What each vehicle was sent: message, sender and target."""

    async def open(self, door: str) -> tuple[Hub, Send]:
        urls = [f"udp:127.0.0.1:{each.port}" for each in self.vehicles]
        kind = {"rest": "udp", "mavlink1": "udp", "signed": "udp"}.get(door, door)
        url = f"{kind}-listen:127.0.0.1:0?trusted=yes"
        if kind == "zenoh":
            url = "zenoh:tcp/127.0.0.1:1?site=x&trusted=yes"
        hub = self.rig.hub(*urls, url if door == "rest" else f"{url}&systems={ALLOWED}")
        await self.rig.until(lambda: [one.state for one in hub.clients()][:2] == ["open"] * 2)
        for number, vehicle in enumerate(self.vehicles):
            hub.send(self.rig.out(self.rig.sender(9).attitude(), hub.clients()[number].client_id))
            await vehicle.receive()
        if kind == "zenoh":
            client: Any = list(hub._clients.values())[2]
            now_us = client.context.now_us
            return hub, _each(
                lambda data: client.receive(split_datagram(data), len(data), now_us())
            )
        if kind == "udp":
            station = self.rig.station(hub.listening_ports()[0])
            return hub, _rest(station) if door == "rest" else _each(station.send)
        sock = await self.rig.connect(hub.listening_ports()[0])
        if kind == "tcp":
            return hub, _each(sock.send)
        web = WSConnection(ConnectionType.CLIENT)
        sock.send(web.send(Request(host="127.0.0.1", target="/")))
        web.receive_data(await receive(sock))
        assert [*web.events()]
        return hub, _each(lambda data: sock.send(web.send(BytesMessage(data=data))))

    async def report(self, number: int, state: str) -> None:
        """Send the frames of a vehicle in a state."""
        vehicle = self.vehicles[number - 1]
        if state != "unheard":
            vehicle.send(packed(beat(), number))
        if state == "telemetry":
            vehicle.send(packed(mavlink.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0), number))
        await self.rig.quiet()

    async def collect(self) -> None:
        await self.rig.quiet_some()
        for number, vehicle in enumerate(self.vehicles):
            for data in vehicle.received():
                frame = frame_of(data)
                self.got[number].add((frame.message_id, frame.origin, frame.target[0]))


def _each(send: Callable[[bytes], object]) -> Send:
    async def send_all(frames: list[MavFrame]) -> None:
        for frame in frames:
            send(frame.data)

    return send_all


def _rest(station: Station) -> Send:
    """Post messages to a REST API, and send those that it accepts from a client without options."""
    uplink = MagicMock()
    uplink.send.side_effect = lambda message, *sender: station.send(packed(message, *sender))
    api = RestApi(uplink)
    systems = SystemFilter(only=frozenset({ALLOWED}))

    async def post_all(frames: list[MavFrame]) -> None:
        for frame in frames:
            system, component = frame.origin
            message = template(MESSAGE_NAMES[frame.message_id])
            for name in ("target", "target_system"):
                if name in message:
                    message[name] = frame.target[0]
            if "target_component" in message:
                message["target_component"] = frame.target[1]
            header = {"system_id": system, "component_id": component}
            api._answer(json.dumps({"header": header, "message": message}), systems)

    return post_all


@pytest.mark.parametrize("state", ["unheard", "heartbeat", "telemetry"])
@pytest.mark.parametrize("door", ["udp", "tcp", "ws", "rest", "zenoh", "mavlink1", "signed"])
async def test_no_message_acts_on_an_excluded_vehicle(rig: Rig, door: str, state: str) -> None:
    bench = Bench(rig)
    _, send = await bench.open(door)
    await bench.report(ALLOWED, "telemetry")
    await bench.report(EXCLUDED, state)
    sent = set()
    for sender in SENDERS:
        frames = [sent_by(each, *sender, signed=door == "signed") for each in messages()]
        if door == "mavlink1":
            frames = [frame_of(data) for f in frames if (data := to_mavlink1(f.data))]
        if door == "rest":
            frames = [f for f in frames if f.message_id in mavlink.mavlink_map]
        else:
            await send([frame_of(packed(GCS, *sender, sequence=1))])
        for begin in range(0, len(frames), AT_ONCE):
            await send(frames[begin : begin + AT_ONCE])
            await bench.collect()
        sent |= {(f.message_id, f.origin, f.target[0]) for f in frames}
    await rig.quiet()
    await bench.collect()
    allowed, excluded = bench.got
    assert not {each for each in excluded if acts(each[0]) and each[0] not in HARMLESS}
    assert not {each for each in excluded if each[2]}
    assert {each[0] for each in excluded if each[1] != (ALLOWED, 1)} <= HARMLESS
    assert {each for each in sent if each[2] == ALLOWED and each[1] == SENDERS[0]} <= allowed
