"""One recording that is being played: a place in a tlog that moves on and can be sought."""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Final

from gateway.flightlog.readdress import readdress
from gateway.flightlog.tlog import (
    SEEK_BYTES,
    STRIDE,
    TlogIndex,
    TlogRecord,
    TlogScanner,
)
from gateway.wire.mavlink_splitter import message_id_of, origin_of

Read = Callable[[int, int], bytes]
"""Reads up to so many bytes at an offset; empty at the end of the file."""

BLOCK_BYTES: Final = 1 << 18
"""Read at once while playing: some 0.1 s of reading and deciding for minutes of flight."""

CONTEXT_RECORDS: Final = 20 * STRIDE
"""How far back a seek looks for what a ground station must know: a minute and more."""
CONTEXT_IDS: Final = frozenset({0, 1, 22, 24, 49, 148, 242, 245, 33, 30, 31, 74})
"""HEARTBEAT, SYS_STATUS, PARAM_VALUE, GPS_RAW_INT, GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION,
HOME_POSITION, EXTENDED_SYS_STATE, and the newest position and attitude."""
PARAM_VALUE_ID: Final = 22
PARAM_NAME: Final = slice(18, 34)
"""Where the parameter's name stands in a MAVLink 2 frame; close enough in the older ones."""


class Track:
    """A tlog being played.

    Parameters
    ----------
    read : callable
        Reads the file.
    index : TlogIndex
        Of the same file.
    shift_us : int
        Added to every time, to lay several recordings over one another.
    system_ids : mapping of int to int
        Senders to put in place of recorded ones; others keep theirs.
    """

    def __init__(
        self,
        read: Read,
        index: TlogIndex,
        *,
        shift_us: int = 0,
        system_ids: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        self._read = read
        self._index = index
        self._shift_us = shift_us
        self._system_ids = system_ids
        self._records = self._read_from(0)
        self._next = next(self._records, None)

    @property
    def first_us(self) -> int:
        """Time of the first record; 0 in an empty recording."""
        return (self._index.first_us or 0) + self._shift_us

    @property
    def last_us(self) -> int:
        """Time of the last record."""
        return (self._index.last_us or 0) + self._shift_us

    @property
    def systems(self) -> set[int]:
        """Ids of all that send, as they are played."""
        return {self._system_ids.get(system_id, system_id) for system_id in self._index.systems}

    def peek_us(self) -> int | None:
        """Tell the time of the next record, None at the end."""
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
        self._records = self._read_from(self._index.offset_before(wanted_us, CONTEXT_RECORDS))
        self._next = None
        for record in self._records:
            if record.time_us >= wanted_us:
                self._next = record
                break
            if message_id_of(record.frame) in CONTEXT_IDS:
                key = _key_of(record.frame)
                newest.pop(key, None)
                newest[key] = record.frame
        return [self._addressed(frame) for frame in newest.values()]

    def _addressed(self, frame: bytes) -> bytes:
        system_id = self._system_ids.get(origin_of(frame)[0])
        return frame if system_id is None else readdress(frame, system_id)

    def _read_from(self, offset: int) -> Iterator[TlogRecord]:
        scanner = TlogScanner(offset)
        size = SEEK_BYTES
        while data := self._read(offset, size):
            yield from scanner.feed(data).records()
            offset += len(data)
            size = BLOCK_BYTES
        yield from scanner.feed(b"", final=True).records()


def _key_of(frame: bytes) -> tuple[int, int, int, bytes]:
    """Tell which frames replace one another; each parameter stands for itself."""
    message_id = message_id_of(frame)
    name = frame[PARAM_NAME] if message_id == PARAM_VALUE_ID else b""
    return (*origin_of(frame), message_id, name)
