"""The recorder on a disk that is really full, read-only or gone: a small one, mounted here."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.live.session import RETRY_US
from tests.kit.recorder import FRAMES, NAME, MakeBench, RecorderBench, frames_of

pytestmark = pytest.mark.io

SIZE = 2 << 20
RETRY_S = RETRY_US / 1e6


def mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("mounting a disk needs root")
    folder = tmp_path / "disk"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder))
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
async def bench(disk: Path, make_bench: MakeBench) -> RecorderBench:
    made = make_bench(disk / "recordings")
    await made.turn()
    await made.record(FRAMES[:5])
    assert made.troubles == []
    return made


async def test_full_disk_stops_recording_until_there_is_space(
    bench: RecorderBench, disk: Path
) -> None:
    ballast = disk / "ballast"
    with pytest.raises(OSError, match="No space left"):
        ballast.write_bytes(bytes(2 * SIZE))
    # The page that the file has begun has room for some of these, which are taken back.
    await bench.record(FRAMES[5:] * 20)
    assert bench.troubles == ["Recording stopped: disk is full"]
    assert bench.recorder.status().reason == "disk is full"
    await bench.record(FRAMES[5:8], RETRY_S)
    assert not bench.recorder.recording
    ballast.unlink()
    await bench.turn(RETRY_S)
    await bench.record(FRAMES[8:])
    assert bench.recorder.recording
    assert frames_of(bench.recorder.folder) == FRAMES[:5] + FRAMES[8:]
    assert bench.announced[-1] == (False, f"Recording {NAME}")
    assert len(bench.troubles) == 1
