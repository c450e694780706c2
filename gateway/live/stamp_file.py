"""The newest signing timestamps in one file, written by a separate thread."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec

from gateway.live.worker import begin_worker
from gateway.output import PRIVATE, write_new
from gateway.reasons import reason_of

log = logging.getLogger(__name__)

NAME: Final = "signing-stamps.json"

_Stream = Annotated[str, msgspec.Meta(pattern=r"^\d{1,3}\.\d{1,3}\.\d{1,3}$")]
_Stamp = Annotated[int, msgspec.Meta(ge=0, lt=1 << 49)]
Kept = Mapping[int, dict[str, dict[str, int]]]
"""By vehicle id; see `SigningTimestamps`."""


class StampFile:
    """The file of all aircraft."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / NAME
        self._worker = begin_worker("stamps")
        self._waiting: Kept | None = None
        self._is_reported = False

    def load(self) -> Kept:
        """Read the file; nothing if there is none, or it cannot be read."""
        kind = dict[int, dict[str, dict[_Stream, _Stamp]]]
        try:
            return msgspec.json.decode(self._file.read_bytes(), type=kind, strict=False)
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.DecodeError) as error:
            log.warning(
                "%s cannot be read: %s. Signed commands of the last minute could be sent again "
                "by whoever recorded them.",
                self._file,
                reason_of(error),
            )
            return {}

    def save(self, stamps: Kept) -> None:
        """Store these; returns at once, only the newest are written."""
        is_busy, self._waiting = self._waiting is not None, stamps
        if not is_busy:
            self._worker.submit(self._write)

    def close(self, stamps: Kept) -> None:
        """Write these last if there are any, and end."""
        if stamps:
            self.save(stamps)
        self._worker.shutdown(wait=True)

    def _write(self) -> None:
        stamps, self._waiting = self._waiting, None
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            text = msgspec.json.encode({str(key): kept for key, kept in (stamps or {}).items()})
            write_new(self._file, [text], overwrite=True, rights=PRIVATE)
        except OSError as error:
            if not self._is_reported:
                log.warning("%s cannot be written: %s", self._file, reason_of(error))
            self._is_reported = True
        else:
            self._is_reported = False
