"""Thousands of untrusted clients at a port: telemetry continues and memory does not grow."""

import asyncio
import gc
import itertools
import logging
import socket
import sys
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Outgoing
from tests.kit.hub import FlyingHub
from tests.kit.mavlink import STATION, Sender

pytestmark = [pytest.mark.io, pytest.mark.slow]

CLIENTS, MAX_CLIENTS = 2000, 16
GROWTH_LIMIT_BLOCKS = CLIENTS // 8
"""Half a block for each of a quarter: a client that is kept takes one or more."""


async def test_thousands_of_unknown_addresses_cost_no_frame_and_no_memory(
    rig: Any, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    # The lines that pytest keeps would be counted.
    caplog.set_level(logging.CRITICAL, logger="gateway")
    steady, forged = rig.station(), Sender(255, STATION)
    endpoints = (f"udp:127.0.0.1:{steady.port}", "udp-listen:127.0.0.1:0?trusted=no")
    gateway = FlyingHub(rig, 1, *endpoints, max_clients=MAX_CLIENTS, idle_timeout_s=5.0)
    await rig.until_open(gateway.hub)
    target, sent, numbers = ("127.0.0.1", gateway.hub.listening_ports()[0]), 0, bytearray()
    change = forged.pack(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    datagrams = [forged.heartbeat(), change, Sender(1, 1).heartbeat(), rng.bytes(3000), b"", change]

    def listen() -> None:
        numbers.extend(frame[4] for frame in steady.received() if frame[5:7] == b"\x01\x01")

    async def assail(first: int, last: int) -> None:
        nonlocal sent
        for number in range(first, last):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.bind((f"127.1.{number // 250}.{1 + number % 250}", 0))
                client.sendto(datagrams[number % len(datagrams)], target)
            if number % 5 == 0:
                rig.clock.now_us += 1_000_000
                sent += sum(isinstance(each, Outgoing) for each in gateway.fly())
                await asyncio.sleep(0)
                listen()
                assert len(gateway.hub.clients()) <= 1 + MAX_CLIENTS
        gc.collect()

    blocks = []
    for first, last in itertools.pairwise((0, CLIENTS // 2, 3 * CLIENTS // 4, CLIENTS)):
        await assail(first, last)
        blocks.append(sys.getallocatedblocks())
    # Other objects may come once; kept clients would come in both quarters.
    assert min(np.diff(blocks)) < GROWTH_LIMIT_BLOCKS
    await rig.until(lambda: bool(listen()) or len(numbers) >= sent)
    steps = {(after - before) % 256 for before, after in itertools.pairwise(numbers)}
    assert steps == {1}, "nothing lost, and no gap from what others were answered"
    assert gateway.vehicle.refusals > CLIENTS // 20
