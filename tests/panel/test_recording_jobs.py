"""Exports of recordings by other commands, and the update of the catalogue."""

import asyncio
import shutil
import tempfile
from pathlib import Path

import pytest

from gateway.batch.catalogue import FlightFigures
from gateway.panel import recording_jobs
from gateway.panel.admission import Holder, Role
from gateway.panel.recording_jobs import FORMATS, ExportError, Order, RecordingJobs
from gateway.panel.recording_search import RecordingFacts
from gateway.recordings.index import RecordingError, list_recordings
from tests.kit.recordings import write_tlog
from tests.panel.messages import flight_records
from tests.panel.web_client import client_of

pytestmark = pytest.mark.io

NAME = "a day's --flight"


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    path = tmp_path / 'with "quotes"'
    path.mkdir()
    write_tlog(path / f"{NAME}_01.tlog", flight_records(40))
    return path


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder, not made yet, in which the exports are."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "begin"), [("gpx", b"<?xml"), ("page", b"<!doctype html>")])
async def test_export_has_an_unguessable_address(exported: Path, kind: str, begin: bytes) -> None:
    jobs = RecordingJobs()
    async with client_of(jobs.serve) as client:
        url = await jobs.export(Order(exported, NAME, kind))
        answer = await client.get(url)
        assert answer.content.startswith(begin)
        assert FORMATS[kind][2] in answer.headers["content-disposition"]
        assert (await client.get("/exports/guessed")).status_code == 404
        jobs.close()
        assert (await client.get(url)).status_code == 404


@pytest.mark.slow
async def test_part_of_a_recording_is_cut_anonymised_and_extracted(exported: Path) -> None:
    jobs, found = RecordingJobs(), {}
    async with client_of(jobs.serve) as client:
        whole = [("cut", ()), ("cut", ("--to=10",)), ("anonymised", ()), ("texts", ("--system=3",))]
        for kind, options in whole:
            answer = await client.get(await jobs.export(Order(exported, NAME, kind, options)))
            found[kind, options] = answer.content
            is_named = "flight" in answer.headers["content-disposition"]
            assert is_named == (kind != "anonymised")
        with pytest.raises(ExportError, match="no parameters"):
            await jobs.export(Order(exported, NAME, "params", ("--system=3",)))
    jobs.close()
    assert found["cut", ()] == (exported / f"{NAME}_01.tlog").read_bytes()
    assert found["cut", ()].startswith(found["cut", ("--to=10",)])
    assert len(found["cut", ("--to=10",)]) < len(found["cut", ()]) == len(found["anonymised", ()])
    assert found["texts", ("--system=3",)].startswith(b"time,system,component")


@pytest.mark.slow
async def test_failed_export_reports_the_reason_and_leaves_no_file(
    exported: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary.mkdir()
    (exported / "broken_01.tlog").write_bytes(b"no recording at all\n" * 10)
    jobs = RecordingJobs()
    with pytest.raises(ExportError, match="broken_01"):
        await jobs.export(Order(exported, "broken", "kml"))
    with pytest.raises(RecordingError):
        await jobs.export(Order(exported, "../../etc/passwd", "kml"))
    monkeypatch.setattr(recording_jobs, "EXPORT_S", 0.05)
    with pytest.raises(ExportError, match=r"not finished after .* another format"):
        await jobs.export(Order(exported, NAME, "report"))
    cancelled = asyncio.create_task(jobs.export(Order(exported, NAME, "page")))
    # Its command runs as soon as its folder holds the settings.
    async with asyncio.timeout(60.0):
        while not list(temporary.glob("mavgate-export-*/*/settings.toml")):
            await asyncio.sleep(0)
    cancelled.cancel()
    await asyncio.wait([cancelled])
    assert list(temporary.glob("mavgate-export-*/*")) == []
    jobs.close()
    assert list(temporary.glob("mavgate-export-*")) == []


async def test_export_that_writes_too_much_is_stopped_and_deleted(
    exported: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary.mkdir()
    monkeypatch.setattr(recording_jobs, "MAX_EXPORT", 1_000_000)
    endless = 'head -c 1100000 /dev/zero > "$TMPDIR/part"; exec sleep 5'
    monkeypatch.setattr(recording_jobs, "own_command", lambda _: ["sh", "-c", endless])
    jobs = RecordingJobs()
    with pytest.raises(ExportError, match="larger than 1 MB, and stopped: choose a shorter"):
        await jobs.export(Order(exported, NAME, "csv"))
    assert list(temporary.glob("mavgate-export-*/*")) == []
    jobs.close()


class Maker:
    """Makes exports at once and lists their kinds; KML waits until it may end."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.may_end = asyncio.Event()
        self.may_end.set()

    async def make(self, work: Path, order: Order) -> Path:
        if order.kind == "kml":
            await self.may_end.wait()
        self.kinds.append(order.kind)
        target = work / f"{order.name}.{order.kind}"
        target.write_bytes(bytes(1000))
        return target


@pytest.fixture
def maker(monkeypatch: pytest.MonkeyPatch) -> Maker:
    made = Maker()
    monkeypatch.setattr(recording_jobs, "_make", made.make)
    return made


async def test_export_is_made_again_after_the_temporary_folder_failed_or_was_removed(
    exported: Path, maker: Maker, temporary: Path
) -> None:
    jobs, order = RecordingJobs(), Order(exported, NAME, "csv")
    for _ in range(recording_jobs.EXPORTS_OF_ROLE + 1):
        with pytest.raises(FileNotFoundError):
            await jobs.export(order)
    temporary.mkdir()
    for kind in ("csv", "gpx"):
        await jobs.export(Order(exported, NAME, kind))
        shutil.rmtree(*temporary.glob("mavgate-export-*"))
    assert maker.kinds == ["csv", "gpx"]
    jobs.close()


VIEWER = Holder(Role.VIEWER, "session", "10.0.0.1")


async def test_exports_of_a_viewer_keep_no_operator_waiting(exported: Path, maker: Maker) -> None:
    jobs = RecordingJobs()
    maker.may_end.clear()
    async with asyncio.timeout(60.0):
        waiting = [
            asyncio.create_task(jobs.export(Order(exported, NAME, kind), VIEWER))
            for kind in ("kml", "gpx")
        ]
        await asyncio.sleep(0)
        with pytest.raises(ExportError, match="other exports"):
            await jobs.export(Order(exported, NAME, "csv"), VIEWER)
        await jobs.export(Order(exported, NAME, "csv"))
        maker.may_end.set()
        await asyncio.gather(*waiting)
    assert maker.kinds == ["csv", "kml", "gpx"]
    jobs.close()


async def test_equal_export_is_made_once_and_deleted(
    exported: Path, maker: Maker, temporary: Path
) -> None:
    temporary.mkdir()
    jobs = RecordingJobs()
    order = Order(exported, NAME, "kml")
    first, second = await asyncio.gather(*(jobs.export(order, VIEWER) for _ in range(2)))
    assert (first, maker.kinds) == (second, ["kml"])
    async with client_of(jobs.serve) as client:
        assert [(await client.get(first)).status_code for _ in range(3)] == [200, 200, 404]
    assert list(temporary.glob("mavgate-export-*/*")) == []
    jobs.close()


async def test_bytes_of_exports_are_bounded(
    exported: Path, maker: Maker, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary.mkdir()
    monkeypatch.setattr(recording_jobs, "MAX_EXPORTED", 2500)
    jobs = RecordingJobs()
    for kind in ("csv", "kml", "gpx", "page"):
        await jobs.export(Order(exported, NAME, kind), VIEWER)
    kept = sorted(file.suffix for file in temporary.glob("mavgate-export-*/*/*"))
    assert kept == [".gpx", ".page"]
    jobs.close()


@pytest.mark.slow
async def test_indexed_recording_has_facts_and_a_track(exported: Path) -> None:
    jobs, facts = RecordingJobs(), RecordingFacts()
    jobs.index(exported, list_recordings(exported))
    async with asyncio.timeout(60.0):
        while jobs.is_indexing:
            await asyncio.sleep(0.01)
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
