"""DataFlash, the log of ArduPilot: bytes or text in, messages out.

Theory of operation. A binary message is A3 95, a type, and fields; an FMT message, itself of type
128, has told their layout before. There is no checksum, so a message is believed if another one
follows it, or the end of the log, or the padding of a page. What is not believed is left out up to
the next message that is, and counted. Of two layouts for one type the first stands: the logger
tells each once, so the second is damage.

As text, a message is a line of values with commas between them.
"""

import struct
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Final

HEAD: Final = b"\xa3\x95"
HEAD_SIZE: Final = 3
FMT: Final = 128
PAGE: Final = 528
"""The rest of the last page of a flash chip may be empty."""
MAX_LINE: Final = 1 << 16
"""Longer lines are no messages, and do not fill the memory."""
_EMPTY: Final = (b"\0\0", b"\xff\xff")
_CODES: Final = {
    "a": "64s", "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d",
    "g": "e", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I",
    "L": "i", "M": "B", "q": "q", "Q": "Q",
}  # fmt: skip
_DIVISORS: Final = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
_TEXTS: Final = "anNZ"
_REALS: Final = "fdgcCeEL"


@dataclass(frozen=True, slots=True)
class MessageFormat:
    """The layout of one type of message."""

    name: str
    size: int
    """Bytes of a message, its head included."""
    letters: str
    columns: tuple[str, ...]
    fields: struct.Struct | None = field(compare=False)
    """None if the letters do not fit the size or the columns, or are unknown: newer than this."""

    def decode(self, body: bytes) -> SimpleNamespace | None:
        """Return the values by their columns, in units; None if the layout is not understood."""
        if self.fields is None:
            return None
        message = SimpleNamespace(**dict(zip(self.columns, self.fields.unpack(body), strict=True)))
        for letter, column in zip(self.letters, self.columns, strict=True):
            if letter in _DIVISORS:
                setattr(message, column, getattr(message, column) / _DIVISORS[letter])
            elif letter in _TEXTS:
                setattr(message, column, _plain(getattr(message, column)))
        return message

    def read(self, cells: list[str]) -> SimpleNamespace:
        """Return the values of a line by their columns; raises ValueError if they are none."""
        if len(cells) < len(self.columns):
            raise ValueError("too few values")
        values = (
            cell if letter in _TEXTS else float(cell) if letter in _REALS else int(cell)
            for letter, cell in zip(self.letters, cells, strict=False)
        )
        return SimpleNamespace(**dict(zip(self.columns, values, strict=False)))


NamedMessage = tuple[str, SimpleNamespace]
"""The name of a message, and its values as attributes, by the columns of its format."""


class DataflashReader:
    """Read a log in any chunks; never raises on data.

    Parameters
    ----------
    names : set of str
        Of the messages to return.
    is_text : bool
        Whether it is a log of lines.
    """

    def __init__(self, names: set[str], *, is_text: bool) -> None:
        self.damaged_bytes = 0
        """Bytes, or of text lines, that are no message."""
        self.cut_bytes = 0
        """Of a message that the log ends in."""
        self.broken = 0
        """Messages that cannot be understood."""
        self._names = names
        self._is_text = is_text
        self._rest = b""
        self._in_step = True
        fmt = _format_of(89, "FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))
        self._formats: dict[int, MessageFormat] = {FMT: fmt}
        self._by_name: dict[str, MessageFormat] = {}

    def feed(self, data: bytes, *, final: bool = False) -> list[NamedMessage]:
        """Take the next bytes of the log.

        Parameters
        ----------
        data : bytes
            Any chunk.
        final : bool
            Whether the log ends with it.

        Returns
        -------
        list of (str, SimpleNamespace)
            The wanted messages that are certain now.
        """
        data = self._rest + data if self._rest else data
        found, end = (self._lines if self._is_text else self._scan)(data, final)
        self._rest = data[end:]
        return found

    def _scan(self, data: bytes, final: bool) -> tuple[list[NamedMessage], int]:
        """Return messages, and where the bytes begin that are still undecided."""
        found: list[NamedMessage] = []
        at, end = 0, len(data)
        while end - at >= HEAD_SIZE:
            form = self._formats.get(data[at + 2]) if data.startswith(HEAD, at) else None
            stop = at + (form.size if form else HEAD_SIZE)
            if form is not None and not final and stop + HEAD_SIZE > end:
                return found, at
            if form is not None and self._is_believed(data, stop):
                self._in_step = True
                self._take(form, data[at + HEAD_SIZE : stop], found)
                at = stop
                continue
            if form is not None and stop > end and self._in_step:
                self.cut_bytes += end - at
                return found, end
            if _is_padding(data, at):
                break
            at = self._pass_over(data, at, final)
        if final:
            self.damaged_bytes += 0 if _is_padding(data, at) else end - at
            at = end
        return found, at

    def _is_believed(self, data: bytes, stop: int) -> bool:
        """Return whether what ends here is a message, by what follows."""
        if stop >= len(data):
            return stop == len(data)
        if not data.startswith(HEAD, stop):
            return self._in_step and data.startswith(_EMPTY, stop)
        return self._in_step or stop + 2 >= len(data) or data[stop + 2] in self._formats

    def _pass_over(self, data: bytes, at: int, final: bool) -> int:
        """Count bytes that are no message; return where the next may begin."""
        self._in_step = False
        place = data.find(HEAD, at + 1)
        if place < 0:
            # The last byte may be the first of a head.
            place = len(data) if final else max(len(data) - 1, at + 1)
        self.damaged_bytes += place - at
        return place

    def _take(self, form: MessageFormat, body: bytes, found: list[NamedMessage]) -> None:
        if form.name == "FMT":
            number, size, name, letters, columns = struct.unpack("<BB4s16s64s", body)
            named = tuple(_plain(columns).split(","))
            self._learn(number, _format_of(size, _plain(name), _plain(letters), named))
        elif form.name in self._names:
            message = form.decode(body)
            if message is None:
                self.broken += 1
            else:
                found.append((form.name, message))

    def _learn(self, number: int, form: MessageFormat) -> None:
        if form.size < HEAD_SIZE or self._formats.setdefault(number, form) != form:
            self.broken += 1
        else:
            self._by_name.setdefault(form.name, form)

    def _lines(self, data: bytes, final: bool) -> tuple[list[NamedMessage], int]:
        """Return messages, and where the line begins that is still incomplete."""
        found: list[NamedMessage] = []
        end = len(data) if final else data.rfind(b"\n") + 1
        for line in data[:end].split(b"\n"):
            try:
                self._read_line(line, found)
            except ValueError:
                self.broken += 1
        if len(data) - end > MAX_LINE:
            self.damaged_bytes += len(data) - end
            end = len(data)
        return found, end

    def _read_line(self, line: bytes, found: list[NamedMessage]) -> None:
        name, *cells = (cell.strip() for cell in line.decode("ascii", "replace").split(","))
        if name == "FMT":
            if len(cells) < len(("number", "size", "name", "letters", "columns")):
                raise ValueError("too few values")
            form = _format_of(int(cells[1]), cells[2], cells[3], tuple(cells[4:]))
            self._learn(int(cells[0]), form)
        elif name in self._names:
            if name not in self._by_name:
                raise ValueError("its format is not known")
            found.append((name, self._by_name[name].read(cells)))


def _format_of(size: int, name: str, letters: str, columns: tuple[str, ...]) -> MessageFormat:
    fields = None
    if len(set(columns)) == len(letters) and all(letter in _CODES for letter in letters):
        fields = struct.Struct("<" + "".join(_CODES[letter] for letter in letters))
        if fields.size + HEAD_SIZE != size:
            fields = None
    return MessageFormat(name, size, letters, columns, fields)


def _is_padding(data: bytes, at: int) -> bool:
    """Return whether nothing but an empty end of a page is left, as far as is known."""
    return len(data) - at < PAGE and (
        data.count(0, at) == len(data) - at or data.count(0xFF, at) == len(data) - at
    )


def _plain(text: bytes) -> str:
    return text.partition(b"\0")[0].decode("ascii", "replace")
