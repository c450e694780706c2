"""The command line in process."""

import logging

import pytest
from typer.testing import CliRunner, Result

from gateway.cli.app import app


def invoke(*words: object, answers: str = "", code: int | None = None) -> Result:
    """Run `mavgate` with words as text and its standard input; check the exit code if given."""
    result = CliRunner().invoke(app, [str(word) for word in words], input=answers)
    # An exit is the one exception that a user may see.
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    if code is not None:
        assert result.exit_code == code, result.output
    return result


def run(*words: object, code: int = 0) -> str:
    """Return the output of `mavgate` with one space for each run of white space."""
    return " ".join(invoke(*words, code=code).output.split())


def reset_logging(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the root logger be that of a new process until the end of the test."""
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.WARNING)
