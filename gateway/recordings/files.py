"""Read files of any kind, gzipped or not, as streams of chunks, lines and blocks."""

import errno
import gzip
import io
import os
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any, BinaryIO, Final, cast

from gateway.printable import UserError
from gateway.recordings.table import MAX_LINE, TableBlock, TableReader

CHUNK: Final = 1 << 20
TAIL: Final = 1 << 14
"""Bytes read at the end of a table, about 20 rows."""
MAX_HEAD: Final = 4 * MAX_LINE
"""Maximum bytes before the first row: a few packed kilobytes can expand to any number of zeros."""
MAX_PACKED_RATIO: Final = 100
"""Maximum compression ratio of a gzipped file. Recordings are packed to a third or a tenth. A file
of repeated lines is packed to a thousandth, and reading its lines would take minutes."""
LEAST_BOMB: Final = 1 << 25
"""Unpacked bytes from which the ratio is checked; less is read within a second."""
MAX_UNPACKED: Final = 1 << 30
"""Maximum unpacked size of a file, bytes, unless the settings give another limit: a megabyte of
gzip can expand to a gigabyte of zeros."""
GZIP: Final = ".gz"
GZIP_MAGIC: Final = b"\x1f\x8b"
"""First bytes of a gzipped file; its name is not considered."""

Progress = Callable[[int], None]
"""Callback with the number of bytes read since its last call."""


class FlightError(UserError):
    """A file lacks the data that a command needs; the text names the data and the file."""


def is_packed(path: Path) -> bool:
    """Return whether a file is gzipped, by its first bytes; raises OSError."""
    with open_unpacked(path) as (file, raw):
        return file is not raw


@contextmanager
def open_unpacked(path: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """Open a file, gzipped or not, for reading to its end; yields the content and the raw file."""
    with _readable(path), open_file(path) as raw:
        packed = raw.peek(len(GZIP_MAGIC)).startswith(GZIP_MAGIC)
        yield (cast(BinaryIO, io.BufferedReader(_Unpacker(path, raw))) if packed else raw), raw


class _Unpacker(io.RawIOBase):
    """The content of a gzipped file; rejects a compression ratio that no recording has."""

    def __init__(self, path: Path, raw: BinaryIO) -> None:
        self._path = path
        self._raw = raw
        self._file = gzip.GzipFile(fileobj=raw)
        self._size = 0

    def readable(self) -> bool:
        """Return True, as `io.RawIOBase` requires."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer; raises OSError if the compression ratio is too high."""
        data = self._file.read(len(buffer))
        buffer[: len(data)] = data
        self._size += len(data)
        if self._size > max(MAX_PACKED_RATIO * self._raw.tell(), LEAST_BOMB):
            why = f"has a compression ratio above {MAX_PACKED_RATIO}, which no recording has"
            raise OSError(errno.EFBIG, why, str(self._path))
        return len(data)


def open_file(path: Path) -> io.BufferedReader:
    """Open a file for reading to its end; raises OSError as `open_descriptor`."""
    return os.fdopen(open_descriptor(path), "rb")


def open_descriptor(path: Path) -> int:
    """Open a regular file for reading; raises OSError for a pipe or a device."""
    # Non-blocking: opening a pipe without a writer would wait forever.
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
    """Raise OSError with a clear text for a damaged gzip file, and with a name for other errors."""
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
    """Read a file, gzipped or not, in chunks."""
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
    """Copy content to a temporary file, which nobody can truncate while it is read.

    The file has no name, so nothing is left if the process is killed; see `name_of`.
    """
    copy = TemporaryFile(prefix="mavgate-")  # noqa: SIM115
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


def name_of(file: IO[bytes]) -> str:
    """Return a path by which this process can open an unnamed file."""
    return f"/dev/fd/{file.fileno()}"


def read_ends(path: Path) -> tuple[bytes, bytes]:
    """Read the lines of a text file up to its first row, and some of its last lines."""
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
    """Read a table block by block; the reader stores its head."""
    for data in read_chunks(path, progress):
        yield reader.feed_block(data)
    yield reader.feed_block(b"", final=True)
