"""Every command on recordings accepts the names that `info` lists."""

import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from gateway.cli.live.demo import recorded_line
from gateway.cli.support.recordings import files_of
from gateway.config import load
from gateway.recordings.files import FlightError
from tests.cli.arrangements import recordings
from tests.kit.cli import invoke

pytestmark = pytest.mark.io


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Settings with the folder of `recordings`."""
    recordings(tmp_path)
    return tmp_path / "gateway.toml"


def run(*arguments: object, code: int = 0) -> str:
    return invoke(*arguments, code=code).output


def test_demo_flies_the_named_recording(config: Path) -> None:
    frames, aircraft = recorded_line(load(config), Path("alps"))
    assert list(aircraft) == [1]
    assert next(frames).data


def test_existing_path_takes_precedence_over_a_name(tmp_path: Path) -> None:
    there, missing = tmp_path / "a.tlog", tmp_path / "gone.tlog"
    there.touch()
    assert files_of([there, missing], tmp_path, "tables") == [there, missing]
    with pytest.raises(FlightError, match=r"gone\.tlog: no such file"):
        files_of([Path("gone.tlog")], tmp_path, "tables")


def test_only_names_need_a_choice_where_several_gateways_run(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = tmp_path / "runtime"
    (runtime / "mavgate").mkdir(parents=True, mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    file, out = config.parent / "recordings" / "lake_01.tlog", tmp_path / "out.tlog"
    with ExitStack() as opened:
        for name in ("run.sock", "run-2.sock"):
            listening = opened.enter_context(socket.socket(socket.AF_UNIX))
            listening.bind(str(runtime / "mavgate" / name))
            listening.listen()
        run("convert", file, "-o", out)
        assert out.read_bytes() == file.read_bytes()
        refused = run("convert", "lake", "-o", tmp_path / "again.tlog", code=2)
        assert "MAVGATE_SOCKET" in refused
    monkeypatch.setenv("MAVGATE_SOCKET", str(runtime / "mavgate" / "run-2.sock"))
    chosen = invoke("convert", "lake", "-o", tmp_path / "again.tlog")
    assert "nobody listens at the socket" in chosen.output
    assert "run-2.sock" in chosen.output.replace("\n", "")
