"""Memory of the compiled step that forwards: buffers, the table of routes, and counters."""

from collections.abc import Callable
from typing import Final

import numpy as np

from gateway.compiled import address_of
from gateway.compiled.entry_point import LibraryError
from gateway.compiled.messages import LENGTH, PARTS, Outbox, headers_of
from gateway.hub import forwarding_step as step

MAX_COMPILED: Final = step.ENTRIES // 2
"""Maximum routes in the table; frames of further ones are forwarded by Python."""
FIRST_LARGEST: Final = 280
"""Assumed size of datagrams until some are received, bytes: that of the largest frame."""

Words = memoryview


def new_client_words(client_id: int) -> Words:
    """Return the words of a client without a file to receive from or send to."""
    words = np.zeros(step.CLIENT_WORDS, np.int64)
    words[step.CLIENT_ID], words[step.LARGEST] = client_id, FIRST_LARGEST
    words[step.INPUT] = words[step.OUTPUT] = -1
    return words.data


class Forwarding:
    """The memory of one hub; `problem` is the reason if there is no compiled step.

    Parameters
    ----------
    is_compiled : bool
        False lets Python forward, for a comparison.
    """

    def __init__(self, *, is_compiled: bool = True) -> None:
        self.problem: LibraryError | None = None
        self.is_compiled = is_compiled
        try:
            step.forward.load()
        except LibraryError as error:
            self.problem, self.is_compiled = error, False
        buffer = np.zeros(step.READS * step.MAX_DATAGRAM, np.uint8)
        begins = address_of(buffer) + np.arange(step.READS) * step.MAX_DATAGRAM
        places = np.column_stack([begins, np.full(step.READS, step.MAX_DATAGRAM)])
        received, self._outbox = headers_of(places), Outbox()
        self._table = np.zeros((step.ENTRIES, 3), np.int64)
        self._filled: set[int] = set()
        """Entries of the table that are used."""
        self._routes = np.zeros((MAX_COMPILED, step.ROUTE_WORDS), np.int64)
        self._route_words = self._routes.data
        self._used = 0
        self._free: list[int] = []
        """Rows of the routes used before that are free."""
        self._failed = np.zeros((step.MAX_FAILED, step.FAILED_WORDS), np.int64)
        records = np.zeros(step.READS * step.MAX_RECORD, np.uint8)
        self._newest = np.zeros((MAX_COMPILED, step.MAX_FRAME), np.uint8)
        memory = (
            *(buffer, received, self._outbox.words, self._table, self._failed),
            *(records, self._routes, self._newest),
        )
        work = np.zeros(step.WORDS, np.int64)
        work[step.MOST] = len(buffer)
        work[step.BUFFER_AT :] = [address_of(each) for each in memory]
        self.work: Words = work.data
        self._work_at = address_of(work)
        self._buffer, self._lengths, self._records = buffer.data, received[:, LENGTH], records.data
        self._kept = (*memory, places)
        self._record = step.record.bound(self._work_at) if self.is_compiled else None

    def step(self, client: Words, *, reads: bool) -> Callable[[], None]:
        """Return a client's step: one that receives first, or one that continues a read."""
        if not self.is_compiled:
            return lambda: None
        return step.forward.bound(self._work_at, address_of(client), int(reads))

    def enter(
        self, client_id: int, key: bytes, seed: int, targets_at: int, stream_at: int, heard_at: int
    ) -> int | None:
        """Add the route of a client's frames of one key; return its row, None without room.

        The caller keeps what is passed by address: targets, the stream of the system, and the time
        when it was received last.
        """
        if not self.is_compiled or (self._used == MAX_COMPILED and not self._free):
            return None
        if self._free:
            row = self._free.pop()
        else:
            row, self._used = self._used, self._used + 1
        self._routes[row] = seed, targets_at, stream_at, heard_at, 0, 0, 0, 0
        number = int.from_bytes(key, "little")
        entry = step.entry_of(client_id, number)
        while entry in self._filled:
            entry = (entry + 1) % step.ENTRIES
        self._filled.add(entry)
        self._table[entry] = client_id, number, address_of(self._routes[row])
        return row

    def leave(self, client_id: int, key: bytes, row: int) -> None:
        """Remove a route; the entries after it move up, since a search ends at the first gap."""
        number, table = int.from_bytes(key, "little"), self._table
        gap = step.entry_of(client_id, number)
        while (table[gap, step.KEY_CLIENT], table[gap, step.KEY]) != (client_id, number):
            gap = (gap + 1) % step.ENTRIES
        entry = gap
        while (entry := (entry + 1) % step.ENTRIES) in self._filled:
            begin = step.entry_of(*map(int, table[entry, : step.ROUTE_AT]))
            if (entry - begin) % step.ENTRIES >= (entry - gap) % step.ENTRIES:
                table[gap] = table[entry]
                gap = entry
        table[gap, step.KEY_CLIENT] = 0
        self._filled.discard(gap)
        self._routes[row, step.NEWEST_SIZE] = 0
        self._free.append(row)

    def settle(self, row: int) -> tuple[int, int]:
        """Return the frames and bytes of a route since the last call."""
        words = self._route_words
        frames = words[row, step.FRAMES]
        if not frames:
            return 0, 0
        size = words[row, step.SIZE]
        words[row, step.FRAMES] = words[row, step.SIZE] = 0
        return frames, size

    def newest(self) -> list[tuple[bytes, int]]:
        """Return the newest frame of each route that had one since the last call, and its time."""
        routes, found = self._routes[: self._used], []
        for row in np.flatnonzero(routes[:, step.NEWEST_SIZE]).tolist():
            size, time_us = routes[row, step.NEWEST_SIZE :].tolist()
            found.append((self._newest[row, :size].tobytes(), time_us))
        routes[:, step.NEWEST_SIZE] = 0
        return found

    def clear(self) -> None:
        """Discard all routes."""
        if self._filled:
            self._table[list(self._filled), step.KEY_CLIENT] = 0
            self._filled.clear()
        self._used = 0
        self._free.clear()

    def records(self, first_us: int, step_us: int) -> bytes:
        """Return the frames of the run as in a tlog, with the time of the first and the step."""
        if self._record is None:
            return b""
        work = self.work
        work[step.TIME_US], work[step.TIME_STEP] = first_us, step_us
        self._record()
        return bytes(self._records[: work[step.RECORDS_SIZE]])

    @property
    def run_length(self) -> int:
        """The number of frames of the run."""
        return int(self._outbox.words[PARTS])

    def load(self, data: bytes, now_us: int) -> None:
        """Load a chunk of a stream, of at most 256 kB, as if the step had received it."""
        self._buffer[: len(data)] = data
        self._lengths[0] = len(data)
        work = self.work
        work[step.NOW_US] = now_us
        work[step.COUNT] = 1
        work[step.AT] = work[step.OFFSET] = work[step.TAKEN] = 0

    def run(self) -> list[bytes]:
        """Return the frames of the run."""
        buffer, begin = self._buffer, self.work[step.BUFFER_AT]
        parts = self._outbox.parts[: self._outbox.words[PARTS]].tolist()
        return [bytes(buffer[at - begin : at - begin + size]) for at, size in parts]

    def failures(self) -> list[list[int]]:
        """Return the clients that did not get the whole run, as in `forwarding_step.FAILED`."""
        found: list[list[int]] = self._failed[: self.work[step.FAILED]].tolist()
        return found

    def rest(self) -> bytes:
        """Return the rest of the present datagram."""
        at, offset = self.work[step.AT], self.work[step.OFFSET]
        begin = at * step.MAX_DATAGRAM
        return bytes(self._buffer[begin + offset : begin + int(self._lengths[at])])

    def skip(self) -> None:
        """Go on to the next datagram."""
        work = self.work
        work[step.TAKEN] += int(self._lengths[work[step.AT]])
        work[step.AT] += 1
        work[step.OFFSET] = 0

    def unread(self) -> list[bytes]:
        """Return the datagrams that are left, and skip them."""
        found = []
        while self.work[step.AT] < self.work[step.COUNT]:
            found.append(self.rest())
            self.skip()
        return found
