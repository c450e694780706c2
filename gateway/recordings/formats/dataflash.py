"""Open a DataFlash log, ArduPilot's, binary (.bin) or text (.log), with pymavlink."""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from itertools import chain
from mmap import mmap
from pathlib import Path
from typing import IO, Any, Final, TypeVar

from pymavlink.DFReader import DFReader_binary, DFReader_text

from gateway.recordings.autopilot_record import system_id_of
from gateway.recordings.file_format import DATAFLASH_BEGIN, skip_to
from gateway.recordings.files import FlightError, name_of, read_chunks, temporary_copy
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import counted

Message = Any
"""A message with its columns as attributes, in the units of the format."""
Item = TypeVar("Item")
MAGIC: Final = b"\xa3\x95"
HEAD_BYTES: Final = 3
"""Magic number and type of a message."""
FMT: Final = 128
"""Type of the messages with the formats, which begin with type and size of one."""
FMT_BYTES: Final = 89
PART_BYTES: Final = 1 << 20
"""Size of the parts in which a damaged log is copied."""
SYSTEM_IDS: Final = ("SYSID_THISMAV", "MAV_SYSID")
TITLE_BYTES: Final = 1 << 16
"""Bytes at the begin of a text log that are searched for the title line."""
_AS_TEXT: Final = bytes(range(128)) + b"?" * 128
_SKIPPED: Final = re.compile(r"Skipped (\d+) bad bytes")


class _Printed(io.TextIOBase):
    """The damage that pymavlink prints."""

    size = 0
    """Number of bytes that are reported as skipped."""
    is_empty = True

    def write(self, text: str) -> int:
        self.is_empty = False
        self.size += sum(map(int, _SKIPPED.findall(text)))
        return len(text)


class DataFlash:
    """A log, read from a temporary copy, and its damage.

    pymavlink memory-maps a log; if the file shrank, the process would be killed. On damaged logs it
    raises any exception, including bare ones.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        whole = read_chunks(path, options.progress, options.unpacked_limit)
        content, self._before = skip_to(DATAFLASH_BEGIN, whole)
        first = next(content, b"")
        self.is_text = not first.startswith(MAGIC)
        kind = DFReader_text if self.is_text else DFReader_binary
        self._printed, self._broken, self._skipped = _Printed(), 0, 0
        # Replace bytes that are not ASCII, so that reading continues.
        all_of_it = chain([first], content)
        sound = (data.translate(_AS_TEXT) for data in all_of_it) if self.is_text else all_of_it
        with temporary_copy(path, sound) as copy:
            error = self._open(kind, copy)
        if not self.is_text and (error or not self._printed.is_empty):
            # pymavlink's index would end at the first damage that looks like a message.
            damaged = self.log
            with temporary_copy(path, self._messages(damaged.data_map)) as copy:
                if copy.tell():
                    self._printed = _Printed()
                    error = self._open(kind, copy)
                    damaged.close()
                else:
                    self._skipped = 0
        if error:
            # A log without any message is not mapped.
            for part in ("data_map", "filehandle"):
                if part in vars(self.log):
                    getattr(self.log, part).close()
            raise FlightError(f"{path}: its list of formats is damaged: {error}") from error

    def _open(self, kind: Any, copy: IO[bytes]) -> Exception | None:
        """Open a copy of a log; return why it cannot be opened."""
        self.log = log = kind.__new__(kind)
        # The fast indexer prints to the terminal directly, not through Python's stdout.
        log.init_arrays_fast = log.init_arrays
        try:
            self._quiet(lambda: kind.__init__(log, name_of(copy)))
        except Exception as error:  # noqa: BLE001 - see above
            return error
        return None

    def _messages(self, data: mmap) -> Iterator[bytes]:
        """Yield the parts of a damaged log that are messages, and count the other bytes.

        Between damage and a message, only one that another follows is accepted.
        """
        sizes = {FMT: FMT_BYTES}
        begin = at = 0
        is_sure = True
        while at >= 0 and (head := data[at : at + HEAD_BYTES]):
            after = at + sizes.get(head[-1], 0) if head.startswith(MAGIC) else at
            if after > at and (is_sure or data[after : after + HEAD_BYTES].startswith(MAGIC)):
                if head[-1] == FMT and after <= len(data):
                    sizes[data[at + HEAD_BYTES]] = data[at + HEAD_BYTES + 1]
                at, is_sure = after, True
                if at - begin >= PART_BYTES:
                    yield data[begin:at]
                    begin = at
            else:
                yield data[begin:at]
                begin = data.find(MAGIC, at + 1)
                self._skipped += (begin if begin >= 0 else len(data)) - at
                at, is_sure = begin, False
        if at >= 0:
            yield data[begin:]

    def _quiet(self, call: Callable[[], Any]) -> Any:
        with redirect_stdout(self._printed), redirect_stderr(self._printed):
            return call()

    @property
    def system_id(self) -> int:
        """The system id in the parameters; 1 if there is no valid one."""
        named = (self.log.params.get(name) for name in SYSTEM_IDS)
        return system_id_of(next((value for value in named if value is not None), None))

    @property
    def title(self) -> str:
        """The begin of a text log, which contains its title."""
        head = bytes(self.log.data_map[:TITLE_BYTES]) if self.is_text else b""
        return head.decode("ascii", "replace")

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by name."""
        log = self.log
        if self.is_text:
            return {name: n for name, n in log.counts.items() if name in log.formats}
        return {name: log.counts[kind] for name, kind in log.name_to_id.items()}

    @property
    def columns(self) -> Mapping[str, set[str]]:
        """Columns by the name of the message."""
        return {known.name: {*known.columns} for known in self.log.formats.values()}

    def each_of(self, names: set[str]) -> Iterator[Message]:
        """Yield the messages of these names up to the first damage, and rewind the log."""
        log = self.log
        log.type_list = None
        try:
            while message := self._quiet(lambda: log.recv_match(type=names, strict=True)):
                yield message
        except Exception:  # noqa: BLE001 - see above
            return
        finally:
            log._rewind(keep_messages=True)  # noqa: SLF001 - the public one clears the parameters

    def items_of(
        self, names: set[str], feed: Callable[[str, Message], list[Item]]
    ) -> Iterator[Item]:
        """Feed the messages of these names; one that cannot be decoded is counted."""
        log = self.log
        lines, end = 0, -1
        while True:
            begin = log.offset
            try:
                message = self._quiet(lambda: log.recv_match(type=names, strict=True))
                # Instead of an invalid line pymavlink returns the next message, and again later.
                is_again, end = log.offset == end, log.offset
                is_new = message is not None and not is_again
                found = feed(message.get_type(), message) if is_new else []
            except Exception:  # noqa: BLE001 - see above
                self._broken += 1
                log.offset = max(log.offset, begin + 1)
                continue
            if message is None:
                break
            lines += not is_again
            yield from found
        if self.is_text:
            # Lines that should be these messages, or have an unknown format.
            odd = {name for name in log.counts if name.strip() and name not in log.formats}
            self._broken = sum(log.counts.get(name, 0) for name in names | odd) - lines

    def damage(self, dropped: int) -> Iterator[str]:
        """Yield remarks for the user, given the number of messages with impossible times."""
        yield from self._before.remarks
        if skipped := self._skipped + self._printed.size:
            yield f"is damaged: left out {counted(skipped, 'byte')} that belong to no message"
        if (left := self.log.data_len - self.log.offset) > 0:
            yield f"ends within a message: left out {counted(left, 'byte')}"
        if broken := self._broken + dropped:
            yield f"is damaged: left out {counted(broken, 'message')} that cannot be decoded"
