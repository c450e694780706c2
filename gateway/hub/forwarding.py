"""Memory of the compiled step that forwards: buffers, the table of routes, and counters."""

from collections.abc import Callable
from typing import Final

import numpy as np

from gateway.compiled import address_of
from gateway.compiled.entry_point import LibraryError
from gateway.compiled.messages import PART, Outbox, headers_of
from gateway.hub import forwarding_step as kernel

MAX_COMPILED: Final = kernel.ENTRIES // 2
"""Maximum routes in the table; frames of further ones are forwarded by Python."""
FIRST_LARGEST: Final = 280
"""Assumed size of datagrams until some are received, bytes: that of the largest frame."""


def new_client_state(client_id: int) -> kernel.ClientState:
    """Return the state of a client without a file to receive from or send to."""
    state = kernel.ClientState()
    state.id, state.input, state.output, state.largest = client_id, -1, -1, FIRST_LARGEST
    return state


class Forwarding:
    """The memory of one hub; `problem` is the reason if there is no compiled kernel.

    Parameters
    ----------
    is_compiled : bool
        False lets Python forward, for a comparison.
    """

    def __init__(self, *, is_compiled: bool = True) -> None:
        self.problem: LibraryError | None = None
        self.is_compiled = is_compiled
        try:
            kernel.forward.load()
        except LibraryError as error:
            self.problem, self.is_compiled = error, False
        buffer = np.zeros(kernel.READS * kernel.MAX_DATAGRAM, np.uint8)
        parts = np.zeros(kernel.READS, PART)
        parts["at"] = address_of(buffer) + np.arange(kernel.READS) * kernel.MAX_DATAGRAM
        parts["length"] = kernel.MAX_DATAGRAM
        received, self._outbox = headers_of(parts), Outbox()
        self._table = np.zeros(kernel.ENTRIES, kernel.ENTRY)
        self._filled: set[int] = set()
        """Entries of the table that are used."""
        self._routes = np.zeros(MAX_COMPILED, kernel.ROUTE)
        self._frames, self._sizes = (self._routes[name].data for name in ("frames", "frames_size"))
        self._used = 0
        self._free: list[int] = []
        """Rows of the routes used before that are free."""
        self._failed = (kernel.Failure * kernel.MAX_FAILED)()  # type: ignore[operator]
        records = np.zeros(kernel.READS * kernel.MAX_RECORD, np.uint8)
        self._newest = np.zeros((MAX_COMPILED, kernel.MAX_FRAME), np.uint8)
        memory = {
            "buffer_at": buffer, "headers_at": received, "outbox_at": self._outbox.state,
            "table_at": self._table, "failed_at": self._failed, "records_at": records,
            "routes_at": self._routes, "newest_at": self._newest,
        }  # fmt: skip
        self.work = work = kernel.Work()
        work.most = len(buffer)
        for name, part in memory.items():
            setattr(work, name, address_of(part))
        self._buffer, self._lengths, self._records = buffer.data, received["length"], records.data
        self._kept = (memory, parts)
        self._record = kernel.record.bound(address_of(work)) if self.is_compiled else None

    def step(self, client: kernel.ClientState, *, reads: bool) -> Callable[[], None]:
        """Return a client's step: one that receives first, or one that continues a read."""
        if not self.is_compiled:
            return lambda: None
        return kernel.forward.bound(address_of(self.work), address_of(client), int(reads))

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
        entry = kernel.entry_of(client_id, number)
        while entry in self._filled:
            entry = (entry + 1) % kernel.ENTRIES
        self._filled.add(entry)
        route_at = self.work.routes_at + row * kernel.ROUTE.itemsize
        self._table[entry] = client_id, number, route_at
        return row

    def leave(self, client_id: int, key: bytes, row: int) -> None:
        """Remove a route; the entries after it move up, since a search ends at the first gap."""
        number, table = int.from_bytes(key, "little"), self._table
        gap = kernel.entry_of(client_id, number)
        while (table[gap].client_id, table[gap].key) != (client_id, number):
            gap = (gap + 1) % kernel.ENTRIES
        entry = gap
        while (entry := (entry + 1) % kernel.ENTRIES) in self._filled:
            begin = kernel.entry_of(int(table[entry].client_id), int(table[entry].key))
            if (entry - begin) % kernel.ENTRIES >= (entry - gap) % kernel.ENTRIES:
                table[gap] = table[entry]
                gap = entry
        table[gap].client_id = 0
        self._filled.discard(gap)
        self._routes[row].newest_size = 0
        self._free.append(row)

    def settle(self, row: int) -> tuple[int, int]:
        """Return the frames and bytes of a route since the last call."""
        if not (frames := self._frames[row]):
            return 0, 0
        size = self._sizes[row]
        self._frames[row] = self._sizes[row] = 0
        return frames, size

    def newest(self) -> list[tuple[bytes, int]]:
        """Return the newest frame of each route that had one since the last call, and its time."""
        routes = self._routes[: self._used]
        rows = np.flatnonzero(routes["newest_size"])
        sizes, times_us = (routes[name][rows].tolist() for name in ("newest_size", "newest_us"))
        found = [self._newest[row, :size].tobytes() for row, size in zip(rows, sizes, strict=True)]
        routes["newest_size"] = 0
        return [*zip(found, times_us, strict=True)]

    def clear(self) -> None:
        """Discard all routes."""
        if self._filled:
            self._table["client_id"][list(self._filled)] = 0
            self._filled.clear()
        self._used = 0
        self._free.clear()

    def records(self, first_us: int, step_us: int) -> bytes:
        """Return the frames of the run as in a tlog, with the time of the first and the kernel."""
        if self._record is None:
            return b""
        work = self.work
        work.time_us, work.time_step = first_us, step_us
        self._record()
        return bytes(self._records[: work.records_size])

    @property
    def run_length(self) -> int:
        """The number of frames of the run."""
        return int(self._outbox.state.parts)

    def load(self, data: bytes, now_us: int) -> None:
        """Load a chunk of a stream, of at most 256 kB, as if the step had received it."""
        self._buffer[: len(data)] = data
        self._lengths[0] = len(data)
        work = self.work
        work.now_us = now_us
        work.count = 1
        work.at = work.offset = work.taken = 0

    def run(self) -> list[bytes]:
        """Return the frames of the run."""
        buffer, begin = self._buffer, self.work.buffer_at
        parts = self._outbox.parts[: self._outbox.state.parts].tolist()
        return [bytes(buffer[at - begin : at - begin + size]) for at, size in parts]

    def failures(self) -> list[kernel.Failure]:
        """Return the clients that did not get the whole run."""
        found: list[kernel.Failure] = self._failed[: self.work.failed]
        return found

    def rest(self) -> bytes:
        """Return the rest of the present datagram."""
        at, offset = self.work.at, self.work.offset
        begin = at * kernel.MAX_DATAGRAM
        return bytes(self._buffer[begin + offset : begin + int(self._lengths[at])])

    def skip(self) -> None:
        """Go on to the next datagram."""
        work = self.work
        work.taken += int(self._lengths[work.at])
        work.at += 1
        work.offset = 0

    def unread(self) -> list[bytes]:
        """Return the datagrams that are left, and skip them."""
        found = []
        while self.work.at < self.work.count:
            found.append(self.rest())
            self.skip()
        return found
