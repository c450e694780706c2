"""The settings as MAVLink parameters: names, numbers, one change at a time, files for clients.

Every parameter is sent as MAV_PARAM_TYPE_REAL32, switches and choices too (0, 1, 2 ...): a float
is the only encoding on which the clients agree, since MAVProxy decodes byte-wise integers only for
PX4. An integer that a client encodes byte-wise is understood all the same.

A name has at most 16 characters and is made from the settings' own keys: `paper.alpha_gyro` becomes
PAPER_ALPHA_GYRO and `rates.attitude_quaternion_hz` RATE_ATT_QUAT. The unit is left out (it is in
the metadata), long words have fixed abbreviations, and a name that is still too long loses vowels
after its first word. It depends on the section's keys alone, so that other settings may be added
or removed without changing it.

The component metadata describes the meaning, unit and range of each parameter as JSON [1]_. The
file is compressed by xz, as the specification allows: 6 kB in place of 40 kB, which takes a 57600
baud radio 2 s in place of 10 s.

References
----------
.. [1] https://mavlink.io/en/services/component_metadata.html
"""

import json
import lzma
import math
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import takewhile
from types import MappingProxyType
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.geometry.rotation import Matrix3, euler_deg_from_matrix, matrix_from_euler_deg
from gateway.records import Vec3
from gateway.settings import Field, Settings, fields_of
from gateway.vehicle.encoding import MessagePacker
from gateway.vehicle.services.ftp import crc32
from gateway.vehicle.telemetry.messages import boot_ms
from gateway.wire import mavlink_messages

COMPONENT_METADATA: Final = MessagePacker(mavlink_messages.COMPONENT_METADATA)
MAX_NAME: Final = 16

UNITS: Final = frozenset(
    {
        "hz", "s", "ms", "us", "m", "mps", "mps2", "rad", "radps", "deg", "dps", "ut", "db", "pa",
        "hpa", "g", "percent", "ppm", "degc", "degps", "degprs", "degpsprs", "mprs", "mpsprs",
        "mps2prs", "utprs",
    }
)  # fmt: skip

ABBREVIATIONS: Final = {
    "accel": "ACC", "accuracy": "ACCUR", "altitude": "ALT", "attitude": "ATT",
    "calibration": "CAL", "chebyshev": "CHEB", "controller": "CTRL", "declination": "DECL",
    "estimation": "EST", "extended": "EXT", "heading": "HDG", "height": "HGT", "highpass": "HP",
    "highres": "HR", "lowpass": "LP", "mission": "MIS", "mounting": "MNT", "nominal": "NOM",
    "position": "POS", "pressure": "PRES", "quaternion": "QUAT", "rates": "RATE",
    "reference": "REF", "satellites": "SATS", "scaled": "SCAL", "status": "STAT", "system": "SYS",
    "takeoff": "TKOFF", "tolerance": "TOL", "vehicle": "VEH", "velocity": "VEL",
}  # fmt: skip
VOWELS: Final = frozenset("AEIOU")
AXES: Final = ("X", "Y", "Z")
ANGLES: Final = (("ROLL", "Roll", 180.0), ("PIT", "Pitch", 90.0), ("YAW", "Yaw", 180.0))
"""The angles of a rotation: in names, in texts, and the limit of each to either side, deg."""
RotationAngles = tuple[
    Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)],
    Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)],
    Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)],
]
PACKED: Final = 0x671B
PACKED_WITH_DEFAULTS: Final = 0x671C
PACKED_FLOAT: Final = 4
PACKED_COMMON: Final = 15
"""Magic numbers, type and longest shared name of the packed file."""
INTEGER_CODES: Final = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<Bxxx",
    mavlink.MAV_PARAM_TYPE_INT8: "<bxxx",
    mavlink.MAV_PARAM_TYPE_UINT16: "<Hxx",
    mavlink.MAV_PARAM_TYPE_INT16: "<hxx",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}
GENERAL_PATH: Final = "/general.json"
PARAMETER_PATH: Final = "/parameter.json.xz"
"""Path for programs with fixed paths. Each vehicle announces its own paths, since programs store
a download under its name: two vehicles would overwrite each other's file."""
MAX_SHORT: Final = 100
"""Length of a short description in the specification's schema."""
POSITION_PLACES: Final = 7
PLACES: Final = 4
"""Decimal places shown of a latitude or longitude, and of other numbers."""


def without_unit(key: str) -> str:
    """Remove the unit from a key."""
    head, _, tail = key.rpartition("_")
    return head if head and tail in UNITS else key


@cache
def parameter_name(section: str, key: str, axis: str = "") -> str:
    """Name the parameter of a key in its innermost section."""
    words = key.split("_")
    # A key that begins with the name of its section does not repeat it.
    if words[0] != section:
        words.insert(0, section)
    short = [ABBREVIATIONS.get(word, word.upper()) for word in words]
    room = MAX_NAME - (len(axis) + 1 if axis else 0)
    while len("_".join(short)) > room:
        # The first word is not shortened: ground stations group parameters by it.
        longest = max(range(1, len(short)), key=lambda index: len(short[index]))
        word = short[longest]
        # Its last vowel, or else its last letter, is removed.
        last = max((n for n in range(1, len(word)) if word[n] in VOWELS), default=len(word) - 1)
        short[longest] = word[:last] + word[last + 1 :]
    return "_".join([*short, axis] if axis else short)


def decode_value(value: float, kind: int) -> float:
    """Undo the byte-wise encoding of the value of a message, whose MAV_PARAM_TYPE is `kind`.

    The result is the shortest decimal that is the same 32-bit float: 0.1, not 0.10000000149.
    """
    code = INTEGER_CODES.get(kind)
    if code is not None:
        return float(struct.unpack(code, struct.pack("<f", value))[0])
    return float(str(np.float32(value)))


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of the settings."""

    name: str
    section: str
    """Key of the tree of settings that contains it."""
    path: tuple[str, ...]
    """Keys within that tree."""
    axis: int | None
    """Component of a vector; of a rotation: roll, pitch or yaw."""
    field: Field
    """The setting; for a rotation, with angles instead of the matrix."""
    index: int = 0
    """Its number among the parameters of its table."""

    def to_number(self, value: Any) -> float:
        """Convert the setting's value to the parameter's."""
        if self.field.choices:
            return float(self.field.choices.index(value))
        return float(value if self.axis is None else value[self.axis])

    def from_number(self, number: float, old: Any) -> Any:
        """Convert a parameter's value to the setting's, or raise ValueError."""
        if not math.isfinite(number):
            raise ValueError("not a number")
        value: Any = number
        if self.field.choices:
            if round(number) not in range(len(self.field.choices)):
                raise ValueError(f"there is no choice {number:.0f}")
            value = self.field.choices[round(number)]
        elif self.axis is not None:
            value = tuple(number if n == self.axis else v for n, v in enumerate(old))
        elif isinstance(self.field.default, bool):
            value = bool(number)
        elif isinstance(self.field.default, int):
            value = round(number)
        return msgspec.convert(value, self.field.type)


class ParameterTable:
    """All parameters of one vehicle, in an order that never changes.

    The sections are the trees of settings that may be changed live, by key.
    """

    def __init__(self, sections: Mapping[str, Settings]) -> None:
        self.sections = dict(sections)
        self.kinds = tuple((key, type(tree)) for key, tree in sections.items())
        self.parameters = parameters_of(self.kinds)
        """Parameters by name, in their order."""
        # The angles as they were set: the matrix alone would give others if the pitch is a right
        # angle, or while only some of the three are set.
        self._angles: dict[tuple[str, ...], tuple[Matrix3, Vec3]] = {}

    def number(self, parameter: Parameter) -> float:
        """Read a parameter."""
        return parameter.to_number(self._value(parameter))

    def change(self, parameter: Parameter, number: float) -> Settings:
        """Write a parameter, or raise ValueError and change nothing if it is not allowed."""
        value = parameter.from_number(number, self._value(parameter))
        if parameter.field.is_rotation:
            angles, value = value, matrix_from_euler_deg(value)
            self._angles[(parameter.section, *parameter.path)] = value, angles
        tree = _replaced(self.sections[parameter.section], parameter.path, value)
        self.sections[parameter.section] = tree
        return tree

    def reset(self, section: str) -> Settings:
        """Set every parameter of a tree to its default; other settings stay as they are."""
        for parameter in self.parameters.values():
            if parameter.section == section:
                self.change(parameter, parameter.to_number(parameter.field.default))
        return self.sections[section]

    def _value(self, parameter: Parameter) -> Any:
        value: Any = self.sections[parameter.section]
        for key in parameter.path:
            value = getattr(value, key)
        if not parameter.field.is_rotation:
            return value
        matrix, angles = self._angles.get((parameter.section, *parameter.path), (None, None))
        return angles if matrix == value else euler_deg_from_matrix(value)


def packed_parameters(table: ParameterTable, query: str) -> bytes:
    """Pack parameters as ArduPilot's file `@PARAM/param.pck`.

    A header of magic, count and total, then for each parameter: its type in the lower and a flag
    for a default in the upper four bits; how many characters its name shares with the one before
    in the lower, and the number of others less one in the upper four bits; the other characters;
    the value; the default, if the flag is set. The padding at block boundaries in [1]_ is left
    out: it protects against values that change between two reads, and here the content of a file is
    fixed when it is opened. In the query, `withdefaults=1` adds the defaults.

    References
    ----------
    .. [1] ArduPilot, libraries/AP_Filesystem/README.md, "The @PARAM VFS"
    """
    with_defaults = "withdefaults=1" in query.split("&")
    magic, count = PACKED_WITH_DEFAULTS if with_defaults else PACKED, len(table.parameters)
    packed = struct.pack("<HHH", magic, count, count)
    last = ""
    for parameter in table.parameters.values():
        name, number = parameter.name, table.number(parameter)
        default = parameter.to_number(parameter.field.default)
        flag = int(with_defaults and default != number)
        same = (a == b for a, b in zip(last, name, strict=False))
        common = min(sum(takewhile(bool, same)), PACKED_COMMON, len(name) - 1)
        rest = name[common:].encode()
        packed += bytes([PACKED_FLOAT | flag << 4, common | len(rest) - 1 << 4]) + rest
        packed += struct.pack("<f", number) + (struct.pack("<f", default) if flag else b"")
        last = name
    return packed


@cache
def parameters_of(kinds: tuple[tuple[str, type[Settings]], ...]) -> Mapping[str, Parameter]:
    """List the parameters of some classes of settings by name, in the order of their names.

    They are computed once, which takes some milliseconds, and shared by all vehicles. ValueError
    if two settings would share a name.
    """
    found = [parameter for key, kind in kinds for parameter in _walk(key, kind)]
    names = Counter(parameter.name for parameter in found)
    if twice := sorted(name for name, count in names.items() if count > 1):
        raise ValueError(f"parameter names used twice: {', '.join(twice)}")
    found.sort(key=lambda parameter: parameter.name)
    return MappingProxyType({p.name: replace(p, index=n) for n, p in enumerate(found)})


def _walk(section: str, kind: type[Settings], path: tuple[str, ...] = ()) -> Iterator[Parameter]:
    fields = fields_of(kind)
    bare_keys = Counter(without_unit(field.name) for field in fields)
    for field in fields:
        inner = (*path, field.name)
        if field.section is not None:
            yield from _walk(section, field.section, inner)
            continue
        group = path[-1] if path else section
        bare = without_unit(field.name)
        key = bare if bare_keys[bare] == 1 else field.name
        if field.choices or isinstance(field.default, bool | int | float):
            yield Parameter(parameter_name(group, key), section, inner, None, field)
        for axis, letters in enumerate(_axes(field)):
            described = _angle_field(field, axis) if field.is_rotation else field
            yield Parameter(parameter_name(group, key, letters), section, inner, axis, described)


def _axes(field: Field) -> tuple[str, ...]:
    """Name the components of a rotation or a vector; a setting of any other type has none."""
    if field.is_rotation:
        return tuple(letters for letters, _, _ in ANGLES)
    value = field.default
    is_vector = isinstance(value, tuple) and len(value) == len(AXES)
    return AXES if is_vector and all(isinstance(item, float) for item in value) else ()


def _angle_field(field: Field, axis: int) -> Field:
    what = field.meaning.partition(". ")[0]
    _, name, limit = ANGLES[axis]
    return replace(
        field,
        type=RotationAngles,
        default=euler_deg_from_matrix(field.default),
        meaning=f"{name} of the {what[0].lower()}{what[1:]}. Yaw is turned first, then pitch, then "
        "roll; a board that lies face up with its x arrow to the nose has a roll of 180",
        unit="deg",
        bounds=(-limit, limit),
    )


def _replaced(tree: Settings, path: tuple[str, ...], value: Any) -> Settings:
    key, *rest = path
    inner = _replaced(getattr(tree, key), tuple(rest), value) if rest else value
    return msgspec.structs.replace(tree, **{key: inner})


class Metadata:
    """The metadata files of one vehicle."""

    def __init__(self, table: ParameterTable, system_id: int) -> None:
        self._table = table
        self._general = _named(GENERAL_PATH, system_id)
        parameters, described = _named(PARAMETER_PATH, system_id), _described(table.kinds)
        kind = {"type": 1, "uri": f"mftp://{parameters}", "fileCrc": crc32(described)}
        general = _json(
            {
                "version": 1,
                "vendorName": "mavgate",
                "modelName": "mavgate tracker",
                "firmwareVersion": ".".join((*__version__.split("."), "0", "0", "0")[:3]),
                # COMP_METADATA_TYPE_PARAMETER is the only one.
                "metadataTypes": [kind],
            }
        )
        self.files: Mapping[str, bytes] = {
            **dict.fromkeys((self._general, GENERAL_PATH), general),
            **dict.fromkeys((parameters, PARAMETER_PATH), described),
        }
        """Files by their FTP paths."""

    def of(self, system_id: int) -> "Metadata":
        """Return the metadata for another vehicle."""
        return Metadata(self._table, system_id)

    def describes(self, names: Collection[str]) -> bool:
        """Return whether all parameters (and at least one) are those of this version."""
        return bool(names) and set(names) <= self._table.parameters.keys()

    def of_parameters(self) -> dict[str, tuple[float, str]]:
        """Return the default and the meaning of each parameter, by name."""
        return {
            name: (one.to_number(one.field.default), _first_sentence(one.field.meaning))
            for name, one in self._table.parameters.items()
        }

    def announcement(self, _newest: Any, now_us: int) -> Any:
        """Encode COMPONENT_METADATA."""
        uri = f"mftp://{self._general}".encode()
        return COMPONENT_METADATA(boot_ms(now_us), crc32(self.files[self._general]), uri)


def _named(path: str, system_id: int) -> str:
    stem, ending = path.split(".", 1)
    return f"{stem}-{system_id}.{ending}"


@cache
def _described(kinds: tuple[tuple[str, type[Settings]], ...]) -> bytes:
    """Write the file that describes the parameters, once for all vehicles."""
    described = [_describe(parameter) for parameter in parameters_of(kinds).values()]
    # Every decoder of xz supports the check CRC32; embedded ones lack the default, CRC64.
    return lzma.compress(_json({"version": 1, "parameters": described}), check=lzma.CHECK_CRC32)


def _describe(parameter: Parameter) -> dict[str, Any]:
    field = parameter.field
    group = parameter.path[-2] if len(parameter.path) > 1 else parameter.section
    is_whole = bool(field.choices) or isinstance(field.default, int)
    default = parameter.to_number(field.default)
    described: dict[str, Any] = {
        "name": parameter.name,
        "type": "Int32" if is_whole else "Float",
        "shortDesc": _first_sentence(field.meaning),
        "longDesc": f"{field.meaning} ({'.'.join((parameter.section, *parameter.path))})",
        "units": field.unit,
        "default": int(default) if is_whole else default,
        "group": group,
        "category": parameter.section,
    }
    low, high = field.bounds
    names = ("off", "on") if isinstance(field.default, bool) else field.choices
    if names:
        described["values"] = [
            {"value": number, "description": name} for number, name in enumerate(names)
        ]
        return described
    described |= {key: end for key, end in (("min", low), ("max", high)) if end is not None}
    if not is_whole:
        is_position = parameter.path[-1] in ("lat_deg", "lon_deg")
        described["decimalPlaces"] = POSITION_PLACES if is_position else PLACES
    return described


def _first_sentence(text: str) -> str:
    """Return the first sentence, cut after a word if it is longer than the schema allows."""
    sentence = text.split(". ")[0].rstrip(".")
    if len(sentence) <= MAX_SHORT:
        return sentence
    return sentence[: MAX_SHORT - 3].rpartition(" ")[0].rstrip(",;:") + "..."


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
