"""The commands as people run them, as a table: `transcripts.txt` next to this file.

`[NAME; ARGUMENT; …]` is an arrangement of `arrangements.py`, of which each case begins with a new
one. A line is a command (`$`, or `&` after another of the same case), its input after ` < ` (or the
number of empty lines), its exit code unless that is 0, and its expectations, separated by bars:

    TEXT                is in the output, with one space for all white space; ! TEXT is not
    + FILE: TEXT        is made (or changed: ~) in the case and contains a text; - FILE is removed
    == FILE FILE        have equal contents

All other files are neither made nor changed. `{a|b}` stands for a case of each.
"""

import re
import shlex
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path

import pytest

from tests.cli.arrangements import arrange
from tests.kit.cli import invoke

pytestmark = pytest.mark.io

TABLE = Path(__file__).with_name("transcripts.txt")
CHOICE = re.compile(r"\{([^{}]*\|[^{}]*)\}")
STEP = re.compile(r"[$&] (.*?)(?: < (\S+))?(?: \[(\d)\])?")
CPU_S = 20.0
"""Bound on the processor time of a case: input without an end is refused in a moment."""
NEVER = ("Traceback", "Input should", "Value error", "parse string")
"""Words of libraries that users never read."""


def expanded(text: str) -> list[str]:
    found = CHOICE.search(text)
    if found is None:
        return [text]
    return [each for one in found[1].split("|") for each in expanded(text.replace(found[0], one))]


def read_cases() -> Iterator[str]:
    """Yield the arrangement and the commands of each case, one a line."""
    lines = [line for line in TABLE.read_text().splitlines() if line and not line.startswith("# ")]
    head = ""
    for number, line in enumerate(lines):
        if line.startswith("["):
            head = line[1:-1]
        elif line.startswith("$"):
            more = takewhile(lambda next_: next_.startswith("&"), lines[number + 1 :])
            yield from expanded("\n".join([head, line, *more]))


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.is_symlink() and path.suffix != ".sqlite"
    }


@pytest.mark.parametrize("case", [*read_cases()], ids=lambda case: case.replace("\n", " ")[:90])
def test_transcript(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder := tmp_path / "here").mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    head, *steps = case.replace("HERE", str(folder)).split("\n")
    with ExitStack() as opened:
        arrange(head, folder, monkeypatch, opened)
        check(steps, folder)


def check(steps: list[str], folder: Path) -> None:
    """Run the commands of a case, and compare output and files."""
    before, begin_s = contents(folder), time.process_time()
    made, changed = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
    removed = set[str]()
    for step in steps:
        command, *expected = step.split(" | ")
        found = STEP.fullmatch(command)
        assert found is not None, command
        lines = found[2] or ""
        answers = "\n" * int(lines) if lines.isdigit() else lines.replace("\\n", "\n")
        done = invoke(*shlex.split(found[1]), answers=answers, code=int(found[3] or 0))
        output = " ".join(done.output.split())
        assert not [word for word in NEVER if word in output], output
        for each in expected:
            mark, _, text = each.partition(" ")
            file, _, part = text.partition(": ")
            match mark:
                case "!":
                    assert text not in output, output
                case "+":
                    made[file].append(part)
                case "~":
                    changed[file].append(part)
                case "-":
                    removed.add(text)
                case "==":
                    first, second = (Path(name).read_bytes() for name in text.split())
                    assert first == second, text
                case _:
                    assert each in output, output
    assert time.process_time() - begin_s < CPU_S
    after = contents(folder)
    assert (after.keys() - before, before.keys() - after) == (made.keys(), removed)
    assert {name for name in after.keys() & before if after[name] != before[name]} == {*changed}
    for name, part in ((name, part) for name, parts in (made | changed).items() for part in parts):
        assert part.replace("\\n", "\n").encode() in after[name], name
