"""Recordings of a site listed and fetched over real sessions, with breaks, and what is refused."""

import asyncio
import base64
import fcntl
import hashlib
import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from gateway.fleet import recording_fetch
from gateway.fleet.recording_fetch import FetchError, RecordingFetch
from gateway.fleet.remote_recordings import RemoteRecordings
from gateway.hub.transports.zenoh import site_queries
from gateway.hub.transports.zenoh.site_queries import (
    MAX_PIECE,
    RecordingAnswers,
    RefusedQueryError,
    RemoteFile,
    RemoteRecording,
)
from gateway.live.control_socket import ControlError, request
from tests.fleet.conftest import World
from tests.kit.cli import invoke
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

NAME, SIZE = "flight_01.tlog", 300_000
CONTENT = np.random.default_rng(1).bytes(SIZE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A site's recordings, and a secret outside of them."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / NAME).write_bytes(CONTENT)
    (folder / "flight_01_v1.csv").write_text("time_us\n1\n")
    (tmp_path / "secret_01.tlog").write_text("secret")
    (folder / "link_01.tlog").symlink_to(tmp_path / "secret_01.tlog")
    (folder / "notes.txt").write_text("private")
    return folder


def over(world: World) -> Callable[[str, dict[str, Any], float], Any]:
    """Ask as the command does."""
    path = world.fleet.control_socket
    return lambda verb, params, wait_s: request(path, verb, params, timeout_s=wait_s)


async def opened(world: World, folder: Path) -> None:
    world.open_site("field-a", "&trusted=yes", recordings=folder)
    await world.until(world.systems)


async def result_of(world: World, work: Callable[..., Any], *arguments: object) -> Any:
    """Do some work in a thread while all go on."""
    task = asyncio.create_task(asyncio.to_thread(work, *arguments))
    await world.until(task.done)
    return task.result()


class TestOverTheSession:
    async def test_recordings_are_listed_and_fetched_and_differing_files_kept(
        self, world: World, folder: Path, tmp_path: Path
    ) -> None:
        await opened(world, folder)

        async def run(*words: str) -> Any:
            return await result_of(world, invoke, *words)

        listed = await run("fleet", "recordings", "--json")
        assert {each["name"] for each in json.loads(listed.output)["field-a"]} == {"flight", "link"}
        shown = await run("fleet", "recordings", "--site", "field-*")
        assert "flight" in shown.output
        to = tmp_path / "fetched"
        words = ("fleet", "recordings", "get", "field-a", "flight", "-o", str(to))
        assert (await run(*words)).exit_code == 0
        assert (to / NAME).read_bytes() == CONTENT
        assert sorted(path.name for path in to.iterdir()) == [NAME, "flight_01_v1.csv"]
        assert f"{NAME} already complete" in (await run(*words)).output
        (to / NAME).write_bytes(b"other")
        refused = await run(*words)
        assert (refused.exit_code, "--force" in refused.output) == (2, True)
        assert (await run(*words, "--force")).exit_code == 0
        assert (to / NAME).read_bytes() == CONTENT
        none = await run("fleet", "recordings", "get", "field-b", "flight")
        assert (none.exit_code, "does not serve recordings" in none.output) == (2, True)

    async def test_fetch_continues_with_the_site(
        self, world: World, folder: Path, tmp_path: Path
    ) -> None:
        await opened(world, folder)
        ask, asked = over(world), []
        gone, retried = threading.Event(), threading.Event()

        def recorded(verb: str, params: dict[str, Any], wait_s: float) -> Any:
            asked.append((verb, params.get("offset")))
            if len(asked) == 4:
                assert gone.wait(START_LIMIT_S)
            return ask(verb, params, wait_s)

        def wait(seconds: float) -> None:
            if seconds == recording_fetch.RETRY_S:
                retried.set()
                threading.Event().wait(0.05)

        to = tmp_path / "fetched"
        fetch = RecordingFetch("field-a", to, recorded, wait=wait)
        fetching = asyncio.create_task(result_of(world, fetch.fetch, NAME, SIZE, lambda _: None))
        await world.until(lambda: len(asked) == 4)
        world.sites.pop("field-a").close()
        await world.until(lambda: not world.fleet.status()["sites"][0]["is_here"])
        gone.set()
        await world.until(retried.is_set)
        assert [path.name for path in to.iterdir()] == [f".{NAME}.part"], "nothing looks whole"
        world.open_site("field-a", "&trusted=yes", recordings=folder)
        assert await fetching is True
        assert (to / NAME).read_bytes() == CONTENT
        offsets = [offset for verb, offset in asked if verb == "fleet.piece"]
        assert offsets == sorted(offsets)
        assert offsets.count(0) == 1, "none from the start"

    async def test_untrusting_site_offers_no_recordings(self, world: World, folder: Path) -> None:
        world.open_site("field-a", recordings=folder)
        await world.until(world.systems)
        asked = ("fleet.recordings", {"site": "field-a"}, 20.0)
        assert await result_of(world, over(world), *asked) == {}


async def listed(answers: dict[str, bytes]) -> Any:
    """List the recordings of sites that answer so."""

    async def query(key: str, payload: bytes, timeout_s: float) -> dict[str, bytes]:
        return answers

    session = MagicMock(patterns=["*"], query=query)
    return await RemoteRecordings(session).verbs()["fleet.recordings"]()


async def test_malformed_list_of_one_site_hides_no_others() -> None:
    answers = {
        "no_text": b'[{"name":"\xff"}]',
        "deep": b'[{"name":"a","files":[],"modified_s":1,"x":' + b"[" * 100_000,
        "sound": b'[{"name":"one","files":[],"modified_s":1.5}]',
    }
    assert await listed(answers) == {"sound": [RemoteRecording("one", [], 1.5)]}


@pytest.mark.parametrize(
    "name", ["\x1b]0;x\x07", "a\nb", "../a", "", "last", "a\u202eb", "x" * 200]
)
async def test_recording_with_an_unusual_name_is_left_out(name: str) -> None:
    usual = RemoteRecording("one", [RemoteFile("one_01.tlog", 5)], 1.5)
    given = [
        usual,
        RemoteRecording(name, [RemoteFile("one_01.tlog", 5)], 1.5),
        RemoteRecording("two", [RemoteFile(f"{name}_01.tlog", 5)], 1.5),
    ]
    found = (await listed({"site": msgspec.json.encode(given)}))["site"]
    assert usual in found
    assert name not in {each.name for each in found}
    assert len(found) == (2 if name == "last" else 1)


def query(**fields: object) -> bytes:
    return json.dumps({"file": NAME, "size": 10, **fields}).encode()


class TestAnswers:
    @pytest.mark.parametrize(
        "asked",
        [
            *(query(file=name) for name in ("../secret_01.tlog", "notes.txt", "link_01.tlog")),
            *(query(file=name) for name in ("/etc/passwd", "a\0_01.tlog")),
            *(b"garbage", b'{"file": 1}', b'{"file": "\xff\xfe"}'),
            *(query(size=size) for size in (0, 1e99, MAX_PIECE + 1)),
            *(query(offset=offset) for offset in (-1, (1 << 63) - 1)),
        ],
    )
    def test_malformed_query_and_foreign_file_are_refused(self, folder: Path, asked: bytes) -> None:
        with pytest.raises(RefusedQueryError):
            RecordingAnswers(folder)(asked)

    @pytest.mark.parametrize("digest", [False, True])
    def test_irregular_file_is_refused_without_waiting(self, folder: Path, digest: bool) -> None:
        os.mkfifo(folder / "pipe_01.tlog")
        (folder / "folder_01.tlog").mkdir()
        for name in ("pipe_01.tlog", "folder_01.tlog"):
            with pytest.raises(RefusedQueryError, match="not a regular file"):
                RecordingAnswers(folder)(query(file=name, digest=digest))
        listed = json.loads(RecordingAnswers(folder)(b""))
        sizes = {file["name"]: file["size"] for each in listed for file in each["files"]}
        assert sizes[NAME] == SIZE
        assert not sizes.keys() & {"pipe_01.tlog", "folder_01.tlog", "link_01.tlog"}

    def test_list_beyond_its_limit_lacks_the_oldest_recordings(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for number in range(20):
            path = folder / f"old{number:02}_01.tlog"
            path.write_bytes(b"x")
            os.utime(path, (number, number))
        monkeypatch.setattr(site_queries, "MAX_LIST", 500)
        answer = RecordingAnswers(folder)(b"")
        assert len(answer) <= 500
        names = [each["name"] for each in json.loads(answer)]
        assert "flight" in names
        assert "old00" not in names

    def test_query_above_its_limit_is_refused_unread(self) -> None:
        asked, session = MagicMock(), MagicMock()
        asked.payload.__len__.return_value = site_queries.MAX_QUERY + 1
        session.declare_queryable.return_value.__iter__.return_value = iter([asked])
        site_queries.QueryAnswers(session, "key", lambda _: b"").undeclare()
        asked.reply_err.assert_called_once_with(b"a query has at most 4096 bytes")
        asked.payload.to_bytes.assert_not_called()

    def test_piece_and_digest_equal_the_file(self, folder: Path) -> None:
        answer = RecordingAnswers(folder)
        assert answer(query(offset=SIZE - 3)) == CONTENT[-3:]
        assert answer(query(offset=SIZE)) == b""
        whole = hashlib.sha256(CONTENT[:1000]).hexdigest().encode()
        assert answer(query(size=1000, digest=True)) == whole

    def test_digest_stops_when_its_query_has_timed_out(self, folder: Path) -> None:
        times_s = iter([0.0, site_queries.DIGEST_TIMEOUT_S + 0.1])
        answer = RecordingAnswers(folder, lambda: next(times_s))
        with pytest.raises(RefusedQueryError, match="no digest within 300 s"):
            answer(query(size=SIZE, digest=True))


class Site:
    """The answers of a site that has one file, without a network."""

    def __init__(self, content: bytes = CONTENT, digest: str = "") -> None:
        self.content, self.digest = content, digest
        self.asked: list[tuple[int, int]] = []
        """Offset and size of each piece."""
        self.took_s, self.now_s = 0.0, 0.0

    def __call__(self, verb: str, params: dict[str, Any], wait_s: float) -> Any:
        self.now_s += self.took_s
        if verb == "fleet.digest":
            right = hashlib.sha256(self.content[: params["size"]]).hexdigest()
            return {"sha256": self.digest or right}
        begin, size = params["offset"], params["size"]
        self.asked.append((begin, size))
        return {"data": base64.b64encode(self.content[begin : begin + size]).decode()}


REFUSED: dict[str, tuple[Callable[..., Any], str, str]] = {
    "file changed meanwhile": (Site(digest="0" * 64), NAME, "changed"),
    "shortened file": (Site(CONTENT[:100]), NAME, "shorter"),
    "silent site": (lambda *_: {"data": None}, NAME, "continues from here"),
    **{
        f"file {name}": (lambda *_: {}, name, "not a file of a recording")
        for name in ("../flight_01.tlog", "flight.txt", "x/flight_01.tlog")
    },
}


class TestFetch:
    @pytest.mark.parametrize("name", REFUSED)
    def test_fetch_fails_with_the_reason_and_can_be_repeated(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
    ) -> None:
        site, file, reason = REFUSED[name]
        monkeypatch.setattr(recording_fetch, "SITE_TIMEOUT_S", -1.0)
        one = RecordingFetch("site", tmp_path / "to", site, wait=lambda _: None)
        with pytest.raises(FetchError, match=reason):
            one.fetch(file, 10_000, lambda _: None)
        assert not [each for each in tmp_path.rglob("*.*") if each.suffix != ".part"]
        assert self.fetch(tmp_path / "to", Site())
        assert (tmp_path / "to" / NAME).read_bytes() == CONTENT[:10_000]

    def fetch(self, folder: Path, site: Callable[..., Any], size: int = 10_000) -> bool:
        one = RecordingFetch("site", folder, site, wait=lambda _: None)
        return one.fetch(NAME, size, lambda _: None)

    def test_stopped_fetch_continues(self, tmp_path: Path) -> None:
        site = Site()

        def stopping(*asked: Any) -> Any:
            if len(site.asked) == 3:
                raise ControlError("stopped")
            return site(*asked)

        with pytest.raises(ControlError):
            self.fetch(tmp_path, stopping, SIZE)
        have = (tmp_path / f".{NAME}.part").stat().st_size
        assert have == sum(size for _, size in site.asked) < SIZE
        assert self.fetch(tmp_path, site, SIZE)
        assert site.asked[3][0] == have
        assert (tmp_path / NAME).read_bytes() == CONTENT

    def test_grown_recording_is_continued(self, tmp_path: Path) -> None:
        site = Site()
        for size in (10_000, 25_000):
            assert self.fetch(tmp_path, site, size)
            assert (tmp_path / NAME).read_bytes() == CONTENT[:size]
        assert [begin for begin, _ in site.asked].count(0) == 1
        (tmp_path / NAME).write_bytes(b"another")
        with pytest.raises(FetchError, match="differs"):
            self.fetch(tmp_path, site, 25_000)

    def test_partial_file_of_other_content_is_replaced(self, tmp_path: Path) -> None:
        (tmp_path / f".{NAME}.part").write_bytes(b"x" * 5000)
        assert self.fetch(tmp_path, Site())
        assert (tmp_path / NAME).read_bytes() == CONTENT[:10_000]

    def test_file_that_another_program_fetches_is_an_error(self, tmp_path: Path) -> None:
        with (tmp_path / f".{NAME}.part").open("w") as part:
            fcntl.flock(part, fcntl.LOCK_EX)
            with pytest.raises(FetchError, match="is being fetched by another program"):
                self.fetch(tmp_path, Site())

    @pytest.mark.parametrize(
        ("took_s", "waited_s", "kib"),
        [
            (0.01, 0.01, [4, 8, 16, 32, 64, 128]),
            (0.1, 0.1, [16, 16, 16, 16]),
            (3.0, recording_fetch.SLOW_S, [16, 8, 4, 4]),
        ],
        ids=["fast", "fitting", "slow"],
    )
    def test_pieces_and_pauses_leave_half_of_the_link_to_telemetry(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, took_s: float, waited_s: float,
        kib: list[int],
    ) -> None:  # fmt: skip
        site, waits = Site(), list[float]()
        site.took_s = took_s
        monkeypatch.setattr(time, "monotonic", lambda: site.now_s)
        one = RecordingFetch("site", tmp_path, site, wait=waits.append)
        one.piece_size = kib[0] << 10
        assert one.fetch(NAME, sum(kib) << 10, lambda _: None)
        assert [size for _, size in site.asked] == [size << 10 for size in kib]
        assert waits == pytest.approx([waited_s] * len(kib))
        assert recording_fetch.LARGEST == MAX_PIECE
