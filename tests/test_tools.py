"""The programs of tools/ and of the bench can be imported: most run only now and then."""

from importlib import import_module
from pathlib import Path

import pytest

from tools import attack

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = [f"tools.{path.stem}" for path in sorted(ROOT.glob("tools/*.py"))]


@pytest.mark.parametrize("name", [*PROGRAMS, "firmware.rig.measure"])
def test_tool_can_be_imported(name: str) -> None:
    import_module(name)


@pytest.mark.slow
def test_attacks_by_files_and_on_the_control_socket_do_not_succeed(tmp_path: Path) -> None:
    assert attack.run(attack.OF_FILES, attack.Target(tmp_path, 0))
    names = ("idle control connections", "devices as serial clients")
    with attack.started(tmp_path, panel=False) as target:
        assert attack.run({name: attack.OF_GATEWAY[name] for name in names}, target)
