"""Recordings to the browser and from it, exports by other commands, and the catalogue."""

import asyncio
import os
import tempfile
from collections.abc import AsyncIterator
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import httpx
import pytest
from fastapi import FastAPI
from pymavlink.dialects.v20 import common as mavlink
from starlette.types import Receive, Scope, Send

from gateway.batch.catalogue import Catalogue, CataloguedFile, FlightFigures
from gateway.batch.facts import FlightFacts
from gateway.panel import recording_files
from gateway.panel.access import ROLE, Role
from gateway.panel.admission import Holder
from gateway.panel.recording_files import (
    CHUNK,
    FORMATS,
    ExportError,
    RecordingFacts,
    RecordingJobs,
    add_recording_files,
    zip_stream,
)
from gateway.recordings.index import RecordingError, list_recordings
from gateway.recordings.tlog import encode_record
from tests.panel.messages import flight_frames

pytestmark = pytest.mark.io

NAME = "a day's --flight"


def flight() -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(sender)
    return b"".join(
        (1_700_000_000_000_000 + second * 1_000_000).to_bytes(8, "big") + frame
        for second in range(5)
    )


def client_as(role: Role, app: FastAPI) -> httpx.AsyncClient:
    async def with_role(scope: Scope, receive: Receive, send: Send) -> None:
        scope[ROLE] = role
        await app(scope, receive, send)

    return httpx.AsyncClient(
        transport=httpx.ASGITransport(app=with_role), base_url="http://127.0.0.1"
    )


def client_of(folder: Path, role: Role = Role.OPERATOR) -> httpx.AsyncClient:
    app = FastAPI()
    add_recording_files(app, lambda: folder)
    return client_as(role, app)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "secret_01.tlog").write_bytes(flight())
    (tmp_path / "recordings").mkdir()
    return tmp_path / "recordings"


@pytest.fixture
async def client(folder: Path) -> AsyncIterator[httpx.AsyncClient]:
    async with client_of(folder) as opened:
        yield opened


async def test_uploaded_recording_can_be_downloaded(
    client: httpx.AsyncClient, folder: Path
) -> None:
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
async def test_name_outside_the_folder_is_refused(
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
async def test_invalid_upload_leaves_no_file(
    client: httpx.AsyncClient, folder: Path, content: bytes
) -> None:
    answer = await client.put("/recordings/upload", content=content)
    assert (answer.status_code, list(folder.iterdir())) == (HTTPStatus.BAD_REQUEST, [])
    assert "unknown file format" in answer.text


async def test_upload_under_an_existing_name_is_refused(
    client: httpx.AsyncClient, folder: Path
) -> None:
    (folder / "day_01.tlog").write_bytes(b"first")
    answer = await client.put("/recordings/day", content=flight())
    assert answer.status_code == HTTPStatus.BAD_REQUEST
    assert (folder / "day_01.tlog").read_bytes() == b"first"


async def test_viewer_may_download_but_not_upload(folder: Path) -> None:
    (folder / "day_01.tlog").write_bytes(flight())
    async with client_of(folder, Role.VIEWER) as viewer:
        assert (await viewer.get("/recordings/day")).status_code == HTTPStatus.OK
        answer = await viewer.put("/recordings/other", content=flight())
    assert answer.status_code == HTTPStatus.FORBIDDEN
    assert [file.name for file in folder.iterdir()] == ["day_01.tlog"]


async def test_mode_of_uploads_follows_the_umask(client: httpx.AsyncClient, folder: Path) -> None:
    before = os.umask(0o027)
    try:
        await client.put("/recordings/day", content=flight())
    finally:
        os.umask(before)
    assert (folder / "day_01.tlog").stat().st_mode & 0o777 == 0o640


async def test_links_and_pipes_are_not_downloaded(client: httpx.AsyncClient, folder: Path) -> None:
    (folder / "link_01.tlog").symlink_to(folder.parent / "secret_01.tlog")
    answer = await client.get("/recordings/link")
    assert answer.status_code == HTTPStatus.FORBIDDEN
    os.mkfifo(folder / "pipe_01.tlog")
    assert (await client.get("/recordings/pipe")).status_code == HTTPStatus.NOT_FOUND
    (folder / "link_02.tlog").write_bytes(flight())
    with ZipFile(BytesIO((await client.get("/recordings/link")).content)) as packed:
        assert packed.namelist() == ["link_02.tlog"]


def test_archive_is_packed_piece_by_piece_without_a_file_or_an_open_descriptor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = tmp_path / "large_01.tlog"
    large.write_bytes(os.urandom(4 * CHUNK))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    before = sum(1 for _ in Path("/proc/self/fd").iterdir())
    stream = zip_stream([large, tmp_path / "gone_01.tlog"])
    first = next(stream)
    assert 0 < len(first) < 2 * CHUNK
    stream.close()
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) == before
    with ZipFile(BytesIO(b"".join(zip_stream([large])))) as packed:
        assert packed.read("large_01.tlog") == large.read_bytes()


def catalogue(folder: Path, **seconds: float) -> None:
    catalogue = Catalogue(folder)
    for name, duration in seconds.items():
        for kind in ("tlog", "table"):
            facts = FlightFacts(duration=duration, loss=0.1 if kind == "table" else None)
            path = f"{name}.{kind}"
            catalogue.put([CataloguedFile(path, name, kind, 1, 1, path, flights=((facts, []),))])
    catalogue.close()


def test_recording_is_found_by_name_and_by_condition(tmp_path: Path) -> None:
    catalogue(tmp_path, Morning=400.0, evening=100.0)
    facts = RecordingFacts()
    facts.look(tmp_path, "morn")
    assert [facts.shows(name, "morn") for name in ("Morning", "evening")] == [True, False]
    # The table contains more facts than the tlog next to it.
    assert facts.of("Morning") == FlightFigures(400.0, loss=0.1)
    facts.look(tmp_path, "duration < 300")
    assert [facts.shows(name, "duration < 300") for name in ("Morning", "evening")] == [False, True]


def test_invalid_condition_is_reported_and_matches_nothing(tmp_path: Path) -> None:
    catalogue(tmp_path, a=1.0)
    facts = RecordingFacts()
    facts.look(tmp_path, "height > 3")
    assert "no such column: height" in facts.trouble
    assert not facts.shows("a", "height > 3")
    facts.look(tmp_path, "")
    assert (facts.trouble, facts.shows("a", "")) == ("", True)


def test_names_are_searched_without_a_catalogue(tmp_path: Path) -> None:
    facts = RecordingFacts()
    facts.look(tmp_path, "x")
    assert facts.of("x1") is None
    assert facts.shows("x1", "x")
    assert "once the recordings are indexed" in facts.trouble
    catalogue(tmp_path, x1=5.0)
    facts.look(tmp_path, "x")
    assert facts.trouble == ""
    assert facts.of("x1") is not None


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    path = tmp_path / 'with "quotes"'
    path.mkdir()
    (path / f"{NAME}_01.tlog").write_bytes(b"".join(encode_record(*f) for f in flight_frames(40)))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "begin"), [("gpx", b"<?xml"), ("page", b"<!doctype html>")])
async def test_export_is_fetched_under_an_unguessable_address(
    exported: Path, kind: str, begin: bytes
) -> None:
    jobs, app = RecordingJobs(), FastAPI()
    jobs.serve(app)
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://panel") as client:
        url = await jobs.export(exported, NAME, kind)
        answer = await client.get(url)
        assert answer.content.startswith(begin)
        assert FORMATS[kind][2] in answer.headers["content-disposition"]
        assert (await client.get("/exports/guessed")).status_code == 404
        jobs.close()
        assert (await client.get(url)).status_code == 404


@pytest.mark.slow
async def test_failed_export_reports_the_reason_and_leaves_no_file(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (exported / "broken_01.tlog").write_bytes(b"no recording at all\n" * 10)
    jobs = RecordingJobs()
    with pytest.raises(ExportError, match="broken_01"):
        await jobs.export(exported, "broken", "kml")
    with pytest.raises(RecordingError):
        await jobs.export(exported, "../../etc/passwd", "kml")
    monkeypatch.setattr(recording_files, "EXPORT_S", 0.05)
    with pytest.raises(ExportError, match=r"not finished after .* another format"):
        await jobs.export(exported, NAME, "report")
    cancelled = asyncio.create_task(jobs.export(exported, NAME, "page"))
    # Its command runs as soon as its folder holds the settings.
    async with asyncio.timeout(60.0):
        while not list(tmp_path.glob("mavgate-export-*/*/settings.toml")):
            await asyncio.sleep(0)
    cancelled.cancel()
    await asyncio.wait([cancelled])
    assert list(tmp_path.glob("mavgate-export-*/*")) == []
    jobs.close()
    assert list(tmp_path.glob("mavgate-export-*")) == []


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Exports are made at once, and listed."""
    names: list[str] = []

    async def make(folder: Path, work: Path, name: str, kind: str) -> Path:
        names.append(kind)
        target = work / f"{name}.{kind}"
        target.write_bytes(bytes(1000))
        return target

    monkeypatch.setattr(recording_files, "_make", make)
    return names


VIEWER = Holder(Role.VIEWER, "session", "10.0.0.1")


async def test_exports_of_a_viewer_keep_no_operator_waiting(
    exported: Path, made: list[str]
) -> None:
    jobs = RecordingJobs()
    async with asyncio.timeout(60.0), jobs._exporting[Role.VIEWER]:
        waiting = [
            asyncio.create_task(jobs.export(exported, NAME, kind, VIEWER))
            for kind in ("kml", "gpx")
        ]
        await asyncio.sleep(0)
        with pytest.raises(ExportError, match="other exports"):
            await jobs.export(exported, NAME, "csv", VIEWER)
        await jobs.export(exported, NAME, "csv")
    await asyncio.gather(*waiting)
    assert made == ["csv", "kml", "gpx"]
    jobs.close()


async def test_equal_export_is_made_once_and_deleted_after_the_last_fetch(
    exported: Path, made: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    jobs, app = RecordingJobs(), FastAPI()
    jobs.serve(app)
    first, second = await asyncio.gather(
        *(jobs.export(exported, NAME, "kml", VIEWER) for _ in range(2))
    )
    assert (first, made) == (second, ["kml"])
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://panel") as client:
        assert [(await client.get(first)).status_code for _ in range(3)] == [200, 200, 404]
    assert list(tmp_path.glob("mavgate-export-*/*")) == []
    jobs.close()


async def test_bytes_of_exports_are_bounded(
    exported: Path, made: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(recording_files, "MAX_EXPORTED", 2500)
    jobs = RecordingJobs()
    for kind in ("csv", "kml", "gpx", "page"):
        await jobs.export(exported, NAME, kind, VIEWER)
    kept = sorted(file.suffix for file in tmp_path.glob("mavgate-export-*/*/*"))
    assert kept == [".gpx", ".page"]
    jobs.close()


@pytest.mark.slow
async def test_indexed_recording_has_facts_and_a_track(exported: Path) -> None:
    jobs, facts = RecordingJobs(), RecordingFacts()
    jobs.index(exported, list_recordings(exported))
    assert jobs._indexing is not None
    await jobs._indexing
    facts.look(exported)
    figures = facts.of(NAME)
    assert isinstance(figures, FlightFigures)
    assert figures.duration == pytest.approx(39.9, abs=0.5)
    corners = [tuple(map(float, corner.split(","))) for corner in facts.track(NAME).split()]
    assert len(corners) > 5
    assert all(0 <= x <= 46 and 0 <= y <= 24 for x, y in corners)
    jobs.index(exported, list_recordings(exported))
    assert not jobs.is_indexing
    jobs.close()
