"""One table of the requests that the standard's pages allow, and the answer that each must get.

Each row is asked over a sound link and over one that loses a third of all messages each way; a
client asks again as its page says. Pages are those of https://mavlink.io/en/services/.
"""

from functools import partial
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.dialects.v20 import development

from gateway.records import RECORDED_ONLY
from gateway.vehicle.telemetry import messages
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.kit.ground_station import (
    GroundStation,
    command,
    command_int,
    count,
    ftp_request,
    item,
    kinds,
    of_kind,
    qgroundcontrol,
    request_item,
    results,
    to_vehicle,
)

ME = (1, 1)
ACK, ENDED = "COMMAND_ACK", "MISSION_ACK"
VALUE = "PARAM_VALUE"
FTP = "FILE_TRANSFER_PROTOCOL"


param_set = partial(mavlink.MAVLink_param_set_message, *ME, param_type=9)
param_read = partial(mavlink.MAVLink_param_request_read_message, *ME, param_index=-1)


def valued(name: str, value: float) -> dict[str, Any]:
    return {"param_id": name, "param_value": value}


ACCEPTED = {"result": mavlink.MAV_RESULT_ACCEPTED}
DENIED = {"result": mavlink.MAV_RESULT_DENIED}
UNSUPPORTED = {"result": mavlink.MAV_RESULT_UNSUPPORTED}
IN_PROGRESS = {"result": mavlink.MAV_RESULT_IN_PROGRESS}
REFUSED = {"type": mavlink.MAV_MISSION_UNSUPPORTED}
NO_ITEM = {"type": mavlink.MAV_MISSION_INVALID_SEQUENCE}
STORED = {"type": mavlink.MAV_MISSION_ACCEPTED}
UNKNOWN = {"error": mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST}
HOME = (475_000_000, 85_000_000, 500.0)

TABLE: dict[str, tuple[Any, str, dict[str, Any]]] = {
    # command.html: every command is acknowledged by the same number.
    "command/known": (command(512, 148), ACK, ACCEPTED | {"command": 512}),
    "command/unknown": (command(31_000), ACK, UNSUPPORTED | {"command": 31_000}),
    "command/unknown-int": (command_int(31_998, 0, 0, 0), ACK, UNSUPPORTED | {"command": 31_998}),
    "command/int": (command_int(179, *HOME), ACK, ACCEPTED | {"command": 179}),
    "command/arm": (command(400, 1), ACK, DENIED | {"command": 400}),
    "command/mode": (command(176, 1), ACK, DENIED | {"command": 176}),
    "command/reboot": (command(246, 1), ACK, DENIED | {"command": 246}),
    "command/long-running": (command(241, 1), ACK, IN_PROGRESS | {"progress": 255}),
    "command/cancelled": (command(241), ACK, ACCEPTED),
    "command/home-position": (command(410), "HOME_POSITION", {"longitude": -87_654_321}),
    "command/capabilities": (command(520, 1), "AUTOPILOT_VERSION", {"product_id": 0}),
    "command/protocol-version": (command(519, 1), "PROTOCOL_VERSION", {}),
    "command/set-roi": (command_int(195, *HOME), ACK, ACCEPTED),
    "command/no-such-mission-item": (command(224, 7), ACK, DENIED),
    "command/set-mode": (mavlink.MAVLink_set_mode_message(1, 1, 4), ACK, DENIED | {"command": 176}),
    "command/store": (command(245, 1), ACK, IN_PROGRESS),
    "command/start-recording": (command(2510), ACK, IN_PROGRESS),
    "command/stop-recording": (command(2511), ACK, ACCEPTED),
    # The messages that MAV_CMD_REQUEST_MESSAGE asks for follow its acknowledgement.
    "request/autopilot-version": (command(512, 148), "AUTOPILOT_VERSION", {"vendor_id": 0}),
    "request/protocol-version": (command(512, 300), "PROTOCOL_VERSION", {}),
    "request/home": (command(512, 242), "HOME_POSITION", {"latitude": 471_234_567}),
    "request/interval": (command(510, 30), "MESSAGE_INTERVAL", {"interval_us": 20_000}),
    "request/set-interval": (command(511, 30, 100_000), ACK, ACCEPTED),
    "request/set-interval-unknown": (command(511, 12_345, 100_000), ACK, UNSUPPORTED),
    "request/interval-by-message": (
        command(512, 244, 30), "MESSAGE_INTERVAL", {"interval_us": 20_000, "message_id": 30},
    ),
    "request/no-such-instance": (command(512, 105, 1), ACK, DENIED),
    "request/no-data": (command(512, 62), ACK, {"result": 1}),
    **{
        f"request/unknown-{number}": (command(512, number), ACK, UNSUPPORTED)
        for number in (132, 9999, 12_345, -1, 1_000_000_000)
    },
    # component_metadata.html and standard_modes.html
    "metadata/announcement": (command(512, 397), "COMPONENT_METADATA", {}),
    "metadata/deprecated": (command(512, 395), ACK, UNSUPPORTED),
    "modes/available": (command(512, 435, 0), "AVAILABLE_MODES", {}),
    "modes/by-index": (command(512, 435, 1), "AVAILABLE_MODES", {}),
    "modes/beyond-the-last": (command(512, 435, 2), ACK, DENIED),
    "modes/current": (command(512, 436), "CURRENT_MODE", {}),
    # parameter.html: read by name or index, set and reported, unknown ones refused.
    "parameter/list": (to_vehicle("PARAM_REQUEST_LIST"), VALUE, {}),
    "parameter/read-name": (param_read(b"RATE_ATT"), VALUE, valued("RATE_ATT", 50.0)),
    "parameter/read-index": (param_read(b"", param_index=0), VALUE, {"param_index": 0}),
    "parameter/read-unknown": (param_read(b"NOPE"), "PARAM_ERROR", UNKNOWN),
    "parameter/set": (param_set(b"RATE_ATT", 5.0), VALUE, valued("RATE_ATT", 5.0)),
    "parameter/set-out-of-range": (param_set(b"RATE_ATT", -5.0), VALUE, valued("RATE_ATT", 50.0)),
    "parameter/set-unknown": (param_set(b"NOPE", 1.0), "PARAM_ERROR", UNKNOWN),
    "parameter/set-of-home": (param_set(b"HOME_ALT", 12.5), VALUE, valued("HOME_ALT", 12.5)),
    # mission.html: the same for the three types.
    **{
        f"mission/list-{kind}": (
            to_vehicle("MISSION_REQUEST_LIST", kind),
            "MISSION_COUNT", {"count": 0, "mission_type": kind},
        )
        for kind in (0, 1, 2)
    },
    "mission/upload": (count(2), "MISSION_REQUEST_INT", {"seq": 0}),
    "mission/too-large": (count(60_000), ENDED, {"type": mavlink.MAV_MISSION_NO_SPACE}),
    "mission/no-such-item": (request_item(9), ENDED, NO_ITEM),
    "mission/no-such-type": (to_vehicle("MISSION_REQUEST_LIST", 7), ENDED, REFUSED),
    "mission/partial-download": (
        to_vehicle("MISSION_REQUEST_PARTIAL_LIST", 0, 3, 0),
        ENDED, REFUSED,
    ),
    "mission/partial-upload": (to_vehicle("MISSION_WRITE_PARTIAL_LIST", 0, 3, 0), ENDED, REFUSED),
    "mission/stray-item": (item(3), ENDED, {"type": mavlink.MAV_MISSION_ERROR}),
    "mission/empty-upload": (count(0, 1), ENDED, STORED | {"mission_type": 1}),
    "mission/older-request": (to_vehicle("MISSION_REQUEST", 2, 0), ENDED, NO_ITEM),
    "mission/clear": (to_vehicle("MISSION_CLEAR_ALL", 255), ENDED, STORED),
    "mission/clear-no-such-type": (to_vehicle("MISSION_CLEAR_ALL", 7), ENDED, REFUSED),
    "mission/set-current-none": (to_vehicle("MISSION_SET_CURRENT", 4), "STATUSTEXT", {}),
    # ftp.html: an answer to every opcode, with the request's opcode in it.
    "ftp/open": (ftp_request(4, b"/general.json"), FTP, {"opcode": (128, 4)}),
    "ftp/packed-parameters": (
        ftp_request(4, b"@PARAM/param.pck?withdefaults=1"), FTP, {"opcode": (128, 4)},
    ),
    "ftp/not-there": (ftp_request(4, b"@SYS/threads.txt"), FTP, {"opcode": (129, 4)}),
    "ftp/list": (ftp_request(3, b"/"), FTP, {"opcode": (128, 3)}),
    "ftp/write": (ftp_request(6, b"/x"), FTP, {"opcode": (129, 6)}),
    "ftp/reset": (ftp_request(2, b""), FTP, {"opcode": (128, 2)}),
    # ping.html and timesync.html
    "ping": (
        mavlink.MAVLink_ping_message(5, 6, 0, 0),
        "PING", {"time_usec": 5, "seq": 6, "target_system": 255, "target_component": 190},
    ),
    "timesync": (mavlink.MAVLink_timesync_message(0, 7), "TIMESYNC", {"ts1": 7}),
    # log.html
    "log/list": (to_vehicle("LOG_REQUEST_LIST", 0, 0xFFFF), "LOG_ENTRY", {"id": 0, "num_logs": 0}),
    "log/data": (
        to_vehicle("LOG_REQUEST_DATA", 3, 90, 90),
        "LOG_DATA", {"id": 3, "ofs": 90, "count": 0},
    ),
    # parameter_ext.html: there are none.
    "parameter-ext/list": (
        to_vehicle("PARAM_EXT_REQUEST_LIST"), "PARAM_EXT_VALUE", {"param_count": 0},
    ),
    "parameter-ext/set": (
        to_vehicle("PARAM_EXT_SET", b"X", b"1", 1),
        "PARAM_EXT_ACK", {"param_result": mavlink.PARAM_ACK_FAILED},
    ),
    # terrain.html: spacing 0 is "not available here".
    "terrain/check": (
        mavlink.MAVLink_terrain_check_message(471_234_567, -87_654_321),
        "TERRAIN_REPORT", {"lat": 471_234_567, "lon": -87_654_321, "spacing": 0, "pending": 0},
    ),
    "signing/setup": (to_vehicle("SETUP_SIGNING", [7] * 32, 0), "STATUSTEXT", {}),
    "origin/set": (
        mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0),
        "GPS_GLOBAL_ORIGIN", {"latitude": 471_234_567},
    ),
}  # fmt: skip


def answers(message: Any, field: str) -> Any:
    if field == "opcode":
        return (message.payload[3], message.payload[5])
    return getattr(message, field)


@pytest.mark.parametrize("loss", [0.0, 0.33])
@pytest.mark.parametrize("row", TABLE)
def test_each_request_gets_its_answer(station: GroundStation, row: str, loss: float) -> None:
    request, kind, fields = TABLE[row]
    rng = np.random.default_rng([*row.encode()])
    station.loses = lambda *_: rng.random() < loss
    answer = station.ask(request, kind, retries=30, timeout_s=0.05)[0]
    assert {field: answers(answer, field) for field in fields} == fields


TEXT_TO_ALL = (
    *("command/arm", "command/mode", "command/reboot", "command/long-running", "command/set-roi"),
    *("command/set-mode", "mission/set-current-none", "signing/setup"),
)
SENT_TO_ALL = {
    "command/int": {"HOME_POSITION", "STATUSTEXT"},
    "parameter/set-of-home": {"HOME_POSITION"},
    **{row: {"STATUSTEXT"} for row in TEXT_TO_ALL},
}
"""What changed, and why something was refused, concerns every ground station."""


@pytest.mark.parametrize("row", TABLE)
def test_answer_is_sent_once_and_to_its_client_only(station: GroundStation, row: str) -> None:
    request, kind, _ = TABLE[row]
    found = station.send(request)
    # A list comes in tens; with home's height goes who set it.
    expected = {"parameter/list": 10, "parameter/set-of-home": 2, "signing/setup": 3}.get(row, 1)
    assert len(of_kind(found, kind)) == expected
    is_command = request.get_type() in ("COMMAND_LONG", "COMMAND_INT", "SET_MODE")
    assert len(results(found)) == is_command
    assert {frame.client_id for frame in station.frames} <= {7, None, RECORDED_ONLY}
    assert station.broadcasts == SENT_TO_ALL.get(row, set())


@pytest.mark.parametrize(
    ("target", "is_ours"),
    [
        *(((2, 1), False), ((2, 0), False), ((1, 100), False), ((255, 190), False)),
        *(((0, 0), True), ((1, 0), True), ((0, 1), True), ((1, 1), True)),
    ],
    ids=str,
)
def test_only_messages_for_the_vehicle_or_all_are_answered(
    station: GroundStation, target: tuple[int, int], is_ours: bool
) -> None:
    assert kinds(station.command(31_999, target=target)) == [ACK] * is_ours
    for name, *fields in (("PARAM_REQUEST_LIST",), ("MISSION_REQUEST_LIST", 0)):
        assert bool(station.send(to_vehicle(name, *fields, target=target))) == is_ours


def test_answers_to_ping_and_timesync_are_not_answered(station: GroundStation) -> None:
    [sync] = station.send(mavlink.MAVLink_timesync_message(0, 777))
    assert sync.tc1 == station.clock.now_us * 1000
    assert station.send(mavlink.MAVLink_ping_message(123, 45, 1, 1)) == []
    assert station.send(mavlink.MAVLink_timesync_message(5, 777)) == []


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("one_by_one", [True, False])
def test_qgroundcontrol_connects_within_a_second(
    station: GroundStation, version: int, one_by_one: bool, loss: float
) -> None:
    rng = np.random.default_rng(version)
    station.version, station.loses = version, lambda *_: rng.random() < loss
    began_us = station.clock.now_us
    ready = qgroundcontrol(station, one_by_one=one_by_one)
    assert (ready.modes, ready.plans, ready.cameras) == (["Tracking"], (0, 0, 0), [])
    assert ready.parameters
    assert loss or station.clock.now_us - began_us < 1_000_000


def test_versions_and_capabilities_are_reported(station: GroundStation) -> None:
    ack, version = station.request(148)
    assert (ack.target_system, ack.target_component) == (255, 190)
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    assert not version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    assert version.uid & 0xFF == 1
    _, version = station.request(300)
    assert version.payload[:6] == bytes([200, 0, 100, 0, 200, 0])


@pytest.mark.parametrize(
    ("text", "number"),
    [("1.2.3", 0x010203FF), ("0.10.0", 0x000A00FF), ("2.0", 0x020000FF), ("1.2rc1.3", 0x010003FF)],
)
def test_software_version_is_encoded_in_four_bytes(text: str, number: int) -> None:
    assert messages.software_version(text) == number


def test_modes_are_decoded_by_the_development_dialect(station: GroundStation) -> None:
    for message_id in (435, 436):
        station.request(message_id)
    frames = [each.frame for each in station.frames if each.message_id in (435, 436)]
    modes, mode = (development.MAVLink(None).decode(bytearray(frame)) for frame in frames)
    assert (modes.number_modes, modes.mode_index, modes.mode_name) == (1, 1, "Tracking")
    assert mode.custom_mode == 0


STREAMED = {
    "HEARTBEAT": 0, "SYS_STATUS": 1, "SYSTEM_TIME": 2, "GPS_RAW_INT": 24, "SCALED_PRESSURE": 29,
    "ATTITUDE": 30, "ATTITUDE_QUATERNION": 31, "GLOBAL_POSITION_INT": 33, "MISSION_CURRENT": 42,
    "VFR_HUD": 74, "HIGHRES_IMU": 105, "ESTIMATOR_STATUS": 230, "HOME_POSITION": 242,
    "EXTENDED_SYS_STATE": 245,
}  # fmt: skip


def test_every_streamed_message_can_be_requested(station: GroundStation) -> None:
    for kind, message_id in STREAMED.items():
        assert kinds(station.request(message_id)) == [ACK, kind]
    assert set(results(station.inbox)) == {mavlink.MAV_RESULT_ACCEPTED}


def test_request_of_a_message_without_content_is_temporarily_rejected(
    clock: ManualClock, vehicle: Vehicle
) -> None:
    fresh = GroundStation(vehicle, clock)
    for message_id in (242, 31, 33, 62):
        assert results(fresh.request(message_id)) == [mavlink.MAV_RESULT_TEMPORARILY_REJECTED]
