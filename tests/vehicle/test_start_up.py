"""The questions that ground stations ask on connecting, and how soon they are through."""

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from pymavlink.dialects.v20 import development

from gateway.vehicle import encoding
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.vehicle.ground_station import OWN_MESSAGES, GroundStation, kinds

ACK, ACCEPTED, UNSUPPORTED = "COMMAND_ACK", 0, 3
SYSTEM, COMPONENT = 1, 1


def qgroundcontrol(station: GroundStation) -> None:
    """Ask what QGroundControl 4.3 and its successor ask, in their order, with their patience."""

    def request(message_id: int, kind: str) -> None:
        message = mavlink.MAVLink_command_long_message(
            SYSTEM, COMPONENT, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, message_id, 0, 0, 0, 0, 0, 0
        )
        found: list[Any] = []
        for _ in range(8):
            found += station.send(message)
            for _ in range(station.patience):
                found += station.wait(station.slice_s)
                refused = any(m.get_type() == ACK and m.result != ACCEPTED for m in found)
                if {ACK, kind} <= set(kinds(found)) or refused:
                    return
        raise AssertionError(f"{kind} never came")

    request(148, "AUTOPILOT_VERSION")
    request(300, "PROTOCOL_VERSION")
    request(435, "AVAILABLE_MODES")
    request(397, "COMPONENT_METADATA")
    request(395, "COMPONENT_INFORMATION")
    load_parameters(station)
    for kind in (0, 1, 2) if station.version == 2 else (0,):
        message = mavlink.MAVLink_mission_request_list_message(SYSTEM, COMPONENT, kind)
        [count] = station.ask(message, "MISSION_COUNT", timeout_s=0.05)[:1]
        assert count.count == 0
        station.send(mavlink.MAVLink_mission_ack_message(SYSTEM, COMPONENT, 0, kind))


def load_parameters(station: GroundStation) -> dict[int, Any]:
    """List all, then ask for each missing one by its index."""
    listing = mavlink.MAVLink_param_request_list_message(SYSTEM, 0)
    first, *_ = station.ask(listing, "PARAM_VALUE", timeout_s=0.05)
    count = first.param_count

    def had() -> dict[int, Any]:
        return {m.param_index: m for m in station.inbox if m.get_type() == "PARAM_VALUE"}

    quiet_s = 0.0
    while len(had()) < count and quiet_s < 0.1:
        fresh = "PARAM_VALUE" in kinds(station.wait(station.slice_s))
        quiet_s = 0.0 if fresh else quiet_s + station.slice_s
    for _ in range(20 * count):
        # What comes next may be another one: still of the list, or asked for before.
        if not (missing := set(range(count)) - set(had())):
            break
        read = mavlink.MAVLink_param_request_read_message(SYSTEM, COMPONENT, b"", min(missing))
        station.ask(read, "PARAM_VALUE", retries=20, timeout_s=0.01)
    assert set(had()) == set(range(count))
    return had()


@pytest.mark.parametrize("version", [1, 2])
def test_qgroundcontrol_is_through_in_less_than_a_second(
    station: GroundStation, version: int
) -> None:
    station.version = version
    began_us = station.clock.now_us
    qgroundcontrol(station)
    assert station.clock.now_us - began_us < 1_000_000


@pytest.mark.parametrize("seed", range(5))
def test_qgroundcontrol_gets_through_a_lossy_link(station: GroundStation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    station.loses = lambda *_: rng.random() < 0.2
    qgroundcontrol(station)


def test_autopilot_version(station: GroundStation) -> None:
    ack, version = station.request(148)
    assert (ack.command, ack.result) == (mavlink.MAV_CMD_REQUEST_MESSAGE, ACCEPTED)
    assert (ack.target_system, ack.target_component) == (255, 190)
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    assert not version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    assert version.uid & 0xFF == 1


@pytest.mark.parametrize(
    ("text", "number"),
    [("1.2.3", 0x010203FF), ("0.10.0", 0x000A00FF), ("2.0", 0x020000FF), ("1.2rc1.3", 0x010003FF)],
)
def test_software_version(text: str, number: int) -> None:
    assert encoding.software_version(text) == number


def test_protocol_version(station: GroundStation) -> None:
    _, version = station.request(300)
    assert version.payload[:6] == bytes([200, 0, 100, 0, 200, 0])


def test_modes_are_as_the_development_dialect_has_them() -> None:
    parser = development.MAVLink(None)
    modes, mode = (
        parser.decode(bytearray(Encoder(1).encode(message).frame))
        for message in (encoding.available_modes(0), encoding.current_mode(0))
    )
    assert (modes.number_modes, modes.mode_index, modes.mode_name) == (1, 1, "Tracking")
    assert mode.custom_mode == 0


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (
            encoding.ProtocolVersion,
            (
                "uint16_t version/uint16_t min_version/uint16_t max_version/"
                "uint8_t spec_version_hash/\x08uint8_t library_version_hash/\x08"
            ),
        ),
        (
            encoding.ComponentMetadata,
            "uint32_t time_boot_ms/uint32_t file_crc/char uri/\x64",
        ),
    ],
)
def test_crc_seeds_follow_from_the_definitions(kind: Any, fields: str) -> None:
    """CRC_EXTRA is the checksum of the message's own definition, in wire order."""
    definition = f"{kind.msgname} {fields.replace('/', ' ')}"
    crc = mavlink.x25crc(bytearray(definition, "latin1")).crc
    assert kind.crc_extra == (crc & 0xFF) ^ (crc >> 8)
    assert (kind.msgname, kind.crc_extra) == OWN_MESSAGES[kind.id]


STREAMED = [
    ("HEARTBEAT", 0), ("SYS_STATUS", 1), ("SYSTEM_TIME", 2), ("GPS_RAW_INT", 24),
    ("SCALED_PRESSURE", 29), ("ATTITUDE", 30), ("ATTITUDE_QUATERNION", 31),
    ("GLOBAL_POSITION_INT", 33), ("MISSION_CURRENT", 42), ("VFR_HUD", 74), ("HIGHRES_IMU", 105),
    ("ESTIMATOR_STATUS", 230), ("HOME_POSITION", 242),
    ("EXTENDED_SYS_STATE", 245),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "message_id"), STREAMED)
def test_every_message_that_is_sent_can_be_requested(
    station: GroundStation, kind: str, message_id: int
) -> None:
    ack, message = station.request(message_id)
    assert ack.result == ACCEPTED
    assert message.get_type() == kind


def test_a_message_without_content_yet_is_put_off(clock: ManualClock, vehicle: Vehicle) -> None:
    fresh = GroundStation(vehicle, clock)
    for message_id in (242, 31, 33, 62):
        assert [m.result for m in fresh.request(message_id)] == [
            mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        ]


@pytest.mark.parametrize("message_id", [395, 132, 9999, -1, 1_000_000_000])
def test_a_message_that_is_never_sent_is_unsupported(
    station: GroundStation, message_id: int
) -> None:
    assert [m.result for m in station.request(message_id)] == [UNSUPPORTED]


def test_older_commands_for_the_same_questions(station: GroundStation) -> None:
    expected = {410: "HOME_POSITION", 519: "PROTOCOL_VERSION", 520: "AUTOPILOT_VERSION"}
    for number, kind in expected.items():
        assert kinds(station.command(number, 1)) == [ACK, kind]


def test_ping_and_timesync(station: GroundStation) -> None:
    [pong] = station.send(mavlink.MAVLink_ping_message(123, 45, 0, 0))
    assert (pong.time_usec, pong.seq) == (123, 45)
    assert (pong.target_system, pong.target_component) == (255, 190)
    assert station.send(mavlink.MAVLink_ping_message(123, 45, 1, 1)) == []
    [sync] = station.send(mavlink.MAVLink_timesync_message(0, 777))
    assert (sync.tc1, sync.ts1) == (station.clock.now_us * 1000, 777)
    assert station.send(mavlink.MAVLink_timesync_message(5, 777)) == []


def test_unknown_command_is_refused_once_to_the_requesting_client(station: GroundStation) -> None:
    incoming = station.command(31_999)
    assert [(m.command, m.result) for m in incoming] == [(31_999, UNSUPPORTED)]
    assert station.broadcasts == set()
    command = mavlink.MAVLink_command_int_message(1, 1, 5, 31_998, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    assert [m.result for m in station.send(command)] == [UNSUPPORTED]


@pytest.mark.parametrize("target", [(2, 1), (2, 0), (1, 100), (255, 190)])
def test_messages_for_others_are_left_alone(
    station: GroundStation, target: tuple[int, int]
) -> None:
    assert station.command(31_999, target=target) == []
    assert station.send(mavlink.MAVLink_param_request_list_message(*target)) == []
    assert station.send(mavlink.MAVLink_mission_request_list_message(*target, 0)) == []


@pytest.mark.parametrize("target", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_broadcasts_are_answered(station: GroundStation, target: tuple[int, int]) -> None:
    assert kinds(station.command(31_999, target=target)) == [ACK]


def test_arming_and_modes_are_refused_politely(station: GroundStation) -> None:
    for number in (400, 176, 246):
        ack, text = station.command(number, 1)
        assert (ack.result, text.get_type()) == (mavlink.MAV_RESULT_DENIED, "STATUSTEXT")
    [ack, _] = station.send(mavlink.MAVLink_set_mode_message(1, 1, 4))
    assert (ack.command, ack.result) == (176, mavlink.MAV_RESULT_DENIED)
