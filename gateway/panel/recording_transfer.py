"""Transfer of recordings: download as a ZIP archive, and upload.

File names from the browser are always checked: a recording must be one of the existing ones, and
an upload gets a name that follows the rules of recordings. An upload is written to a temporary
file, checked, and then renamed. A download is packed while it is sent, so it needs no space on the
disk.
"""

import os
import secrets
import stat
from collections.abc import AsyncIterator, Callable, Generator, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import quote
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from fastapi import FastAPI
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse

from gateway.panel.access import RECORDINGS, ROLE
from gateway.panel.admission import Role
from gateway.recordings.file_format import TABLE, TLOG
from gateway.recordings.index import RecordingError, check_free, find_recording
from gateway.recordings.recording import open_recording
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableReader
from gateway.recordings.tlog import TlogScanner
from gateway.recordings.workshop.convert import Pieces

LOOKED_AT: Final = 1 << 20
CHUNK: Final = 1 << 18
KINDS: Final[dict[str | None, str]] = {TLOG: "_01.tlog", TABLE: "_01_v1.csv"}
"""Kinds that can be uploaded, and the ending of their files."""


def add_recording_files(app: FastAPI, folder_of: Callable[[], Path]) -> None:
    """Serve `GET /recordings/NAME` (a ZIP of its files) and `PUT /recordings/NAME`."""

    @app.get(RECORDINGS + "{name}")
    async def _download(name: str) -> Response:
        try:
            files = [
                file
                for file in find_recording(folder_of(), name).files
                if file.is_file() and not file.is_symlink()
            ]
        except RecordingError as error:
            return PlainTextResponse(str(error), HTTPStatus.NOT_FOUND)
        if not files:
            text = f"{name}: links and devices are not sent"
            return PlainTextResponse(text, HTTPStatus.FORBIDDEN)
        disposition = f"attachment; filename*=utf-8''{quote(f'{name}.zip')}"
        return StreamingResponse(
            zip_stream(files),
            media_type="application/zip",
            headers={"content-disposition": disposition},
        )

    @app.put(RECORDINGS + "{name}")
    async def _upload(name: str, request: Request) -> Response:
        folder = folder_of()
        return await answer_upload(
            request, folder, lambda: check_free(folder, name), partial(_recording_name, name)
        )


async def answer_upload(
    request: Request, folder: Path, check: Callable[[], None], name_of: Callable[[Path], str]
) -> Response:
    """Store the body of an operator's request in a folder, and return its file name.

    `check` raises ValueError or RecordingError before anything is received; `name_of` returns the
    name for the received file, or raises ValueError if its contents are wrong. `AccessControl`
    limits the size.
    """
    if request.scope[ROLE] is not Role.OPERATOR:
        return PlainTextResponse("viewers have read-only access", HTTPStatus.FORBIDDEN)
    try:
        check()
        stored = await _store(folder, request.stream(), name_of)
    except ClientDisconnect:
        return PlainTextResponse("interrupted", HTTPStatus.BAD_REQUEST)
    except (RecordingError, ValueError) as error:
        return PlainTextResponse(str(error), HTTPStatus.BAD_REQUEST)
    except OSError as error:
        text = f"cannot be stored: {error.strerror}"
        return PlainTextResponse(text, HTTPStatus.INSUFFICIENT_STORAGE)
    return PlainTextResponse(stored.name, HTTPStatus.CREATED)


def zip_stream(files: Sequence[Path]) -> Generator[bytes]:
    """Pack files into a ZIP archive, piece by piece; links and devices are left out."""
    pieces = Pieces()
    with ZipFile(pieces, "w", ZIP_DEFLATED) as packed:
        for path in files:
            with suppress(OSError), open_regular(path) as file:
                info = ZipInfo.from_file(path, path.name, strict_timestamps=False)
                info.compress_type = ZIP_DEFLATED
                with packed.open(info, "w", force_zip64=True) as entry:
                    while chunk := file.read(CHUNK):
                        entry.write(chunk)
                        yield pieces.take()
    yield pieces.take()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; raises OSError for a link, a pipe or a device."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(f"{path} is not a regular file")
    return os.fdopen(handle, "rb")


async def _store(
    folder: Path, chunks: AsyncIterator[bytes], name_of: Callable[[Path], str]
) -> Path:
    """Write an upload to a temporary file, and rename it once it is checked."""
    folder.mkdir(parents=True, exist_ok=True)
    fresh = folder / f".upload-{secrets.token_hex(8)}"
    try:
        # Not by `tempfile`, whose files always have the mode 0600.
        with fresh.open("xb") as file:
            async for chunk in chunks:
                file.write(chunk)
        target = folder / name_of(fresh)
        # A file that was created during the upload is never overwritten.
        target.touch(exist_ok=False)
        fresh.replace(target)
        return target
    finally:
        with suppress(FileNotFoundError):
            fresh.unlink()


def _recording_name(name: str, path: Path) -> str:
    """Return the file name of an uploaded recording; raises ValueError for another file."""
    suffix = KINDS.get(_kind(path))
    if suffix is None:
        allowed = " and ".join(str(kind) for kind in KINDS)
        raise ValueError(f"unknown file format: {allowed} are accepted")
    return f"{name}{suffix}"


def _kind(path: Path) -> str | None:
    """Return the kind of an upload by its first bytes; None if it is not a recording."""
    kind = open_recording(path).kind
    with path.open("rb") as file:
        head = file.read(LOOKED_AT)
    if kind == TLOG:
        batch = TlogScanner().feed(head, final=True)
        return kind if len(batch) else None
    rows = (event for event in TableReader().feed(head) if isinstance(event, TableRow))
    return kind if kind == TABLE and next(rows, None) is not None else None
