"""Exports of recordings by other commands, and the update of the catalogue."""

import asyncio
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.batch.catalogue import FlightFigures
from gateway.panel import recording_jobs
from gateway.panel.admission import Holder, Role
from gateway.panel.recording_jobs import KINDS, ExportError, Order, RecordingJobs
from gateway.panel.recording_search import RecordingFacts
from gateway.recordings.index import RecordingError, list_recordings
from tests.kit.recordings import write_tlog
from tests.panel.messages import flight_records
from tests.panel.web_client import client_of

pytestmark = pytest.mark.io

NAME = "a day's --flight"


class Exports:
    """Exports of a recording in a folder."""

    def __init__(self, folder: Path) -> None:
        self.jobs, self.folder = RecordingJobs(), folder

    async def make(self, kind: str, *options: str, name: str = NAME, **by: Holder) -> str:
        return await self.jobs.export(Order(self.folder, name, kind, options), **by)


@pytest.fixture
def exports(tmp_path: Path) -> Iterator[Exports]:
    made = Exports(tmp_path / 'with "quotes"')
    made.folder.mkdir()
    write_tlog(made.folder / f"{NAME}_01.tlog", flight_records(40))
    yield made
    made.jobs.close()


@pytest.mark.slow
async def test_recording_is_exported_cut_anonymised_and_extracted(exports: Exports) -> None:
    to_10, system_3, found = ("--to=10",), ("--system=3",), {}
    kinds = [("gpx", ()), ("page", ()), ("cut", to_10), ("anonymised", ())]
    async with client_of(exports.jobs.serve) as client:
        for kind, options in [*kinds, ("texts", system_3)]:
            url = await exports.make(kind, *options)
            answer = await client.get(url)
            found[kind, options] = answer.content
            head = answer.headers["content-disposition"]
            assert KINDS[kind][2] in head
            assert ("flight" in head) == (kind != "anonymised")
        with pytest.raises(ExportError, match="no parameters"):
            await exports.make("params", *system_3)
        assert (await client.get("/exports/guessed")).status_code == 404
        exports.jobs.close()
        assert (await client.get(url)).status_code == 404
    assert found["gpx", ()].startswith(b"<?xml")
    assert found["page", ()].startswith(b"<!doctype html>")
    whole = (exports.folder / f"{NAME}_01.tlog").read_bytes()
    assert whole.startswith(found["cut", to_10])
    assert 0 < len(found["cut", to_10]) < len(whole) == len(found["anonymised", ()])
    assert found["texts", system_3].startswith(b"time,system,component")


@pytest.mark.slow
async def test_failed_export_reports_the_reason_and_leaves_no_file(
    exports: Exports, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary.mkdir()
    (exports.folder / "broken_01.tlog").write_bytes(b"no recording at all\n" * 10)
    with pytest.raises(ExportError, match="broken_01"):
        await exports.make("kml", name="broken")
    with pytest.raises(RecordingError):
        await exports.make("kml", name="../../etc/passwd")
    monkeypatch.setattr(recording_jobs, "EXPORT_S", 0.05)
    with pytest.raises(ExportError, match=r"not finished after .* another format"):
        await exports.make("report")
    cancelled = asyncio.create_task(exports.make("page"))
    # Its command runs as soon as its folder holds the settings.
    async with asyncio.timeout(60.0):
        while not list(temporary.glob("mavgate-export-*/*/settings.toml")):
            await asyncio.sleep(0)
    cancelled.cancel()
    await asyncio.wait([cancelled])
    assert list(temporary.glob("mavgate-export-*/*")) == []
    exports.jobs.close()
    assert list(temporary.glob("mavgate-export-*")) == []


async def test_export_that_writes_too_much_is_stopped_and_deleted(
    exports: Exports, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary.mkdir()
    monkeypatch.setattr(recording_jobs, "MAX_EXPORT", 1_000_000)
    endless = 'head -c 1100000 /dev/zero > "$TMPDIR/part"; exec sleep 5'
    monkeypatch.setattr(recording_jobs, "own_command", lambda _: ["sh", "-c", endless])
    with pytest.raises(ExportError, match="larger than 1 MB, and stopped: choose a shorter"):
        await exports.make("csv")
    assert list(temporary.glob("mavgate-export-*/*")) == []


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
    exports: Exports, maker: Maker, temporary: Path
) -> None:
    for _ in range(recording_jobs.EXPORTS_OF_ROLE + 1):
        with pytest.raises(FileNotFoundError):
            await exports.make("csv")
    temporary.mkdir()
    for kind in ("csv", "gpx"):
        await exports.make(kind)
        shutil.rmtree(*temporary.glob("mavgate-export-*"))
    assert maker.kinds == ["csv", "gpx"]


VIEWER = Holder(Role.VIEWER, "session", "10.0.0.1")


async def test_exports_of_a_viewer_keep_no_operator_waiting(exports: Exports, maker: Maker) -> None:
    maker.may_end.clear()
    async with asyncio.timeout(60.0):
        waiting = [
            asyncio.create_task(exports.make(kind, holder=VIEWER)) for kind in ("kml", "gpx")
        ]
        await asyncio.sleep(0)
        with pytest.raises(ExportError, match="other exports"):
            await exports.make("csv", holder=VIEWER)
        await exports.make("csv")
        maker.may_end.set()
        await asyncio.gather(*waiting)
    assert maker.kinds == ["csv", "kml", "gpx"]


async def test_equal_export_is_made_once_and_deleted(
    exports: Exports, maker: Maker, temporary: Path
) -> None:
    temporary.mkdir()
    first, second = await asyncio.gather(*(exports.make("kml", holder=VIEWER) for _ in range(2)))
    assert (first, maker.kinds) == (second, ["kml"])
    async with client_of(exports.jobs.serve) as client:
        assert [(await client.get(first)).status_code for _ in range(3)] == [200, 200, 404]
    assert list(temporary.glob("mavgate-export-*/*")) == []


async def test_bytes_of_exports_are_bounded(
    exports: Exports,
    maker: Maker,
    temporary: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    temporary.mkdir()
    monkeypatch.setattr(recording_jobs, "MAX_EXPORTED", 2500)
    for kind in ("csv", "kml", "gpx", "page"):
        await exports.make(kind, holder=VIEWER)
    kept = sorted(file.suffix for file in temporary.glob("mavgate-export-*/*/*"))
    assert kept == [".gpx", ".page"]


@pytest.mark.slow
async def test_indexed_recording_has_facts_and_a_track(exports: Exports) -> None:
    jobs, folder, facts = exports.jobs, exports.folder, RecordingFacts()
    jobs.index(folder, list_recordings(folder))
    async with asyncio.timeout(60.0):
        while jobs.is_indexing:
            await asyncio.sleep(0.01)
    facts.look(folder)
    figures = facts.of(NAME)
    assert isinstance(figures, FlightFigures)
    assert figures.duration == pytest.approx(39.9, abs=0.5)
    corners = [tuple(map(float, corner.split(","))) for corner in facts.track(NAME).split()]
    assert len(corners) > 5
    assert all(0 <= x <= 46 and 0 <= y <= 24 for x, y in corners)
    jobs.index(folder, list_recordings(folder))
    assert not jobs.is_indexing
