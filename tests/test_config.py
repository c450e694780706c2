"""The settings file: strict in, documented out."""

from pathlib import Path

import msgspec
import pytest

from gateway.config import (
    ConfigError,
    GatewaySettings,
    load,
    load_calibrations,
    render,
)
from gateway.settings import Field, Settings, fields_of

ROOT = Path(__file__).resolve().parent.parent


def all_fields(kind: type[Settings], prefix: str = "") -> list[tuple[str, Field]]:
    found = []
    for field in fields_of(kind):
        if field.section:
            found += all_fields(field.section, f"{prefix}{field.name}.")
        else:
            found.append((f"{prefix}{field.name}", field))
    return found


FIELDS = all_fields(GatewaySettings)


def test_documented_file_is_the_defaults(tmp_path: Path) -> None:
    """config/gateway.toml shows every setting; `mavgate check-config` writes it."""
    assert (ROOT / "config" / "gateway.toml").read_text() == render(GatewaySettings())
    assert load(ROOT / "config" / "gateway.toml") == GatewaySettings()


@pytest.mark.parametrize(("path", "field"), FIELDS, ids=[path for path, _ in FIELDS])
def test_every_setting_is_explained(path: str, field: Field) -> None:
    assert len(field.meaning) > 10
    number = isinstance(field.default, int | float) and not isinstance(field.default, bool)
    if number:
        assert None not in field.bounds, "a number needs a range"
    suffixes = {"_hz": "Hz", "_s": "s", "_m": "m", "_mps": "m/s", "_deg": "deg", "_us": "us"}
    for suffix, unit in suffixes.items():
        if number and path.endswith(suffix):
            assert field.unit == unit


def test_empty_file_is_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "empty.toml"
    file.write_text("")
    assert load(file) == GatewaySettings()


def test_changed_settings_survive_the_round_trip(tmp_path: Path) -> None:
    settings = GatewaySettings()
    serial = msgspec.structs.replace(settings.serial, port="usb:1a86:7523", baud=1_000_000)
    rates = msgspec.structs.replace(settings.vehicle.rates, attitude_hz=12.5)
    vehicle = msgspec.structs.replace(settings.vehicle, rates=rates, type="quadrotor")
    settings = msgspec.structs.replace(settings, serial=serial, vehicle=vehicle)
    file = tmp_path / "changed.toml"
    file.write_text(render(settings))
    assert load(file) == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[serial]\nbaud = 300", "serial.baud = 300: expected `int` >= 9600 (speed of the line"),
        ('[serial]\nbaud = "fast"', 'serial.baud = "fast": expected `int`, got `str`'),
        ("[serial]\nbauds = 9600", "serial.bauds: no such setting; did you mean 'baud'?"),
        ("[serial]\nzzz = 1", "serial.zzz: no such setting; known here: port, baud"),
        ("[serail]", "serail: no such setting; did you mean 'serial'?"),
        ("serial = 3", "serial = 3: expected"),
        ('[serial]\nport = "ttyUSB0"', 'serial.port = "ttyUSB0": expected `str` matching'),
        ("[vehicle.rates]\nattitude_hz = -1", "vehicle.rates.attitude_hz = -1: expected `float`"),
        ('[vehicle]\ntype = "ufo"', 'vehicle.type = "ufo": invalid enum value'),
        ('[hub]\nendpoints = ["udp:"]', "hub: endpoint 'udp:'"),
        ("[serial\n", "is not valid TOML"),
    ],
)
def test_refusals_name_file_key_value_and_what_is_allowed(
    text: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert message in str(caught.value)


def test_all_errors_are_told_at_once(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text("[serial]\nbaud = 1\nport = 2\n[vehicle]\nnope = 3\n")
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert len(str(caught.value).splitlines()) == 3


def test_missing_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "missing.toml")
    file = tmp_path / "latin.toml"
    file.write_bytes(b'port = "\xff"')
    with pytest.raises(ConfigError, match="cannot be read"):
        load(file)


def test_calibrations_are_found_by_vehicle_id(tmp_path: Path) -> None:
    (tmp_path / "3.toml").write_text("gyro_bias_radps = [0.1, 0.0, -0.1]\n")
    (tmp_path / "99.toml").write_text("nonsense")
    calibrations = load_calibrations(tmp_path)
    assert list(calibrations) == [3]
    assert calibrations[3].gyro_bias_radps == (0.1, 0.0, -0.1)
    assert load_calibrations(tmp_path / "missing") == {}
