"""Recordings on the disk as streams, read in chunks, and any recorded MAVLink as a tlog.

| layout | bytes before each frame           | times                                   |
| ------ | --------------------------------- | --------------------------------------- |
| tlog   | eight: the time                   | as recorded, without jumps of the clock |
| padded | sixteen: the time and eight zeros | the same                                |
| bare   | none: a capture of a link         | of the messages, see `FrameClock`       |
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
from gateway.recordings.senders import Senders
from gateway.recordings.table import MAX_LINE, TableBlock, TableReader
from gateway.recordings.tlog import (
    DAY_US,
    FIRST_CIVIL_US,
    Batch,
    Timeline,
    TlogScanner,
    encode_record,
    fields_of,
)
from gateway.recordings.tlog_scan import TIME_SIZE
from gateway.units import US_PER_S, counted
from gateway.wire.mavlink_messages import DEFINITIONS
from gateway.wire.mavlink_splitter import MavlinkSplitter, SplitFault, message_id_of, origin_of

CHUNK: Final = 1 << 20
SNIFF: Final = 512
TAIL: Final = 1 << 14
"""Some twenty rows."""
MAX_HEAD: Final = 4 * MAX_LINE
"""Before the first row; a few kilobytes pack any number of zeros."""
MAX_PACKED_RATIO: Final = 100
"""Of a gzipped file. Recordings are packed to a third or a tenth, and a file of repeated lines to a
thousandth, on which a reader of lines would work for minutes."""
LEAST_BOMB: Final = 1 << 25
"""Bytes from which on that matters: they are read in a second."""
MAX_UNPACKED: Final = 1 << 30
"""Bytes to which a packed file may be unpacked at once, unless the settings give another limit; a
megabyte of gzip can hold a gigabyte of zeros."""
HEAD: Final = 1 << 14
"""The begin of a log is looked for in so many bytes, behind text that a console wrote; and some
hundred frames, by which the layout of a tlog is recognised."""
BLANK: Final = b"\xff\0"
"""Flash memory that was erased and never written, and zeros of a card that lost its power, as in
front of a log that was copied whole."""
MAX_BLANK: Final = 1 << 20
GZIP: Final = ".gz"
GZIP_MAGIC: Final = b"\x1f\x8b"
"""The first bytes show that a file is packed, whatever its name."""

Progress = Callable[[int], None]
"""Called with how many more bytes were read."""


Position = Literal["causal", "interpolated"]
SettingsChoice = Literal["recorded", "current"]
Estimates = Literal["own", "fused", "both"]
"""Of an autopilot's log: its own estimates, those of mavgate, or both as two vehicles."""

NO_RECORDING: Final = (
    "unknown file format; readable: tlog, raw MAVLink, CSV, ULog, DataFlash, MCAP, Parquet"
)
TLOG, TABLE, CSV, PARQUET = "tlog", "table", "csv", "Parquet"
"""Formats; a CSV is that of another program, with columns of its own."""
ULOG_HEAD: Final = b"ULog\x01\x12\x35"
ULOG_BEGIN: Final = re.compile(
    rb"\A[^\xfd\xfe]*?(?=ULog\x01\x12\x35|..F[a-z0-9_]+:uint64_t timestamp;)", re.DOTALL
)
"""Ends at the header of a ULog, or where that is lost at the first format of a topic. A tlog that
holds the download of a log has MAVLink frames before it."""
DATAFLASH_BEGIN: Final = re.compile(
    rb"\A(?:(?=\xa3\x95)|[^\xfd\xfe]*?(?=\xa3\x95\x80..[A-Z][A-Z0-9]{2,3}))", re.DOTALL
)
"""The same of a binary DataFlash log: its first message, or behind other bytes its first format."""
_DATAFLASH_LINE: Final = re.compile(rb"^FMT, ?\d", re.MULTILINE)
LINE_BPS: Final = 57_600
"""The usual telemetry radio; ten bits a byte."""
LAST_CIVIL_US: Final = 4_102_444_800 * US_PER_S
"""The year 2100."""
_UNITS_US: Final = {"time_boot_ms": 1000, "time_usec": 1, "time_unix_usec": 1}
"""Fields with the sender's time, and their unit."""
_TIMES: Final = {
    message_id: names
    for message_id, kind in DEFINITIONS.items()
    if (names := [name for name in _UNITS_US if name in kind.fieldnames])
}
"""Fields of each message with a time."""
PIECE: Final = 1 << 12
SHOWN_JUMPS: Final = 3
_DAY_S: Final = 86_400


class FlightError(UserError):
    """A file without the data that a command needs; the text names the data and the file."""


def _begins(*heads: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(heads)


OTHER_FORMATS: Final[dict[str, Callable[[bytes], bool]]] = {
    "ULog": lambda head: ULOG_BEGIN.search(head) is not None,
    "DataFlash": lambda head: any(
        begin.search(head) is not None for begin in (DATAFLASH_BEGIN, _DATAFLASH_LINE)
    ),
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
    """Return the begin of a file, unpacked, by which its format is known; raises OSError."""
    with open_unpacked(path) as (file, _):
        head, _ = _behind_blank(iter(lambda: file.read(HEAD), b""))
        return head[:HEAD].removeprefix(codecs.BOM_UTF8)


def _behind_blank(content: Iterator[bytes]) -> tuple[bytes, int]:
    """Return the first bytes that are not blank, `HEAD` of them if there are; and how many were."""
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
    """Bytes before the begin of a log."""

    blank: int = 0
    text: bytes = b""
    """Those that follow the blank ones."""

    @property
    def remarks(self) -> list[str]:
        """Remarks for the user about them."""
        size = self.blank + len(self.text)
        return [f"left out {counted(size, 'byte')} before its first message"] if size else []


def skip_to(begin: re.Pattern[bytes], content: Iterator[bytes]) -> tuple[Iterator[bytes], Before]:
    """Leave out the bytes before the begin of a log."""
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
    """Open a file, gzipped or not, to read it to its end."""
    with _readable(path), open_recording(path) as raw:
        packed = raw.peek(len(GZIP_MAGIC)).startswith(GZIP_MAGIC)
        yield (cast(BinaryIO, io.BufferedReader(_Unpacker(path, raw))) if packed else raw), raw


class _Unpacker(io.RawIOBase):
    """The content of a gzipped file, unless it is packed as no recording can be."""

    def __init__(self, path: Path, raw: BinaryIO) -> None:
        self._path = path
        self._raw = raw
        self._file = gzip.GzipFile(fileobj=raw)
        self._size = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer; raises OSError for a bomb."""
        data = self._file.read(len(buffer))
        buffer[: len(data)] = data
        self._size += len(data)
        if self._size > max(MAX_PACKED_RATIO * self._raw.tell(), LEAST_BOMB):
            why = f"is packed to less than 1/{MAX_PACKED_RATIO}, as no recording is"
            raise OSError(errno.EFBIG, why, str(self._path))
        return len(data)


def open_recording(path: Path) -> io.BufferedReader:
    """Open a file to read it to its end; raises OSError as `open_descriptor`."""
    return os.fdopen(open_descriptor(path), "rb")


def open_descriptor(path: Path) -> int:
    """Open a file to read it, if it has an end."""
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
    """Have a file's content in a temporary one, which nobody cuts while it is read.

    It has no name, so that nothing is left of it if the process is killed; see `name_of`.
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
    """Return a name by which this process can open a file without a name."""
    return f"/dev/fd/{file.fileno()}"


def read_ends(path: Path) -> tuple[bytes, bytes]:
    """Read the lines of a text file up to its first row, and some of the last."""
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


class FrameClock:
    """The time of each frame, counted from the first one."""

    def __init__(self, *, by_size: bool = False) -> None:
        self._by_size = by_size
        self.civil_us_at_zero: int | None = None
        """Civil time of the first frame; None until a message gives it."""
        self.is_timed = False
        """Whether any message held a time."""
        self._now_us = 0
        self._line_us = 0.0
        self._bases_us: dict[tuple[int | str, ...], tuple[int, int]] = {}
        """Of each sender and field: time at its own zero, and its newest own time."""

    def time_us(self, frame: bytes) -> int:
        """Return the time of the next frame."""
        self._line_us += len(frame) * 10 * US_PER_S / LINE_BPS
        message_id = message_id_of(frame)
        if names := _TIMES.get(message_id):
            fields = fields_of(frame)
            for name in names:
                if own_us := fields[name] * _UNITS_US[name]:
                    self._update(own_us, (*origin_of(frame), message_id, name))
        return round(self._line_us) if self._by_size else self._now_us

    def _update(self, own_us: int, key: tuple[int | str, ...]) -> None:
        is_civil = FIRST_CIVIL_US < own_us < LAST_CIVIL_US
        if is_civil and self.civil_us_at_zero is None:
            self.civil_us_at_zero = own_us - self._now_us
        self.is_timed = True
        base_us, newest_us = self._bases_us.get(key, (self._now_us - own_us, own_us))
        if not -US_PER_S <= own_us - newest_us <= DAY_US:
            base_us = self._now_us - own_us
        self._now_us = max(self._now_us, base_us + own_us)
        self._bases_us[key] = (base_us, own_us)


class Layout(IntEnum):
    """Bytes between two frames."""

    BARE = 0
    TLOG = TIME_SIZE
    PADDED = 2 * TIME_SIZE


@dataclass(frozen=True, slots=True)
class TlogSource:
    """A file of recorded MAVLink whose layout and clock are known."""

    path: Path
    layout: Layout
    timeline: Timeline
    senders: Senders
    remarks: tuple[str, ...] = ()
    """Remarks for the user about its times."""
    civil_us_at_zero: int = 0
    by_size: bool = False
    """Whether frames of a bare capture are spaced by their size."""

    def chunks(self, progress: Progress | None = None, limit: int | None = None) -> Iterator[bytes]:
        """Read it as the bytes of a tlog; see `read_chunks`."""
        data = read_chunks(self.path, progress, limit)
        if self.layout is Layout.TLOG:
            return data
        if self.layout is Layout.PADDED:
            return _stamped(data)
        return self._timed(data)

    def batches(self, progress: Progress | None = None, *, strict: bool = False) -> Iterator[Batch]:
        """Read it batch by batch, at corrected times; see `TlogScanner`."""
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
    """Recognise the layout of a file, and read its times once; raises OSError."""
    layout = file_layout(first_bytes(path))
    if layout is Layout.BARE:
        return _open_bare(path)
    timeline, senders = Timeline(), Senders()
    for batch in TlogSource(path, layout, Timeline(), senders).batches():
        timeline.add(batch)
        senders.add(batch)
    padded = ("has eight zero bytes more in each record; left out",)
    remarks = padded if layout is Layout.PADDED else ()
    return TlogSource(path, layout, timeline, senders, (*remarks, *_jumps_in_words(timeline)))


def file_layout(head: bytes) -> Layout:
    """Recognise the layout by the bytes between the first frames; a tlog where it is unclear."""
    gaps: Counter[int] = Counter()
    splitter, gap, met = MavlinkSplitter(), 0, False
    # In pieces: bytes with many false starts are not searched to their end.
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
        how = (
            f"no message holds a time, so frames are spaced as a line of {LINE_BPS} baud sends them"
        )
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
    """Yield the frames of each chunk, each behind the count and last of the bytes before it."""
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
    """Leave out the eight zeros of each record, before or behind its time."""
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
            "its times run on without the jump"
        )
    if (more := len(timeline.jumps) - SHOWN_JUMPS) > 0:
        yield f"and {counted(more, 'more jump')} of its clock"
