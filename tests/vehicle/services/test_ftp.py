"""MAVLink FTP as its page has it: reading, refusing, repeating; and the files that are there."""

import json
import lzma
import struct

import numpy as np
import pytest
from MAVProxy.modules.lib.param_ftp import ftp_param_decode

from gateway.aircraft import AircraftSettings
from gateway.vehicle.services.ftp import ACK, MAX_SESSIONS, NAK, FtpError, Opcode, Packet, crc32
from gateway.vehicle.services.parameters import PARAMETER_PATH, Metadata, ParameterTable
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import FtpClient, GroundStation, load_parameters

GENERAL = b"/general.json"
KEYS = {
    "name", "type", "shortDesc", "longDesc", "units", "default", "decimalPlaces", "min", "max",
    "increment", "rebootRequired", "group", "category", "volatile", "values", "bitmask",
}  # fmt: skip
"""Of the schema of metadata of parameters."""


@pytest.fixture
def ftp(station: GroundStation) -> FtpClient:
    return FtpClient(station)


def refusal(answer: Packet) -> FtpError:
    assert (answer.opcode, answer.size) == (NAK, 1)
    return FtpError(answer.data[0])


@pytest.mark.parametrize("loss", [0.0, 0.25])
def test_metadata_is_announced_and_describes_every_parameter(ftp: FtpClient, loss: float) -> None:
    _, announced = ftp.station.request(397)
    file_crc, uri = struct.unpack("<I100s", announced.payload[4:108])
    assert uri.rstrip(b"\0") == b"mftp:///general-1.json"
    rng = np.random.default_rng(4)
    ftp.station.loses = lambda *_: rng.random() < loss
    general = ftp.read(b"/general-1.json")
    assert ftp.read(GENERAL) == general
    assert crc32(general) == file_crc
    [kind] = json.loads(general)["metadataTypes"]
    assert (kind["type"], kind["uri"]) == (1, "mftp:///parameter-1.json.xz")
    described = ftp.read(b"/parameter-1.json.xz")
    assert crc32(described) == kind["fileCrc"]
    ftp.station.loses = lambda *_: False
    parameters = {p["name"]: p for p in json.loads(lzma.decompress(described))["parameters"]}
    assert set(parameters) == set(load_parameters(ftp.station))
    for parameter in parameters.values():
        assert set(parameter) <= KEYS
        assert parameter["type"] == ("Int32" if "values" in parameter else parameter["type"])
        assert len(parameter["name"]) <= 16
        assert all(len(each["description"]) <= 100 for each in parameter.get("values", ()))
    cutoff = parameters["TUNING_CUTOFF"]
    assert (cutoff["min"], cutoff["max"], cutoff["units"]) == (0.1, 500, "Hz")
    assert (cutoff["default"], cutoff["decimalPlaces"]) == (10.0, 4)
    assert [v["description"] for v in parameters["TUNING_ENABLED"]["values"]] == ["off", "on"]
    assert parameters["VEH_TYPE"]["values"][1] == {"value": 1, "description": "fixed_wing"}
    integers = ("VEH_TYPE", "TUNING_ENABLED", "TUNING_ORDER")
    assert {parameters[name]["type"] for name in integers} == {"Int32"}
    assert [parameters[name]["decimalPlaces"] for name in ("HOME_LAT", "HOME_LON")] == [7, 7]


def test_vehicles_announce_files_of_different_names(clock: ManualClock) -> None:
    """QGroundControl downloads the files of all vehicles to one folder."""
    uris = []
    for system_id in (1, 2):
        station = GroundStation(Vehicle(VehicleSettings(), system_id), clock)
        ftp = FtpClient(station)
        [_, announced] = station.request(397)
        uris.append(announced.payload[8:108].rstrip(b"\0"))
        uris += [kind["uri"] for kind in json.loads(ftp.read(uris[-1]))["metadataTypes"]]
    assert len(set(uris)) == 4


def test_parameter_metadata_of_the_gateway_is_small() -> None:
    """A radio of 57600 baud carries about 140 bytes of a file in 60 ms."""
    settings = AircraftSettings()
    table = ParameterTable({name: getattr(settings, name) for name in settings.__struct_fields__})
    content = Metadata(table, 1).files[PARAMETER_PATH]
    assert len(content) < 8_000 < 30_000 < len(lzma.decompress(content))


@pytest.mark.parametrize(
    "root",
    [
        *("/", "//", "///", "", "/./", "mftp:///", "mftp://", "mftp://;comp=1/"),
        *("mftp://[;comp=1]/", "MFTP:///"),
    ],
)
def test_file_is_opened_by_every_form_of_its_path(ftp: FtpClient, root: str) -> None:
    assert ftp.open(f"{root}general.json".encode()).opcode == ACK


@pytest.mark.parametrize("path", [b"/", b"", b".", b"//", b"/.", b"./"])
def test_root_folder_is_listed_by_every_form_of_its_path(ftp: FtpClient, path: bytes) -> None:
    listed = ftp.ask(Opcode.LIST_DIRECTORY, path)
    names = [entry.split(b"\t")[0] for entry in listed.data.split(b"\0") if entry]
    wanted = b"general-1.json general.json parameter-1.json.xz parameter.json.xz"
    assert names == [b"F" + name for name in wanted.split()]
    assert refusal(ftp.ask(Opcode.LIST_DIRECTORY, path, offset=4)) == FtpError.EOF


def test_packed_parameters_are_decoded_by_mavproxy(ftp: FtpClient) -> None:
    """MAVProxy and Mission Planner load the parameters by this file."""
    wanted = load_parameters(ftp.station)
    ftp.station.set_parameter("TUNING_CUTOFF", 12.5)
    for query in (b"", b"?withdefaults=1"):
        found = ftp_param_decode(ftp.read(b"@PARAM/param.pck" + query))
        values_of = {name.decode(): value for name, value, _ in found.params}
        assert values_of == pytest.approx(wanted | {"TUNING_CUTOFF": 12.5})
    defaults = {name.decode(): value for name, value, _ in found.defaults}
    assert defaults["TUNING_CUTOFF"] == 10.0
    assert b"Fparam.pck" in ftp.ask(Opcode.LIST_DIRECTORY, b"@PARAM").data


def test_client_that_read_the_packed_parameters_is_sent_changes(ftp: FtpClient) -> None:
    ftp.read(b"@PARAM/param.pck")
    changed = VehicleSettings(takeoff_speed_mps=7.0)
    [value] = ftp.station.receive(ftp.station.vehicle.apply_settings("vehicle", changed))
    assert (value.param_id, value.param_value) == ("VEH_TKOFF_SPEED", 7.0)


def test_crc_of_a_file_is_that_of_mavlink_ftp(ftp: FtpClient) -> None:
    """CRC-32 of the Ethernet polynomial, started at 0 and not inverted at the end."""
    content = ftp.read(GENERAL)
    expected = 0
    for byte in content:
        expected ^= byte
        for _ in range(8):
            expected = expected >> 1 ^ (0xEDB88320 if expected & 1 else 0)
    assert struct.unpack("<I", ftp.ask(Opcode.CALC_FILE_CRC32, GENERAL).data) == (expected,)
    assert crc32(b"") == 0


@pytest.mark.parametrize(
    "path", [b"@SYS/threads.txt", b"@PARAM", b"/../general.json", b"/general.json/x", b"/general"]
)
def test_missing_path_is_refused_with_session_and_opcode(ftp: FtpClient, path: bytes) -> None:
    """A client without an answer repeats its request for a quarter of a minute."""
    request = ftp.packet(Opcode.OPEN_FILE_RO, path, session=5)
    [answer] = ftp.send(request)
    error = bytes([FtpError.FILE_NOT_FOUND])
    assert answer == Packet(request.sequence + 1, 5, NAK, 1, Opcode.OPEN_FILE_RO, 0, 0, error)


@pytest.mark.parametrize(
    ("opcode", "error"),
    [
        *((opcode, FtpError.FILE_PROTECTED) for opcode in range(6, 14)),
        (Opcode.READ_FILE, FtpError.INVALID_SESSION),
        (Opcode.BURST_READ_FILE, FtpError.INVALID_SESSION),
        (Opcode.TERMINATE_SESSION, FtpError.INVALID_SESSION),
        (Opcode.CALC_FILE_CRC32, FtpError.FILE_NOT_FOUND),
        (Opcode.LIST_DIRECTORY, FtpError.FILE_NOT_FOUND),
        (99, FtpError.UNKNOWN_COMMAND),
        (128, FtpError.UNKNOWN_COMMAND),
    ],
)
def test_unsupported_request_has_its_error(ftp: FtpClient, opcode: int, error: FtpError) -> None:
    answer = ftp.ask(opcode, b"/x", session=3)
    assert (refusal(answer), answer.request_opcode, answer.session) == (error, opcode, 3)


def test_repeated_request_gets_the_same_answer(ftp: FtpClient) -> None:
    assert [ftp.ask(each).opcode for each in (Opcode.NONE, Opcode.RESET_SESSIONS)] == [ACK, ACK]
    request = ftp.packet(Opcode.OPEN_FILE_RO, GENERAL)
    [first] = ftp.send(request)
    assert ftp.send(request) == [first]
    assert ftp.open(GENERAL).session == first.session + 1


def test_read_ends_at_the_end_of_the_file_and_is_refused_beyond(ftp: FtpClient) -> None:
    opened = ftp.open(GENERAL)
    size = struct.unpack("<I", opened.data)[0]
    last = ftp.ask(Opcode.READ_FILE, session=opened.session, offset=size - 5, size=239)
    assert last.size == 5
    for opcode in (Opcode.READ_FILE, Opcode.BURST_READ_FILE):
        beyond = ftp.ask(opcode, session=opened.session, offset=size, size=239)
        assert refusal(beyond) == FtpError.EOF


def test_clients_keep_their_own_sessions(ftp: FtpClient) -> None:
    other = FtpClient(ftp.station.other())
    assert ftp.open(GENERAL, session=81).session == 81, "MAVProxy requires its own number"
    assert other.open(GENERAL, session=81).session != 81
    assert ftp.open(GENERAL, session=255).session < 255
    stolen = other.ask(Opcode.READ_FILE, session=81, size=9)
    assert refusal(stolen) == FtpError.INVALID_SESSION
    other.ask(Opcode.RESET_SESSIONS)
    assert ftp.ask(Opcode.READ_FILE, session=81, size=9).opcode == ACK


def test_sessions_left_open_by_others_do_not_prevent_a_new_one(ftp: FtpClient) -> None:
    for client in (FtpClient(ftp.station.other(number)) for number in range(100, 200)):
        client.open(b"/parameter.json.xz")
        client.send(client.packet(Opcode.BURST_READ_FILE, session=0, size=239))
    assert json.loads(ftp.read(GENERAL))


def test_sessions_of_an_untrusted_client_close_no_others(ftp: FtpClient) -> None:
    session = ftp.open(GENERAL).session
    untrusted = FtpClient(ftp.station.other(trusted=False))
    for _ in range(100):
        assert untrusted.open(b"/parameter.json.xz").opcode == ACK
    assert ftp.ask(Opcode.READ_FILE, session=session, size=9).opcode == ACK


def test_untrusted_sessions_give_way_to_a_trusted_client(ftp: FtpClient) -> None:
    untrusted = [FtpClient(ftp.station.other(100 + n, trusted=False)) for n in range(65)]
    opened = [each.open(GENERAL).opcode for each in untrusted[:64] for _ in range(4)]
    assert opened == [ACK] * MAX_SESSIONS + [NAK]
    assert refusal(untrusted[64].open(GENERAL)) == FtpError.NO_SESSIONS
    assert ftp.open(GENERAL).opcode == ACK
