"""What the first start shows, and what helps at the prompt."""

import io
import sys

import pytest
from rich.console import Console

from gateway.cli.app import app
from gateway.cli.support import warm_up
from gateway.cli.support.warm_up import OWN_ESTIMATORS, STEPS, make_ready

pytestmark = pytest.mark.io


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Estimators that were compiled, by a compiler that takes no time."""
    found: list[str] = []
    monkeypatch.setattr(warm_up, "cores", lambda: 1)
    monkeypatch.setattr(warm_up, "is_kept", lambda step: STEPS.index(step) < len(set(found)))
    monkeypatch.setattr(warm_up, "_rehearse", found.append)
    return found


@pytest.mark.parametrize("is_terminal", [True, False])
def test_the_first_start_shows_how_far_it_is(
    done: list[str], monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=is_terminal, width=100)
    monkeypatch.setattr(warm_up, "console_of", lambda **_: console)
    make_ready("eskf")
    assert set(done) == set(OWN_ESTIMATORS)
    assert done[-1] == "eskf", "its machine code is the one that this process has"
    text = shown.getvalue()
    assert ("compiling the estimators" in text) == is_terminal
    for count in range(len(STEPS) + 1):
        assert (f"{count}/{len(STEPS)}" in text) == is_terminal


def test_a_later_start_shows_nothing(done: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "is_kept", lambda _: True)
    monkeypatch.setattr(warm_up, "console_of", lambda **_: pytest.fail("a bar"))
    make_ready("paper")
    assert done == ["paper"]


@pytest.mark.parametrize(
    ("typed", "offered"), [("mavgate doc", "doctor"), ("mavgate check-config --he", "--help")]
)
def test_the_shell_completes_commands_and_options(
    typed: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_MAVGATE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    monkeypatch.setattr(sys, "argv", ["mavgate"])
    with pytest.raises(SystemExit):
        app(prog_name="mavgate")
    assert offered in capsys.readouterr().out.split()
