"""Our own frames are sent signed, on every route; frames of others are sent unchanged."""

from typing import Any

import pytest

from gateway.hub.round_trip import PROBE_COMPONENT
from gateway.records import ClientInterval
from gateway.wire.mavlink_splitter import MavlinkSplitter, frame_of, message_id_of
from tests.kit.hub import receive
from tests.kit.mavlink import KEY, frames_of, signer, strict

pytestmark = pytest.mark.io

OTHER_KEY = bytes(range(32))


def read(receiver: Any, frame: bytes) -> tuple[str, int, int]:
    message = receiver.decode(bytearray(frame))
    assert message.get_signed()
    return message.get_type(), message.get_srcComponent(), message.get_seq()


async def test_greetings_requests_answers_and_limited_telemetry_are_signed(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0?rate=RAW_IMU:1", signer=signer())
    rig.publish(hub, rig.vehicle.heartbeat(), rig.vehicle.home())
    station, receiver = await rig.call(hub), strict()
    (client,) = hub.clients()
    got = []
    hub.set_interval(ClientInterval(client.client_id, 1, 30, -1))
    for _ in range(3):
        rig.publish(hub, rig.vehicle.raw_imu(), rig.vehicle.attitude())
    hub.send(rig.out(rig.vehicle.home(), client.client_id))
    rig.clock.now_us += 5_000_000
    rig.publish(hub, rig.vehicle.heartbeat())
    rig.tick(hub)
    while ("TIMESYNC", PROBE_COMPONENT) not in [kind[:2] for kind in got]:
        got.append(read(receiver, await station.receive()))
    assert [kind for kind, component, _ in got if component == 1] == [
        *("HEARTBEAT", "HOME_POSITION", "RAW_IMU", "HOME_POSITION", "HEARTBEAT"),
    ]
    numbers = [sequence for _, component, sequence in got if component == 1]
    assert numbers == list(range(numbers[0], numbers[0] + 5)), "signed and yet without a gap"
    probes = {kind for kind, component, _ in got if component == PROBE_COMPONENT}
    assert probes == {"PING", "TIMESYNC"}


async def test_timestamps_follow_the_order_in_which_frames_leave_a_queue(rig: Any) -> None:
    hub = rig.hub("tcp-listen:127.0.0.1:0", signer=signer())
    rig.publish(hub, rig.vehicle.heartbeat())
    client = await rig.connect(hub.listening_ports()[0])
    await rig.until(lambda: len(hub.clients()) == 1)
    while hub.clients()[0].queued < 50:
        rig.publish(hub, rig.vehicle.raw_imu())
    for _ in range(50):
        rig.publish(hub, rig.vehicle.raw_imu(), rig.vehicle.attitude())
    splitter, receiver, kinds = MavlinkSplitter(), strict(), []
    while hub.clients()[0].queued or kinds.count("ATTITUDE") < 50:
        frames = frames_of(splitter.feed(await receive(client)))
        kinds += [read(receiver, frame)[0] for frame in frames]
    assert "RAW_IMU" in kinds[kinds.index("ATTITUDE") :], "some were overtaken"


async def test_frames_of_others_are_unchanged(rig: Any) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0", signer=signer())
    rig.publish(hub, rig.vehicle.heartbeat())
    port = hub.listening_ports()[0]
    source, station, receiver = rig.station(port), await rig.call(hub), strict()
    autopilots = [rig.sender(40), rig.sender(41, signed=True), rig.sender(1, 100)]
    source.send(*(pilot.heartbeat() for pilot in autopilots))

    def received() -> int:
        return sum(client.received for client in hub.clients())

    await rig.until(lambda: received() == 1 + len(autopilots))
    sent = [make() for pilot in autopilots for make in (pilot.attitude, pilot.raw_imu)]
    source.send(*sent)
    await rig.until(lambda: received() == 1 + len(autopilots) + len(sent))
    rig.publish(hub, rig.vehicle.raw_imu())
    got = []
    while not got or (got[-1][5:7], message_id_of(got[-1])) != (b"\1\1", 27):
        got.append(await station.receive())
        if got[-1][5:7] == b"\1\1":
            read(receiver, got[-1])
    assert [frame for frame in got if frame in sent] == sent


async def test_changed_key_applies_from_the_next_frame_on(rig: Any) -> None:
    keys = signer()
    hub = rig.hub("udp-listen:127.0.0.1:0", signer=keys)
    rig.publish(hub, rig.vehicle.heartbeat())
    station = await rig.call(hub)
    for key in (KEY, OTHER_KEY):
        keys.keys[1] = key
        rig.publish(hub, rig.vehicle.heartbeat())
        receiver = strict(key)
        if key is KEY:
            read(receiver, await station.receive())
        read(receiver, await station.receive())
    del keys.keys[1]
    rig.publish(hub, rig.vehicle.heartbeat())
    assert not frame_of(await station.receive()).signed
