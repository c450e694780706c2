"""MAVLink FTP as its page has it: reading, refusing, repeating; and the files that are there."""

import json
import lzma
import struct
from typing import Any

import numpy as np
import pytest
from MAVProxy.modules.lib.param_ftp import ftp_param_decode
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.vehicle.services.ftp import ACK, NAK, FtpError, Opcode, Packet, crc32, decode_packet
from gateway.vehicle.services.parameters import PARAMETER_PATH, Metadata, ParameterTable
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.vehicle.ground_station import GroundStation
from tests.vehicle.services.test_parameters import values


class Ftp:
    """A client that reads files as QGroundControl does."""

    def __init__(self, station: GroundStation) -> None:
        self.station = station
        self.sequence = 0

    def packet(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        self.sequence += 1
        plain = {"session": 0, "size": len(data), "offset": 0} | fields
        return Packet(
            self.sequence, plain["session"], opcode, plain["size"], 0, 0, plain["offset"], data
        )

    def send(self, packet: Packet) -> list[Packet]:
        message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, packet.encode())
        return self.packets(self.station.send(message))

    def packets(self, messages: list[Any]) -> list[Packet]:
        return [
            decode_packet(bytes(m.payload))
            for m in messages
            if m.get_type() == "FILE_TRANSFER_PROTOCOL"
        ]

    def ask(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        packet = self.packet(opcode, data, **fields)
        for _ in range(50):
            answers = self.send(packet)
            if answers:
                return answers[0]
        raise AssertionError("no answer")

    def read(self, path: bytes) -> bytes:
        opened = self.ask(Opcode.OPEN_FILE_RO, path)
        assert opened.opcode == ACK
        size = struct.unpack("<I", opened.data)[0]
        content = bytearray(size)
        missing = set(range(size))
        burst = self.packet(Opcode.BURST_READ_FILE, session=opened.session, size=239)
        pieces = self.send(burst) + self.packets(self.station.wait(0.5))
        if len(pieces) * 239 >= size:  # none was lost
            after = range(burst.sequence + 1, burst.sequence + 1 + len(pieces))
            assert [piece.sequence for piece in pieces] == list(after)
        for piece in pieces:
            content[piece.offset : piece.offset + piece.size] = piece.data
            missing -= set(range(piece.offset, piece.offset + piece.size))
        while missing:
            start = min(missing)
            piece = self.ask(Opcode.READ_FILE, session=opened.session, size=100, offset=start)
            content[start : start + piece.size] = piece.data
            missing -= set(range(start, start + piece.size))
        assert self.ask(Opcode.TERMINATE_SESSION, session=opened.session).opcode == ACK
        return bytes(content)


def described(ftp: Ftp) -> list[dict[str, Any]]:
    return json.loads(lzma.decompress(ftp.read(b"parameter.json.xz")))["parameters"]


@pytest.fixture
def ftp(station: GroundStation) -> Ftp:
    return Ftp(station)


@pytest.mark.parametrize("loss", [0.0, 0.25])
def test_the_metadata_is_found_and_describes_every_parameter(ftp: Ftp, loss: float) -> None:
    _, announced = ftp.station.request(397)
    file_crc, uri = struct.unpack("<I100s", announced.payload[4:108])
    assert uri.rstrip(b"\0") == b"mftp:///general.json"
    rng = np.random.default_rng(4)
    ftp.station.loses = lambda *_: rng.random() < loss
    general = ftp.read(b"/general.json")
    assert crc32(general) == file_crc
    [kind] = json.loads(general)["metadataTypes"]
    assert (kind["type"], kind["uri"]) == (1, "mftp:///parameter.json.xz")
    described = ftp.read(b"/parameter.json.xz")
    assert crc32(described) == kind["fileCrc"]
    ftp.station.loses = lambda *_: False
    parameters = {p["name"]: p for p in json.loads(lzma.decompress(described))["parameters"]}
    assert set(parameters) == set(values(ftp.station))
    cutoff = parameters["TUNING_CUTOFF"]
    assert (cutoff["min"], cutoff["max"], cutoff["units"]) == (0.1, 500, "Hz")
    assert cutoff["default"] == 10.0
    assert [v["description"] for v in parameters["TUNING_ENABLED"]["values"]] == ["off", "on"]
    assert parameters["VEH_TYPE"]["values"][1] == {"value": 1, "description": "fixed_wing"}


@pytest.mark.parametrize(
    "path",
    [
        b"/general.json",
        b"//general.json",
        b"///general.json",
        b"general.json",
        b"/./general.json",
        b"mftp:///general.json",
        b"mftp://general.json",
        b"mftp://;comp=1/general.json",
        b"mftp://[;comp=1]/general.json",
        b"MFTP:///general.json",
    ],
)
def test_every_way_to_write_a_path(ftp: Ftp, path: bytes) -> None:
    assert ftp.ask(Opcode.OPEN_FILE_RO, path).opcode == ACK


@pytest.mark.parametrize("path", [b"/", b"", b".", b"//", b"/.", b"./"])
def test_every_way_to_write_the_folder(ftp: Ftp, path: bytes) -> None:
    assert b"general.json" in ftp.ask(Opcode.LIST_DIRECTORY, path).data


@pytest.mark.parametrize(
    "path", [b"@SYS/threads.txt", b"@PARAM", b"/../general.json", b"/general.json/x", b"/general"]
)
def test_other_paths_are_not_there(ftp: Ftp, path: bytes) -> None:
    refused = ftp.ask(Opcode.OPEN_FILE_RO, path)
    assert (refused.opcode, refused.data[:1]) == (NAK, b"\x0a")


def test_every_key_of_the_metadata_is_of_the_schema(ftp: Ftp) -> None:
    allowed = {
        "name", "type", "shortDesc", "longDesc", "units", "default", "decimalPlaces", "min", "max",
        "increment", "rebootRequired", "group", "category", "volatile", "values", "bitmask",
    }  # fmt: skip
    for parameter in described(ftp):
        assert set(parameter) <= allowed
        assert parameter["type"] == ("Int32" if "values" in parameter else parameter["type"])
        assert len(parameter["name"]) <= 16
        assert len(parameter["shortDesc"]) <= 100
        assert all(len(value["description"]) <= 100 for value in parameter.get("values", ()))


def test_packed_parameters_are_decoded_by_mavproxy(ftp: Ftp) -> None:
    """MAVProxy and Mission Planner load the parameters by this file."""
    wanted = values(ftp.station)
    ftp.station.send(mavlink.MAVLink_param_set_message(1, 1, b"TUNING_CUTOFF", 12.5, 9))
    for query in (b"", b"?withdefaults=1"):
        found = ftp_param_decode(ftp.read(b"@PARAM/param.pck" + query))
        values_of = {name.decode(): value for name, value, _ in found.params}
        assert values_of == pytest.approx(wanted | {"TUNING_CUTOFF": 12.5})
    defaults = {name.decode(): value for name, value, _ in found.defaults}
    assert defaults["TUNING_CUTOFF"] == 10.0
    assert b"Fparam.pck" in ftp.ask(Opcode.LIST_DIRECTORY, b"@PARAM").data


def test_client_that_read_the_packed_parameters_is_sent_changes(ftp: Ftp) -> None:
    ftp.read(b"@PARAM/param.pck")
    changed = VehicleSettings(takeoff_speed_mps=7.0)
    [value] = ftp.station.receive(ftp.station.vehicle.take_settings("vehicle", changed))
    assert (value.param_id, value.param_value) == ("VEH_TKOFF_SPEED", 7.0)


def test_enumerations_are_integers_and_coordinates_have_seven_decimal_places(ftp: Ftp) -> None:
    parameters = {p["name"]: p for p in described(ftp)}
    assert {
        parameters[name]["type"] for name in ("VEH_TYPE", "TUNING_ENABLED", "TUNING_ORDER")
    } == {"Int32"}
    assert [parameters[name]["decimalPlaces"] for name in ("HOME_LAT", "HOME_LON")] == [7, 7]
    assert parameters["TUNING_CUTOFF"]["decimalPlaces"] == 4


def test_parameter_metadata_of_the_gateway_is_small() -> None:
    """A radio of 57600 baud carries about 140 bytes of a file in 60 ms."""
    settings = AircraftSettings()
    table = ParameterTable({name: getattr(settings, name) for name in settings.__struct_fields__})
    content = Metadata(table).files[PARAMETER_PATH]
    assert len(content) < 8_000 < 30_000 < len(lzma.decompress(content))


def test_the_crc_is_the_one_of_mavlink() -> None:
    """CRC-32 of the Ethernet polynomial, started at 0 and not inverted at the end."""
    assert crc32(b"") == 0
    expected = 0
    for byte in b"123456789":
        expected ^= byte
        for _ in range(8):
            expected = expected >> 1 ^ (0xEDB88320 if expected & 1 else 0)
    assert crc32(b"123456789") == expected


def test_files_that_are_not_there_are_refused_with_everything_echoed(ftp: Ftp) -> None:
    """A client without an answer repeats its request for a quarter of a minute."""
    request = ftp.packet(Opcode.OPEN_FILE_RO, b"@SYS/threads.txt", session=5)
    [answer] = ftp.send(request)
    assert answer == Packet(
        request.sequence + 1, 5, NAK, 1, Opcode.OPEN_FILE_RO, 0, 0, bytes([FtpError.FILE_NOT_FOUND])
    )


@pytest.mark.parametrize(
    ("opcode", "error"),
    [
        *((opcode, FtpError.FILE_PROTECTED) for opcode in range(6, 14)),
        (Opcode.READ_FILE, FtpError.INVALID_SESSION),
        (Opcode.BURST_READ_FILE, FtpError.INVALID_SESSION),
        (Opcode.TERMINATE_SESSION, FtpError.INVALID_SESSION),
        (Opcode.CALC_FILE_CRC32, FtpError.FILE_NOT_FOUND),
        (99, FtpError.UNKNOWN_COMMAND),
        (128, FtpError.UNKNOWN_COMMAND),
    ],
)
def test_refusals(ftp: Ftp, opcode: int, error: FtpError) -> None:
    answer = ftp.ask(opcode, b"/x", session=3)
    assert (answer.opcode, answer.request_opcode, answer.session) == (NAK, opcode, 3)
    assert answer.data == bytes([error])


def test_none_and_reset_are_always_acknowledged(ftp: Ftp) -> None:
    assert ftp.ask(Opcode.NONE).opcode == ACK
    assert ftp.ask(Opcode.RESET_SESSIONS).opcode == ACK


def test_a_repeated_request_gets_the_same_answer(ftp: Ftp) -> None:
    request = ftp.packet(Opcode.OPEN_FILE_RO, b"/general.json")
    [first] = ftp.send(request)
    [again] = ftp.send(request)
    assert first == again
    assert ftp.ask(Opcode.OPEN_FILE_RO, b"/general.json").session == first.session + 1


def test_reading_to_the_end_and_beyond(ftp: Ftp) -> None:
    opened = ftp.ask(Opcode.OPEN_FILE_RO, b"/general.json")
    size = struct.unpack("<I", opened.data)[0]
    last = ftp.ask(Opcode.READ_FILE, session=opened.session, offset=size - 5, size=239)
    assert last.size == 5
    for opcode in (Opcode.READ_FILE, Opcode.BURST_READ_FILE):
        beyond = ftp.ask(opcode, session=opened.session, offset=size, size=239)
        assert beyond.data == bytes([FtpError.EOF])


def test_the_directory(ftp: Ftp) -> None:
    listed = ftp.ask(Opcode.LIST_DIRECTORY, b"/")
    names = [entry.split(b"\t")[0] for entry in listed.data.split(b"\0") if entry]
    assert names == [b"Fgeneral.json", b"Fparameter.json.xz"]
    assert ftp.ask(Opcode.LIST_DIRECTORY, b"/", offset=2).data == bytes([FtpError.EOF])
    assert ftp.ask(Opcode.LIST_DIRECTORY, b"/etc").data == bytes([FtpError.FILE_NOT_FOUND])
    crc = ftp.ask(Opcode.CALC_FILE_CRC32, b"/general.json")
    assert struct.unpack("<I", crc.data)[0] == crc32(ftp.read(b"/general.json"))


def test_session_number_of_the_request_is_taken_if_it_is_free(ftp: Ftp) -> None:
    other = Ftp(GroundStation(ftp.station.vehicle, ftp.station.clock, client_id=8))
    assert ftp.ask(Opcode.OPEN_FILE_RO, b"/general.json", session=81).session == 81
    assert other.ask(Opcode.OPEN_FILE_RO, b"/general.json", session=81).session != 81
    assert ftp.ask(Opcode.OPEN_FILE_RO, b"/general.json", session=255).session < 255


def test_clients_keep_their_own_sessions(ftp: Ftp) -> None:
    other = Ftp(GroundStation(ftp.station.vehicle, ftp.station.clock, client_id=8))
    mine = ftp.ask(Opcode.OPEN_FILE_RO, b"/general.json").session
    assert other.ask(Opcode.READ_FILE, session=mine, size=9).data == bytes(
        [FtpError.INVALID_SESSION]
    )
    other.ask(Opcode.RESET_SESSIONS)
    assert ftp.ask(Opcode.READ_FILE, session=mine, size=9).opcode == ACK


def test_sessions_left_open_do_not_shut_others_out(ftp: Ftp) -> None:
    for client_id in range(100, 200):
        client = Ftp(GroundStation(ftp.station.vehicle, ftp.station.clock, client_id=client_id))
        client.ask(Opcode.OPEN_FILE_RO, b"/parameter.json.xz")
        client.send(client.packet(Opcode.BURST_READ_FILE, session=0, size=239))
    assert json.loads(ftp.read(b"/general.json"))
