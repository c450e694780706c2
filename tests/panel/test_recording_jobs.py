"""Exports of recordings by the commands that make them, and the catalogue that fills itself."""

import asyncio
import tempfile
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from gateway.panel import recording_jobs
from gateway.panel.recording_jobs import (
    FORMATS,
    MAX_WAITING,
    ExportError,
    RecordingFacts,
    RecordingJobs,
)
from gateway.recordings.index import RecordingError, list_recordings
from gateway.recordings.tlog import encode_record
from tests.panel.test_flight_page import frames

pytestmark = [pytest.mark.io, pytest.mark.slow]
NAME = "a day's --flight"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / 'with "quotes"'
    path.mkdir()
    (path / f"{NAME}_01.tlog").write_bytes(b"".join(encode_record(*f) for f in frames(40)))
    return path


@pytest.mark.parametrize(("kind", "begin"), [("gpx", b"<?xml"), ("page", b"<!doctype html>")])
async def test_export_is_made_and_fetched_under_an_address_of_its_own(
    folder: Path, kind: str, begin: bytes
) -> None:
    jobs, app = RecordingJobs(), FastAPI()
    jobs.serve(app)
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://panel") as client:
        url = await jobs.export(folder, NAME, kind)
        answer = await client.get(url)
        assert answer.content.startswith(begin)
        assert FORMATS[kind][2] in answer.headers["content-disposition"]
        assert (await client.get("/exports/guessed")).status_code == 404
        jobs.close()
        assert (await client.get(url)).status_code == 404


async def test_failed_export_says_why_and_leaves_no_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (folder / "broken_01.tlog").write_bytes(b"no recording at all\n" * 10)
    jobs = RecordingJobs()
    with pytest.raises(ExportError, match="broken_01"):
        await jobs.export(folder, "broken", "kml")
    with pytest.raises(RecordingError):
        await jobs.export(folder, "../../etc/passwd", "kml")
    monkeypatch.setattr(recording_jobs, "EXPORT_S", 0.05)
    with pytest.raises(ExportError, match=r"not finished after .* another format"):
        await jobs.export(folder, NAME, "report")
    cancelled = asyncio.create_task(jobs.export(folder, NAME, "page"))
    # Its command runs as soon as its folder holds the settings.
    async with asyncio.timeout(60.0):
        while not list(tmp_path.glob("mavgate-export-*/*/settings.toml")):
            await asyncio.sleep(0)
    cancelled.cancel()
    await asyncio.wait([cancelled])
    assert list(tmp_path.glob("mavgate-export-*/*")) == []
    jobs.close()
    assert list(tmp_path.glob("mavgate-export-*")) == []


async def test_number_of_waiting_exports_is_limited(folder: Path) -> None:
    jobs = RecordingJobs()
    async with asyncio.timeout(60.0), jobs._exporting:
        waiting = [
            asyncio.create_task(jobs.export(folder, NAME, "kml")) for _ in range(MAX_WAITING)
        ]
        await asyncio.sleep(0)
        with pytest.raises(ExportError, match="other exports"):
            await jobs.export(folder, NAME, "kml")
        for task in waiting:
            task.cancel()
        await asyncio.wait(waiting)
    jobs.close()


async def test_catalogue_and_tracks_fill_themselves(folder: Path) -> None:
    jobs, facts = RecordingJobs(), RecordingFacts()
    jobs.index(folder, list_recordings(folder))
    assert jobs._indexing is not None
    await jobs._indexing
    facts.look(folder)
    row = facts.of(NAME)
    assert row is not None
    assert row["duration"] == pytest.approx(39.9, abs=0.5)
    corners = [tuple(map(float, corner.split(","))) for corner in facts.track(NAME).split()]
    assert len(corners) > 5
    assert all(0 <= x <= 46 and 0 <= y <= 24 for x, y in corners)
    jobs.index(folder, list_recordings(folder))
    assert not jobs.is_indexing
    jobs.close()
