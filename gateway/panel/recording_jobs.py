"""Jobs on recordings: exports to other formats, and the update of the catalogue.

Both run in other processes at a lower priority, so that neither the gateway nor the page waits for
them: one export of each role at a time, so that no operator waits for a viewer. A file is deleted
once all clients that requested it have fetched it.
"""

import asyncio
import json
import logging
import os
import secrets
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Hashable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from zipfile import ZIP_DEFLATED, ZipFile

from fastapi import FastAPI
from starlette.background import BackgroundTask
from starlette.responses import FileResponse, PlainTextResponse, Response

from gateway.live.terminal import own_command
from gateway.panel.admission import LOCAL, Holder, Role, Slots
from gateway.recordings.index import Recording, find_recording

log = logging.getLogger(__name__)

EXPORTS: Final = "/exports/"
LOW: Final = ("nice", "-n", "5")
"""Priority below the gateway and the page, but high enough next to a busy browser."""
EXPORT_S: Final = 900.0
"""Timeout of an export; at a first start, compiling may take a minute of it."""
KEPT_S: Final = 600.0
"""Time after which an exported file that was not fetched is deleted."""
EXPORTS_OF_SESSION: Final = 2
EXPORTS_OF_ROLE: Final = 4
"""Maximum running and waiting exports of a role, of which one runs at a time."""
MAX_EXPORT: Final = 1 << 29
"""Maximum bytes of one export with its temporary files; also at most half of the free space."""
MAX_EXPORTED: Final = 1 << 29
"""Maximum bytes of exported files of one role that were not fetched; the oldest are deleted. With
the running export, a role uses at most 1 GiB."""
MEASURED_S: Final = 0.25
"""Interval of measuring the size of a running export."""
ANONYMISED: Final = "anonymised"
INDEX_AGAIN_S: Final = 20.0
"""Shortest time between two indexings."""
FORMATS: Final = {
    "csv": ("CSV table", ("convert", "-o"), ".csv"),
    "tlog": ("tlog", ("convert", "-o"), ".tlog"),
    "kml": ("KML (Google Earth)", ("convert", "-o"), ".kml"),
    "gpx": ("GPX", ("convert", "-o"), ".gpx"),
    "mcap": ("MCAP (Foxglove)", ("convert", "-o"), ".mcap"),
    "page": ("Page (one HTML file)", ("report", "-o"), ".html"),
    "report": ("Report (figures and tables)", ("report", "-o"), ".zip"),
}
"""Title, command and ending of the file of each export; the command ends with the option of the
file."""
CUTS: Final = {
    "cut": ("Cut to a tlog", ("convert", "-o"), ".tlog"),
    ANONYMISED: ("Anonymised tlog", ("convert", "--anonymise", "-o"), ".tlog"),
}
"""The same for tlogs of a part of a recording."""
EXTRACTS: Final = {
    "params": ("Parameters", ("extract", "--params"), ".param"),
    "plan": ("Mission, fence, rally", ("extract", "--mission"), ".plan"),
    "texts": ("Texts", ("extract", "--texts"), ".csv"),
    "events": ("Events", ("extract", "--events"), ".csv"),
}
KINDS: Final = FORMATS | CUTS | EXTRACTS


class ExportError(Exception):
    """A recording cannot be exported; the text gives the reason."""


@dataclass(frozen=True, slots=True)
class Order:
    """A requested export of a recording."""

    folder: Path
    name: str
    kind: str
    """One of `KINDS`."""
    options: tuple[str, ...] = ()
    """Further options of its command, checked by the caller."""


@dataclass(eq=False)
class _Export:
    """An exported file, or a running export."""

    role: Role | None
    task: "asyncio.Task[Path]" = field(init=False)
    users: int = 0
    """Number of requests that have not fetched the file yet."""
    token: str = ""
    size: int = 0


class RecordingJobs:
    """The catalogue and the exports of all pages."""

    def __init__(self) -> None:
        self._exports: dict[Hashable, _Export] = {}
        """Exports by role, recording and kind, oldest first."""
        self._slots: Slots[Hashable] = Slots(EXPORTS_OF_SESSION, EXPORTS_OF_ROLE, EXPORTS_OF_ROLE)
        self._folder: Path | None = None
        self._exporting: dict[Role | None, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._indexing: asyncio.Task[None] | None = None
        self._indexed: object = None
        self._indexed_s = -INDEX_AGAIN_S

    @property
    def is_indexing(self) -> bool:
        """Whether the catalogue is being brought up to date."""
        return self._indexing is not None and not self._indexing.done()

    def index(self, folder: Path, recordings: list[Recording]) -> None:
        """Bring the catalogue of a folder up to date if its recordings have changed."""
        state = (folder, [(each.name, each.size, each.modified_s) for each in recordings])
        waits = time.monotonic() - self._indexed_s < INDEX_AGAIN_S
        if not recordings or self.is_indexing or waits or state == self._indexed:
            return
        self._indexed, self._indexed_s = state, time.monotonic()
        self._indexing = asyncio.get_running_loop().create_task(self._index(folder))

    async def export(self, order: Order, holder: Holder = LOCAL) -> str:
        """Export a recording, and return the address of the file; an equal export is reused.

        Raises ExportError if the export fails; RecordingError if there is no such recording.
        """
        recording = find_recording(order.folder, order.name)
        key = (holder.role, order, recording.size, recording.modified_s)
        export = self._exports.get(key)
        if export is None:
            if not self._slots.admit(key, holder):
                raise ExportError("other exports are being made; try again in a while")
            export = self._exports[key] = _Export(holder.role)
            export.task = asyncio.create_task(self._export(key, export, order))
        export.users += 1
        try:
            await asyncio.shield(export.task)
        except asyncio.CancelledError:
            export.users -= 1
            if not export.users:
                export.task.cancel()
                await asyncio.wait([export.task])
            raise
        return f"{EXPORTS}{export.token}"

    def close(self) -> None:
        """Stop all jobs, and delete their files."""
        if self._indexing is not None:
            self._indexing.cancel()
        for export in self._exports.values():
            export.task.cancel()
        self._exports.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def serve(self, app: FastAPI) -> None:
        """Serve the exported files, each under an address that cannot be guessed."""

        @app.get(EXPORTS + "{token}")
        async def _fetch(token: str) -> Response:
            for key, export in self._exports.items():
                if token and export.token == token:
                    file = export.task.result()
                    fetched = BackgroundTask(self._note_fetched, key, export)
                    return FileResponse(file, filename=file.name, background=fetched)
            return PlainTextResponse("this file is no longer there: export it again", 404)

    async def _note_fetched(self, key: Hashable, export: _Export) -> None:
        export.users -= 1
        if export.users <= 0:
            self._delete(key, export)

    async def _export(self, key: Hashable, export: _Export, order: Order) -> Path:
        token = secrets.token_urlsafe(16)
        try:
            # Systems remove old folders of temporary files.
            if self._folder is None or not self._folder.is_dir():
                self._folder = Path(tempfile.mkdtemp(prefix="mavgate-export-"))
            async with self._exporting[export.role]:
                work = self._folder / token
                work.mkdir()
                target = await _make(work, order)
        except BaseException:
            # The unfinished file of a large recording may have gigabytes.
            if self._folder is not None:
                shutil.rmtree(self._folder / token, ignore_errors=True)
            self._exports.pop(key, None)
            raise
        finally:
            self._slots.release(key)
        export.token, export.size = token, target.stat().st_size
        self._make_room(export)
        asyncio.get_running_loop().call_later(KEPT_S, self._delete, key, export)
        return target

    def _make_room(self, export: _Export) -> None:
        """Delete the oldest files of a role beyond the limit of bytes."""
        made = [
            (key, each)
            for key, each in self._exports.items()
            if each.role is export.role and each.token
        ]
        excess = sum(each.size for _, each in made) - MAX_EXPORTED
        for key, each in made:
            if excess > 0 and each is not export:
                excess -= each.size
                self._delete(key, each)

    def _delete(self, key: Hashable, export: _Export) -> None:
        if self._folder is not None and self._exports.get(key) is export:
            del self._exports[key]
            shutil.rmtree(self._folder / export.token, ignore_errors=True)

    async def _index(self, folder: Path) -> None:
        try:
            await _run([*own_command("info"), str(folder)])
        except ExportError as error:
            log.info("the recordings in %s are not indexed: %s", folder, error)


async def _make(work: Path, order: Order) -> Path:
    """Export a recording into an empty folder, and return the only file in it."""
    folder, name, kind = order.folder, order.name, order.kind
    _, (command, *of_file), suffix = KINDS[kind]
    # The name of a recording contains its date, and may contain its location.
    target = work / f"{ANONYMISED if kind == ANONYMISED else name}{suffix}"
    output = work / name if kind == "report" else target
    # Settings with the folder of the recordings, in which the commands look up names.
    config = work / "settings.toml"
    config.write_text(f"[recording]\nfolder = {json.dumps(str(folder), ensure_ascii=False)}\n")
    arguments = ["--config", str(config), *order.options, *of_file, str(output), "--", name]
    await _run([*own_command(command), *arguments], work)
    config.unlink()
    if kind == "report":
        await asyncio.to_thread(_pack, output, target)
        shutil.rmtree(output, ignore_errors=True)
    return target


async def _run(command: list[str], work: Path | None = None) -> None:
    """Run a command, with a separate folder for its files.

    Raises ExportError if it fails (with its last line), times out, or writes too much.
    """
    child = await asyncio.create_subprocess_exec(
        *LOW,
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        env=os.environ if work is None else os.environ | {"TMPDIR": str(work)},
    )
    ended = asyncio.create_task(child.communicate())
    try:
        async with asyncio.timeout(EXPORT_S):
            while not ended.done():
                await asyncio.wait([ended], timeout=MEASURED_S)
                if work is not None:
                    await asyncio.to_thread(_check_size, work)
    except TimeoutError as error:
        raise ExportError(
            f"not finished after {EXPORT_S / 60.0:.0f} min, and stopped: choose a shorter "
            "recording or another format"
        ) from error
    finally:
        if child.returncode is None:
            with suppress(ProcessLookupError):
                child.kill()
        _, text = await ended
    if child.returncode:
        lines = text.decode(errors="replace").strip().splitlines()
        raise ExportError(lines[-1] if lines else f"the command ended with {child.returncode}")


def _check_size(work: Path) -> None:
    """Raise ExportError if the files of an export are too large for the disk."""
    size = 0
    for file in work.rglob("*"):
        with suppress(OSError):
            size += file.lstat().st_size
    limit = min(MAX_EXPORT, (shutil.disk_usage(work).free + size) // 2)
    if size > limit:
        raise ExportError(
            f"larger than {limit / 1e6:.0f} MB, and stopped: choose a shorter recording or another "
            "format, or run mavgate convert on the gateway's machine"
        )


def _pack(folder: Path, target: Path) -> None:
    with ZipFile(target, "w", ZIP_DEFLATED) as packed:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                packed.write(file, file.relative_to(folder.parent))
