"""Recognise the format of a recording by its first bytes, and the start of a log."""

import codecs
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, Final

from gateway.extras import how_to_add
from gateway.recordings.files import FlightError, open_unpacked
from gateway.units import counted

SNIFF: Final = 512
HEAD: Final = 1 << 14
"""Bytes that are searched for the start of a log, which may follow text that a console wrote, and
from which the layout of a tlog is recognised: several hundred frames."""
BLANK: Final = b"\xff\0"
"""Erased flash memory, and zeros of a card that lost its power; they may precede a log that was
copied from raw memory."""
MAX_BLANK: Final = 1 << 20
NO_RECORDING: Final = (
    "unknown file format; readable: tlog, raw MAVLink, CSV, ULog, DataFlash, MCAP, Parquet"
)
TLOG, TABLE, CSV, PARQUET = "tlog", "table", "csv", "Parquet"
"""Names of formats; a CSV is one of another program, with columns of its own."""
LOGS: Final = {"DataFlash": "dataflash_record", "ULog": "ulog_record"}
"""Module that reads an autopilot's log, by the name of the format."""
ULOG_HEAD: Final = b"ULog\x01\x12\x35"
ULOG_BEGIN: Final = re.compile(
    rb"\A[^\xfd\xfe]*?(?=ULog\x01\x12\x35|..F[a-z0-9_]+:uint64_t timestamp;)", re.DOTALL
)
"""Match up to the header of a ULog or, if the header is lost, up to the first format of a topic. A
tlog that contains a log download does not match: it begins with MAVLink frames."""
DATAFLASH_BEGIN: Final = re.compile(
    rb"\A(?:(?=\xa3\x95)|[^\xfd\xfe]*?(?=\xa3\x95\x80..[A-Z][A-Z0-9]{2,3}))", re.DOTALL
)
"""Match up to a binary DataFlash log: its first message or, after other bytes, its first format."""
_DATAFLASH_LINE: Final = re.compile(rb"^FMT, ?\d", re.MULTILINE)


def _begins(*heads: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(heads)


OTHER_FORMATS: Final[dict[str, Callable[[bytes], bool]]] = {
    "ULog": lambda head: ULOG_BEGIN.search(head) is not None,
    "DataFlash": lambda head: any(
        begin.search(head) is not None for begin in (DATAFLASH_BEGIN, _DATAFLASH_LINE)
    ),
    PARQUET: _begins(b"PAR1"),
}
"""Test whether a file that begins with these bytes is of a format, by the format's name."""


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text by its byte order mark or its zeros; UTF-8 by default."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    sample = head[: SNIFF & ~1]
    even, odd = sample[::2], sample[1::2]
    for letters, zeros, encoding in ((even, odd, "utf-16-le"), (odd, even, "utf-16-be")):
        if letters and letters.isascii() and all(letters) and not any(zeros):
            return encoding
    return "utf-8-sig"


def format_of(path: Path) -> str:
    """Recognise the format of a file by its first bytes; raises OSError if it cannot be read."""
    head = first_bytes(path)
    if encoding_of(head) != "utf-8-sig":
        return CSV
    known = (name for name, knows in OTHER_FORMATS.items() if knows(head))
    if (name := next(known, None)) is not None:
        return name
    if head.startswith((b"# mavgate table", b"time_us,")):
        return TABLE
    first = head[:SNIFF]
    has_frames = b"\xfd" in head or b"\xfe" in head
    is_binary = b"\0" in first or b"\xfd" in first or b"\xfe" in first
    is_binary |= has_frames and b"\0" in head
    has_cells = any(delimiter in first for delimiter in (b",", b";", b"\t"))
    is_markup = head.lstrip()[:1] in (b"{", b"[", b"<")  # JSON, HTML and other XML
    return CSV if has_cells and not is_binary and not is_markup else TLOG


def has_signature(path: Path) -> bool:
    """Return whether a file begins with the bytes of a format that is known by them."""
    head = first_bytes(path)
    return any(knows(head) for knows in OTHER_FORMATS.values())


def import_format(module: str, name: str) -> Any:
    """Import the module of a format, which requires an extra; raises FlightError if missing."""
    try:
        return import_module(f"gateway.recordings.formats.{module}")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gateway"):
            raise
        raise FlightError(how_to_add(name, "formats")) from error


def first_bytes(path: Path) -> bytes:
    """Return the start of a file, unpacked, to recognise its format; raises OSError."""
    with open_unpacked(path) as (file, _):
        head, _ = _behind_blank(iter(lambda: file.read(HEAD), b""))
        return head[:HEAD].removeprefix(codecs.BOM_UTF8)


def _behind_blank(content: Iterator[bytes]) -> tuple[bytes, int]:
    """Return up to `HEAD` bytes after the blank ones, and the number of blank bytes."""
    head, size = b"", 0
    for data in content:
        size += len(data)
        head += data
        if head[:1] * 2 == head[:2] and head[:1] in (b"\xff", b"\0"):
            head = head.lstrip(BLANK)
        if len(head) >= HEAD or size > MAX_BLANK:
            break
    return head, size - len(head)


@dataclass(frozen=True, slots=True)
class Before:
    """Bytes before the start of a log."""

    blank: int = 0
    text: bytes = b""
    """The bytes that follow the blank ones."""

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user on these bytes."""
        size = self.blank + len(self.text)
        return [f"left out {counted(size, 'byte')} before its first message"] if size else []


def skip_to(begin: re.Pattern[bytes], content: Iterator[bytes]) -> tuple[Iterator[bytes], Before]:
    """Skip the bytes before the start of a log."""
    head, blank = _behind_blank(content)
    found = begin.search(head, 0, HEAD)
    at = found.end() if found else 0
    return chain([head[at:]], content), Before(blank, head[:at])
