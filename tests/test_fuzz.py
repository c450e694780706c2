"""The properties of `tools/fuzz.py` for a moment: the same values each time."""

import os
from pathlib import Path

import pytest

from tools.fuzz import TARGETS, bounded

EXAMPLES = {"command": 40, "settings_file": 60}


@pytest.mark.parametrize("name", TARGETS)
def test_nothing_raises(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The commands read the settings of the user.
    monkeypatch.setenv("HOME", os.fspath(tmp_path))
    bounded(name, EXAMPLES.get(name, 100), always_the_same=True)()
