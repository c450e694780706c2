"""Every command on recordings accepts the names that `info` lists."""

import socket
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from gateway.cli.live.demo import recorded_line
from gateway.cli.recorded import play
from gateway.cli.support.options import read_options
from gateway.cli.support.recordings import files_of, load_flight
from gateway.config import load
from gateway.player import PlayerDaemon
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


def test_play_accepts_a_name(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[str] = []

    async def serve(daemon_of: Callable[[], PlayerDaemon], *, attached: bool) -> None:
        assert not attached
        daemon = daemon_of()
        played.extend(daemon.edge.status().files)
        daemon.close()

    monkeypatch.setattr(play, "_serve", serve)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    for name in ("alps", "last"):
        run("play", name, "--config", config)
    assert (played[0], len(played)) == ("alps_01.tlog", 2)


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


def test_flight_is_named_by_its_recording_or_its_file(config: Path) -> None:
    folder, settings = config.parent / "recordings", load(config)
    (folder / "day_01_v1.csv").write_bytes((folder / "alps_01_v1.csv").read_bytes())
    assert load_flight(Path("last"), settings, read_options(settings)).name == "day"
    file = folder / "alps_01_v1.csv"
    assert load_flight(file, settings, read_options(settings)).name == "alps_01_v1.csv"


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
