"""One table of what the standard's pages let a client ask, and what it must get.

Each row is asked over a sound link and over one that loses a third of all messages each way; a
client asks again as its page says. Pages are those of https://mavlink.io/en/services/.
"""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import RECORDED_ONLY
from tests.vehicle.ground_station import GroundStation

ME = (1, 1)
ACK = "COMMAND_ACK"


def command(number: int, *params: float) -> Callable[[], Any]:
    padded = [*params, *[0.0] * (7 - len(params))]
    return lambda: mavlink.MAVLink_command_long_message(*ME, number, 0, *padded)


def command_int(number: int, x: int, y: int, z: float) -> Callable[[], Any]:
    frame = mavlink.MAV_FRAME_GLOBAL_INT
    return lambda: mavlink.MAVLink_command_int_message(
        *ME, frame, number, 0, 0, 0, 0, 0, 0, x, y, z
    )


def ftp(opcode: int, data: bytes) -> Callable[[], Any]:
    payload = struct.pack("<HBBBBBxI", 1, 0, opcode, len(data), 0, 0, 0) + data
    return lambda: mavlink.MAVLink_file_transfer_protocol_message(0, *ME, payload.ljust(251, b"\0"))


def param_set(name: bytes, value: float) -> Callable[[], Any]:
    return lambda: mavlink.MAVLink_param_set_message(*ME, name, value, 9)


ACCEPTED = {"result": mavlink.MAV_RESULT_ACCEPTED}
DENIED = {"result": mavlink.MAV_RESULT_DENIED}
UNSUPPORTED = {"result": mavlink.MAV_RESULT_UNSUPPORTED}
IN_PROGRESS = {"result": mavlink.MAV_RESULT_IN_PROGRESS}
HOME_PLACE = (475_000_000, 85_000_000, 500.0)

TABLE: dict[str, tuple[Callable[[], Any], str, dict[str, Any]]] = {
    # command.html: every command is acknowledged by the same number.
    "command/known": (command(512, 148), ACK, ACCEPTED | {"command": 512}),
    "command/unknown": (command(31_000), ACK, UNSUPPORTED | {"command": 31_000}),
    "command/int": (command_int(179, *HOME_PLACE), ACK, ACCEPTED | {"command": 179}),
    "command/denied": (command(400, 1), ACK, DENIED | {"command": 400}),
    "command/long-running": (command(241, 1), ACK, IN_PROGRESS | {"progress": 255}),
    "command/cancelled": (command(241), ACK, ACCEPTED),
    "command/home-position": (command(410), "HOME_POSITION", {"longitude": -87_654_321}),
    "command/capabilities": (command(520, 1), "AUTOPILOT_VERSION", {"product_id": 0}),
    "command/protocol-version": (command(519, 1), "PROTOCOL_VERSION", {}),
    "command/set-roi": (command_int(195, *HOME_PLACE), ACK, ACCEPTED),
    "command/no-such-mission-item": (command(224, 7), ACK, DENIED),
    "command/set-mode": (
        lambda: mavlink.MAVLink_set_mode_message(1, 1, 4), ACK, DENIED | {"command": 176},
    ),
    "command/store": (command(245, 1), ACK, IN_PROGRESS),
    "command/start-recording": (command(2510), ACK, IN_PROGRESS),
    "command/stop-recording": (command(2511), ACK, ACCEPTED),
    # The messages that MAV_CMD_REQUEST_MESSAGE asks for follow its acknowledgement.
    "request/autopilot-version": (command(512, 148), "AUTOPILOT_VERSION", {"vendor_id": 0}),
    "request/protocol-version": (command(512, 300), "PROTOCOL_VERSION", {}),
    "request/home": (command(512, 242), "HOME_POSITION", {"latitude": 471_234_567}),
    "request/unknown": (command(512, 12_345), ACK, UNSUPPORTED),
    "request/interval": (command(510, 30), "MESSAGE_INTERVAL", {"interval_us": 20_000}),
    "request/set-interval": (command(511, 30, 100_000), ACK, ACCEPTED),
    "request/set-interval-unknown": (command(511, 12_345, 100_000), ACK, UNSUPPORTED),
    "request/interval-by-message": (
        command(512, 244, 30), "MESSAGE_INTERVAL", {"interval_us": 20_000},
    ),
    "request/no-data": (command(512, 62), ACK, {"result": 1}),
    # component_metadata.html and standard_modes.html
    "metadata/announcement": (command(512, 397), "COMPONENT_METADATA", {}),
    "metadata/deprecated": (command(512, 395), ACK, UNSUPPORTED),
    "modes/available": (command(512, 435, 0), "AVAILABLE_MODES", {}),
    "modes/current": (command(512, 436), "CURRENT_MODE", {}),
    # parameter.html: read by name or index, set and reported, unknown ones refused.
    "parameter/list": (
        lambda: mavlink.MAVLink_param_request_list_message(*ME), "PARAM_VALUE", {},
    ),
    "parameter/read-name": (
        lambda: mavlink.MAVLink_param_request_read_message(*ME, b"RATE_ATT", -1),
        "PARAM_VALUE", {"param_id": "RATE_ATT", "param_value": 50.0},
    ),
    "parameter/read-index": (
        lambda: mavlink.MAVLink_param_request_read_message(*ME, b"", 0),
        "PARAM_VALUE", {"param_index": 0},
    ),
    "parameter/read-unknown": (
        lambda: mavlink.MAVLink_param_request_read_message(*ME, b"NOPE", -1),
        "PARAM_ERROR", {"error": mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST},
    ),
    "parameter/set": (
        param_set(b"RATE_ATT", 5.0), "PARAM_VALUE", {"param_id": "RATE_ATT", "param_value": 5.0},
    ),
    "parameter/set-out-of-range": (
        param_set(b"RATE_ATT", -5.0), "PARAM_VALUE", {"param_id": "RATE_ATT", "param_value": 50.0},
    ),
    "parameter/set-unknown": (
        param_set(b"NOPE", 1.0), "PARAM_ERROR", {"error": mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST},
    ),
    "parameter/set-of-home": (
        param_set(b"HOME_ALT", 12.5), "PARAM_VALUE", {"param_id": "HOME_ALT", "param_value": 12.5},
    ),
    # mission.html: the same for the three types.
    **{
        f"mission/list-{kind}": (
            lambda kind=kind: mavlink.MAVLink_mission_request_list_message(*ME, kind),
            "MISSION_COUNT", {"count": 0, "mission_type": kind},
        )
        for kind in (0, 1, 2)
    },
    "mission/upload": (
        lambda: mavlink.MAVLink_mission_count_message(*ME, 2, 0), "MISSION_REQUEST_INT", {"seq": 0},
    ),
    "mission/too-large": (
        lambda: mavlink.MAVLink_mission_count_message(*ME, 60_000, 0),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_NO_SPACE},
    ),
    "mission/no-such-item": (
        lambda: mavlink.MAVLink_mission_request_int_message(*ME, 9, 0),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_INVALID_SEQUENCE},
    ),
    "mission/no-such-type": (
        lambda: mavlink.MAVLink_mission_request_list_message(*ME, 7),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_UNSUPPORTED},
    ),
    "mission/partial-download": (
        lambda: mavlink.MAVLink_mission_request_partial_list_message(*ME, 0, 3, 0),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_UNSUPPORTED},
    ),
    "mission/partial-upload": (
        lambda: mavlink.MAVLink_mission_write_partial_list_message(*ME, 0, 3, 0),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_UNSUPPORTED},
    ),
    "mission/stray-item": (
        lambda: mavlink.MAVLink_mission_item_int_message(
            *ME, 3, 5, 16, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0
        ),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_ERROR},
    ),
    "mission/empty-upload": (
        lambda: mavlink.MAVLink_mission_count_message(*ME, 0, 1),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_ACCEPTED, "mission_type": 1},
    ),
    "mission/older-request": (
        lambda: mavlink.MAVLink_mission_request_message(*ME, 2, 0),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_INVALID_SEQUENCE},
    ),
    "mission/clear": (
        lambda: mavlink.MAVLink_mission_clear_all_message(*ME, 255),
        "MISSION_ACK", {"type": mavlink.MAV_MISSION_ACCEPTED},
    ),
    "mission/set-current-none": (
        lambda: mavlink.MAVLink_mission_set_current_message(*ME, 4), "STATUSTEXT", {},
    ),
    # ftp.html: an answer to every opcode, with the request's opcode in it.
    "ftp/open": (ftp(4, b"/general.json"), "FILE_TRANSFER_PROTOCOL", {"opcode": (128, 4)}),
    "ftp/packed-parameters": (
        ftp(4, b"@PARAM/param.pck?withdefaults=1"), "FILE_TRANSFER_PROTOCOL", {"opcode": (128, 4)},
    ),
    "ftp/not-there": (ftp(4, b"@SYS/threads.txt"), "FILE_TRANSFER_PROTOCOL", {"opcode": (129, 4)}),
    "ftp/list": (ftp(3, b"/"), "FILE_TRANSFER_PROTOCOL", {"opcode": (128, 3)}),
    "ftp/write": (ftp(6, b"/x"), "FILE_TRANSFER_PROTOCOL", {"opcode": (129, 6)}),
    "ftp/reset": (ftp(2, b""), "FILE_TRANSFER_PROTOCOL", {"opcode": (128, 2)}),
    # ping.html and timesync.html
    "ping": (lambda: mavlink.MAVLink_ping_message(5, 6, 0, 0), "PING", {"seq": 6}),
    "timesync": (lambda: mavlink.MAVLink_timesync_message(0, 7), "TIMESYNC", {"ts1": 7}),
    # log.html
    "log/list": (
        lambda: mavlink.MAVLink_log_request_list_message(*ME, 0, 0xFFFF),
        "LOG_ENTRY", {"id": 0, "num_logs": 0},
    ),
    "log/data": (
        lambda: mavlink.MAVLink_log_request_data_message(*ME, 3, 90, 90),
        "LOG_DATA", {"id": 3, "ofs": 90, "count": 0},
    ),
    # parameter_ext.html: there are none.
    "parameter-ext/list": (
        lambda: mavlink.MAVLink_param_ext_request_list_message(*ME),
        "PARAM_EXT_VALUE", {"param_count": 0},
    ),
    "parameter-ext/set": (
        lambda: mavlink.MAVLink_param_ext_set_message(*ME, b"X", b"1", 1),
        "PARAM_EXT_ACK", {"param_result": mavlink.PARAM_ACK_FAILED},
    ),
    # terrain.html: spacing 0 is "not available here".
    "terrain/check": (
        lambda: mavlink.MAVLink_terrain_check_message(471_234_567, -87_654_321),
        "TERRAIN_REPORT", {"lat": 471_234_567, "lon": -87_654_321, "spacing": 0, "pending": 0},
    ),
    "signing/setup": (
        lambda: mavlink.MAVLink_setup_signing_message(*ME, [7] * 32, 0), "STATUSTEXT", {},
    ),
    "origin/set": (
        lambda: mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0),
        "GPS_GLOBAL_ORIGIN", {"latitude": 471_234_567},
    ),
}  # fmt: skip


def answers(message: Any, field: str) -> Any:
    if field == "opcode":
        return (message.payload[3], message.payload[5])
    return getattr(message, field)


@pytest.mark.parametrize("loss", [0.0, 0.33])
@pytest.mark.parametrize("row", TABLE)
def test_the_answer(station: GroundStation, row: str, loss: float) -> None:
    request, kind, fields = TABLE[row]
    rng = np.random.default_rng([*row.encode()])
    station.loses = lambda *_: rng.random() < loss
    answer = station.ask(request(), kind, retries=30, timeout_s=0.05)[0]
    assert {field: answers(answer, field) for field in fields} == fields


SENT_TO_ALL = {
    "command/int": {"HOME_POSITION", "STATUSTEXT"},
    "command/denied": {"STATUSTEXT"},
    "command/long-running": {"STATUSTEXT"},
    "command/set-roi": {"STATUSTEXT"},
    "command/set-mode": {"STATUSTEXT"},
    "parameter/set-of-home": {"HOME_POSITION"},
    "mission/set-current-none": {"STATUSTEXT"},
    "signing/setup": {"STATUSTEXT"},
}
"""What changed, and why something was refused, concerns every ground station."""


@pytest.mark.parametrize("row", TABLE)
def test_answer_is_sent_once_and_to_the_requesting_client_only(
    station: GroundStation, row: str
) -> None:
    request, kind, _ = TABLE[row]
    found = station.send(request())
    # A list comes in tens; with home's height goes who set it.
    expected = {"parameter/list": 10, "parameter/set-of-home": 2, "signing/setup": 3}.get(row, 1)
    assert sum(m.get_type() == kind for m in found) == expected
    assert {frame.client_id for frame in station.frames} <= {7, None, RECORDED_ONLY}
    assert station.broadcasts == SENT_TO_ALL.get(row, set())
