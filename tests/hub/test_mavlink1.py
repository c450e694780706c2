"""Clients that know only MAVLink 1, by their options or by the frames they send."""

from typing import Any

import pytest
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as dialect

from tests.kit.mavlink import STATION, packed

pytestmark = pytest.mark.io

V1, V2 = 0xFE, 0xFD
PROBE_US = 6_000_000


def heartbeat(sequence: int) -> bytes:
    message = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    return packed(message, 254, STATION, sequence=sequence, version=1)


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
    rig.publish(hub, packed(odometry))
    first, second = [await next_attitude(rig, hub, station) for _ in range(2)]
    assert [first[0], second[0]] == [V1, V1]
    assert (second[2] - first[2]) % 256 == 1
    found = v1.MAVLink(None).decode(bytearray(first))
    assert (found.get_type(), found.get_srcSystem()) == ("ATTITUDE", 1)


@pytest.mark.parametrize(
    ("options", "versions"), [("", (V2, V1, V2, V2, V2)), ("?mavlink=2", (V2, V2, V2, V2, V2))]
)
async def test_client_that_only_sends_version_1_gets_it_after_a_probe(
    rig: Any, options: str, versions: tuple[int, ...]
) -> None:
    """Programs that know both versions answer version 2 by version 2 within the probe."""
    hub = rig.hub(f"udp-listen:127.0.0.1:0{options}")
    station = rig.station(hub.listening_ports()[0])
    frames = [heartbeat(0), heartbeat(1), station.sender.heartbeat(), heartbeat(2), heartbeat(3)]
    for count, (frame, version) in enumerate(zip(frames, versions, strict=True), start=1):
        station.send(frame)
        await rig.until(lambda n=count: rig.received == n)
        assert (await next_attitude(rig, hub, station))[0] == version
        rig.clock.now_us += PROBE_US
