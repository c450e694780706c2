"""Arbitrary bytes and messages on the listening port: counted, dropped, and nothing else."""

import random

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Incoming
from gateway.vehicle.vehicle import Vehicle
from tests.kit.ground_station import GroundStation, command, count, ftp_request, of_kind
from tests.kit.mavlink import packed, random_message
from tests.kit.memory import size_of
from tests.kit.records import sample_at, state_at


@pytest.mark.parametrize("trusted", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_messages_with_random_values_are_handled(
    station: GroundStation, seed: int, trusted: bool
) -> None:
    station.trusted = trusted
    for message_id, kind in sorted(mavlink.mavlink_map.items()):
        chance = random.Random(1000 * message_id + seed)
        targets = {"target_system": 1, "target_component": 1}
        given = {name: value for name, value in targets.items() if name in kind.fieldnames}
        message = random_message(kind, chance, bytes(range(256)), **given)
        station.send_bytes(packed(message, 255, 190, sequence=7))
        station.wait(0.001)
    station.wait(5.0)
    assert station.vehicle.faults["broken"] == 0, "the frames are well-formed"


@pytest.mark.parametrize("seed", range(4))
def test_random_bytes_are_counted_and_not_answered(station: GroundStation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for size in rng.integers(0, 300, 2000):
        data = bytearray(rng.bytes(int(size)))
        if data and rng.random() < 0.7:
            data[0] = rng.choice([0xFD, 0xFE])
        assert station.send_bytes(bytes(data)) == []
    assert station.vehicle.faults.total() == 2000


@pytest.mark.parametrize("version", [1, 2])
def test_cut_and_corrupt_frames_are_not_answered(station: GroundStation, version: int) -> None:
    station.version = version
    frame = station.frame(mavlink.MAVLink_param_request_list_message(1, 1))
    for size in range(len(frame)):
        assert station.send_bytes(frame[:size]) == []
    for position in range(1, len(frame)):
        broken = bytearray(frame)
        broken[position] ^= 0x80
        assert station.send_bytes(bytes(broken)) == []
    assert station.send_bytes(frame) != []


def test_unknown_messages_and_flags_are_counted(station: GroundStation) -> None:
    head = bytes([0xFD, 1, 0, 0, 0, 255, 190]) + (70_000).to_bytes(3, "little")
    assert station.send_bytes(head + b"\x01\x00\x00") == []
    assert station.vehicle.faults["unknown"] == 1
    flagged = bytearray(station.frame(mavlink.MAVLink_ping_message(0, 0, 0, 0)))
    flagged[2] = 0x02
    assert station.send_bytes(bytes(flagged)) == []
    assert station.vehicle.faults["malformed"] == 1


def test_ten_thousand_clients_do_not_grow_the_memory(vehicle: Vehicle) -> None:
    requests = (
        mavlink.MAVLink_param_request_list_message(1, 1),
        command(511, 31, 9000),
        command(511, 30, 900_000),
        count(5),
        ftp_request(4, b"/general.json"),
    )
    asks = [packed(request, 255, 190) for request in requests]

    def flood(first: int, last: int) -> None:
        for client_id in range(first, last):
            now_us = client_id * 1000
            frame = asks[client_id % len(asks)]
            vehicle.handle(Incoming(client_id, frame, client_id % 2 == 0), now_us)
            vehicle.poll(now_us)

    flood(0, 5000)
    before = size_of(vehicle)
    flood(5000, 10_000)
    assert size_of(vehicle) < 1.05 * before
    state = state_at(20_000_000)
    assert vehicle.on_state(state, sample_at(20_000_000), 20_000_000)


def test_every_command_is_acknowledged_once_to_its_client(station: GroundStation) -> None:
    known = set(mavlink.enums["MAV_CMD"]) - {mavlink.MAV_CMD_LOGGING_START}
    asked = sorted((known | set(range(0, 65_536, 37))) & set(range(65_536)))
    for number in asked:
        station.send(command(number))
        station.wait(0.001)
    acks = of_kind(station.inbox, "COMMAND_ACK")
    begun = [m.command for m in acks if m.result == mavlink.MAV_RESULT_IN_PROGRESS]
    assert set(begun) <= {mavlink.MAV_CMD_LOGGING_STOP, mavlink.MAV_CMD_FIXED_MAG_CAL_YAW}
    ended = [m.command for m in acks if m.result != mavlink.MAV_RESULT_IN_PROGRESS]
    assert sorted({*ended, *begun}) == asked
    assert len(ended) + len(begun) == len(acks) == len(asked)
    reported = {frame.client_id for frame in station.frames if frame.message_id == 77}
    assert reported == {station.client_id}
