"""A hub with an output on the manual clock, and the messages of a vehicle."""

import asyncio
import math
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.outputs import extend
from gateway.outputs.output import Output
from tests.kit.hub import Rig
from tests.kit.mavlink import Sender, outgoing

UNIX_US = 1_717_243_384_560_000
"""2024-06-01 12:03:04.56 UTC."""
HERE = (47.397_742_0, -8.545_594_1, 488.13)
"""Latitude, longitude and height AMSL in m."""


class OutputRig(Rig):
    """An output of a hub; `fly` sends the messages of one moment through the hub."""

    async def output(self, url: str) -> Any:
        hub = self.hub(url)
        self.of_hub = hub
        (found,) = hub._clients.values()
        assert isinstance(found, Output)
        found.unix_us = lambda: UNIX_US + self.clock()
        assert found._timer is not None
        found._timer.cancel()
        await self.until(lambda: found.carrier.state not in ("connecting", "resolving"))
        return found

    def hear(self, *messages: Any, system: int = 1, component: int = 1) -> None:
        """Send messages of a vehicle to all clients of the hub."""
        sender = Sender(system, component)
        for message in messages:
            self.of_hub.send(outgoing(sender.pack(message)))

    def turn(self, output: Any) -> None:
        """Let the output send what is due now, without its timer."""
        output._turn()
        output._timer.cancel()


def beat(kind: int = 2, autopilot: int = 3, mode: int = 5, base_mode: int = 0x81) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, base_mode, mode, 4, 3)


def at(
    lat_deg: float = HERE[0], lon_deg: float = HERE[1], alt_m: float = HERE[2], hdg: int = 9050
) -> Any:
    """Return GLOBAL_POSITION_INT: north 3 m/s, east -4 m/s, climb 1 m/s."""
    return mavlink.MAVLink_global_position_int_message(
        0, round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3), 20_000,
        300, -400, -100, hdg,
    )  # fmt: skip


def gps(kind: int = 3, satellites: int = 11, ellipsoid_m: float = HERE[2] + 47.5) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        0, kind, round(HERE[0] * 1e7), round(HERE[1] * 1e7), round(HERE[2] * 1e3), 120, 150, 500,
        30_687, satellites, alt_ellipsoid=round(ellipsoid_m * 1e3), h_acc=1500,
    )  # fmt: skip


def estimator(flags: int) -> Any:
    return mavlink.MAVLink_estimator_status_message(
        0, flags, *[math.nan] * 6, pos_horiz_accuracy=1, pos_vert_accuracy=1
    )


@pytest.fixture
async def outputs() -> AsyncIterator[OutputRig]:
    extend()
    rig = OutputRig()
    yield rig
    rig.close()
    # Transports close in the next turns of the loop.
    for _ in range(5):
        await asyncio.sleep(0)
