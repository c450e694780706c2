"""A tlog on disk for the player: indexed once, then read at any position."""

import os
from pathlib import Path
from typing import Final

from gateway.edges.disk.recording_streams import (
    MAX_UNPACKED,
    Progress,
    is_packed,
    open_descriptor,
    temporary_copy,
)
from gateway.edges.disk.tlog_source import Layout, TlogSource, open_tlog
from gateway.flightlog.answers import LogAnswers
from gateway.flightlog.tlog.tlog import TlogIndex, TlogScanner

READ_SIZE: Final = 1 << 20


class TlogFile:
    """A tlog on disk: its index, and reading at any position.

    It is read, not memory-mapped: a file that shrinks, or a USB stick that is pulled out, would
    kill a process that had mapped it.

    Parameters
    ----------
    path : Path
        The file.
    progress : callable, optional
        Called with how many more bytes were indexed.
    answers : LogAnswers, optional
        Collects answers from the file.
    unpacked_limit : int
        Maximum unpacked size of a packed file, in bytes.

    Raises
    ------
    OSError
        If it cannot be read, or is too large when unpacked.
    """

    def __init__(
        self,
        path: Path,
        progress: Progress | None = None,
        answers: LogAnswers | None = None,
        unpacked_limit: int = MAX_UNPACKED,
    ) -> None:
        self.path = path
        source = open_tlog(path)
        self.remarks = source.remarks
        """What the user should know of its times."""
        is_plain = source.layout is Layout.TLOG and not is_packed(path)
        self._file = open_descriptor(path) if is_plain else _plain_copy(source, unpacked_limit)
        self.index = TlogIndex(source.timeline)
        scanner = TlogScanner()
        offset = 0
        data = b" "
        while data:
            data = self.read(offset, READ_SIZE)
            batch = source.timeline.apply(scanner.feed(data, final=not data))
            self.index.add(batch)
            if answers is not None:
                answers.note(batch, self.index.stations)
            offset += len(data)
            if progress is not None:
                progress(len(data))

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; nothing at the end, or if the medium fails."""
        try:
            return os.pread(self._file, size, offset)
        except OSError:
            return b""

    @property
    def last_us(self) -> int:
        """Greatest time; 0 in an empty file."""
        return self.index.last_us or 0

    def prepare(self, until_us: int) -> bool:  # noqa: ARG002
        """Return True: everything is there."""
        return True

    def close(self) -> None:
        """Close the file; its tracks end."""
        os.close(self._file)


def _plain_copy(source: TlogSource, limit: int) -> int:
    """Open a copy, since only a plain tlog can be read at any position."""
    with temporary_copy(source.path, source.chunks(None, limit)) as plain:
        return os.dup(plain.fileno())
