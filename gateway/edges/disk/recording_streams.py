"""Recordings on the disk as streams: read in chunks."""

import codecs
import errno
import gzip
import io
import os
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from tempfile import NamedTemporaryFile, gettempdir
from typing import IO, BinaryIO, Final, cast

from gateway.flightlog.table.table import MAX_LINE, TableBlock, TableReader

CHUNK: Final = 1 << 20
SNIFF: Final = 512
TAIL: Final = 1 << 14
"""Some twenty rows."""
MAX_HEAD: Final = 4 * MAX_LINE
"""Before the first row; a few kilobytes pack any number of zeros."""
MAX_UNPACKED: Final = 1 << 30
"""Bytes to which a packed file may be unpacked at once, unless the settings give another limit; a
megabyte of gzip can hold a gigabyte of zeros."""
ERASED: Final = b"\xff"
"""Flash memory that was erased and never written, as in front of a log that was copied whole."""
MAX_ERASED: Final = 1 << 20
GZIP: Final = ".gz"
GZIP_MAGIC: Final = b"\x1f\x8b"
"""The first bytes tell that a file is packed, whatever its name."""

Progress = Callable[[int], None]
"""Called with how many more bytes were read."""


class FileKind(StrEnum):
    """What a file holds."""

    TLOG = "tlog"
    TABLE = "table"
    CSV = "csv"
    """Of another program, with columns of its own."""
    OTHER = "other"
    """A format in `OTHER_FORMATS`."""


def _begins(*heads: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(heads)


PARQUET: Final = "Parquet"
OTHER_FORMATS: Final[dict[str, Callable[[bytes], bool]]] = {
    "ULog": _begins(b"ULog\x01\x12\x35"),
    "DataFlash": lambda head: head.startswith((b"\xa3\x95", b"FMT,")) or b"\nFMT, 1" in head,
    PARQUET: _begins(b"PAR1"),
}
"""Whether a file that begins with these bytes is of a format, by the format's name."""


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


def kind_of(path: Path) -> FileKind:
    """Recognise a file by its first bytes; raises OSError if it cannot be read."""
    head = first_bytes(path)
    if encoding_of(head) != "utf-8-sig":
        return FileKind.CSV
    if any(knows(head) for knows in OTHER_FORMATS.values()):
        return FileKind.OTHER
    if head.startswith((b"# mavgate table", b"time_us,")):
        return FileKind.TABLE
    is_binary = b"\0" in head or b"\xfd" in head or b"\xfe" in head
    has_cells = any(delimiter in head for delimiter in (b",", b";", b"\t"))
    return FileKind.CSV if has_cells and not is_binary else FileKind.TLOG


def other_format(path: Path) -> str:
    """Return which of `OTHER_FORMATS` a file has; raises KeyError if none."""
    head = first_bytes(path)
    for name, knows in OTHER_FORMATS.items():
        if knows(head):
            return name
    raise KeyError(path)


def first_bytes(path: Path) -> bytes:
    """Return the begin of a file, unpacked, by which its format is known; raises OSError."""
    with open_unpacked(path) as (file, _):
        head = file.read(SNIFF)
        for _ in range(MAX_ERASED // SNIFF):
            if head.strip(ERASED) or not head:
                break
            head = file.read(SNIFF)
        if head[:2] == ERASED * 2:
            head = head.lstrip(ERASED) + file.read(SNIFF)
        return head.removeprefix(codecs.BOM_UTF8)


def is_packed(path: Path) -> bool:
    """Return whether a file is gzipped, by its first bytes; raises OSError."""
    with open_unpacked(path) as (file, raw):
        return file is not raw


@contextmanager
def open_unpacked(path: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """Open a file, gzipped or not, to read it to its end.

    Yields
    ------
    file : BinaryIO
        Gives its bytes unpacked.
    raw : BinaryIO
        The file on the disk.

    Raises
    ------
    OSError
        As `open_descriptor`, or if it is a damaged gzip file.
    """
    with _readable(path), open_recording(path) as raw:
        packed = raw.peek(len(GZIP_MAGIC)).startswith(GZIP_MAGIC)
        yield (cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if packed else raw), raw


def open_recording(path: Path) -> io.BufferedReader:
    """Open a file to read it to its end; raises OSError as `open_descriptor`."""
    return os.fdopen(open_descriptor(path), "rb")


def open_descriptor(path: Path) -> int:
    """Open a file to read it, if it has an end.

    Raises
    ------
    OSError
        If it cannot be read, or is a pipe or a device: they may have no end, and give their bytes
        only once.
    """
    # A pipe that nobody writes to would wait here.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "is a pipe or a device; save its bytes as a file", str(path))


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raise a clear OSError for a damaged gzip file, and one with a name for what fails later."""
    try:
        yield
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise OSError(
            errno.EIO,
            f"is a damaged gzip file ({error}); `gzip -dc FILE > NEW` saves the intact part",
            str(path),
        ) from error
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def read_chunks(
    path: Path, progress: Progress | None = None, limit: int | None = None
) -> Iterator[bytes]:
    """Read a file, gzipped or not, in chunks.

    Parameters
    ----------
    path : Path
        The file.
    progress : callable, optional
        Called with the number of further bytes read from the disk.
    limit : int, optional
        Maximum unpacked size of a packed file, in bytes. Callers that keep the content need one;
        a caller that handles chunk by chunk does not.

    Raises
    ------
    OSError
        As `open_unpacked`, or if the limit is exceeded.
    """
    done = size = 0
    with open_unpacked(path) as (file, raw):
        while data := file.read(CHUNK):
            size += len(data)
            if limit is not None and file is not raw and size > limit:
                why = (
                    f"unpacks to more than {limit / 1e6:.0f} MB; unpack it with gzip -d, or raise "
                    "unpacked_limit_mb in the section [recording] of the settings"
                )
                raise OSError(errno.EFBIG, why, str(path))
            yield data
            if progress is not None:
                progress(raw.tell() - done)
                done = raw.tell()


@contextmanager
def temporary_copy(path: Path, content: Iterable[bytes]) -> Iterator[IO[bytes]]:
    """Have a file's content in a temporary one, which nobody cuts while it is read.

    Parameters
    ----------
    path : Path
        The file, for an error.
    content : iterable of bytes
        Its bytes, unpacked.

    Raises
    ------
    OSError
        If there is no room for it.
    """
    copy = NamedTemporaryFile(prefix="mavgate-")  # noqa: SIM115
    try:
        for data in content:
            copy.write(data)
        copy.flush()
    except OSError as error:
        with suppress(OSError):
            copy.close()
        if error.filename is not None:
            raise
        why = f"{error.strerror} for a copy of {path}; TMPDIR names another folder"
        raise OSError(error.errno, why, gettempdir()) from error
    with copy:
        yield copy


def read_ends(path: Path) -> tuple[bytes, bytes]:
    """Read the lines of a text file up to its first row, and some of the last.

    Returns
    -------
    head : bytes
        The lines up to and including the first that is not a comment.
    tail : bytes
        The last lines, the first of them whole.
    """
    head = tail = b""
    with open_unpacked(path) as (file, raw):
        while line := file.readline(MAX_LINE):
            head += line
            if not line.startswith(b"#") or len(head) > MAX_HEAD:
                break
        if file is raw:
            file.seek(max(len(head), path.stat().st_size - TAIL))
            tail = file.read()
        else:
            while data := file.read(CHUNK):
                tail = tail[-TAIL:] + data
    return head, tail[-TAIL:].partition(b"\n")[2]


def read_blocks(path: Path, reader: TableReader, progress: Progress | None) -> Iterator[TableBlock]:
    """Read a table block by block; the reader then knows its head."""
    for data in read_chunks(path, progress):
        yield reader.feed_block(data)
    yield reader.feed_block(b"", final=True)
