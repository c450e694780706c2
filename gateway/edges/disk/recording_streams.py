"""Recordings on the disk as streams: read in chunks."""

import gzip
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO, Final, cast

from gateway.flightlog.table.table import TableEvent, TableReader
from gateway.flightlog.tlog.tlog import Batch, TlogScanner

CHUNK: Final = 1 << 20
SNIFF: Final = 512
TAIL: Final = 1 << 14
"""Some twenty rows."""
GZIP: Final = ".gz"

Progress = Callable[[int], None]
"""Called with how many more bytes were read."""


class FileKind(StrEnum):
    """What a file holds."""

    TLOG = "tlog"
    TABLE = "table"
    FOREIGN = "foreign"
    """Text with columns that are not ours."""
    OTHER = "other"
    """A format that `OTHER_FORMATS` knows."""


OTHER_FORMATS: Final[dict[str, Callable[[bytes], bool]]] = {}
"""Whether a file that begins with these bytes is of a format, by the format's name."""


def kind_of(path: Path) -> FileKind:
    """Look at a file's first bytes; raises OSError if it cannot be read."""
    with _open(path) as file:
        head = file.read(SNIFF)
    if any(knows(head) for knows in OTHER_FORMATS.values()):
        return FileKind.OTHER
    if head.startswith((b"# mavgate table", b"time_us,")):
        return FileKind.TABLE
    is_binary = b"\0" in head or b"\xfd" in head or b"\xfe" in head
    return FileKind.TLOG if is_binary or b"," not in head else FileKind.FOREIGN


def other_format(path: Path) -> str:
    """Return which of `OTHER_FORMATS` a file is; raises KeyError if it is none."""
    with _open(path) as file:
        head = file.read(SNIFF)
    for name, knows in OTHER_FORMATS.items():
        if knows(head):
            return name
    raise KeyError(path)


def read_chunks(path: Path, progress: Progress | None = None) -> Iterator[bytes]:
    """Read a file, gzipped or not, piece by piece; progress counts bytes on the disk."""
    done = 0
    with path.open("rb") as raw, _unpacked(path, raw) as file:
        while data := file.read(CHUNK):
            yield data
            if progress is not None:
                progress(raw.tell() - done)
                done = raw.tell()


def read_ends(path: Path) -> tuple[bytes, bytes]:
    """Read the lines of a text that stand before its first row, and some of the last.

    Returns
    -------
    head : bytes
        The lines up to the first that is no comment, and that one.
    tail : bytes
        The last lines, the first of them whole.
    """
    head = tail = b""
    with _open(path) as file:
        for line in file:
            head += line
            if not line.startswith(b"#"):
                break
        if path.suffix == GZIP:
            while data := file.read(CHUNK):
                tail = tail[-TAIL:] + data
        else:
            file.seek(max(len(head), path.stat().st_size - TAIL))
            tail = file.read()
    return head, tail[-TAIL:].partition(b"\n")[2]


def _open(path: Path) -> BinaryIO:
    return cast(BinaryIO, gzip.open(path)) if path.suffix == GZIP else path.open("rb")


def _unpacked(path: Path, raw: BinaryIO) -> BinaryIO:
    return cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if path.suffix == GZIP else raw


def read_batches(
    path: Path, progress: Progress | None = None, *, strict: bool = False
) -> Iterator[Batch]:
    """Read a tlog batch by batch; see `TlogScanner`."""
    scanner = TlogScanner(strict=strict)
    for data in read_chunks(path, progress):
        yield scanner.feed(data)
    yield scanner.feed(b"", final=True)


def read_events(
    path: Path, reader: TableReader, progress: Progress | None = None
) -> Iterator[TableEvent]:
    """Read a table event by event; the reader then knows its head."""
    for data in read_chunks(path, progress):
        yield from reader.feed(data)
    yield from reader.feed(b"", final=True)
