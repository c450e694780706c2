"""What the first start shows, and what helps at the prompt."""

import io
import sys
from collections.abc import Callable, Iterable

import pytest
from rich.console import Console

from gateway.cli.app import app
from gateway.cli.support import warm_up
from gateway.cli.support.warm_up import ENTRY_POINTS, make_ready
from gateway.compiled.entry_point import EntryPoint

pytestmark = pytest.mark.io


class Compiler:
    """A compiler that takes no time, and what it was asked for: where, and of which estimator."""

    def __init__(self, kept: set[str]) -> None:
        self.kept = kept
        self.asked: list[tuple[str, str]] = []

    def is_kept(self, name: str) -> bool:
        return name in self.kept

    def apart(
        self,
        _work: object,
        shares: Iterable[Iterable[EntryPoint[...]]],
        while_waiting: Callable[[], None],
    ) -> None:
        while_waiting()
        entry_points = [entry_point for share in shares for entry_point in share]
        [name] = [n for n, known in ENTRY_POINTS.items() if set(known) == set(entry_points)]
        self.asked.append(("apart", name))
        self.kept.add(name)

    def behind(self, _work: object, names: Iterable[str]) -> None:
        self.asked += [("behind", name) for name in names]

    def here(self, name: str) -> None:
        assert name in self.kept, "telemetry would wait for the compiler in this process"
        self.asked.append(("here", name))


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch) -> Compiler:
    found = Compiler(set())
    monkeypatch.setattr(warm_up, "is_kept", found.is_kept)
    monkeypatch.setattr(warm_up, "run_copies", found.apart)
    monkeypatch.setattr(warm_up, "begin_copy", found.behind)
    monkeypatch.setattr(warm_up, "_rehearse", found.here)
    return found


@pytest.mark.parametrize("is_terminal", [True, False])
def test_the_first_start_waits_for_the_chosen_estimator_alone(
    compiler: Compiler, monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=is_terminal, width=100)
    monkeypatch.setattr(warm_up, "console_of", lambda **_: console)
    make_ready("eskf")
    others = [("behind", name) for name in ENTRY_POINTS if name != "eskf"]
    assert compiler.asked == [("apart", "eskf"), ("here", "eskf"), *others]
    assert ("compiling the estimator" in shown.getvalue()) == is_terminal


def test_others_that_are_missing_are_not_waited_for(compiler: Compiler) -> None:
    compiler.kept.update({"complementary", "paper"})
    make_ready("complementary")
    assert compiler.asked == [("here", "complementary"), ("behind", "eskf")]


def test_a_later_start_shows_nothing(compiler: Compiler, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler.kept.update(ENTRY_POINTS)
    monkeypatch.setattr(warm_up, "console_of", lambda **_: pytest.fail("a clock"))
    make_ready("paper")
    assert compiler.asked == [("here", "paper")]


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
