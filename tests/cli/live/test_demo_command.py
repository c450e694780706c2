"""`mavgate demo`: it leaves the user's own aircraft and disk alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.live import demo
from gateway.config import GatewaySettings, aircraft_folder
from tests.kit.cli import invoke

pytestmark = pytest.mark.io


@pytest.fixture
def settings_of_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., list[GatewaySettings]]:
    """The settings with which the daemon would start, and those that a reload would read."""
    file = tmp_path / "gateway.toml"
    file.write_text(f'aircraft_folder = "{tmp_path}/mine"\n[recording]\nmode = "in_flight"\n')

    def run(*options: str) -> list[GatewaySettings]:
        found: list[GatewaySettings] = []

        async def serve(daemon_of: Callable[[], object], **_: object) -> None:
            daemon_of()

        def make_daemon(started: GatewaySettings, _: Any, read: Any, *__: Any) -> object:
            found.extend([started, read()])
            return object()

        monkeypatch.setattr(demo, "serve", serve)
        monkeypatch.setattr(demo, "Daemon", make_daemon)
        result = invoke("demo", "--config", file, "--no-panel", *options)
        assert result.exit_code == 0, result.output
        return found

    return run


def test_the_users_aircraft_are_not_the_demos(
    settings_of_demo: Callable[..., list[GatewaySettings]], tmp_path: Path
) -> None:
    """What a ground station has the demo save must not become a real aircraft's calibration."""
    started, reloaded = settings_of_demo()
    folder = aircraft_folder(started)
    assert folder not in (tmp_path / "mine", Path("~/.config/mavgate/aircraft").expanduser())
    assert aircraft_folder(reloaded) == folder
    assert not folder.exists(), "it goes with the demo"


@pytest.mark.parametrize(("options", "mode"), [((), "manual"), (("--record",), "always")])
def test_nothing_is_recorded_unless_asked(
    settings_of_demo: Callable[..., list[GatewaySettings]], options: tuple[str, ...], mode: str
) -> None:
    assert [settings.recording.mode for settings in settings_of_demo(*options)] == [mode, mode]
