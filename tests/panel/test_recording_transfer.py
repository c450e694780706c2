"""Recordings to the browser and from it."""

import os
from collections.abc import AsyncIterator
from functools import partial
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import httpx
import pytest
from fastapi import FastAPI

from gateway.panel.admission import Role
from gateway.panel.recording_transfer import CHUNK, add_recording_files, zip_stream
from tests.panel.messages import short_tlog
from tests.panel.web_client import client_of

pytestmark = pytest.mark.io


def serve(folder: Path, app: FastAPI) -> None:
    add_recording_files(app, lambda: folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "secret_01.tlog").write_bytes(short_tlog())
    (tmp_path / "recordings").mkdir()
    return tmp_path / "recordings"


@pytest.fixture
async def client(folder: Path) -> AsyncIterator[httpx.AsyncClient]:
    async with client_of(partial(serve, folder)) as opened:
        yield opened


async def test_uploaded_recording_is_downloaded(client: httpx.AsyncClient, folder: Path) -> None:
    answer = await client.put("/recordings/day one", content=short_tlog())
    assert answer.status_code == HTTPStatus.CREATED
    assert (folder / "day one_01.tlog").read_bytes() == short_tlog()
    answer = await client.get("/recordings/day one")
    with ZipFile(BytesIO(answer.content)) as packed:
        assert packed.namelist() == ["day one_01.tlog"]
        assert packed.read("day one_01.tlog") == short_tlog()


@pytest.mark.parametrize(
    "name", ["../secret", "..%2Fsecret", "%2e%2e/secret", "/etc/passwd", "%2Fetc%2Fpasswd", ".."]
)
async def test_outside_name_is_refused(client: httpx.AsyncClient, folder: Path, name: str) -> None:
    before = sorted(folder.parent.rglob("*"))
    assert (await client.get(f"/recordings/{name}")).status_code >= HTTPStatus.BAD_REQUEST
    answer = await client.put(f"/recordings/{name}", content=short_tlog())
    assert answer.status_code >= HTTPStatus.BAD_REQUEST
    assert sorted(folder.parent.rglob("*")) == before


@pytest.mark.parametrize(
    "content",
    [b"", b"a text\n", b"a,b,c\n1,2,3\n", bytes(range(256)) * 40, short_tlog()[:12]],
    ids=["empty", "text", "another table", "noise", "cut tlog"],
)
async def test_bad_upload_is_deleted(
    client: httpx.AsyncClient, folder: Path, content: bytes
) -> None:
    answer = await client.put("/recordings/upload", content=content)
    assert (answer.status_code, list(folder.iterdir())) == (HTTPStatus.BAD_REQUEST, [])
    assert "unknown file format" in answer.text


@pytest.mark.parametrize(
    ("role", "name", "status"),
    [(Role.OPERATOR, "day", HTTPStatus.BAD_REQUEST), (Role.VIEWER, "other", HTTPStatus.FORBIDDEN)],
    ids=["existing name", "viewer"],
)
async def test_refused_upload_changes_no_file_and_the_recording_is_served(
    folder: Path, role: Role, name: str, status: HTTPStatus
) -> None:
    (folder / "day_01.tlog").write_bytes(b"first")
    async with client_of(partial(serve, folder), role) as client:
        answer = await client.put(f"/recordings/{name}", content=short_tlog())
        assert answer.status_code == status
        assert (await client.get("/recordings/day")).status_code == HTTPStatus.OK
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == {"day_01.tlog": b"first"}


async def test_mode_of_uploads_follows_the_umask(client: httpx.AsyncClient, folder: Path) -> None:
    before = os.umask(0o027)
    try:
        await client.put("/recordings/day", content=short_tlog())
    finally:
        os.umask(before)
    assert (folder / "day_01.tlog").stat().st_mode & 0o777 == 0o640


async def test_links_and_pipes_are_not_downloaded(client: httpx.AsyncClient, folder: Path) -> None:
    (folder / "link_01.tlog").symlink_to(folder.parent / "secret_01.tlog")
    answer = await client.get("/recordings/link")
    assert answer.status_code == HTTPStatus.FORBIDDEN
    os.mkfifo(folder / "pipe_01.tlog")
    assert (await client.get("/recordings/pipe")).status_code == HTTPStatus.NOT_FOUND
    (folder / "link_02.tlog").write_bytes(short_tlog())
    with ZipFile(BytesIO((await client.get("/recordings/link")).content)) as packed:
        assert packed.namelist() == ["link_02.tlog"]


@pytest.mark.usefixtures("temporary")
def test_archive_is_packed_piece_by_piece_without_a_file_or_an_open_descriptor(
    tmp_path: Path,
) -> None:
    large = tmp_path / "large_01.tlog"
    large.write_bytes(os.urandom(4 * CHUNK))
    before = sum(1 for _ in Path("/proc/self/fd").iterdir())
    stream = zip_stream([large, tmp_path / "gone_01.tlog"])
    first = next(stream)
    assert 0 < len(first) < 2 * CHUNK
    stream.close()
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) == before
    with ZipFile(BytesIO(b"".join(zip_stream([large])))) as packed:
        assert packed.read("large_01.tlog") == large.read_bytes()
