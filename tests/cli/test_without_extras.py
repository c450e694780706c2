"""Every command runs in an environment without any extra: a line instead of a traceback."""

import json
import subprocess
from typing import Any

import pytest

from gateway.cli.app import COMMANDS
from gateway.cli.live.doctor import EXTRA_USES
from gateway.extras import EXTRAS
from tests.cli.test_app import all_commands
from tests.kit.process import python

pytestmark = [pytest.mark.io, pytest.mark.slow]

NEEDS = {
    "panel": "panel", "report x -o x.html": "panel", "run --panel --port none": "panel",
    "map 1,2 a": "panel", "report": "plot", "report x y -o o": "plot",
    "fleet": "fleet", "report --quick s3://x -o o": "batch",
    "sweep s3://x --vary alpha=0.1,0.2": "batch",
}  # fmt: skip
"""The commands that need an extra, which they name."""
PROGRAM = """
import json, sys
sys.modules.update(dict.fromkeys({blocked!r}))
from typer.testing import CliRunner
from gateway.cli.app import app
found = {{}}
for words in {lines!r}:
    done = CliRunner().invoke(app, words.split())
    ended = done.exception is None or isinstance(done.exception, SystemExit)
    found[words] = [done.exit_code, done.output, "" if ended else repr(done.exception)]
print(json.dumps(found))
"""


ENDLESS = {"run", "demo"}
"""They serve until they are interrupted."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("home")
    words = all_commands()
    leaves = {" ".join(each) for each in words if not any(each == other[:-1] for other in words)}
    lines = [*NEEDS, *sorted(leaves - ENDLESS)]
    blocked = [module for modules in EXTRAS.values() for module in modules]
    env = {"HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "PATH": "/usr/bin:/bin"}
    program = PROGRAM.format(blocked=blocked, lines=lines)
    done = python("-c", program, check=False, cwd=folder, stdin=subprocess.DEVNULL, env=env)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_no_command_ends_in_a_traceback(found: dict[str, Any]) -> None:
    assert {words: error for words, (_, _, error) in found.items() if error} == {}
    assert len(found) > len(COMMANDS)


def test_missing_extra_is_one_line(found: dict[str, Any]) -> None:
    for words, extra in NEEDS.items():
        code, output, _ = found[words]
        assert code == 2, words
        assert f" needs the extra {extra}; to install it: " in output, words
        assert len(output.splitlines()) == 1, words


def test_use_of_every_extra_is_named() -> None:
    assert set(EXTRA_USES) == set(EXTRAS)
