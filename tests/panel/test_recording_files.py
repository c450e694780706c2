"""Recordings to the browser and from it, whatever is asked for or sent."""

from collections.abc import AsyncIterator
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from zipfile import ZipFile

import httpx
import pytest
from fastapi import FastAPI
from pymavlink.dialects.v20 import common as mavlink
from starlette.types import Receive, Scope, Send

from gateway.panel.access import ROLE
from gateway.panel.recording_files import add_recording_files
from gateway.panel.view_context import Role

pytestmark = pytest.mark.io


def flight() -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(sender)
    return b"".join(
        (1_700_000_000_000_000 + second * 1_000_000).to_bytes(8, "big") + frame
        for second in range(5)
    )


def client_of(folder: Path, role: Role = Role.OPERATOR) -> httpx.AsyncClient:
    app = FastAPI()
    add_recording_files(app, SimpleNamespace(recordings_folder=folder))  # type: ignore[arg-type]

    async def with_role(scope: Scope, receive: Receive, send: Send) -> None:
        scope[ROLE] = role
        await app(scope, receive, send)

    return httpx.AsyncClient(
        transport=httpx.ASGITransport(app=with_role), base_url="http://127.0.0.1"
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "secret_01.tlog").write_bytes(flight())
    (tmp_path / "recordings").mkdir()
    return tmp_path / "recordings"


@pytest.fixture
async def client(folder: Path) -> AsyncIterator[httpx.AsyncClient]:
    async with client_of(folder) as opened:
        yield opened


async def test_what_was_brought_can_be_taken_away(client: httpx.AsyncClient, folder: Path) -> None:
    answer = await client.put("/recordings/day one", content=flight())
    assert answer.status_code == HTTPStatus.CREATED
    assert (folder / "day one_01.tlog").read_bytes() == flight()
    answer = await client.get("/recordings/day one")
    with ZipFile(BytesIO(answer.content)) as packed:
        assert packed.namelist() == ["day one_01.tlog"]
        assert packed.read("day one_01.tlog") == flight()


@pytest.mark.parametrize(
    "name", ["../secret", "..%2Fsecret", "%2e%2e/secret", "/etc/passwd", "%2Fetc%2Fpasswd", ".."]
)
async def test_no_name_leaves_the_folder(
    client: httpx.AsyncClient, folder: Path, name: str
) -> None:
    before = sorted(folder.parent.rglob("*"))
    assert (await client.get(f"/recordings/{name}")).status_code >= HTTPStatus.BAD_REQUEST
    answer = await client.put(f"/recordings/{name}", content=flight())
    assert answer.status_code >= HTTPStatus.BAD_REQUEST
    assert sorted(folder.parent.rglob("*")) == before


@pytest.mark.parametrize(
    "content", [b"", b"a text\n", b"a,b,c\n1,2,3\n", bytes(range(256)) * 40, flight()[:12]]
)
async def test_what_is_no_recording_leaves_nothing(
    client: httpx.AsyncClient, folder: Path, content: bytes
) -> None:
    answer = await client.put("/recordings/upload", content=content)
    assert (answer.status_code, list(folder.iterdir())) == (HTTPStatus.BAD_REQUEST, [])
    assert "no recording" in answer.text


async def test_nothing_is_overwritten(client: httpx.AsyncClient, folder: Path) -> None:
    (folder / "day_01.tlog").write_bytes(b"first")
    answer = await client.put("/recordings/day", content=flight())
    assert answer.status_code == HTTPStatus.BAD_REQUEST
    assert (folder / "day_01.tlog").read_bytes() == b"first"


async def test_viewer_takes_and_does_not_bring(folder: Path) -> None:
    (folder / "day_01.tlog").write_bytes(flight())
    async with client_of(folder, Role.VIEWER) as viewer:
        assert (await viewer.get("/recordings/day")).status_code == HTTPStatus.OK
        answer = await viewer.put("/recordings/other", content=flight())
    assert answer.status_code == HTTPStatus.FORBIDDEN
    assert [file.name for file in folder.iterdir()] == ["day_01.tlog"]
