"""The programs of tools/ and of the bench: each can be imported, and some are run for a moment."""

import os
import subprocess
from importlib import import_module
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tools import attack
from tools.fuzz import TARGETS, bounded

PROGRAMS = [f"tools.{path.stem}" for path in sorted(ROOT.glob("tools/*.py"))]
EXAMPLES = {"command": 40, "settings_file": 60}
STUBS = {
    "dpkg-query": 'case "$4" in {absent}) exit 1;; *) echo install ok installed;; esac',
    "apt-get": "echo no network >&2; exit 100",
    "sudo": "exit 1",
    "id": "echo 0",
}


@pytest.mark.parametrize("name", [*PROGRAMS, "firmware.rig.measure"])
def test_tool_can_be_imported(name: str) -> None:
    import_module(name)


@pytest.mark.slow
def test_attacks_by_files_and_on_the_control_socket_do_not_succeed(tmp_path: Path) -> None:
    assert attack.run(attack.OF_FILES, attack.Target(tmp_path, 0))
    names = ("idle control connections", "devices as serial clients")
    with attack.started(tmp_path, panel=False) as target:
        assert attack.run({name: attack.OF_GATEWAY[name] for name in names}, target)


@pytest.mark.parametrize("name", TARGETS)
def test_fuzzed_code_raises_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The commands read the settings of the user.
    monkeypatch.setenv("HOME", os.fspath(tmp_path))
    bounded(name, EXAMPLES.get(name, 100), always_the_same=True)()


@pytest.mark.io
@pytest.mark.parametrize(
    ("absent", "code"), [("none", 0), ("gcc-avr", 100)], ids=["all installed", "one is missing"]
)
def test_network_is_used_only_for_a_missing_debian_package(
    tmp_path: Path, absent: str, code: int
) -> None:
    for name, body in STUBS.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body.format(absent=absent)}\n")
        (tmp_path / name).chmod(0o755)
    done = subprocess.run(
        [ROOT / "tools" / "apt_install.sh", "make", "gcc-avr"], capture_output=True, text=True,
        check=False, env=os.environ | {"PATH": f"{tmp_path}:/usr/bin:/bin"},
    )  # fmt: skip
    assert done.returncode == code
    assert ("no network" in done.stderr) == (code != 0)
