"""ULog, the log of PX4: bytes in, topics out.

Theory of operation. After 16 bytes come messages: a size, a kind, and the content. Formats (F) tell
the fields of topics, subscriptions (A) give a topic a number, data (D) hold its rows. There is no
checksum, so a message is judged by its content (a row has exactly the size of its topic) and by
whether a header follows it:

| state       | the message here                     | what is done                        |
| ----------- | ------------------------------------ | ----------------------------------- |
| in step     | sound, and a header or the end next  | taken                               |
| in step     | a sound row or sync, whatever next   | taken: the damage comes next        |
| in step     | not sound, but a header next         | left out: of a kind newer than this |
| in step     | neither                              | damage begins: out of step          |
| out of step | sound, and a header next             | taken: in step again                |
| out of step | anything else                        | one byte on                         |
"""

import re
import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

START_SIZE: Final = 16
"""Magic, version, time."""
HEAD_SIZE: Final = 3
KINDS: Final = frozenset(b"BFIMPQARLCSOD")
SYNC: Final = bytes.fromhex("2f731320250cbb12")
MAX_FIELDS: Final = 4000
"""Of a topic, those nested in it included; rows have at most 64 kB."""
MAX_DEPTH: Final = 8
_ROW, _FLAGS = ord("D"), ord("B")
_CERTAIN: Final = frozenset(b"DS")
"""Kinds whose content alone proves them."""
_APPENDED, _FLAGS_SIZE = 1, 40
_TYPES: Final = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "i1", "char": "i1",
}  # fmt: skip
_FORMAT: Final = re.compile(rb"([\w/-]+):((?:[\w/-]+(?:\[\d+\])? \w+;)*)")
_FIELD: Final = re.compile(r"([\w/-]+)(?:\[(\d+)\])? (\w+)")
_KEY: Final = re.compile(rb"[\w/-]+(?:\[\d*\])? [\w/.\[\]-]+")
_NEXT: Final = re.compile(b"[" + bytes(sorted(KINDS)) + b"]")

Fields = list[tuple[str, str]]
"""Names and NumPy types."""
Topic = dict[str, NDArray[Any]]


@dataclass(slots=True)
class _Subscription:
    name: str
    instance: int
    row: np.dtype[Any]
    most: int
    """Size of a row with the padding that may end it."""
    rows: bytearray | None = field(default_factory=bytearray)
    """None if nobody wants them."""


class UlogReader:
    """Read a log in any chunks; never raises on data.

    Parameters
    ----------
    topics : collection of str
        Those whose rows are kept.
    """

    def __init__(self, topics: Collection[str]) -> None:
        self.damaged_bytes = 0
        """Of no message, or of one that cannot be understood."""
        self.cut_bytes = 0
        """Of a message that the log ends in."""
        self.dropouts_ms: list[int] = []
        """How long the logger was too slow, each time."""
        self.parameters: dict[str, float] = {}
        """As they were at the start."""
        self.is_newer = False
        """Whether its flags say that only a newer program can read it; then nothing is read."""
        self._wanted = topics
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._subscriptions: dict[int, _Subscription] = {}
        self._appended: list[int] = []
        """Where data were appended, perhaps after a message that was never finished."""
        self._rest = b""
        self._offset = 0
        self._in_step = True

    def feed(self, data: bytes, *, final: bool = False) -> None:
        """Take the next bytes of the log.

        Parameters
        ----------
        data : bytes
            Any chunk.
        final : bool
            Whether the log ends with it.
        """
        data = self._rest + data if self._rest else data
        at = 0 if self._offset else START_SIZE
        if len(data) >= at:
            at = self._scan(data, at, final)
            self._offset += at
            self._rest = data[at:]
        else:
            self._rest = data

    def topics(self) -> dict[str, Topic]:
        """Return the rows of each topic as columns, of its first instance that has any."""
        found: dict[str, Topic] = {}
        merged: dict[tuple[str, int], list[_Subscription]] = {}
        for one in self._subscriptions.values():
            if one.rows:
                merged.setdefault((one.name, one.instance), []).append(one)
        for name, instance in sorted(merged):
            rows = [np.frombuffer(bytes(s.rows or b""), s.row) for s in merged[name, instance]]
            alike = np.concatenate([r for r in rows if r.dtype == rows[0].dtype])
            found.setdefault(name, {key: alike[key] for key in alike.dtype.names or ()})
        return found

    def _scan(self, data: bytes, at: int, final: bool) -> int:
        """Take messages; return where the bytes begin that are still undecided."""
        end = len(data)
        while end - at >= HEAD_SIZE and not self.is_newer:
            size, kind = struct.unpack_from("<HB", data, at)
            stop = at + HEAD_SIZE + size
            jump = next((o for o in self._appended if at < o - self._offset < stop), None)
            if jump is not None and jump - self._offset <= end:
                at = jump - self._offset
                continue
            if not final and stop + HEAD_SIZE > end:
                return at
            content = data[at + HEAD_SIZE : stop]
            is_sound = stop <= end and kind in KINDS and self._is_sound(kind, content)
            follows = self._follows(data, stop)
            if is_sound and (follows or (self._in_step and kind in _CERTAIN)):
                self._in_step = True
                self._take(kind, content, at)
            elif self._in_step and follows:
                # A known kind is damaged; others are for newer programs.
                self.damaged_bytes += stop - at if kind in KINDS else 0
            else:
                at = self._pass_over(data, at, stop, final)
                continue
            at = stop
        if final and not self.is_newer:
            self.cut_bytes += end - at
        return end if final or self.is_newer else at

    def _follows(self, data: bytes, stop: int) -> bool:
        """Return whether a message that ends here is followed by another, or by the end."""
        if stop + HEAD_SIZE > len(data):
            return stop <= len(data)
        return data[stop + 2] in KINDS or self._offset + stop in self._appended

    def _pass_over(self, data: bytes, at: int, stop: int, final: bool) -> int:
        """Count bytes that are no message; return where the next may begin."""
        was_in_step, self._in_step = self._in_step, False
        match = _NEXT.search(data, at + HEAD_SIZE)
        place = match.start() - 2 if match else max(len(data) - 2, at + 1)
        if final and stop > len(data) and was_in_step and self._is_last(data, place):
            self.cut_bytes += len(data) - at
            return len(data)
        self.damaged_bytes += place - at
        return place

    def _is_last(self, data: bytes, at: int) -> bool:
        """Return whether no message begins behind: then the log just ends in the one before."""
        while match := _NEXT.search(data, at + 2):
            at = match.start() - 2
            size, kind = struct.unpack_from("<HB", data, at)
            stop = at + HEAD_SIZE + size
            content = data[at + HEAD_SIZE : stop]
            if stop <= len(data) and self._is_sound(kind, content) and self._follows(data, stop):
                return False
            at += 1
        return True

    def _is_sound(self, kind: int, content: bytes) -> bool:
        """Return whether the content of a message of a known kind can be."""
        if kind == _ROW:
            known = self._subscriptions.get(int.from_bytes(content[:2], "little"))
            return known is not None and known.row.itemsize <= len(content) - 2 <= known.most
        match chr(kind):
            case "S":
                return content == SYNC
            case "F":
                return _FORMAT.fullmatch(content) is not None
            case "A":
                return content[3:].decode("ascii", "replace") in self._formats
            case "I" | "P":
                return _has_key(content)
            case "M" | "Q":
                return _has_key(content[1:])
            case "O":
                return len(content) == struct.calcsize("<H")
            case "B":
                return len(content) >= _FLAGS_SIZE
            case "L":
                return len(content) >= struct.calcsize("<BQ")
            case _:
                return len(content) >= struct.calcsize("<BH")

    def _take(self, kind: int, content: bytes, at: int) -> None:
        if kind == _ROW:
            known = self._subscriptions[int.from_bytes(content[:2], "little")]
            if known.rows is not None:
                known.rows += content[2 : 2 + known.row.itemsize]
            return
        match chr(kind):
            case "F":
                self._define(content)
            case "A":
                self._subscribe(content)
            case "P" if not self._subscriptions:
                self._set(content)
            case "O":
                self.dropouts_ms.append(int.from_bytes(content, "little"))
            case "B" if self._offset + at == START_SIZE:
                self._heed(content)

    def _heed(self, flags: bytes) -> None:
        """Take the flags: whether it can be read without knowing more, and of appended data."""
        self.is_newer = bool(flags[8] & ~_APPENDED or any(flags[9:16]))
        if flags[8] & _APPENDED:
            offsets = struct.unpack_from("<3Q", flags, 16)
            self._appended = sorted(offset for offset in offsets if offset > START_SIZE)

    def _define(self, content: bytes) -> None:
        name, _, fields = content.decode("ascii").partition(":")
        told = [(kind, int(count or 0), key) for kind, count, key in _FIELD.findall(fields)]
        if self._formats.setdefault(name, told) != told:
            self.damaged_bytes += HEAD_SIZE + len(content)

    def _subscribe(self, content: bytes) -> None:
        instance, number = struct.unpack_from("<BH", content)
        name = content[3:].decode("ascii")
        try:
            fields = self._flat(name, "", 0)
            padded = sum(np.dtype(kind).itemsize for _, kind in fields)
            while fields and fields[-1][0].startswith("_padding"):
                fields.pop()
            row = np.dtype(fields)
        except ValueError:
            row = np.dtype([])
        fresh = _Subscription(name, instance, row, padded if row.itemsize else 0)
        if not row.itemsize or self._subscriptions.get(number, fresh).name != name:
            self.damaged_bytes += HEAD_SIZE + len(content)
            return
        if name not in self._wanted:
            fresh.rows = None
        self._subscriptions.setdefault(number, fresh)

    def _flat(self, name: str, prefix: str, depth: int) -> Fields:
        """Return the fields of a format, nested ones by their whole names.

        Raises
        ------
        ValueError
            If one is of no known type, or they are too many.
        """
        if name not in self._formats or depth > MAX_DEPTH:
            raise ValueError(f"{name} is no type")
        found: Fields = []
        for kind, count, key in self._formats[name]:
            if count > MAX_FIELDS:
                raise ValueError(f"{name} has too many fields")
            names = [f"{prefix}{key}[{n}]" for n in range(count)] if count else [prefix + key]
            for one in names:
                known = _TYPES.get(kind)
                found += [(one, known)] if known else self._flat(kind, f"{one}.", depth + 1)
                if len(found) > MAX_FIELDS:
                    raise ValueError(f"{name} has too many fields")
        return found

    def _set(self, content: bytes) -> None:
        end = 1 + content[0]
        kind, _, key = content[1:end].decode("ascii").partition(" ")
        form = {"int32_t": "<i", "float": "<f"}.get(kind)
        if form is not None and len(content) - end == struct.calcsize(form):
            self.parameters.setdefault(key, struct.unpack_from(form, content, end)[0])


def _has_key(content: bytes) -> bool:
    return bool(content) and _KEY.fullmatch(content[1 : 1 + content[0]]) is not None
