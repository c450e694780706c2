"""A tlog that is generated while it is played, from a table that is fused again."""

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Final

from gateway.flightlog.answers import LogAnswers
from gateway.flightlog.tlog.tlog import TlogIndex, TlogRecord, TlogScanner, encode_record

log = logging.getLogger(__name__)

PIECE: Final = 8
"""Frames generated at once: one or two milliseconds."""


class FusedTlog:
    """Generate frames on demand, and keep them on disk for seeking back.

    Parameters
    ----------
    frames : iterator of TlogRecord
        The frames to play, in the order of their times.
    last_us : int, optional
        Time of its end, if known beforehand.
    answers : LogAnswers, optional
        Collects answers from the frames.

    Raises
    ------
    OSError
        If there is no room for temporary files.
    """

    def __init__(
        self,
        frames: Iterator[TlogRecord],
        last_us: int | None = None,
        answers: LogAnswers | None = None,
    ) -> None:
        self._frames = frames
        self._last_us = last_us
        self._answers = answers
        self._file = tempfile.TemporaryFile(prefix="mavgate-play-")  # noqa: SIM115
        self._scanner = TlogScanner()
        self._size = 0
        self._ended = False
        self.index = TlogIndex()
        """Index of the frames generated so far."""
        while not self.index.count and self._make():
            pass

    @property
    def last_us(self) -> int:
        """Time of the end, or of the last frame generated."""
        return max(self._last_us or 0, self.index.last_us or 0)

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; generate the next frames if there are none yet."""
        while offset >= self._size and self._make():
            pass
        return os.pread(self._file.fileno(), size, offset)

    def prepare(self, until_us: int) -> bool:
        """Generate a few of the frames up to a time; return whether all are there."""
        return (self.index.last_us or 0) >= until_us or not self._make()

    def close(self) -> None:
        """Delete the generated frames."""
        with suppress(OSError):
            # What found no room is written again.
            self._file.close()

    def _make(self) -> bool:
        """Generate some frames; return whether there were any."""
        if self._ended:
            return False
        made = b"".join(encode_record(r.time_us, r.frame) for r in islice(self._frames, PIECE))
        self._ended = not made
        try:
            self._file.write(made)
            self._file.flush()
        except OSError as error:
            log.warning("The rest cannot be played: %s: %s", tempfile.gettempdir(), error.strerror)
            self._ended = True
        batch = self._scanner.feed(made, final=self._ended)
        self.index.add(batch)
        if self._answers is not None:
            self._answers.note(batch, self.index.stations)
        self._size += len(made)
        return not self._ended
