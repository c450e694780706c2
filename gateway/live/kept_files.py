"""Files kept for the next start: each aircraft's stored locations, and the signing timestamps.

A separate thread replaces a file atomically, since writing to a disk may block. A failed write is
retried until it succeeds. A plan that cannot be read is reported and left unchanged: it may contain
a mission that a person can repair.
"""

import asyncio
import contextlib
import logging
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Generic, ParamSpec, TypeVar

import msgspec

from gateway.output import PRIVATE, write_new
from gateway.printable import reason_of
from gateway.vehicle.plan import StoredPlan, decode_plan, encode_plan

log = logging.getLogger(__name__)

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Content = TypeVar("Content")
NAME: Final = re.compile(r"(\d{1,3})\.plan\.json")
RETRY_S: Final = 10.0
"""Interval of retries: short for a person who has freed disk space, no load for a failing disk."""
TIMESTAMPS_NAME: Final = "signing-stamps.json"
_Stream = Annotated[str, msgspec.Meta(pattern=r"^\d{1,3}\.\d{1,3}\.\d{1,3}$")]
_Timestamp = Annotated[int, msgspec.Meta(ge=0, lt=1 << 49)]
Kept = Mapping[int, dict[str, dict[str, int]]]
"""Signing timestamps by vehicle id; see `SigningTimestamps`."""


def begin_worker(name: str, most: int = 1) -> ThreadPoolExecutor:
    """Start a thread now, because the event loop would wait for its start at the first job."""
    worker = ThreadPoolExecutor(most, name)
    worker.submit(int)
    return worker


async def done_by(
    worker: ThreadPoolExecutor,
    job: Callable[Parameters, Result],
    *args: Parameters.args,
    **kwargs: Parameters.kwargs,
) -> Result:
    """Return a job's result; the job is done even if the task that waits for it is cancelled."""
    job_alone = partial(job, *args, **kwargs)
    return await asyncio.shield(asyncio.get_running_loop().run_in_executor(worker, job_alone))


class KeptFiles(Generic[Content]):
    """Files by an id, each replaced by its newest content; `_write` does so in a thread."""

    def __init__(self, folder: Path, name: str) -> None:
        self.failures = 0
        """Changes that could not be written at once since the start."""
        self._folder = folder
        self._pending: dict[int, Content] = {}
        self._failed: dict[int, Content] = {}
        """Contents whose last write failed."""
        self._worker = begin_worker(name)
        self._task: asyncio.Task[None] | None = None
        self._retry: asyncio.TimerHandle | None = None

    def save(self, key: int, content: Content) -> None:
        """Store the content of a file; returns at once. Only the newest one is written."""
        self._pending[key] = content
        self._start()

    async def settle(self) -> None:
        """Wait until all pending writes are done."""
        if self._task is not None:
            await self._task

    def close(self) -> None:
        """Write pending data and end; waits for the disk."""
        if self._retry is not None:
            self._retry.cancel()
        if self._task is not None:
            self._task.cancel()
        self._worker.shutdown(wait=True)
        for key, content in self._pending.items():
            with contextlib.suppress(OSError):
                self._write(key, content)

    def _write(self, key: int, content: Content) -> None:
        raise NotImplementedError

    def _report(self, key: int, reason: str | None) -> None:
        """Report the first failure of a content, or with None its end."""
        raise NotImplementedError

    def _start(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._write_pending())

    async def _write_pending(self) -> None:
        """Write all that is pending; failed writes wait for the next attempt."""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        loop = asyncio.get_running_loop()
        tried: dict[int, Content] = {}
        while left := [item for item in self._pending.items() if tried.get(item[0]) is not item[1]]:
            key, content = left[0]
            tried[key] = content
            try:
                await loop.run_in_executor(self._worker, self._write, key, content)
            except OSError as error:
                if self._failed.get(key) is not content:
                    self._failed[key] = content
                    self.failures += 1
                    self._report(key, reason_of(error))
                continue
            # The content stays pending until it is written, so that a shutdown loses nothing.
            if self._pending[key] is content:
                del self._pending[key]
            if self._failed.pop(key, None) is not None:
                self._report(key, None)
        if self._pending:
            self._retry = loop.call_later(RETRY_S, self._start)


class PlanFiles(KeptFiles[StoredPlan]):
    """The plan files of all aircraft: missions, marks and homes."""

    def __init__(self, folder: Path, announce: Callable[[int, str | None], None]) -> None:
        super().__init__(folder, "plans")
        self.broken: dict[int, str] = {}
        """Reasons why plans could not be loaded, by vehicle id."""
        self._announce = announce

    def load(self) -> dict[int, StoredPlan]:
        """Read all files that can be read."""
        found: dict[int, StoredPlan] = {}
        for file in sorted(self._folder.glob("*.plan.json")):
            named = NAME.fullmatch(file.name)
            if named is None:
                continue
            vehicle_id = int(named[1])
            try:
                found[vehicle_id] = decode_plan(file.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                self.broken[vehicle_id] = _broken(file)
                log.warning(
                    "%s cannot be read and is left alone: %s. Missions, mark and home of aircraft "
                    "%d begin empty and are not kept until it is repaired or removed.",
                    file,
                    error,
                    vehicle_id,
                )
        return found

    def _report(self, key: int, reason: str | None) -> None:
        if reason is None:
            log.info("plan of aircraft %d is stored again", key)
        else:
            log.warning("plan of aircraft %d cannot be stored: %s; trying again", key, reason)
        self._announce(key, reason)

    def _write(self, key: int, content: StoredPlan) -> None:
        file = self._folder / f"{key}.plan.json"
        if key in self.broken and file.exists():
            raise OSError(None, _broken(file))
        self._folder.mkdir(parents=True, exist_ok=True)
        write_new(file, [encode_plan(content).encode()], overwrite=True)


def _broken(file: Path) -> str:
    return f"{file.name} is broken: repair or remove it"


class TimestampFile(KeptFiles[Kept]):
    """The file with the signing timestamps of all aircraft."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "timestamps")
        self._file = folder / TIMESTAMPS_NAME

    def load(self) -> Kept:
        """Read the file; empty if it does not exist or cannot be read."""
        kind = dict[int, dict[str, dict[_Stream, _Timestamp]]]
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

    def _report(self, key: int, reason: str | None) -> None:  # noqa: ARG002
        # New timestamps follow every few seconds: only the first failure is logged.
        if reason is None:
            self.failures = 0
        elif self.failures == 1:
            log.warning("%s cannot be written: %s", self._file, reason)

    def _write(self, key: int, content: Kept) -> None:  # noqa: ARG002
        self._folder.mkdir(parents=True, exist_ok=True)
        text = msgspec.json.encode({str(key): kept for key, kept in content.items()})
        write_new(self._file, [text], overwrite=True, rights=PRIVATE)
