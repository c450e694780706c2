"""Download of recordings as one archive, and checked uploads.

File names from the browser are always checked: a recording must be one of the existing ones, and
an upload gets a name that follows the rules of recordings. An upload is written to a temporary
file, checked, and only then becomes a recording.
"""

import os
import tempfile
from collections.abc import AsyncIterator
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import Final
from zipfile import ZIP_DEFLATED, ZipFile

from fastapi import FastAPI
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from gateway.edges.disk.recording_streams import FileKind, kind_of
from gateway.edges.disk.recordings import RecordingError, check_free, find_recording
from gateway.flightlog.table.row import TableRow
from gateway.flightlog.table.table import TableReader
from gateway.flightlog.tlog.tlog import TlogScanner
from gateway.panel.serving.page_guard import ROLE, UPLOAD
from gateway.panel.view_context import PanelParts, Role

LOOKED_AT: Final = 1 << 20
FILE_RIGHTS: Final = 0o644
KINDS: Final[dict[FileKind | None, str]] = {FileKind.TLOG: "_01.tlog", FileKind.TABLE: "_01_v1.csv"}
"""Kinds that can be uploaded, and the ending of their files."""


def add_recording_files(app: FastAPI, parts: PanelParts) -> None:
    """Serve `GET /recordings/NAME` (a ZIP of its files) and `PUT /recordings/NAME`.

    Parameters
    ----------
    app : FastAPI
        The page's.
    parts : PanelParts
        With their folder.
    """

    @app.get(UPLOAD + "{name}")
    def _download(name: str) -> Response:
        try:
            files = find_recording(parts.recordings_folder, name).files
        except RecordingError as error:
            return PlainTextResponse(str(error), HTTPStatus.NOT_FOUND)
        archive = Path(tempfile.mkstemp(prefix="mavgate-", suffix=".zip")[1])
        with ZipFile(archive, "w", ZIP_DEFLATED) as packed:
            for file in files:
                packed.write(file, file.name)
        tidy = BackgroundTask(archive.unlink, missing_ok=True)
        return FileResponse(archive, filename=f"{name}.zip", background=tidy)

    @app.put(UPLOAD + "{name}")
    async def _upload(name: str, request: Request) -> Response:
        if request.scope[ROLE] is not Role.OPERATOR:
            return PlainTextResponse("viewers have read-only access", HTTPStatus.FORBIDDEN)
        try:
            folder = parts.recordings_folder
            check_free(folder, name)
            stored = await _store(folder, name, request.stream())
        except (RecordingError, ValueError) as error:
            return PlainTextResponse(str(error), HTTPStatus.BAD_REQUEST)
        except OSError as error:
            text = f"cannot be stored: {error.strerror}"
            return PlainTextResponse(text, HTTPStatus.INSUFFICIENT_STORAGE)
        return PlainTextResponse(stored.name, HTTPStatus.CREATED)


async def _store(folder: Path, name: str, chunks: AsyncIterator[bytes]) -> Path:
    """Write an upload beside the recordings, and rename it if it is a recording.

    Raises
    ------
    ValueError
        If it is no recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle, place = tempfile.mkstemp(prefix=".upload-", dir=folder)
    fresh = Path(place)
    try:
        with os.fdopen(handle, "wb") as file:
            async for chunk in chunks:
                file.write(chunk)
        suffix = KINDS.get(_kind(fresh))
        if suffix is None:
            allowed = " and ".join(str(kind) for kind in KINDS)
            raise ValueError(f"this is no recording: {allowed} are taken")
        target = folder / f"{name}{suffix}"
        # A file that was created meanwhile is never overwritten.
        target.touch(exist_ok=False)
        fresh.chmod(FILE_RIGHTS)
        fresh.replace(target)
        return target
    finally:
        with suppress(FileNotFoundError):
            fresh.unlink()


def _kind(path: Path) -> FileKind | None:
    """Return the kind of an upload by its first bytes; None if it is no recording."""
    kind = kind_of(path)
    with path.open("rb") as file:
        head = file.read(LOOKED_AT)
    if kind is FileKind.TLOG:
        batch = TlogScanner().feed(head, final=True)
        return kind if len(batch) else None
    rows = (event for event in TableReader().feed(head) if isinstance(event, TableRow))
    return kind if kind is FileKind.TABLE and next(rows, None) is not None else None
