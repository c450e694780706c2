"""Thousands of untrusted clients at a port: telemetry continues and memory does not grow."""

import asyncio
import gc
import itertools
import logging
import socket
import struct
import sys
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Outgoing
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.hub import FlyingHub
from tests.kit.mavlink import STATION, Sender, packed
from tests.kit.records import FIX

pytestmark = [pytest.mark.io, pytest.mark.slow]

CLIENTS = 4000
MAX_CLIENTS = 16
GROWTH_LIMIT_BLOCKS = CLIENTS // 8
"""Half a block for each of a quarter: a client that is kept takes one or more."""
FLIGHT_EVERY = 5
STEP_US = 1_000_000


def address(number: int) -> str:
    return f"127.{1 + number // 62_500}.{number // 250 % 250}.{1 + number % 250}"


def hostile_datagrams(rng: np.random.Generator) -> list[bytes]:
    """Sound requests, requests that would change something, and every kind of rubbish."""
    opening = struct.pack("<HBBBBBxI", 1, 0, 4, 13, 0, 0, 0) + b"/general.json"
    messages = [
        mavlink.MAVLink_param_request_list_message(1, 1),
        mavlink.MAVLink_param_set_message(1, 1, b"RATE_ATT", 0.0, 9),
        mavlink.MAVLink_command_long_message(1, 1, 511, 0, 30, 9000, *[0] * 5),
        mavlink.MAVLink_command_long_message(1, 1, 2510, 0, *[0] * 7),
        mavlink.MAVLink_mission_count_message(1, 1, 500, 0),
        mavlink.MAVLink_mission_clear_all_message(1, 1, 255),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, opening.ljust(251, b"\0")),
    ]
    frames = [
        *(packed(message, 255, STATION) for message in messages),
        packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 255, STATION, version=1),
        # A client that claims to be the vehicle itself.
        Sender(1, 1).heartbeat(),
    ]
    bad = bytearray(frames[0])
    bad[-1] ^= 1
    return [*frames, bytes(bad), frames[1][:9], rng.bytes(300), b"", rng.bytes(60_000)]


class Gateway(FlyingHub):
    """A hub with a real vehicle behind it, and one client that misses nothing."""

    def __init__(self, rig: Any) -> None:
        self.steady = rig.station()
        self.attitudes = self.attitudes_received = 0
        self.sequence = bytearray()
        """Numbers of the vehicle's frames that the client got."""
        endpoints = (f"udp:127.0.0.1:{self.steady.port}", "udp-listen:127.0.0.1:0?trusted=no")
        super().__init__(rig, 1, *endpoints, max_clients=MAX_CLIENTS, idle_timeout_s=5.0)

    def fly(self) -> list[Any]:
        self.clock.now_us += STEP_US
        found = super().fly()
        self.attitudes += sum(a.message_id == 31 for a in found if isinstance(a, Outgoing))
        return found

    def listen(self) -> None:
        for frame in self.steady.received():
            if frame[5:7] == b"\x01\x01":
                self.sequence.append(frame[4])
                self.attitudes_received += frame[7:10] == b"\x1f\0\0"


async def test_thousands_of_unknown_addresses_cost_no_frame_and_no_memory(
    rig: Any, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    # The lines that pytest keeps would be counted.
    caplog.set_level(logging.CRITICAL, logger="gateway")
    gateway = Gateway(rig)
    await rig.until_open(gateway.hub)
    gateway.perform(gateway.vehicle.on_gps(FIX, 0))
    target = ("127.0.0.1", gateway.hub.listening_ports()[0])
    datagrams = hostile_datagrams(rng)

    async def assail(first: int, last: int) -> None:
        for number in range(first, last):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.bind((address(number), 0))
                client.sendto(datagrams[number % len(datagrams)], target)
            if number % FLIGHT_EVERY == 0:
                gateway.fly()
                await asyncio.sleep(0)
                gateway.listen()
                assert len(gateway.hub.clients()) <= 1 + MAX_CLIENTS
        gc.collect()

    await assail(0, CLIENTS // 2)
    blocks = [sys.getallocatedblocks()]
    for first in (CLIENTS // 2, 3 * CLIENTS // 4):
        await assail(first, first + CLIENTS // 4)
        blocks.append(sys.getallocatedblocks())
    # Other objects may come once; kept clients would come in both quarters.
    assert min(np.diff(blocks)) < GROWTH_LIMIT_BLOCKS

    def is_all_received() -> bool:
        gateway.listen()
        return gateway.attitudes_received >= gateway.attitudes

    await rig.until(is_all_received)
    assert gateway.attitudes_received == gateway.attitudes
    steps = {(b - a) % 256 for a, b in itertools.pairwise(gateway.sequence)}
    assert steps == {1}, "nothing lost, and no gap from what others were answered"
    assert gateway.vehicle.refusals > CLIENTS // 20
    assert gateway.vehicle.plan.missions.items[0] == ()
    assert gateway.vehicle.telemetry.settings == VehicleSettings()
