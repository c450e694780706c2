"""Texts for users: sanitised texts from others, errors, and states."""

import logging
import math
import os
import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

_CONTROL: Final = (*range(0x20), *range(0x7F, 0xA0))
"""C0 and C1 control characters, which can move the cursor, rename the window, or enter input."""
_INVISIBLE: Final = (
    *(0xAD, 0x61C, 0x180E, 0x200B, 0x200E, 0x200F),
    *range(0x2028, 0x202F),
    *range(0x2060, 0x2070),
    *(0xFEFF, *range(0xFFF9, 0xFFFC)),
    *range(0xE0000, 0xE0080),
)
"""Unicode controls of direction and line breaks, and invisible format characters: a name with
U+202E is displayed backwards. U+200C and U+200D are excluded, since scripts need them."""
_KEPT: Final = frozenset(map(ord, "\n\t"))
LONGEST: Final = 2000
"""Maximum characters of a log line; an address requested from the panel may have 60,000."""
UNKNOWN: Final = "—"
"""Shown instead of an unknown number."""
NO_RECEIVER: Final = "none"
"""Setting `serial.port` of a gateway that has no receiver."""
FEW_BYTES: Final = 200
"""Bytes that may be the end of a frame, or the buffer of an adapter, not another device."""


_FOLDERS: Final = re.compile(r"(?<![^\s'\"(=])~?/(?:[^\s/:;,]+/)*(?=[^\s/])")
"""Folders of an absolute path, which follows a space or a quotation mark, not those of a URL."""


class UserError(Exception):
    """An error whose text states fault and remedy; it ends a command without a traceback."""


def _escape(code: int) -> str:
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _json_escape(code: int) -> str:
    units = chr(code).encode("utf-16-be").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


_ESCAPES: Final = {code: _escape(code) for code in (*_CONTROL, *_INVISIBLE) if code not in _KEPT}
_JSON_ESCAPES: Final = {code: _json_escape(code) for code in (*_CONTROL[0x20:], *_INVISIBLE)}
"""Characters that JSON allows unescaped in a string; it escapes those below U+0020 itself."""


def printable(text: str) -> str:
    r"""Return a text with control and direction characters escaped, as `\xNN` or `\uNNNN`.

    Line feeds and tabs are kept.
    """
    return text.translate(_ESCAPES)


def printable_json(text: str) -> str:
    r"""Return a JSON document with control and direction characters as `\uNNNN`."""
    return text.translate(_JSON_ESCAPES)


class PrintableFormatter(logging.Formatter):
    """Format log lines that may contain text from the network."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 -- of the base class
        """Return the line of a record, cut to `LONGEST`; further lines of it are indented.

        The indentation prevents a text that contains a line feed from imitating a log line.
        """
        line = super().formatMessage(record)
        if len(line) > LONGEST and not record.exc_info:
            line = f"{line[:LONGEST]}…"
        return line.replace("\n", "\n    ")

    def format(self, record: logging.LogRecord) -> str:
        """Return the whole record, a traceback included, without control characters."""
        return printable(super().format(record))


def without_folders(text: str) -> str:
    """Return a text for other machines: absolute paths in it are reduced to their last names."""
    return _FOLDERS.sub("", text)


def figure(value: float | None, form: str, unit: str = "") -> str:
    """Return a number in a format with its unit; `UNKNOWN` alone for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{value:{form}} {unit}" if unit else f"{value:{form}}"


def reason_of(error: Exception) -> str:
    """Return the text of an error, from the operating system if it has one."""
    if hasattr(error, "library"):
        # A TLS error, whose number is not the operating system's.
        reason = getattr(error, "reason", None)
        return reason.replace("_", " ").lower() if reason else "no certificate and key in PEM"
    number = getattr(error, "errno", None) or 0
    return (
        os.strerror(number)
        if number > 0
        else getattr(error, "strerror", None) or str(error) or type(error).__name__
    )


def near_match(word: str, choices: Iterable[str]) -> str:
    """Return the question `did you mean 'x'?` for a misspelt word, or an empty text."""
    # Imported here, as only an error needs it.
    import difflib

    near = difflib.get_close_matches(word, [*choices], n=1)
    return f"did you mean {near[0]!r}?" if near else ""


def unknown_choice(what: str, word: str, choices: Iterable[str]) -> str:
    """Return the text for a word that is not allowed."""
    listed = [*choices]
    words = (near_match(word, listed), f"choose {', '.join(listed)}")
    return f"unknown {what} {word!r}; {' '.join(filter(None, words))}"


def receiver_state(port: str, connected: bool, bytes_received: int, frames: int) -> str:
    """Describe the receiver's port; empty if none is configured.

    A wrong device or bit rate also opens, but yields no frames.
    """
    if not connected and port == NO_RECEIVER:
        return ""
    if not connected:
        return f"receiver: not connected (serial.port = {port})"
    return f"receiver: {port} {_reception(bytes_received, frames)}"


def source_state(source: Mapping[str, Any], now_us: int) -> str:
    """Describe a source other than the receiver, from the fields of its `SourceReport`."""
    if not source["connected"]:
        state = f"not connected: {source['reason']}"
    elif source["last_time_us"] is None:
        state = f"connected, {source['bytes_received']} bytes without a record"
    else:
        age_s = max(now_us - source["last_time_us"], 0) * 1e-6
        rate = f"{source['rate_hz']:.0f} a second"
        state = f"{source['records']} records, {rate}, the last {age_s:.1f} s ago"
    faults = "".join(f", {count} {kind}" for kind, count in source["faults"])
    return f"source {source['url']}: {state}{faults}"


def _reception(bytes_received: int, frames: int) -> str:
    if frames:
        return "connected"
    if bytes_received < FEW_BYTES:
        return "connected, silent"
    return "connected, sends no frames: is it the receiver, at the speed serial.baud?"
