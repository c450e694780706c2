"""MAVLink messages as JSON and back, in the format of mavlink2rest and mavlink-server.

| field of MAVLink       | JSON                                                    |
| ---------------------- | ------------------------------------------------------- |
| enum                   | `{"type": "MAV_TYPE_FIXED_WING"}`                       |
| bitmask                | `{"bits": 81}`                                          |
| text (an array of char) | an array of characters, padded with NUL                 |
| other array            | an array of numbers                                     |
| `type`                 | `mavtype`, because `type` is the name of the message    |
| NaN or infinity        | `null`                                                  |

Input may also name a bitmask's flags (`"A | B"`), give a bare number for an enum or a bitmask, and
a plain text for an array of characters, and leave out the target. A value unknown to its enum is
written as a number.

References
----------
.. [1] https://github.com/mavlink/mavlink2rest
"""

import inspect
import math
import struct
from typing import Annotated, Any, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.units import counted
from gateway.wire.mavlink_messages import INTEGER_LIMITS

CLASSES: Final = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
NUL: Final = "\0"
BITMASK: Final = "bitmask"
TARGETS: Final = ("target_system", "target_component")
"""Fields that may be missing: 0 addresses all systems or components."""
RENAMED: Final = {"type": "mavtype"}
MAX_FLOAT: Final = 3.4028234663852886e38
"""Largest finite 32-bit float."""
MAX_SHOWN: Final = 40
"""Maximum characters of a rejected value in an error message."""


_Byte = Annotated[int, msgspec.Meta(ge=0, le=255)]


class _Header(msgspec.Struct, frozen=True):
    system_id: _Byte
    component_id: _Byte
    sequence: _Byte = 0


class _Given(msgspec.Struct, frozen=True):
    header: _Header
    message: dict[str, Any]


class BadMessageError(ValueError):
    """An invalid message; the text gives the reason."""


def to_json(message: Any) -> dict[str, Any]:
    """Return `type` with the name of a decoded message, then its fields in order."""
    found: dict[str, Any] = {"type": message.msgname}
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        found[RENAMED.get(name, name)] = _out(message, name, kind)
    return found


def from_json(fields: Any) -> Any:
    """Build a message, to be packed, from fields as `to_json` returns them.

    Extension fields and the target may be missing. Raises BadMessageError, which names the field.
    """
    if not isinstance(fields, dict):
        raise BadMessageError("a message is an object with its name under 'type'")
    kind = class_of(fields.get("type"))
    given: dict[str, Any] = {}
    for name, parameter in inspect.signature(kind).parameters.items():
        key = RENAMED.get(name, name)
        if key in fields:
            try:
                given[name] = _in(kind, name, fields[key])
            except (ValueError, TypeError, OverflowError) as error:
                raise BadMessageError(f"{kind.msgname}.{key}: {error}") from None
        elif name in TARGETS:
            given[name] = 0
        elif parameter.default is inspect.Parameter.empty:
            raise BadMessageError(f"{kind.msgname}.{key} is missing")
    return kind(**given)


def template(name: str) -> dict[str, Any]:
    """Return an empty message, to be filled in.

    Raises
    ------
    BadMessageError
        If no message has this name.
    """
    kind = class_of(name)
    given: dict[str, Any] = {}
    for field, form in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        length = _length(kind, field)
        enum = kind.fieldenums_by_name.get(field)
        value: float = 0.0 if form in ("float", "double") else 0
        if enum is not None and not _is_bitmask(kind, field):
            value = next(iter(mavlink.enums[enum]))
        given[field] = (
            bytes(not length) if form == "char" else [value] * length if length else value
        )
    return to_json(kind(**given))


def json_from_frame(frame: bytes) -> tuple[str, bytes, dict[str, bytes]] | None:
    """Return a complete frame as mavlink-server publishes it; None for an unknown message.

    The parts are the name of the message, `{"header": ..., "message": ...}` as JSON, and the JSON
    of each field by its name.
    """
    try:
        message = mavlink.MAVLink(None).decode(bytearray(frame))
    except mavlink.MAVError:
        return None
    if message.msgname not in CLASSES:
        return None
    fields = to_json(message)
    header = {
        "system_id": message.get_srcSystem(),
        "component_id": message.get_srcComponent(),
        "sequence": message.get_seq(),
        "message_id": message.get_msgId(),
    }
    whole = msgspec.json.encode({"header": header, "message": fields})
    return message.msgname, whole, {key: msgspec.json.encode(fields[key]) for key in fields}


def frame_from_json(data: bytes) -> bytes:
    """Return the frame of a message given as JSON; empty if it is invalid.

    Parameters
    ----------
    data : bytes
        `{"header": {"system_id": 255, "component_id": 190, "sequence": 0}, "message": ...}`.
    """
    try:
        given = msgspec.json.decode(data, type=_Given)
        message = from_json(given.message)
        link = mavlink.MAVLink(None, given.header.system_id, given.header.component_id)
        link.seq = given.header.sequence
        return bytes(message.pack(link))
    except (ValueError, TypeError, OverflowError, RecursionError, struct.error):
        return b""


def class_of(name: Any) -> Any:
    """Return pymavlink's class of a message.

    Raises BadMessageError if no message has this name.
    """
    if not isinstance(name, str) or name not in CLASSES:
        raise BadMessageError(f"no MAVLink message is called {name!r}")
    return CLASSES[name]


def _out(message: Any, name: str, kind: str) -> Any:
    value = getattr(message, name)
    if kind == "char":
        # pymavlink reads a text as ASCII, and keeps its bytes.
        value = getattr(message, f"_{name}_raw", value)
        is_text = isinstance(value, str)
        text = value if is_text else bytes(value).split(b"\0", 1)[0].decode(errors="replace")
        length = _length(message, name)
        return list(text.ljust(length, NUL)) if length else text
    if isinstance(value, list | tuple):
        return [_scalar(message, name, item) for item in value]
    return _scalar(message, name, value)


def _scalar(message: Any, name: str, value: int | float) -> Any:
    enum = message.fieldenums_by_name.get(name)
    if enum is None:
        return None if isinstance(value, float) and not math.isfinite(value) else value
    if _is_bitmask(message, name):
        return {"bits": value}
    entry = mavlink.enums[enum].get(value)
    return value if entry is None else {"type": entry.name}


def _in(kind: Any, name: str, value: Any) -> Any:
    form = kind.fieldtypes[kind.fieldnames.index(name)]
    length = _length(kind, name)
    if form == "char":
        text = "".join(value) if isinstance(value, list) else value
        if not isinstance(text, str):
            raise BadMessageError("is a text or an array of characters")
        data = text.rstrip(NUL).encode()
        if len(data) > max(length, 1):
            raise BadMessageError(f"has more than {counted(max(length, 1), 'byte')}")
        return data if length else data.ljust(1, b"\0")
    if length:
        if not isinstance(value, list) or len(value) != length:
            raise BadMessageError(f"is an array of {length} numbers")
        return [_bounded(_of_enum(kind, name, item), form) for item in value]
    return _bounded(_of_enum(kind, name, value), form)


def _of_enum(kind: Any, name: str, value: Any) -> Any:
    """Return the number of an enum's name; any other value unchanged."""
    enum = kind.fieldenums_by_name.get(name)
    if enum is None:
        return value
    if isinstance(value, dict):
        value = value.get("type", value.get("bits"))
    if not isinstance(value, str):
        return value
    numbers = {entry.name: number for number, entry in mavlink.enums[enum].items()}
    bits = 0
    for word in filter(None, (part.strip() for part in value.split("|"))):
        if word not in numbers:
            raise BadMessageError(f"unknown {enum} {word!r}")
        bits |= numbers[word]
    return bits


def _bounded(value: Any, form: str) -> int | float:
    if form in ("float", "double"):
        if value is None:
            return math.nan
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadMessageError(f"{_short(value)} is not a number")
        number = float(value)
        if form == "float" and math.isfinite(number) and abs(number) > MAX_FLOAT:
            raise BadMessageError(f"{_short(value)} is too large for a 32-bit float")
        return number
    least, greatest = INTEGER_LIMITS[form]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadMessageError(f"{_short(value)} is not a whole number")
    if not least <= value <= greatest:
        raise BadMessageError(f"{_short(value)} is not {least} to {greatest}")
    return value


def _short(value: Any) -> str:
    """Return a client's value, shortened for an error message."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def _length(kind: Any, name: str) -> int:
    """Return the length of an array; 0 for other types."""
    length: int = kind.array_lengths[kind.ordered_fieldnames.index(name)]
    return length


def _is_bitmask(kind: Any, name: str) -> bool:
    return bool(kind.fielddisplays_by_name.get(name) == BITMASK)
