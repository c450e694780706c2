"""Open a DataFlash log, ArduPilot's, binary (.bin) or text (.log), with pymavlink."""

import contextlib
import io
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeVar

from pymavlink.DFReader import DFReader_binary, DFReader_text

from gateway.recordings.file_format import DATAFLASH_BEGIN, skip_to
from gateway.recordings.files import FlightError, name_of, read_chunks, temporary_copy
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import counted

Message = Any
"""A message with its columns as attributes, in the units of the format."""
Item = TypeVar("Item")
MAGIC: Final = b"\xa3\x95"
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
        self._printed, self._broken = _Printed(), 0
        # Replace bytes that are not ASCII, so that reading continues.
        all_of_it = chain([first], content)
        sound = (data.translate(_AS_TEXT) for data in all_of_it) if self.is_text else all_of_it
        with temporary_copy(path, sound) as plain:
            self.log = log = kind.__new__(kind)
            # The fast indexer prints to the terminal directly, not through Python's stdout.
            log.init_arrays_fast = log.init_arrays
            try:
                self._quiet(lambda: kind.__init__(log, name_of(plain)))
            except Exception as error:
                log.close()
                raise FlightError(f"{path}: its list of formats is damaged: {error}") from error

    def _quiet(self, call: Callable[[], Any]) -> Any:
        with contextlib.redirect_stdout(self._printed), contextlib.redirect_stderr(self._printed):
            return call()

    @property
    def is_damaged(self) -> bool:
        """Whether damage was found so far."""
        return not self._printed.is_empty

    @property
    def system_id(self) -> int:
        """The system id in the parameters; 1 if there is no valid one."""
        named = (self.log.params.get(name) for name in SYSTEM_IDS)
        known = next((int(value) for value in named if value is not None), 1)
        return known if 1 <= known <= 255 else 1

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
        """Feed the messages of these names; one that cannot be decoded is counted.

        If the log is intact, only the needed messages are decoded. The index of a damaged one ends
        at the damage, so it is read message by message.
        """
        log = self.log

        def wanted() -> Any:
            return log.recv_match(type=names, strict=True)

        take = log.recv_msg if self.is_damaged else wanted
        lines, end = 0, -1
        while True:
            begin = log.offset
            try:
                message = self._quiet(take)
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
        if skipped := self._printed.size:
            yield f"is damaged: left out {counted(skipped, 'byte')} that belong to no message"
        if (left := self.log.data_len - self.log.offset) > 0:
            yield f"ends within a message: left out {counted(left, 'byte')}"
        if broken := self._broken + dropped:
            yield f"is damaged: left out {counted(broken, 'message')} that cannot be decoded"
