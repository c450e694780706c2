"""Read recordings from disk as streams of chunks, and any recorded MAVLink as a tlog.

| layout | bytes before each frame           | times                                   |
| ------ | --------------------------------- | --------------------------------------- |
| tlog   | 8: the time                       | as recorded, without jumps of the clock |
| padded | 16: the time and eight zeros      | as for tlog                             |
| bare   | 0: a capture of a link            | from the messages, see `FrameClock`     |
"""

import codecs
import errno
import gzip
import io
import os
import re
import stat
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any, BinaryIO, Final, Literal, cast

from gateway.printable import UserError
from gateway.recordings.recorded_clock import LINE_BPS, FrameClock, Timeline
from gateway.recordings.table import MAX_LINE, TableBlock, TableReader
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.units import US_PER_S, counted
from gateway.vehicle_state.senders import Senders
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_splitter import MavlinkSplitter, SplitFault
from gateway.wire.recorded_frames import Batch

CHUNK: Final = 1 << 20
SNIFF: Final = 512
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
HEAD: Final = 1 << 14
"""Bytes that are searched for the start of a log, which may follow text that a console wrote, and
from which the layout of a tlog is recognised: several hundred frames."""
BLANK: Final = b"\xff\0"
"""Erased flash memory, and zeros of a card that lost its power; they may precede a log that was
copied from raw memory."""
MAX_BLANK: Final = 1 << 20
GZIP: Final = ".gz"
GZIP_MAGIC: Final = b"\x1f\x8b"
"""First bytes of a gzipped file; its name is not considered."""

Progress = Callable[[int], None]
"""Callback with the number of bytes read since its last call."""


Position = Literal["causal", "interpolated"]
SettingsChoice = Literal["recorded", "current"]
Estimates = Literal["own", "fused", "both"]
"""Estimates to use from an autopilot's log: its own, those of mavgate, or both as two vehicles."""

NO_RECORDING: Final = (
    "unknown file format; readable: tlog, raw MAVLink, CSV, ULog, DataFlash, MCAP, Parquet"
)
TLOG, TABLE, CSV, PARQUET = "tlog", "table", "csv", "Parquet"
"""Names of formats; a CSV is one of another program, with columns of its own."""
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
PIECE: Final = 1 << 12
SHOWN_JUMPS: Final = 3
_DAY_S: Final = 86_400


class FlightError(UserError):
    """A file lacks the data that a command needs; the text names the data and the file."""


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


def is_packed(path: Path) -> bool:
    """Return whether a file is gzipped, by its first bytes; raises OSError."""
    with open_unpacked(path) as (file, raw):
        return file is not raw


@contextmanager
def open_unpacked(path: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """Open a file, gzipped or not, for reading to its end; yields the content and the raw file."""
    with _readable(path), open_recording(path) as raw:
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


def open_recording(path: Path) -> io.BufferedReader:
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


class Layout(IntEnum):
    """Number of bytes before each frame."""

    BARE = 0
    TLOG = TIME_SIZE
    PADDED = 2 * TIME_SIZE


@dataclass(frozen=True, slots=True)
class TlogSource:
    """A file of recorded MAVLink with its recognised layout and its clock."""

    path: Path
    layout: Layout
    timeline: Timeline
    senders: Senders
    remarks: tuple[str, ...] = ()
    """Remarks for the user on its times."""
    civil_us_at_zero: int = 0
    by_size: bool = False
    """Whether frames of a capture without times are spaced by their transmission time."""

    def chunks(self, progress: Progress | None = None, limit: int | None = None) -> Iterator[bytes]:
        """Read the file as the bytes of a tlog; see `read_chunks`."""
        data = read_chunks(self.path, progress, limit)
        if self.layout is Layout.TLOG:
            return data
        if self.layout is Layout.PADDED:
            return _stamped(data)
        return self._timed(data)

    def batches(self, progress: Progress | None = None, *, strict: bool = False) -> Iterator[Batch]:
        """Read the file batch by batch, at corrected times; see `TlogScanner`."""
        scanner = TlogScanner(strict=strict)
        for data in self.chunks(progress):
            yield self.timeline.apply(scanner.feed(data))
        yield self.timeline.apply(scanner.feed(b"", final=True))

    def _timed(self, data: Iterator[bytes]) -> Iterator[bytes]:
        clock = FrameClock(by_size=self.by_size)
        for pieces in _frames(data):
            yield b"".join(
                encode_record(self.civil_us_at_zero + clock.time_us(frame), frame)
                for *_, frame in pieces
            )


def open_tlog(path: Path) -> TlogSource:
    """Recognise the layout of a file, and read all its times once; raises OSError."""
    layout = file_layout(first_bytes(path))
    if layout is Layout.BARE:
        return _open_bare(path)
    timeline, senders = Timeline(), Senders()
    for batch in TlogSource(path, layout, Timeline(), senders).batches():
        timeline.add(batch)
        senders.add(batch)
    padded = ("has eight extra zero bytes in each record; left out",)
    remarks = padded if layout is Layout.PADDED else ()
    return TlogSource(path, layout, timeline, senders, (*remarks, *_jumps_in_words(timeline)))


def file_layout(head: bytes) -> Layout:
    """Recognise the layout by the bytes between the first frames; a tlog if that is ambiguous."""
    gaps: Counter[int] = Counter()
    splitter, gap, met = MavlinkSplitter(), 0, False
    # In pieces, which bounds the work for bytes with many false starts of frames.
    for begin in range(0, len(head), PIECE):
        for event in splitter.feed(head[begin : begin + PIECE]):
            if isinstance(event, SplitFault):
                gap += event.size
            else:
                gaps[gap] += met
                gap, met = 0, True
    return max((Layout.TLOG, Layout.PADDED, Layout.BARE), key=lambda layout: gaps[int(layout)])


def _open_bare(path: Path) -> TlogSource:
    clock, left_out = FrameClock(), 0
    for pieces in _frames(read_chunks(path)):
        for size, _, frame in pieces:
            left_out += size
            clock.time_us(frame)
    how = "its times are those in its messages"
    if not clock.is_timed:
        how = f"no message contains a time, so frames are spaced as on a link of {LINE_BPS} baud"
    remarks = [f"is a capture without time stamps; {how}"]
    if left_out:
        remarks.append(f"left out {counted(left_out, 'byte')} between frames")
    zero_us = clock.civil_us_at_zero or 0
    source = TlogSource(
        path, Layout.BARE, Timeline(), Senders(), tuple(remarks), zero_us,
        by_size=not clock.is_timed,
    )  # fmt: skip
    for batch in source.batches():
        source.senders.add(batch)
    return source


def _frames(data: Iterator[bytes]) -> Iterator[list[tuple[int, bytes, bytes]]]:
    """Yield the frames of each chunk, each with the number and the last of the skipped bytes."""
    splitter, rest, lead, left_out = MavlinkSplitter(), b"", b"", 0
    for chunk in data:
        for begin in range(0, len(chunk), PIECE):
            piece = chunk[begin : begin + PIECE]
            rest, at = rest + piece, 0
            found: list[tuple[int, bytes, bytes]] = []
            for event in splitter.feed(piece):
                size = event.size if isinstance(event, SplitFault) else len(event.data)
                if isinstance(event, SplitFault):
                    left_out += size
                    lead = (lead + rest[at : at + size])[-2 * TIME_SIZE :]
                else:
                    found.append((left_out, lead, event.data))
                    lead, left_out = b"", 0
                at += size
            rest = rest[at:]
            yield found


def _stamped(data: Iterator[bytes]) -> Iterator[bytes]:
    """Remove the eight zeros of each record, which are before or after its time."""
    for pieces in _frames(data):
        records = []
        for _, lead, frame in pieces:
            first, second = lead[-2 * TIME_SIZE : -TIME_SIZE], lead[-TIME_SIZE:]
            time = second if not any(first) else first
            records.append(time.rjust(TIME_SIZE, b"\0") + frame)
        yield b"".join(records)


def _jumps_in_words(timeline: Timeline) -> Iterator[str]:
    for jump in timeline.jumps[:SHOWN_JUMPS]:
        step_s = jump.step_us / US_PER_S
        days = abs(step_s) / _DAY_S
        size = f"{days:.1f} days" if days >= 1 else f"{abs(step_s):.0f} s"
        direction = "forward" if step_s > 0 else "back"
        yield (
            f"its clock jumped {direction} by {size} at {jump.offset_us / US_PER_S:.1f} s; "
            "its times continue without the jump"
        )
    if (more := len(timeline.jumps) - SHOWN_JUMPS) > 0:
        yield f"and {counted(more, 'more jump')} of its clock"
