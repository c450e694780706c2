"""The completion of commands and options at the prompt."""

import sys

import pytest

from gateway.cli.app import app


@pytest.mark.parametrize(
    ("typed", "offered"), [("mavgate doc", "doctor"), ("mavgate doctor --he", "--help")]
)
def test_shell_completion_offers_commands_and_options(
    typed: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_MAVGATE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    monkeypatch.setattr(sys, "argv", ["mavgate"])
    with pytest.raises(SystemExit):
        app(prog_name="mavgate")
    assert offered in capsys.readouterr().out.split()
