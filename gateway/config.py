"""The settings file: read from TOML, checked, and written with documentation.

Every section contains the settings of one stage or edge, which its code declares. An invalid file
is rejected with all its errors at once, each with file, key, value and the allowed values.
"""

import errno
import logging
import re
import stat
import textwrap
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import tomlkit

from gateway.aircraft import AircraftSettings
from gateway.estimation.select import EstimationSettings
from gateway.fleet.settings import FleetSettings
from gateway.hub.settings import HubSettings
from gateway.live.serial_port import SerialSettings
from gateway.live.session import RecordingSettings
from gateway.output import PRIVATE, write_new
from gateway.panel.panel_settings import PanelSettings
from gateway.printable import UserError, near_match
from gateway.settings import Field, Settings, fields_of, setting
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.sources.settings import MAX_SOURCES, SourceSettings, parse_source
from gateway.toml_file import TomlError, read_toml, read_toml_text
from gateway.vehicle.vehicle_settings import VehicleSettings

USUAL: Final = (
    "serial.port",
    "hub.endpoints",
    "vehicle.type",
    "vehicle.autopilot",
    "vehicle.armed_when",
    "vehicle.signing_passphrase",
    "vehicle.supply_low_v",
    "estimation.reference.gps_latency_s",
    "estimation.reference.declination_deg",
    "recording.mode",
    "recording.folder",
    "recording.free_floor_mb",
    "panel.enabled",
    "panel.password",
    "panel.units",
)
"""The settings that users change most often, which are in the template."""
COMMENT_WIDTH: Final = 96
VEHICLE_IDS: Final = range(1, 32)
MAX_ERRORS: Final = 20
"""Errors that are listed per file; suggesting a name for each unknown key takes time."""

log = logging.getLogger(__name__)
KINDS: Final = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text in quotes",
    "bool": "true or false",
    "array": "a list in brackets",
    "object": "a table",
}
"""Types that msgspec expected, in the terms of TOML."""


class GatewaySettings(Settings, frozen=True):
    """The settings file: a section for each part, with the defaults of what it lacks."""

    serial: SerialSettings = SerialSettings()
    hub: HubSettings = HubSettings()
    vehicle: VehicleSettings = VehicleSettings()
    estimation: EstimationSettings = EstimationSettings()
    recording: RecordingSettings = RecordingSettings()
    panel: PanelSettings = PanelSettings()
    fleet: FleetSettings = FleetSettings()
    simulator: SimulatorSettings = SimulatorSettings()
    aircraft_folder: Annotated[
        str,
        setting(
            "Folder of the aircraft's own settings: one file each, named by its vehicle id "
            '("1.toml"), with the sections vehicle and estimation of this file and the '
            "calibration of its IMU node. Ground stations and `mavgate calibrate` write it too. "
            'Missions, mark and home are kept in the same folder ("1.plan.json").',
            path=True,
        ),
    ] = "~/.config/mavgate/aircraft"

    sources: Annotated[
        tuple[SourceSettings, ...],
        setting(
            "Sources other than the receiver, each a table [[sources]] with a url: "
            'sources = [{ url = "crsf:/dev/ttyACM0?id=2" }]. docs/sources.md lists them.'
        ),
    ] = ()

    def __post_init__(self) -> None:
        """Reject sources of an unknown kind, or with an unknown option."""
        if len(self.sources) > MAX_SOURCES:
            raise ValueError(f"sources: at most {MAX_SOURCES}")
        if not self.sources:
            return
        # Imported here, as small commands should not wait for the decoders.
        from gateway.sources.kinds import check_source

        for source in self.sources:
            check_source(parse_source(source.url))

    @property
    def has_other_sources(self) -> bool:
        """Whether data can come from sources other than the receiver."""
        return self.hub.has_other_sources or bool(self.sources)

    @property
    def default_aircraft(self) -> AircraftSettings:
        """The settings of an aircraft without a file of its own."""
        return AircraftSettings(vehicle=self.vehicle, estimation=self.estimation)


class ConfigError(UserError):
    """An invalid settings file; the text has a line for each error."""


def load(path: Path) -> GatewaySettings:
    """Read and check a TOML file; absent keys keep their defaults.

    Raises ConfigError if it cannot be read, is not TOML, or has an invalid key, type or value.
    """
    return msgspec.convert(_read(path, GatewaySettings), GatewaySettings)


def load_aircraft(settings: GatewaySettings) -> dict[int, AircraftSettings]:
    """Read the files of all aircraft that have one, by vehicle id; raises ConfigError as `load`."""
    default = msgspec.to_builtins(settings.default_aircraft)
    found, errors = {}, []
    for vehicle_id in VEHICLE_IDS:
        file = aircraft_file(settings, vehicle_id)
        try:
            if file.exists():
                table = _read(file, AircraftSettings)
                found[vehicle_id] = msgspec.convert(_merged(default, table), AircraftSettings)
        except ConfigError as error:
            errors.append(str(error))
    if errors:
        raise ConfigError("\n".join(errors))
    return found


def save_aircraft(settings: GatewaySettings, vehicle_id: int, aircraft: AircraftSettings) -> Path:
    """Write those settings of an aircraft that differ from the settings file.

    Comments and order of an existing file are kept; it is replaced completely or not at all. Raises
    OSError if it cannot be written, or if the existing file is not TOML, which is left unchanged.
    """
    file = aircraft_file(settings, vehicle_id)
    document = _document(file)
    values = msgspec.to_builtins(aircraft)
    try:
        msgspec.convert(values, AircraftSettings)
    except msgspec.ValidationError as error:
        raise OSError(errno.EINVAL, f"would be invalid: {error}", str(file)) from error
    _write_difference(document, msgspec.to_builtins(settings.default_aircraft), values)
    # It may contain a passphrase, so its previous mode does not matter.
    _write_document(file, document, PRIVATE)
    return file


def save_endpoint(file: Path, url: str) -> None:
    """Add an endpoint to a settings file, which is created if it does not exist.

    Comments and order are kept; the file is replaced completely or not at all. Raises ConfigError
    if the file is invalid, with or without this endpoint, and OSError if it cannot be written.
    """
    settings = load(file) if file.exists() else GatewaySettings()
    urls = [*settings.hub.endpoints, url]
    try:
        msgspec.structs.replace(settings.hub, endpoints=tuple(urls))
    except ValueError as error:
        raise ConfigError(f"{file}: {error}") from error
    document = _document(file)
    table = document.setdefault("hub", tomlkit.table())
    if "endpoints" in table:
        table["endpoints"].append(url)
    else:
        table["endpoints"] = urls
    _replace_document(file, document)


def save_values(file: Path, values: Mapping[str, Any]) -> None:
    """Set sections or single values of a settings file; otherwise as `save_endpoint`."""
    document = _document(file)
    for name, value in values.items():
        if isinstance(value, Mapping):
            document.setdefault(name, tomlkit.table()).update(value)
        else:
            document[name] = value
    _replace_document(file, document)


def _replace_document(file: Path, document: Any) -> None:
    # The mode is kept: a service must still be able to read a file that root changed.
    rights = stat.S_IMODE(file.stat().st_mode) if file.exists() else PRIVATE
    _write_document(file, document, rights)


def _document(file: Path) -> Any:
    try:
        return tomlkit.parse(read_toml_text(file) if file.exists() else "")
    except ValueError as error:
        raise OSError(errno.EINVAL, "is not TOML: repair or remove it", str(file)) from error


def _write_document(file: Path, document: Any, rights: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_new(file, [tomlkit.dumps(document).encode()], overwrite=True, rights=rights)


def exposed_secrets(
    file: Path, settings: GatewaySettings, aircraft: Mapping[int, AircraftSettings]
) -> list[str]:
    """Return a warning for each file with a passphrase that other users can read."""
    passphrases = [
        settings.vehicle.signing_passphrase,
        *(s.passphrase for s in settings.fleet.site),
    ]
    files = [file] if any(passphrases) else []
    files += [
        aircraft_file(settings, vehicle_id)
        for vehicle_id, each in aircraft.items()
        if each.vehicle.signing_passphrase
    ]
    return [
        f"{each} has a passphrase, and other users can read it: chmod o-r {each}"
        for each in files
        if each.exists() and each.stat().st_mode & stat.S_IROTH
    ]


def aircraft_file(settings: GatewaySettings, vehicle_id: int) -> Path:
    """Return `ID.toml` in the folder of the aircraft; it exists only if something was stored."""
    return aircraft_folder(settings) / f"{vehicle_id}.toml"


def aircraft_folder(settings: GatewaySettings) -> Path:
    """Return the folder of the aircraft's files."""
    return Path(settings.aircraft_folder).expanduser()


def render(settings: GatewaySettings, keys: Sequence[str] = ("",)) -> str:
    """Return a documented TOML file, with meaning, unit and range of every setting as comments.

    `keys` selects the settings, as `section.name`; each stands for all that begin with it.
    """
    head = _comment(
        "Settings of mavgate. Every key may be left out: its value here is the default. "
        "`mavgate doctor FILE` lists the errors in a file, "
        "`mavgate doctor --template all` shows all settings."
    )
    return "\n".join([*head, *_render_section(settings, "", keys)]) + "\n"


def _read(path: Path, kind: type[Settings]) -> dict[str, Any]:
    try:
        table = read_toml(path)
    except TomlError as error:
        raise ConfigError(f"{path}: {error}") from error
    errors = [f"{path}: {error}" for error in islice(_check(table, kind, ""), MAX_ERRORS)]
    if len(errors) == MAX_ERRORS:
        errors.append(f"{path}: has more errors, which are not listed")
    if errors:
        raise ConfigError("\n".join(errors))
    return table


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            merged[key] = _merged(below, value)
        else:
            merged[key] = value
    return merged


def _write_difference(
    table: MutableMapping[str, Any], default: Mapping[str, Any], value: Mapping[str, Any]
) -> None:
    for key, new in value.items():
        old = default.get(key)
        if new == old:
            table.pop(key, None)
        elif isinstance(new, dict) and isinstance(old, dict):
            _write_difference(table.setdefault(key, tomlkit.table()), old, new)
        else:
            table[key] = new


def _check(table: Mapping[str, Any], kind: type[Settings], prefix: str) -> Iterator[str]:
    fields = {field.name: field for field in fields_of(kind)}
    sound = {}
    for key, value in table.items():
        if errors := list(_check_key(key, value, fields, prefix)):
            yield from errors
        else:
            sound[key] = value
    # Each value is valid by itself; the remaining rules concern several values, or parts of texts.
    try:
        msgspec.convert(sound, kind)
    except msgspec.ValidationError as error:
        for line in str(error).partition(" - at `$")[0].splitlines():
            yield f"{prefix.rstrip('.')}: {line}"


def _check_key(key: str, value: Any, fields: Mapping[str, Field], prefix: str) -> Iterator[str]:
    path, field = f"{prefix}{key}", fields.get(key)
    if field is None:
        yield _unknown_key(path, key, fields)
    elif field.section and isinstance(value, dict):
        yield from _check(value, field.section, f"{path}.")
    else:
        try:
            msgspec.convert(value, field.type)
        except msgspec.ValidationError as error:
            yield _wrong_value(path, value, field, error)
        else:
            yield from _check_path(path, value, field)


def _check_path(path: str, value: Any, field: Field) -> Iterator[str]:
    """Check that a path is possible, and that `~` or `~user` at its start is a home folder."""
    if field.is_path and "\0" in value:
        yield f"{path} = {value!r}: a path cannot contain a zero byte"
    elif field.is_path:
        try:
            Path(value).expanduser()
        except RuntimeError:
            user = value.partition("/")[0]
            yield f"{path} = {value!r}: no user has the home {user}; write the whole path"


def _unknown_key(path: str, key: str, fields: Mapping[str, Field]) -> str:
    known = f"known here: {', '.join(fields)}; a newer mavgate may have it"
    return f"{path}: no such setting; {near_match(key, fields) or known}"


def _wrong_value(path: str, value: Any, field: Field, error: msgspec.ValidationError) -> str:
    reason = f"must be {_wanted(field, str(error))}"
    text = f"{path} = {tomlkit.item(value).as_string()}: {reason}"
    allowed = f"allowed: {', '.join(field.choices)}" if field.choices else ""
    choices = " ".join(filter(None, (near_match(str(value), field.choices), allowed)))
    hint = "; ".join(filter(None, (choices, _uncapital(field.meaning))))
    return f"{text} ({hint})" if hint else text


def _wanted(field: Field, error: str) -> str:
    """Describe the allowed values of a setting, given msgspec's error for another value."""
    if field.choices:
        return "one of the choices"
    if field.range and ("`float`" in error or "`int`" in error):
        return f"{field.range} {field.unit}".rstrip()
    if "matching regex" in error:
        return "as described"
    kind = re.match(r"Expected `(\w+)", error)
    length = re.search(r"of length (\d+)", error)
    wanted = KINDS.get(kind[1], kind[1]) if kind else "as described"
    inside = "a list, each entry " if " - at `$[" in error else ""
    return f"{inside}{wanted}{f' of {length[1]} entries' if length else ''}"


def _uncapital(text: str) -> str:
    # The name of a message keeps its capitals.
    return (text[:1] if text[:2].isupper() else text[:1].lower()) + text[1:].rstrip(".")


def _render_section(settings: Settings, prefix: str, keys: Sequence[str]) -> Iterator[str]:
    for field in fields_of(type(settings)):
        value, path = getattr(settings, field.name), f"{prefix}{field.name}"
        if not isinstance(value, Settings):
            if any(map(path.startswith, keys)):
                yield from _render_key(field, value)
        elif below := [*_render_section(value, f"{path}.", keys)]:
            yield ""
            yield from _comment((type(value).__doc__ or "").strip())
            yield f"[{path}]"
            yield from below


def _render_key(field: Field, value: Any) -> Iterator[str]:
    yield ""
    yield from _comment(field.meaning)
    yield from _comment(_allowed(field))
    if value is None:
        yield f"# {field.name} ="
    else:
        plain = msgspec.to_builtins(value)
        yield f"{field.name} = {_in_toml(plain)}"


def _in_toml(value: Any) -> str:
    """Convert a value to TOML; a list of tables is written inline, one table per line."""
    if isinstance(value, list | tuple) and value and isinstance(value[0], dict):
        tables = []
        for entry in value:
            tables.append(tomlkit.inline_table())
            tables[-1].update(entry)
        return "[\n" + "".join(f"  {table.as_string()},\n" for table in tables) + "]"
    return str(tomlkit.item(value).as_string())


def _allowed(field: Field) -> str:
    allowed = field.range
    if field.choices:
        allowed = "one of " + ", ".join(f'"{choice}"' for choice in field.choices)
    unit = f"Unit: {field.unit}." if field.unit else ""
    return f"{unit} {f'Allowed: {allowed}.' if allowed else ''}".strip()


def _comment(text: str) -> list[str]:
    return [
        f"# {line}"
        for line in textwrap.wrap(" ".join(text.split()), COMMENT_WIDTH, break_on_hyphens=False)
    ]
