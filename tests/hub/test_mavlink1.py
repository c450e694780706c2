"""Clients that know only MAVLink 1, by their options or by the frames they send."""

from typing import Any

import pytest
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as dialect

pytestmark = pytest.mark.io

V1, V2 = 0xFE, 0xFD
PROBE_US = 6_000_000


def heartbeat(sequence: int) -> bytes:
    sender = v1.MAVLink(None, 254, 190)
    sender.seq = sequence
    return v1.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(sender)


async def next_attitude(rig: Any, hub: Any, station: Any) -> bytes:
    """Publish an attitude, and return the frame that the station receives."""
    rig.publish(hub, rig.vehicle.attitude())
    while True:
        frame = await station.receive()
        if (frame[5] if frame[0] == V1 else frame[7]) == dialect.MAVLINK_MSG_ID_ATTITUDE:
            return frame


async def test_endpoint_of_version_1_gets_only_messages_of_this_version(rig: Any) -> None:
    station = rig.station()
    hub = await rig.open(f"udp:127.0.0.1:{station.port}?mavlink=1")
    odometry = dialect.MAVLink_odometry_message(
        1, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0] * 21, [0] * 21
    )
    sender = dialect.MAVLink(None, 1, 1)
    rig.publish(hub, odometry.pack(sender))
    first = await next_attitude(rig, hub, station)
    second = await next_attitude(rig, hub, station)
    assert [first[0], second[0]] == [V1, V1]
    assert (second[2] - first[2]) % 256 == 1
    found = v1.MAVLink(None).decode(bytearray(first))
    assert (found.get_type(), found.get_srcSystem()) == ("ATTITUDE", 1)


async def test_client_that_only_sends_version_1_gets_it_after_a_probe(rig: Any) -> None:
    """Programs that know both versions answer version 2 by version 2 within the probe."""
    hub = rig.hub("udp-listen:127.0.0.1:0")
    station = rig.station(hub.listening_ports()[0])
    station.send(heartbeat(0))
    await rig.until(lambda: len(hub.clients()) == 1)
    assert (await next_attitude(rig, hub, station))[0] == V2
    rig.clock.now_us += PROBE_US
    count = len(rig.incoming)
    station.send(heartbeat(1))
    await rig.until(lambda: len(rig.incoming) > count)
    assert (await next_attitude(rig, hub, station))[0] == V1
    count = len(rig.incoming)
    station.send(station.sender.heartbeat())
    await rig.until(lambda: len(rig.incoming) > count)
    assert (await next_attitude(rig, hub, station))[0] == V2
    station.send(heartbeat(2))
    rig.clock.now_us += PROBE_US
    station.send(heartbeat(3))
    await rig.quiet()
    assert (await next_attitude(rig, hub, station))[0] == V2, "it has shown that it knows both"


async def test_option_of_version_2_is_kept_for_a_client_that_sends_version_1(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0?mavlink=2")
    station = rig.station(hub.listening_ports()[0])
    for sequence in range(3):
        station.send(heartbeat(sequence))
        await rig.until(lambda count=sequence: len(rig.incoming) > count)
        rig.clock.now_us += PROBE_US
    assert (await next_attitude(rig, hub, station))[0] == V2
