"""The ids of a fleet on the disk."""

import asyncio
import errno
import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.fleet import id_map
from gateway.fleet.id_map import IdsFile

pytestmark = pytest.mark.io

NO_SPACE = "No space left on device"


def refuse(*_: object, **__: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[IdsFile]:
    made = IdsFile(tmp_path / "folder" / "fleet.json")
    yield made
    made.close()


def on_disk(kept: IdsFile) -> object:
    return json.loads(kept.file.read_bytes())


async def test_ids_are_saved_for_the_next_start(kept: IdsFile) -> None:
    assert await kept.keep() == ""
    assert not kept.file.exists()
    kept.ids.set_by_hand("field-a", 1, 77)
    kept.ids.leave_out("field-b", 2)
    assert await kept.keep() == ""
    assert on_disk(kept) == {"field-b/2": 0, "field-a/1": 77}
    again = IdsFile(kept.file)
    assert again.ids.items() == kept.ids.items()
    again.close()


async def test_keep_waits_for_the_disk(kept: IdsFile, monkeypatch: pytest.MonkeyPatch) -> None:
    may_write, begun, write_new = threading.Event(), asyncio.Event(), id_map.write_new
    loop = asyncio.get_running_loop()

    def slow(path: Path, pieces: list[bytes], *, overwrite: bool) -> int:
        loop.call_soon_threadsafe(begun.set)
        may_write.wait()
        return write_new(path, pieces, overwrite=overwrite)

    monkeypatch.setattr(id_map, "write_new", slow)
    kept.ids.set_by_hand("field-a", 1, 77)
    keeping = asyncio.create_task(kept.keep())
    try:
        await begun.wait()
        assert not keeping.done()
    finally:
        may_write.set()
    assert await keeping == ""
    assert on_disk(kept) == {"field-a/1": 77}


async def test_failed_write_is_reported_and_retried(
    kept: IdsFile, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kept.ids.set_by_hand("field-a", 1, 77)
    with monkeypatch.context() as patch:
        patch.setattr(id_map, "write_new", refuse)
        assert await kept.keep() == NO_SPACE
        assert await kept.keep() == NO_SPACE
    assert [record.getMessage().count(NO_SPACE) for record in caplog.records] == [1]
    assert await kept.keep() == ""
    assert on_disk(kept) == {"field-a/1": 77}


async def test_last_ids_are_saved_on_close(kept: IdsFile) -> None:
    kept.ids.set_by_hand("field-a", 1, 77)
    kept.close()
    assert on_disk(kept) == {"field-a/1": 77}
