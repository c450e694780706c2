"""Files kept for the next start: each aircraft's stored locations, and the signing timestamps.

A separate thread replaces a file atomically, since writing to a disk may block. A failed write of
locations is retried until it succeeds. A file that cannot be read is reported and left unchanged:
it may contain a mission that a person can repair.
"""

import asyncio
import contextlib
import logging
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Final, ParamSpec, TypeVar

import msgspec

from gateway.output import PRIVATE, write_new
from gateway.printable import reason_of
from gateway.vehicle.plan import StoredPlan, decode_plan, encode_plan

log = logging.getLogger(__name__)

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
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


class PlanFiles:
    """The plan files of all aircraft: missions, marks and homes."""

    def __init__(self, folder: Path, report: Callable[[int, str | None], None]) -> None:
        self.failures = 0
        """Changes that could not be written at once since the start."""
        self.broken: dict[int, str] = {}
        """Reasons why plans could not be loaded, by vehicle id."""
        self._folder = folder
        self._report = report
        self._pending: dict[int, StoredPlan] = {}
        self._failed: dict[int, StoredPlan] = {}
        """Plans whose last write failed."""
        self._worker = begin_worker("plans")
        self._task: asyncio.Task[None] | None = None
        self._retry: asyncio.TimerHandle | None = None

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

    def save(self, vehicle_id: int, plan: StoredPlan) -> None:
        """Store the plan of an aircraft; returns at once. Only the newest plan is written."""
        self._pending[vehicle_id] = plan
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
        for vehicle_id, plan in self._pending.items():
            with contextlib.suppress(OSError):
                self._write(vehicle_id, plan)

    def _start(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._write_pending())

    async def _write_pending(self) -> None:
        """Write all that is pending; failed writes wait for the next attempt."""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        loop = asyncio.get_running_loop()
        tried: dict[int, StoredPlan] = {}
        while left := [item for item in self._pending.items() if tried.get(item[0]) is not item[1]]:
            vehicle_id, plan = left[0]
            tried[vehicle_id] = plan
            try:
                await loop.run_in_executor(self._worker, self._write, vehicle_id, plan)
            except OSError as error:
                self._note_failure(vehicle_id, plan, reason_of(error))
            else:
                self._note_success(vehicle_id, plan)
        if self._pending:
            self._retry = loop.call_later(RETRY_S, self._start)

    def _note_failure(self, vehicle_id: int, plan: StoredPlan, reason: str) -> None:
        if self._failed.get(vehicle_id) is plan:
            return
        self._failed[vehicle_id] = plan
        self.failures += 1
        log.warning("plan of aircraft %d cannot be stored: %s; trying again", vehicle_id, reason)
        self._report(vehicle_id, reason)

    def _note_success(self, vehicle_id: int, plan: StoredPlan) -> None:
        # The plan stays pending until it is written, so that a shutdown loses nothing.
        if self._pending[vehicle_id] is plan:
            del self._pending[vehicle_id]
        if self._failed.pop(vehicle_id, None):
            log.info("plan of aircraft %d is stored again", vehicle_id)
            self._report(vehicle_id, None)

    def _write(self, vehicle_id: int, plan: StoredPlan) -> None:
        file = self._folder / f"{vehicle_id}.plan.json"
        if vehicle_id in self.broken and file.exists():
            raise OSError(None, _broken(file))
        self._folder.mkdir(parents=True, exist_ok=True)
        write_new(file, [encode_plan(plan).encode()], overwrite=True)


def _broken(file: Path) -> str:
    return f"{file.name} is broken: repair or remove it"


class TimestampFile:
    """The file with the signing timestamps of all aircraft."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / TIMESTAMPS_NAME
        self._worker = begin_worker("timestamps")
        self._newest: Kept = {}
        """Set by the event loop alone, and read by the worker."""
        self._written: Kept | None = None
        """The last timestamps that were written; of the worker alone."""
        self._is_reported = False

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

    def save(self, timestamps: Kept) -> None:
        """Store timestamps; returns at once. Only the newest ones are written."""
        self._newest = timestamps
        self._worker.submit(self._write)

    def close(self, timestamps: Kept) -> None:
        """Write the last timestamps, if any, and end."""
        if timestamps:
            self.save(timestamps)
        self._worker.shutdown(wait=True)

    def _write(self) -> None:
        newest = self._newest
        if newest is self._written:
            return
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            text = msgspec.json.encode({str(key): kept for key, kept in newest.items()})
            write_new(self._file, [text], overwrite=True, rights=PRIVATE)
        except OSError as error:
            if not self._is_reported:
                log.warning("%s cannot be written: %s", self._file, reason_of(error))
            self._is_reported = True
        else:
            self._written, self._is_reported = newest, False
