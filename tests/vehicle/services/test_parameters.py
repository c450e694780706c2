import math
import operator
import re
import struct
from typing import Annotated

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.config import GatewaySettings
from gateway.records import RECORDED_ONLY
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Settings, fields_of, setting
from gateway.vehicle.request_reader import NOT_TRUSTED
from gateway.vehicle.service import SaveSettings, SettingsChange
from gateway.vehicle.services.parameters import ParameterTable, parameter_name
from gateway.vehicle.vehicle_settings import RateSettings, VehicleSettings
from tests.kit.ground_station import GroundStation, kinds, load_parameters, of_kind, results, texts

PARAM_VALUE = mavlink.MAVLINK_MSG_ID_PARAM_VALUE
STORAGE = mavlink.MAV_CMD_PREFLIGHT_STORAGE
UNKNOWN = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST


def read(name: str, index: int = -1) -> mavlink.MAVLink_param_request_read_message:
    return mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), index)


@pytest.mark.parametrize(
    ("section", "key", "axis", "name"),
    [
        ("paper", "alpha_gyro", "", "PAPER_ALPHA_GYRO"),
        ("rates", "attitude_quaternion", "", "RATE_ATT_QUAT"),
        ("rates", "global_position_int", "", "RATE_GLB_POS_INT"),
        ("calibration", "mag_hard_iron", "X", "CAL_MG_HRD_IRN_X"),
        ("estimation", "estimator", "", "EST_ESTIMATOR"),
        ("alpha", "alpha", "", "ALPHA"),
        ("compass", "norm_tolerance", "", "COMPASS_NORM_TOL"),
    ],
)
def test_parameter_name_is_abbreviated_keys(section: str, key: str, axis: str, name: str) -> None:
    assert parameter_name(section, key, axis) == name


def test_list_contains_numbers_switches_and_choices_but_no_texts(station: GroundStation) -> None:
    found = load_parameters(station)
    names = ("CUTOFF", "ORDER", "ENABLED", "BIAS_X", "BIAS_Y", "BIAS_Z")
    assert [found[f"TUNING_{name}"] for name in names] == [10.0, 2.0, 1.0, 0.0, 1.0, 2.0]
    assert (found["INNER_ALPHA_GYRO"], found["RATE_ATT_QUAT"]) == (0.75, 50.0)
    assert found["VEH_TYPE"] == 1.0, "a choice is its number in the list"
    assert not any("SHAPE" in name or "PASS" in name for name in found), "texts are none"


@pytest.mark.parametrize(
    ("name", "sent", "path", "stored"),
    [
        ("TUNING_CUTOFF", 12.5, "cutoff_hz", 12.5),
        ("TUNING_CUTOFF", struct.unpack("<f", struct.pack("<f", 0.1))[0], "cutoff_hz", 0.1),
        ("TUNING_ORDER", 4.0, "order", 4),
        ("TUNING_ENABLED", 0.0, "enabled", False),
        ("TUNING_BIAS_Y", -3.5, "bias_mps2", (0.0, -3.5, 2.0)),
        ("INNER_ALPHA_GYRO", 0.5, "inner.alpha_gyro", 0.5),
    ],
)
def test_change_takes_effect_and_is_sent_to_every_client_that_requested_parameters(
    station: GroundStation, name: str, sent: float, path: str, stored: object
) -> None:
    other = station.other()
    other.send(read("TUNING_ORDER"))
    [value] = station.set_parameter(name, sent)
    assert value.param_value == pytest.approx(sent)
    assert [frame.client_id for frame in station.frames] == [8, 7]
    [change] = station.of(SettingsChange)
    assert change.section == "tuning"
    assert operator.attrgetter(path)(change.settings) == stored
    assert load_parameters(other)[name] == pytest.approx(sent)


def test_change_is_only_recorded_before_a_client_asks_for_any(station: GroundStation) -> None:
    """QGroundControl takes any PARAM_VALUE for the beginning of the list that it requested."""
    found = station.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 47.5, 8.5, 500.0)
    assert "PARAM_VALUE" not in kinds(found)
    pushed = [f.client_id for f in station.frames if f.message_id == PARAM_VALUE]
    assert pushed == [RECORDED_ONLY] * 4


def test_change_is_not_sent_to_a_removed_client(station: GroundStation) -> None:
    station.send(read("TUNING_ORDER"))
    station.vehicle.remove_client(station.client_id)
    changed = VehicleSettings(takeoff_speed_mps=7.0)
    assert station.receive(station.vehicle.apply_settings("vehicle", changed)) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("TUNING_CUTOFF", value) for value in (0.0, 1e9, math.nan, math.inf)),
        *(("TUNING_ORDER", 9.0), ("VEH_TYPE", 99.0), ("VEH_TYPE", -1.0)),
        *(("HOME_LAT", 90.1), ("HOME_LON", -180.1), ("HOME_ALT", 1e6), ("HOME_SOURCE", 3.0)),
    ],
)
def test_value_out_of_range_is_refused(station: GroundStation, name: str, value: float) -> None:
    before = load_parameters(station)
    error, answer = station.set_parameter(name, value)
    assert (answer.param_id, answer.param_value) == (name, pytest.approx(before[name]))
    refused = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    assert (error.get_type(), error.error) == ("PARAM_ERROR", refused)
    assert station.of(SettingsChange) == []
    assert load_parameters(station) == before


@pytest.mark.parametrize(("form", "code"), [("INT32", "<i"), ("UINT8", "<Bxxx"), ("INT16", "<hxx")])
def test_integers_encoded_bytewise_are_read(station: GroundStation, form: str, code: str) -> None:
    kind = getattr(mavlink, f"MAV_PARAM_TYPE_{form}")
    [encoded] = struct.unpack("<f", struct.pack(code, 5))
    [value] = station.set_parameter("TUNING_ORDER", encoded, kind)
    assert value.param_value == 5.0
    assert load_parameters(station)["TUNING_ORDER"] == 5.0


def test_untrusted_client_changes_nothing_and_is_reported(station: GroundStation) -> None:
    station.trusted = False
    found = station.set_parameter("TUNING_ORDER", 5.0)
    assert kinds(found[:3]) == ["PARAM_ERROR", "PARAM_VALUE", "STATUSTEXT"]
    denied = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED
    assert (found[0].error, found[1].param_value) == (denied, 2.0)
    assert texts(found) == [f"Refused PARAM_SET of system 255: {NOT_TRUSTED}"]
    assert station.vehicle.refusals == 1
    assert station.of(SettingsChange) == []
    assert load_parameters(station)["TUNING_ORDER"] == 2.0, "reading is free"


@pytest.mark.parametrize(
    ("stored", "text", "result", "reported"),
    [
        (True, "1.toml", mavlink.MAV_RESULT_ACCEPTED, "Settings saved: 1.toml"),
        (False, "disk full", mavlink.MAV_RESULT_FAILED, "Settings not saved: disk full"),
    ],
)
def test_storage_is_acknowledged_when_the_disk_has_answered(
    station: GroundStation, stored: bool, text: str, result: int, reported: str
) -> None:
    station.set_parameter("TUNING_ORDER", 5.0)
    assert station.of(SaveSettings) == []
    assert results(station.command(STORAGE, 1)) == [mavlink.MAV_RESULT_IN_PROGRESS]
    [save] = station.of(SaveSettings)
    found = station.receive(station.vehicle.on_saved(save.request, text, 0, stored=stored))
    assert kinds(found) == ["COMMAND_ACK", "STATUSTEXT"]
    assert (found[0].command, found[0].result) == (STORAGE, result)
    assert (found[0].target_system, found[1].text) == (255, reported)
    assert station.frames[-2].client_id == station.client_id, "only who asked"


def test_storage_command_restores_the_defaults(station: GroundStation) -> None:
    station.set_parameter("TUNING_ORDER", 5.0)
    station.set_parameter("RATE_ATT", 1.0)
    assert station.vehicle.telemetry.streams[30].interval_us == 1_000_000, "at once"
    station.set_parameter("VEH_TYPE", 2.0)
    [_, beat] = station.request(0)
    assert beat.type == mavlink.MAV_TYPE_QUADROTOR
    found = of_kind(station.command(STORAGE, 2), "PARAM_VALUE")
    assert {m.param_id: m.param_value for m in found} == {
        "TUNING_ORDER": 2.0, "RATE_ATT": 50.0, "VEH_TYPE": 1.0,
    }  # fmt: skip
    assert station.vehicle.telemetry.streams[30].interval_us == 20_000
    assert results(station.command(STORAGE, 0)) == [mavlink.MAV_RESULT_UNSUPPORTED]


def test_defaults_do_not_change_settings_that_are_no_parameters() -> None:
    settings = VehicleSettings(signing_passphrase="correct horse", node_silent_s=9.0)
    found = ParameterTable({"vehicle": settings}).reset("vehicle")
    assert found == VehicleSettings(signing_passphrase="correct horse")


def test_vehicles_share_one_list_of_parameters() -> None:
    first, second = (ParameterTable({"vehicle": VehicleSettings()}) for _ in range(2))
    assert first.parameters is second.parameters
    first.change(first.parameters["RATE_ATT"], 7.0)
    assert second.sections == {"vehicle": VehicleSettings()}


def test_two_settings_of_one_name_raise_value_error() -> None:
    class Twice(Settings, frozen=True):
        """Two keys that differ beyond sixteen characters."""

        bcdfghjklmnpqrstvwx: Annotated[float, setting("One.")] = 0.0
        bcdfghjklmnpqrstvwz: Annotated[float, setting("Two.")] = 0.0

    with pytest.raises(ValueError, match="used twice"):
        ParameterTable({"twice": Twice()})


def test_every_rate_is_named_as_its_message() -> None:
    for field in RateSettings.__struct_fields__:
        assert hasattr(mavlink, f"MAVLINK_MSG_ID_{field.removesuffix('_hz').upper()}")


def test_every_setting_of_the_gateway_has_a_readable_parameter_name() -> None:
    settings = GatewaySettings().default_aircraft
    table = ParameterTable({name: getattr(settings, name) for name in settings.__struct_fields__})
    known = {"PAPER_ALPHA_ACC", "PAPER_BETA_VEL", "PAPER_ACC_CUTOFF", "REF_GPS_LATENCY"}
    assert known <= set(table.parameters)
    for name, parameter in table.parameters.items():
        assert re.fullmatch(r"[A-Z][A-Z0-9_]{1,15}", name)
        default = parameter.to_number(parameter.field.default)
        assert table.number(parameter) == pytest.approx(default), "within its own range"
        assert parameter.field.meaning, name


def test_mounting_angle_is_described_by_the_first_sentence_of_the_mounting() -> None:
    table = ParameterTable({"calibration": NodeCalibration()})
    meaning = table.parameters["CAL_MNT_ROLL"].field.meaning
    reported = {f.name: f.meaning for f in fields_of(NodeCalibration)}["mounting"].split(". ")[0]
    assert f" of the {reported[0].lower()}{reported[1:]}. Yaw is turned first" in meaning
