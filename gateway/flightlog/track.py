"""One recording that is being played: a position in a tlog that advances and can seek."""

from collections.abc import Iterator, Mapping
from itertools import chain
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np

from gateway.flightlog.tlog.readdress import readdress
from gateway.flightlog.tlog.recorded_commands import telemetry_of
from gateway.flightlog.tlog.tlog import (
    SEEK_BYTES,
    STRIDE,
    Batch,
    TlogIndex,
    TlogRecord,
    TlogScanner,
)
from gateway.flightlog.tlog.tlog_scan import IntArray
from gateway.wire.mavlink_splitter import message_id_of, origin_of

BLOCK_BYTES: Final = 1 << 18
"""Read at once while playing: some 0.1 s of reading and deciding for minutes of flight."""

CONTEXT_RECORDS: Final = 20 * STRIDE
"""How far back a seek looks for frames that a ground station needs: a minute and more."""
CONTEXT_IDS: Final = (0, 1, 22, 24, 30, 31, 33, 49, 74, 148, 242, 245)
"""HEARTBEAT, SYS_STATUS, PARAM_VALUE, GPS_RAW_INT, GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION,
HOME_POSITION, EXTENDED_SYS_STATE, and the newest position and attitude."""
PARAM_VALUE_ID: Final = 22
PARAM_NAME: Final = slice(18, 34)
"""Where the parameter's name stands in a MAVLink 2 frame; close enough in the older ones."""


class Source(Protocol):
    """A tlog that exists, or is generated as it is read."""

    @property
    def index(self) -> TlogIndex:
        """Index of the part that exists so far."""
        ...

    @property
    def last_us(self) -> int:
        """Time of its end, as far as known; 0 if it is empty."""
        ...

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; nothing at the end."""
        ...

    def prepare(self, until_us: int) -> bool:
        """Do a part of the work for reading up to a time; return whether it is done."""
        ...


class Track:
    """A tlog being played.

    Parameters
    ----------
    source : Source
        The tlog.
    shift_us : int
        Added to every time, to play several recordings together.
    system_ids : mapping of int to int
        New system ids by recorded ones; other senders keep theirs.
    with_commands : bool
        Play messages of stations and other requests to a vehicle too.
    """

    def __init__(
        self,
        source: Source,
        *,
        shift_us: int = 0,
        system_ids: Mapping[int, int] = MappingProxyType({}),
        with_commands: bool = False,
    ) -> None:
        self._source = source
        self._shift_us = shift_us
        self._system_ids = system_ids
        self._with_commands = with_commands
        self._records = self._records_of(self._read_from(0))
        self._next = next(self._records, None)

    @property
    def first_us(self) -> int:
        """Time of the first record; 0 in an empty recording."""
        return (self._source.index.first_us or 0) + self._shift_us

    @property
    def last_us(self) -> int:
        """Time of the last record."""
        return self._source.last_us + self._shift_us

    def prepare(self, time_us: int) -> bool:
        """Do a part of the work for a seek; return whether it can be made at once now."""
        return self._source.prepare(time_us - self._shift_us)

    def peek_us(self) -> int | None:
        """Return the time of the next record, None at the end."""
        return None if self._next is None else self._next.time_us + self._shift_us

    def take(self) -> bytes:
        """Return the next frame and move on.

        Raises
        ------
        ValueError
            At the end.
        """
        record = self._next
        if record is None:
            raise ValueError("the recording has ended")
        self._next = next(self._records, None)
        return self._addressed(record.frame)

    def seek(self, time_us: int) -> list[bytes]:
        """Move to the first record that is not before a time.

        Parameters
        ----------
        time_us : int
            In this player's time, the shift included.

        Returns
        -------
        list of bytes
            Frames from before that time that a ground station must know to understand the rest:
            heartbeats, home and the like, the newest of each.
        """
        wanted_us = time_us - self._shift_us
        newest: dict[tuple[int, int, int, bytes], bytes] = {}
        batches = self._read_from(self._source.index.offset_before(wanted_us, CONTEXT_RECORDS))
        self._records = iter(())
        for batch in batches:
            reached = np.flatnonzero(batch.time_us >= wanted_us)
            begin = int(reached[0]) if len(reached) else len(batch)
            known = self._wanted(batch, 0)
            known = known[(known < begin) & np.isin(batch.message_ids[known], CONTEXT_IDS)]
            for i in known.tolist():
                frame = batch.frame(i)
                key = _key_of(frame)
                # Taken out first, so that the newest come last.
                newest.pop(key, None)
                newest[key] = frame
            if len(reached):
                here = batch.records(self._wanted(batch, begin))
                self._records = chain(here, self._records_of(batches))
                break
        self._next = next(self._records, None)
        return [self._addressed(frame) for frame in newest.values()]

    def _wanted(self, batch: Batch, begin: int) -> IntArray:
        if self._with_commands:
            return np.arange(begin, len(batch))
        return telemetry_of(batch, begin, self._source.index.stations)

    def _records_of(self, batches: Iterator[Batch]) -> Iterator[TlogRecord]:
        return chain.from_iterable(batch.records(self._wanted(batch, 0)) for batch in batches)

    def _addressed(self, frame: bytes) -> bytes:
        system_id = self._system_ids.get(origin_of(frame)[0])
        return frame if system_id is None else readdress(frame, system_id)

    def _read_from(self, offset: int) -> Iterator[Batch]:
        scanner, timeline = TlogScanner(offset), self._source.index.timeline
        size = SEEK_BYTES
        while data := self._source.read(offset, size):
            yield timeline.apply(scanner.feed(data))
            offset += len(data)
            size = BLOCK_BYTES
        yield timeline.apply(scanner.feed(b"", final=True))


def _key_of(frame: bytes) -> tuple[int, int, int, bytes]:
    """Return a key, equal for frames that replace one another; each parameter has its own."""
    message_id = message_id_of(frame)
    name = frame[PARAM_NAME] if message_id == PARAM_VALUE_ID else b""
    return (*origin_of(frame), message_id, name)
