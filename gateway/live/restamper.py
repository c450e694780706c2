"""Finished files get their true times once GPS has provided them.

A part may be larger than the memory, so a file is copied in pieces. The copy replaces the file
atomically: a power cut leaves one of the two.
"""

import contextlib
import logging
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from gateway.live.part import TLOG
from gateway.live.part_files import free_bytes_near
from gateway.output import sync_folder
from gateway.recordings.table import HEADER_PREFIX, TableHeader, encode_line
from gateway.recordings.tlog import TlogScanner
from gateway.wire.recorded_frames import Batch

log = logging.getLogger(__name__)

STEP: Final = 1 << 16
"""Bytes copied at once."""
NEW: Final = ".new"


def shift_times(path: Path, shift_us: int, free_floor: int) -> None:
    """Shift the times of a file, which keeps them if the disk fails or would be too full."""
    temporary = path.with_name(path.name + NEW)
    shifted = _shifted_tlog if path.suffix == TLOG else _shifted_table
    try:
        if free_bytes_near(path.parent) < path.stat().st_size + free_floor:
            log.warning("%s keeps the times it was written with: %s", path, "no room for a copy")
            return
        with path.open("rb") as file, temporary.open("wb") as copy:
            copy.writelines(shifted(file, shift_us))
            copy.flush()
            os.fsync(copy.fileno())
        # If the file was deleted during the copy, it must not reappear.
        if path.exists():
            temporary.replace(path)
            sync_folder(path.parent)
    except OSError as error:
        log.warning("%s keeps the times it was written with: %s", path, error.strerror)
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
        yield _shifted_batch(scanner.feed(data), shift_us)
    yield _shifted_batch(scanner.feed(b"", final=True), shift_us)


def _shifted_batch(batch: Batch, shift_us: int) -> bytes:
    return replace(batch, time_us=batch.time_us + shift_us).encoded()


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
