"""The programs of tools/ and of the bench can be imported: most run only now and then."""

from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = [f"tools.{path.stem}" for path in sorted(ROOT.glob("tools/*.py"))]


@pytest.mark.parametrize("name", [*PROGRAMS, "firmware.rig.measure"])
def test_tool_can_be_imported(name: str) -> None:
    import_module(name)
