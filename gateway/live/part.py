"""One part of a recording: the data buffered for it, its limits, and its files on the disk.

Everything about files may block and runs in the recorder's threads. Files are only ever appended
to, so a power cut at any moment leaves the data that was written before. Only a record that was
written partly is removed again. Finished files get their true times once GPS has provided them: a
part may be larger than the memory and the disk slow, so a file is copied in small steps, between
which the present recording is synced. The copy replaces the file in one step: a power cut leaves
either.
"""

import contextlib
import errno
import logging
import os
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from gateway.hub.limits import TokenBucket
from gateway.live.session import part_stem
from gateway.output import sync_folder
from gateway.recordings.columns import RowBuilder, TableRow, row_to_line
from gateway.recordings.index import check_free, free_name, list_recordings, move_recording
from gateway.recordings.table import HEADER_PREFIX, TableHeader, TableMark, encode_head, encode_line
from gateway.recordings.tlog import Stamper, TlogScanner, encode_record
from gateway.records import BaroRaw, FusedSample, FusionState, GpsFix, NodeStatus

PENDING_LIMIT: Final = 16 << 20
"""Bytes that wait for a slow disk: minutes of telemetry. More is dropped."""
TLOG: Final = ".tlog"


@dataclass(slots=True)
class _Table:
    """One aircraft's table, which begins with its first row."""

    header: TableHeader
    state: FusionState | None
    rows: RowBuilder = field(default_factory=RowBuilder)
    begun: bool = False


class Part:
    """Bytes by the ending of their file's name, buffered until they are written to the disk."""

    def __init__(self, session: str, number: int, offset_us: int) -> None:
        self.session = session
        """May be set until the table of an aircraft begins."""
        self.number = number
        self.stamper = Stamper(offset_us)
        self.pending: dict[str, bytearray] = {}
        self.size = 0
        """Bytes added, those beyond the limit included."""
        self._tables: dict[int, _Table] = {}
        self._introduced: set[int] = set()

    def add(self, ending: str, data: bytes) -> None:
        """Buffer bytes for one file, unless too many wait already."""
        if self.size < PENDING_LIMIT:
            self.pending.setdefault(ending, bytearray()).extend(data)
        self.size += len(data)

    def take(self) -> dict[str, bytes]:
        """Return the buffered bytes and clear the buffer."""
        pending, self.pending, self.size = self.pending, {}, 0
        return {ending: bytes(data) for ending, data in pending.items()}

    def add_frame(self, frame: bytes, now_us: int) -> None:
        """Buffer a MAVLink frame for the tlog."""
        self.add(TLOG, encode_record(self.stamper.stamp(now_us), frame))

    def introduces(self, vehicle_id: int) -> bool:
        """Return whether this part has nothing of an aircraft yet; from then on it has."""
        is_new = vehicle_id not in self._introduced
        self._introduced.add(vehicle_id)
        return is_new

    def has_table(self, vehicle_id: int) -> bool:
        """Return whether the table of an aircraft was prepared."""
        return vehicle_id in self._tables

    def prepare_table(self, header: TableHeader, state: FusionState | None = None) -> None:
        """Set the head of an aircraft's table."""
        self._tables[header.vehicle_id] = _Table(header, state)

    def add_flight(
        self, vehicle_id: int, record: BaroRaw | GpsFix | FusedSample | NodeStatus
    ) -> None:
        """Buffer a record of an aircraft, for a table that was prepared."""
        if isinstance(record, NodeStatus):
            # It begins no table: the first row must come first.
            if self._tables[vehicle_id].begun:
                self.add(table_ending(vehicle_id), encode_line(record).encode())
            return
        self._write(self._tables[vehicle_id], self._tables[vehicle_id].rows.add(record))

    def change_settings(self, header: TableHeader) -> None:
        """Note in a prepared table that the following rows are fused with other settings."""
        table = self._tables[header.vehicle_id]
        self._begin(table)
        self._write(table, table.rows.flush())
        self.add(table_ending(header.vehicle_id), encode_line(header).encode())

    def add_mark(self, mark: TableMark) -> None:
        """Add a remark to every table that has begun."""
        for vehicle_id, table in self._tables.items():
            if table.begun:
                self.add(table_ending(vehicle_id), encode_line(mark).encode())

    def flush_rows(self) -> None:
        """Buffer also the records that still wait for an IMU sample to share its row."""
        for table in self._tables.values():
            self._write(table, table.rows.flush())

    def _begin(self, table: _Table) -> None:
        if not table.begun:
            table.begun = True
            # The name may have changed since the table was prepared.
            header = msgspec.structs.replace(table.header, session=self.session)
            begun = "" if table.state is None else encode_line(table.state)
            self.add(table_ending(header.vehicle_id), (encode_head(header) + begun).encode())

    def _write(self, table: _Table, rows: list[TableRow]) -> None:
        for row in rows:
            self._begin(table)
            self.add(table_ending(table.header.vehicle_id), row_to_line(row).encode())


def table_ending(vehicle_id: int) -> str:
    """Return the file name ending of an aircraft's table."""
    return f"_v{vehicle_id}.csv"


TRUSTED_RATE: Final = 64_000
"""Bytes a second for each client that may change things: more than any ground station sends."""
UNTRUSTED_RATE: Final = 4_000
"""Bytes a second for all others together."""
BURST_S: Final = 16
"""Length of a burst: a ground station requests much when it connects, then little."""


class RecordingBudget:
    """Quotas of bytes that are recorded of each client; an unknown client is untrusted."""

    def __init__(self) -> None:
        self._untrusted = _bucket(UNTRUSTED_RATE, 0)
        self._trusted: dict[int, TokenBucket] = {}

    def note(self, client_id: int, now_us: int, *, trusted: bool) -> None:
        """Note whether a client may change things."""
        if not trusted:
            self._trusted.pop(client_id, None)
        elif client_id not in self._trusted:
            self._trusted[client_id] = _bucket(TRUSTED_RATE, now_us)

    def remove_client(self, client_id: int) -> None:
        """Discard the quota of a client that has gone."""
        self._trusted.pop(client_id, None)

    def takes(self, client_id: int, size: int, now_us: int) -> bool:
        """Return whether a frame from a client, or to it alone, is recorded."""
        bucket = self._trusted.get(client_id, self._untrusted)
        bucket.refill(now_us)
        if bucket.level < size:
            return False
        bucket.level -= size
        return True


def _bucket(rate: int, now_us: int) -> TokenBucket:
    return TokenBucket(rate, rate * BURST_S, rate * BURST_S, now_us)


log = logging.getLogger(__name__)

RIGHTS: Final = 0o644


@dataclass(frozen=True, slots=True)
class DiskState:
    """Result of a write."""

    part_bytes: int
    """Size of the largest file."""
    free_bytes: int


def free_bytes_near(folder: Path) -> int:
    """Return the free space where a folder is, or would be created."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def reason_of(error: OSError) -> str:
    """Describe a disk error in a few words: a STATUSTEXT has 50 bytes."""
    known = {
        errno.ENOSPC: "disk is full",
        errno.EDQUOT: "disk quota is used up",
        errno.EROFS: "disk is read-only",
        errno.EACCES: "no right to write",
        errno.ENOENT: "folder has vanished",
        errno.EIO: "disk fails",
    }
    return known.get(error.errno or 0, os.strerror(error.errno or errno.EIO))


class PartFiles:
    """Append to the files of one part, opening each with its first bytes."""

    def __init__(self, folder: Path, session: str, part: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self.session = free_name(folder, session) if part == 1 else session
        self._part = part
        self._files: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        self._has_new_names = False

    def write(self, pieces: Mapping[str, bytes]) -> DiskState:
        """Append to files, without waiting for the physical disk."""
        for ending, data in pieces.items():
            if ending not in self._files:
                self._open(ending)
            self._append(ending, data)
        for file in self._files.values():
            if os.fstat(file).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "removed while it was written")
        return DiskState(max(self._sizes.values(), default=0), free_bytes_near(self._folder))

    def sync_job(self) -> Callable[[], None]:
        """Return a function that waits until all written data is on the physical disk.

        It raises OSError if the disk fails. Other threads may write meanwhile, but not close.
        """
        folder, self._has_new_names = self._folder if self._has_new_names else None, False
        return partial(_sync, tuple(self._files.values()), folder)

    def rename(self, to_name: str) -> None:
        """Rename the recording between two writes; the folder is not synced."""
        if self.session in {recording.name for recording in list_recordings(self._folder)}:
            move_recording(self._folder, self.session, to_name)
        else:
            check_free(self._folder, to_name)
        self.session = to_name

    def close(self, pieces: Mapping[str, bytes]) -> None:
        """Append the last bytes, sync, close all files, and remove empty ones."""
        try:
            self.write(pieces)
        finally:
            try:
                self.sync_job()()
            finally:
                self._close_all()

    def _close_all(self) -> None:
        files, self._files = self._files, {}
        for ending, file in files.items():
            os.close(file)
            if not self._sizes[ending]:
                self._path(ending).unlink(missing_ok=True)

    def _open(self, ending: str) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        try:
            self._files[ending] = os.open(self._path(ending), flags, RIGHTS)
        except FileExistsError:
            if self._part != 1 or self._files:
                raise
            self.session = free_name(self._folder, self.session)
            self._files[ending] = os.open(self._path(ending), flags, RIGHTS)
        self._sizes[ending] = 0
        self._has_new_names = True

    def _path(self, ending: str) -> Path:
        return self._folder / (part_stem(self.session, self._part) + ending)

    def _append(self, ending: str, data: bytes) -> None:
        file, size, view = self._files[ending], self._sizes[ending], memoryview(data)
        try:
            while view:
                view = view[os.write(file, view) :]
        except OSError:
            # A full disk writes only the start of the data: no partial record may stay.
            with contextlib.suppress(OSError):
                os.ftruncate(file, size)
            raise
        self._sizes[ending] = size + len(data)


def close_behind(
    files: PartFiles, written: Future[DiskState], syncing: Future[None] | None
) -> None:
    """Close a part once its end is written and its last sync has ended; log what fails."""
    try:
        try:
            written.result()
        finally:
            files.close({})
        if syncing is not None:
            syncing.result()
    except OSError as error:
        log.warning("Recording: the end of %s is lost: %s", files.session, reason_of(error))


def _sync(files: Iterable[int], folder: Path | None) -> None:
    if folder is not None:
        sync_folder(folder)
    for file in files:
        os.fdatasync(file)


STEP: Final = 1 << 16
"""Bytes in one step: a millisecond's work."""
NEW: Final = ".new"


class Restamper:
    """Shift the times of files, one after the other."""

    def __init__(self, free_floor: int) -> None:
        self._free_floor = free_floor
        self._waiting: deque[tuple[Path, Iterator[None]]] = deque()

    def add(self, path: Path, shift_us: int) -> None:
        """Queue a file whose times are to be shifted."""
        if shift_us:
            self._waiting.append((path, self._steps(path, shift_us)))

    async def run(self, on_disk: Callable[[Callable[[], bool]], Awaitable[bool]]) -> None:
        """Process the queue, running each step in the thread that syncs."""
        while await on_disk(self.step):
            pass

    def finish(self) -> None:
        """Process the queue at once."""
        while self.step():
            pass

    def step(self) -> bool:
        """Do one step; return whether there is more to do."""
        if not self._waiting:
            return False
        path, steps = self._waiting[0]
        try:
            next(steps)
        except StopIteration:
            self._waiting.popleft()
        except OSError as error:
            log.warning("%s keeps the times it was written with: %s", path, error.strerror)
            self._waiting.popleft()
        return True

    def _steps(self, path: Path, shift_us: int) -> Iterator[None]:
        temporary = path.with_name(path.name + NEW)
        if free_bytes_near(path.parent) < path.stat().st_size + self._free_floor:
            raise OSError(errno.ENOSPC, "the disk is too full for a copy")
        shifted = _shifted_tlog if path.suffix == TLOG else _shifted_table
        try:
            with path.open("rb") as file, temporary.open("wb") as copy:
                for data in shifted(file, shift_us):
                    copy.write(data)
                    yield
                copy.flush()
                os.fsync(copy.fileno())
            # If it was deleted meanwhile, it must not come back.
            if path.exists():
                temporary.replace(path)
                sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def clear_copies(folder: Path) -> None:
    """Remove the copies that a power cut has left behind."""
    with contextlib.suppress(OSError):
        for ending in (TLOG, ".csv"):
            for path in folder.glob(f"*{ending}{NEW}"):
                path.unlink()


def _shifted_tlog(file: BinaryIO, shift_us: int) -> Iterator[bytes]:
    scanner = TlogScanner()
    while data := file.read(STEP):
        yield scanner.feed(data).shifted(shift_us)
    yield scanner.feed(b"", final=True).shifted(shift_us)


def _shifted_table(file: BinaryIO, shift_us: int) -> Iterator[bytes]:
    """Yield a table with shifted heads; rows are on the gateway's clock and stay."""
    while lines := file.readlines(STEP):
        yield b"".join([_shifted_line(line, shift_us) for line in lines])


def _shifted_line(line: bytes, shift_us: int) -> bytes:
    if not line.startswith(HEADER_PREFIX.encode()):
        return line
    try:
        header = msgspec.json.decode(line[len(HEADER_PREFIX) :], type=TableHeader)
    except msgspec.DecodeError:
        return line
    zero_us = (header.unix_us_at_zero or 0) + shift_us
    return encode_line(msgspec.structs.replace(header, unix_us_at_zero=zero_us)).encode()
