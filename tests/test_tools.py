"""The programs of tools/ can be imported: most run only now and then, and some use each other."""

from importlib import import_module
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"


@pytest.mark.parametrize("name", sorted(path.stem for path in TOOLS.glob("*.py")))
def test_a_tool_can_be_imported(name: str) -> None:
    import_module(f"tools.{name}")
