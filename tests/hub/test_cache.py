"""Requests to a vehicle behind an endpoint with `cache=yes` are answered by kept answers."""

import itertools
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.hub import Hub
from gateway.vehicle.services.ftp import ACK, Opcode, Packet
from gateway.wire.mavlink_signing import is_genuine
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.hub import Rig, Station
from tests.kit.mavlink import KEY, signer
from tests.kit.messages import beat
from tests.ports import free_ports

COUNT = 30


class Scene:
    """A vehicle on the first port, whose parameters were sent, and two stations."""

    def __init__(self, rig: Rig, hub: Hub, vehicle: Station, stations: list[Station]) -> None:
        self.rig, self.hub, self.vehicle, self.stations = rig, hub, vehicle, stations

    def report(self, *messages: Any) -> None:
        """Send messages of the vehicle."""
        self.vehicle.send(*map(self.vehicle.sender.pack, messages))

    def ask(self, station: int, message: Any) -> None:
        one = self.stations[station]
        one.send(one.sender.pack(message))

    async def values(self, station: int, count: int) -> list[Any]:
        """Return the next parameters that a station is sent."""
        found: list[Any] = []
        reader = mavlink.MAVLink(None)

        def are_sent() -> bool:
            # Ten parameters at a time are sent.
            self.rig.clock.now_us += 100
            for frame in self.stations[station].received():
                message = reader.decode(bytearray(frame))
                found.extend([message] if message.get_type() == "PARAM_VALUE" else [])
            return len(found) >= count

        await self.rig.until(are_sent)
        return found

    async def asked(self) -> list[tuple[int, int]]:
        """Return message and target of what the vehicle has been sent."""
        await self.rig.quiet()
        frames = map(frame_of, self.vehicle.received())
        return [(frame.message_id, frame.target[0]) for frame in frames if frame.target[0]]


def parameter(index: int, value: float) -> Any:
    return mavlink.MAVLink_param_value_message(b"P%d" % index, value, 9, COUNT, index)


ATTITUDE = mavlink.MAVLink_attitude_message(20_000, 0, 0, 0, 0, 0, 0)


async def scene(
    rig: Rig, options: str, station_options: str = "", *, signed: bool = False
) -> Scene:
    chosen = zip(free_ports(3), (options, "", station_options), strict=True)
    urls = (f"udp-listen:127.0.0.1:{port}?trusted=yes{text}" for port, text in chosen)
    hub = await rig.open(*urls, signer=signer() if signed else None)
    vehicle = rig.station(hub.listening_ports()[0], origin=(1, 1))
    one = Scene(rig, hub, vehicle, [await rig.call(hub, number) for number in (1, 2)])
    for each in (vehicle, *one.stations) if signed else ():
        each.sender = rig.sender(
            each.sender.link.srcSystem, each.sender.link.srcComponent, signed=True
        )
    one.report(beat(), ATTITUDE, *(parameter(index, float(index)) for index in range(COUNT)))
    await one.values(0, COUNT)
    vehicle.received()
    return one


def listing(system: int = 1) -> Any:
    return mavlink.MAVLink_param_request_list_message(system, 1)


async def test_second_list_is_answered_here_and_shown(rig: Rig) -> None:
    one = await scene(rig, "&cache=yes")
    one.ask(1, listing())
    found = (await one.values(1, 2 * COUNT))[COUNT:]
    assert [(m.param_id, m.param_value, m.get_srcSystem()) for m in found] == [
        (f"P{i}", float(i), 1) for i in range(COUNT)
    ]
    assert await one.asked() == []
    [text] = [text for client in one.hub.clients() for text in client.cached]
    assert text == f"system 1: parameters ({COUNT}) 0 s"


@pytest.mark.parametrize(("options", "station_options"), [("", ""), ("&cache=yes", "&cache=no")])
async def test_request_is_passed_on_without_the_option_or_past_it(
    rig: Rig, options: str, station_options: str
) -> None:
    one = await scene(rig, options, station_options)
    one.ask(1, listing())
    assert await one.asked() == [(mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST, 1)]


async def test_renumbered_vehicle_is_answered_for_by_its_id_here(rig: Rig) -> None:
    one = await scene(rig, "&cache=yes&as=11")
    one.ask(1, listing(11))
    found = await one.values(1, 2 * COUNT)
    assert {m.get_srcSystem() for m in found} == {11}
    assert await one.asked() == []
    one.ask(1, mavlink.MAVLink_param_set_message(11, 1, b"P3", 8.0, 9))
    assert await one.asked() == [(mavlink.MAVLINK_MSG_ID_PARAM_SET, 1)]


async def test_station_whose_filter_excludes_the_vehicle_is_sent_nothing(rig: Rig) -> None:
    one = await scene(rig, "&cache=yes", "&systems=2")
    one.stations[1].received()
    one.ask(1, listing())
    await rig.quiet()
    assert one.stations[1].is_empty()
    assert await one.asked() == []


def counted_losses(numbers: list[int]) -> int:
    return sum((after - before - 1) % 256 for before, after in itertools.pairwise(numbers))


@pytest.mark.parametrize("signed", [False, True])
async def test_kept_answers_leave_no_gap_in_the_numbers_of_the_vehicle(
    rig: Rig, signed: bool
) -> None:
    one = await scene(rig, "&cache=yes", signed=signed)
    for station in (0, 1, 1):
        one.stations[station].received()
    numbers: list[list[int]] = [[], []]
    turns = iter(range(1000))

    def are_all_sent() -> bool:
        turn = next(turns)
        one.report(ATTITUDE, beat())
        if turn in (5, 300):
            one.ask(1, listing())
        rig.clock.now_us += 1000
        for station, known in enumerate(numbers):
            for data in one.stations[station].received():
                frame = frame_of(data)
                known += [frame.sequence] if frame.origin == (1, 1) else []
                assert not signed or is_genuine(KEY, data)
        return turn > 320 and len(numbers[1]) == len(numbers[0]) + 2 * COUNT

    await rig.until(are_all_sent)
    assert [counted_losses(each) for each in numbers] == [0, 0]


async def test_file_goes_only_to_the_station_that_asked_if_two_share_an_id(rig: Rig) -> None:
    one = await scene(rig, "&cache=yes")
    for station, sequence in ((0, 40), (1, 7)):
        asked = Packet(sequence, 0, Opcode.OPEN_FILE_RO, 7, 0, 0, 0, b"/a.json")
        one.ask(station, mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, asked.encode()))
        await rig.quiet()
        one.vehicle.received(), [each.received() for each in one.stations]
        reply = asked.answer(ACK, station, b"\5\0\0\0").encode()
        one.report(mavlink.MAVLink_file_transfer_protocol_message(0, 255, 190, reply))
        await rig.quiet()
        got = [len(each.received()) for each in one.stations]
        assert got == [station == 0, station == 1]


async def test_answers_stay_when_the_client_of_the_vehicle_proves_that_it_receives(
    rig: Rig,
) -> None:
    one = await scene(rig, "&cache=yes")
    [client] = [client for client in one.hub._clients.values() if client.endpoint.cache]
    client.is_proven = False
    client.prove()
    one.ask(1, listing())
    await one.values(1, 2 * COUNT)
    assert await one.asked() == []


async def test_changed_options_drop_what_was_kept(rig: Rig) -> None:
    one = await scene(rig, "&cache=yes")
    urls = one.hub.endpoints()
    changed = (f"{urls[0]}&deny=RAW_IMU", *urls[1:])
    one.hub.apply(msgspec.structs.replace(one.hub.settings, endpoints=changed))
    one.report(ATTITUDE)
    one.ask(1, listing())
    assert await one.asked() == [(mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST, 1)]
