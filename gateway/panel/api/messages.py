"""MAVLink messages as JSON and back, in the format of mavlink2rest, and the newest of each kind.

| field of MAVLink       | JSON                                                    |
| ---------------------- | ------------------------------------------------------- |
| of an enum             | `{"type": "MAV_TYPE_FIXED_WING"}`                       |
| of a bitmask           | `{"bits": 81}`                                          |
| text (an array of char) | an array of characters, padded with NUL                 |
| another array          | an array of numbers                                     |
| called `type`          | is called `mavtype`; `type` is the name of the message  |
| NaN or infinity        | `null`                                                  |

Input may also name a bitmask's flags (`"A | B"`), give a bare number for an enum or a bitmask, and
a plain text for an array of characters. A value unknown to its enum is written as a number.

References
----------
.. [1] https://github.com/mavlink/mavlink2rest
"""

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import counted

CLASSES: Final = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
NUL: Final = "\0"
BITMASK: Final = "bitmask"
RENAMED: Final = {"type": "mavtype"}
INTEGERS: Final = {
    **{f"uint{bits}_t": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)},
    **{f"int{bits}_t": (-1 << bits - 1, (1 << bits - 1) - 1) for bits in (8, 16, 32, 64)},
}
"""Least and greatest value by type."""
MAX_FLOAT: Final = 3.4028234663852886e38
"""Largest finite 32-bit float."""
MAX_SHOWN: Final = 40
"""Characters of a rejected value in an error message."""

MAX_KINDS: Final = 8192
"""Enough for some fifty aircraft; forged ids must not fill the memory."""

Key = tuple[int, int, str]
"""System, component and name of the message."""


class BadMessageError(ValueError):
    """An invalid message; the text says why."""


def to_json(message: Any) -> dict[str, Any]:
    """Return a decoded message's fields.

    Parameters
    ----------
    message : MAVLink_message
        As pymavlink decodes it.

    Returns
    -------
    dict
        `type` with the message's name, then the fields in the order of the definition.
    """
    found: dict[str, Any] = {"type": message.msgname}
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        found[RENAMED.get(name, name)] = _out(message, name, kind)
    return found


def from_json(fields: Any) -> Any:
    """Build a message from JSON.

    Parameters
    ----------
    fields : dict
        As `to_json` returns it; extension fields may be missing.

    Returns
    -------
    MAVLink_message
        To be packed.

    Raises
    ------
    BadMessageError
        If it is invalid; the text names the field.
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
                raise BadMessageError(f"{kind.msgname}.{key}: {_words(error)}") from None
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


def class_of(name: Any) -> Any:
    """Return pymavlink's class of a message.

    Raises
    ------
    BadMessageError
        If no message has this name.
    """
    if not isinstance(name, str) or name not in CLASSES:
        raise BadMessageError(f"no MAVLink message is called {name!r}")
    return CLASSES[name]


@dataclass(slots=True)
class _Entry:
    message: Any
    first_s: float
    last_s: float
    counter: int = 1

    def as_json(self) -> dict[str, Any]:
        span_s = self.last_s - self.first_s
        return {
            "message": to_json(self.message),
            "status": {
                "time": {
                    "first_update": _written(self.first_s),
                    "last_update": _written(self.last_s),
                    "counter": self.counter,
                    "frequency": (self.counter - 1) / span_s if span_s > 0 else 0.0,
                }
            },
        }


class MessageBook:
    """Received MAVLink messages, as a tree.

    Parameters
    ----------
    now_s : callable
        Civil time in s since the epoch, to show when a message came.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._entries: dict[Key, _Entry] = {}
        self._heard: set[tuple[int, int]] = set()
        self.left_out = 0
        """Messages of kinds for which there was no room."""

    def take(self, message: Any, *, is_sent: bool = False) -> None:
        """Take in one message, received or sent from here."""
        key = (message.get_srcSystem(), message.get_srcComponent(), message.msgname)
        if not is_sent:
            self._heard.add(key[:2])
        now_s = self._now_s()
        entry = self._entries.get(key)
        if entry is not None:
            entry.message = message
            entry.last_s = now_s
            entry.counter += 1
        elif len(self._entries) < MAX_KINDS:
            self._entries[key] = _Entry(message, now_s, now_s)
        else:
            self.left_out += 1

    def has_heard(self, system_id: int, component_id: int) -> bool:
        """Return whether anything came from a component."""
        return (system_id, component_id) in self._heard

    def look_up(self, path: str) -> Any:
        """Return the value at a path of the tree.

        Parameters
        ----------
        path : str
            As in `vehicles/1/components/1/messages/ATTITUDE/message/roll`; empty is all. A JSON
            pointer without its first slash, so a trailing slash means an empty name.

        Returns
        -------
        Any
            A JSON value.

        Raises
        ------
        KeyError
            If the path does not exist.
        """
        parts = path.split("/") if path else []
        node: Any = self._tree(parts)
        for part in parts:
            if isinstance(node, dict):
                node = node[part]
            elif isinstance(node, list) and part in map(str, range(len(node))):
                node = node[int(part)]
            else:
                raise KeyError(part)
        return node

    def _tree(self, parts: list[str]) -> dict[str, Any]:
        """Build as much of the tree as a path needs."""
        vehicles: dict[str, Any] = {}
        for (system_id, component_id, name), entry in self._chosen(parts):
            vehicle = vehicles.setdefault(str(system_id), {"id": system_id, "components": {}})
            component = vehicle["components"].setdefault(
                str(component_id), {"id": component_id, "messages": {}}
            )
            component["messages"][name] = entry.as_json()
        return {"vehicles": vehicles}

    def _chosen(self, parts: list[str]) -> Iterator[tuple[Key, _Entry]]:
        wanted = [*parts[1::2], "", "", ""] if parts[:1] == ["vehicles"] else [""] * 3
        for key, entry in self._entries.items():
            if all(want in ("", str(have)) for want, have in zip(wanted, key, strict=False)):
                yield key, entry


def _out(message: Any, name: str, kind: str) -> Any:
    value = getattr(message, name)
    if kind == "char":
        text = value.decode("latin-1") if isinstance(value, bytes) else value
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
            raise BadMessageError(f"{word!r} is none of {enum}")
        bits |= numbers[word]
    return bits


def _bounded(value: Any, form: str) -> int | float:
    if form in ("float", "double"):
        if value is None:
            return math.nan
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadMessageError(f"{_short(value)} is no number")
        number = float(value)
        if form == "float" and math.isfinite(number) and abs(number) > MAX_FLOAT:
            raise BadMessageError(f"{_short(value)} is too large for a 32-bit float")
        return number
    least, greatest = INTEGERS[form]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadMessageError(f"{_short(value)} is no whole number")
    if not least <= value <= greatest:
        raise BadMessageError(f"{_short(value)} is not {least} to {greatest}")
    return value


def _short(value: Any) -> str:
    """Return a value of the client for an error message."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def _length(kind: Any, name: str) -> int:
    """Return how many elements an array has; 0 for other types."""
    length: int = kind.array_lengths[kind.ordered_fieldnames.index(name)]
    return length


def _is_bitmask(kind: Any, name: str) -> bool:
    return bool(kind.fielddisplays_by_name.get(name) == BITMASK)


def _words(error: Exception) -> str:
    return str(error.args[0]) if error.args else str(error)


def _written(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).astimezone().isoformat()
