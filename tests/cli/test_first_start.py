"""What the first start shows, and what helps at the prompt."""

import io
import subprocess
import sys
from collections.abc import Callable, Iterable

import pytest
from rich.console import Console

from gateway.cli.app import app
from gateway.cli.support import warm_up
from gateway.cli.support.warm_up import ENTRY_POINTS, SCANNER, make_ready
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
        names = [n for n, known in ENTRY_POINTS.items() if set(known) <= set(entry_points)]
        assert {point for n in names for point in ENTRY_POINTS[n]} == set(entry_points)
        self.asked += [("apart", name) for name in names]
        self.kept.update(names)

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
    first = [(where, name) for where in ("apart", "here") for name in ("eskf", SCANNER)]
    others = [("behind", name) for name in ENTRY_POINTS if name not in ("eskf", SCANNER)]
    assert compiler.asked == [*first, *others]
    assert ("compiling the estimator" in shown.getvalue()) == is_terminal


def test_others_that_are_missing_are_not_waited_for(compiler: Compiler) -> None:
    compiler.kept.update({"complementary", "paper", SCANNER})
    make_ready("complementary")
    here = [("here", name) for name in ("complementary", SCANNER)]
    assert compiler.asked == [*here, ("behind", "eskf")]


def test_every_aircraft_with_an_estimator_of_its_own_has_it_at_the_start(
    compiler: Compiler,
) -> None:
    make_ready("complementary", "eskf")
    chosen = {"complementary", "eskf", SCANNER}
    assert {name for where, name in compiler.asked if where == "apart"} == chosen
    assert {name for where, name in compiler.asked if where == "here"} == chosen
    assert compiler.asked[-1] == ("behind", "paper")


def test_the_gateway_holds_no_machine_code_that_is_not_made_ready() -> None:
    """What it may call while telemetry flows; whole recordings are fused by other commands."""
    tell = (
        "import gc, gateway.cli.live.run;"
        "from gateway.compiled.entry_point import EntryPoint;"
        "points = {p for p in gc.get_objects() if isinstance(p, EntryPoint)};"
        "from gateway.cli.support.warm_up import ENTRY_POINTS;"
        "ready = {p for points in ENTRY_POINTS.values() for p in points};"
        "print(*sorted(p.__name__ for p in points - ready), len(ready))"
    )
    done = subprocess.run([sys.executable, "-c", tell], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["run", "run", "10"]


def test_a_later_start_shows_nothing(compiler: Compiler, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler.kept.update(ENTRY_POINTS)
    monkeypatch.setattr(warm_up, "console_of", lambda **_: pytest.fail("a clock"))
    make_ready("paper")
    assert compiler.asked == [("here", "paper"), ("here", SCANNER)]


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
