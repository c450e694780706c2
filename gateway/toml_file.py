"""TOML files of users: settings and column maps, limited in size, nesting and kind of file."""

import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any, Final

MAX_BYTES: Final = 1_000_000
"""Maximum size; a complete settings file with its comments has about 40 kB."""
MAX_DEPTH: Final = 8
"""Levels of sections, lists and tables; the time of a parser is quadratic in the depth."""

_TOKENS: Final = re.compile(
    r'"""(?:\\.|[^\\])*?"""'
    r"|'''.*?'''"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'"
    r"|#[^\n]*"
    r"|[][{}.=,\n]",
    re.DOTALL,
)


class TomlError(ValueError):
    """A file that cannot be used; the text states the reason, without the file's name."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a file; raises TomlError if it cannot be read or is not valid."""
    text = read_toml_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # Includes numbers with too many digits.
        raise TomlError(f"is not valid TOML: {error}") from error


def read_toml_text(path: Path) -> str:
    """Read the text of a file without parsing it; raises TomlError as `read_toml`."""
    try:
        data = _read(path)
    except OSError as error:
        raise TomlError(f"cannot be read: {error.strerror}") from error
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = 1 + error.object.count(b"\n", 0, error.start)
        raise TomlError(f"line {line}: is not UTF-8 text; save it as UTF-8") from error
    _check_depth(text)
    return text


def _read(path: Path) -> bytes:
    # Non-blocking: opening a pipe without a writer would wait forever.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise TomlError("cannot be read: is a pipe or a device; save its text as a file")
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise TomlError(f"cannot be read: has more than {MAX_BYTES / 1e6:.0f} MB")
    return data


def _check_depth(text: str) -> None:
    """Reject nesting on which a parser would take too long, by brackets and dotted keys."""
    depth = dots = 0
    line = 1
    for found in _TOKENS.finditer(text):
        token = found.group()
        line += token.count("\n")
        if token == ".":
            dots += 1
        elif token in "[{":
            depth, dots = depth + 1, 0
        elif token in "]}":
            depth, dots = max(0, depth - 1), 0
        elif token in "=,\n":
            dots = 0
        if depth > MAX_DEPTH or dots >= MAX_DEPTH:
            raise TomlError(f"line {line}: is nested in more than {MAX_DEPTH} levels")
