"""The settings file: TOML in, one checked tree of settings out, and the documented file back.

Every section is the settings of one stage or edge, declared beside its code. A wrong file is
refused with all its errors at once, each with file, key, value and what is allowed.
"""

import difflib
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import msgspec
import tomlkit

from gateway.edges.serial_link import SerialSettings
from gateway.estimation.select import EstimationSettings
from gateway.routing.settings import HubSettings
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensingSettings
from gateway.settings import Field, Settings, fields_of, setting
from gateway.simulator.settings import SimulatorSettings
from gateway.vehicle.settings import VehicleSettings

COMMENT_WIDTH: Final = 96
VEHICLE_IDS: Final = range(1, 32)

Kind = TypeVar("Kind", bound=Settings)


class GatewaySettings(Settings, frozen=True):
    """All settings of the gateway."""

    serial: SerialSettings = SerialSettings()
    hub: HubSettings = HubSettings()
    vehicle: VehicleSettings = VehicleSettings()
    sensing: SensingSettings = SensingSettings()
    estimation: EstimationSettings = EstimationSettings()
    simulator: SimulatorSettings = SimulatorSettings()
    calibration_folder: Annotated[
        str,
        setting(
            "Folder of the IMU nodes' calibrations, one file an aircraft, named by its id: "
            '"1.toml". An aircraft without a file is taken as ideal.'
        ),
    ] = "~/.config/mavgate/calibration"


class ConfigError(Exception):
    """A settings file that cannot be used; the text has a line for each error."""


def load(path: Path) -> GatewaySettings:
    """Read and check the settings file.

    Parameters
    ----------
    path : Path
        A TOML file; keys that are not there keep their defaults.

    Returns
    -------
    GatewaySettings

    Raises
    ------
    ConfigError
        If the file cannot be read, is no TOML, or has a key, type or value that is not allowed.
    """
    return _load(path, GatewaySettings)


def load_calibrations(folder: Path) -> dict[int, NodeCalibration]:
    """Read the calibrations of all aircraft.

    Parameters
    ----------
    folder : Path
        Holds `1.toml` to `31.toml`, any of them or none.

    Returns
    -------
    dict of int to NodeCalibration
        By vehicle id.

    Raises
    ------
    ConfigError
        As `load`.
    """
    files = {vehicle_id: folder / f"{vehicle_id}.toml" for vehicle_id in VEHICLE_IDS}
    return {
        vehicle_id: _load(file, NodeCalibration)
        for vehicle_id, file in files.items()
        if file.exists()
    }


def render(settings: GatewaySettings) -> str:
    """Write settings as a documented TOML file.

    Parameters
    ----------
    settings : GatewaySettings

    Returns
    -------
    str
        Every setting with its meaning, unit and range as a comment; `load` reads it back equal.
    """
    head = _comment(
        "Settings of mavgate. Every key may be left out: its value here is the default. "
        "`mavgate check-config FILE` tells what is wrong with a file."
    )
    return "\n".join([*head, *_render_section(settings, "")]) + "\n"


def _load(path: Path, kind: type[Kind]) -> Kind:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error
    errors = [f"{path}: {error}" for error in _check(table, kind, "")]
    if errors:
        raise ConfigError("\n".join(errors))
    return msgspec.convert(table, kind)


def _check(table: Mapping[str, Any], kind: type[Settings], prefix: str) -> Iterator[str]:
    fields = {field.name: field for field in fields_of(kind)}
    sound = True
    for key, value in table.items():
        for error in _check_key(key, value, fields, prefix):
            sound = False
            yield error
    if sound:
        # Key by key it is right; what is left is a rule between several keys.
        try:
            msgspec.convert(table, kind)
        except msgspec.ValidationError as error:
            yield f"{prefix.rstrip('.')}: {str(error).partition(' - at `$')[0]}"


def _check_key(key: str, value: Any, fields: Mapping[str, Field], prefix: str) -> Iterator[str]:
    path = f"{prefix}{key}"
    field = fields.get(key)
    if field is None:
        yield _unknown_key(path, key, fields)
    elif field.section and isinstance(value, dict):
        yield from _check(value, field.section, f"{path}.")
    else:
        try:
            msgspec.convert(value, field.type)
        except msgspec.ValidationError as error:
            yield _wrong_value(path, value, field, error)


def _unknown_key(path: str, key: str, fields: Mapping[str, Field]) -> str:
    near = difflib.get_close_matches(key, fields, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else f"; known here: {', '.join(fields)}"
    return f"{path}: no such setting{hint}"


def _wrong_value(path: str, value: Any, field: Field, error: msgspec.ValidationError) -> str:
    text = f"{path} = {tomlkit.item(value).as_string()}: {_uncapital(str(error))}"
    return f"{text} ({_uncapital(field.meaning)})" if field.meaning else text


def _uncapital(text: str) -> str:
    return text[:1].lower() + text[1:].rstrip(".")


def _render_section(settings: Settings, prefix: str) -> Iterator[str]:
    for field in fields_of(type(settings)):
        value = getattr(settings, field.name)
        if isinstance(value, Settings):
            yield ""
            yield from _comment((type(value).__doc__ or "").strip())
            yield f"[{prefix}{field.name}]"
            yield from _render_section(value, f"{prefix}{field.name}.")
        else:
            yield from _render_key(field, value)


def _render_key(field: Field, value: Any) -> Iterator[str]:
    yield ""
    yield from _comment(field.meaning)
    yield from _comment(_allowed(field))
    if value is None:
        yield f"# {field.name} ="
    else:
        plain = msgspec.to_builtins(value)
        yield f"{field.name} = {tomlkit.item(plain).as_string()}"


def _allowed(field: Field) -> str:
    low, high = field.bounds
    if field.choices:
        allowed = "one of " + ", ".join(f'"{choice}"' for choice in field.choices)
    elif low is not None and high is not None:
        allowed = f"{low:.12g} to {high:.12g}"
    elif low is not None:
        allowed = f"{low:.12g} or more"
    else:
        allowed = "" if high is None else f"at most {high:.12g}"
    unit = f"Unit: {field.unit}." if field.unit else ""
    return f"{unit} {f'Allowed: {allowed}.' if allowed else ''}".strip()


def _comment(text: str) -> list[str]:
    return [
        f"# {line}"
        for line in textwrap.wrap(" ".join(text.split()), COMMENT_WIDTH, break_on_hyphens=False)
    ]
