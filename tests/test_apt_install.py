"""tools/apt_install.sh: Debian packages are fetched only where one is missing."""

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "tools" / "apt_install.sh"
STUBS = {
    "dpkg-query": 'case "$4" in {absent}) exit 1;; *) echo install ok installed;; esac',
    "apt-get": "echo no network >&2; exit 100",
    "sudo": "exit 1",
    "id": "echo 0",
}


@pytest.mark.io
@pytest.mark.parametrize(
    ("absent", "code"), [("none", 0), ("gcc-avr", 100)], ids=["all installed", "one is missing"]
)
def test_network_is_used_only_for_a_missing_package(tmp_path: Path, absent: str, code: int) -> None:
    for name, body in STUBS.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body.format(absent=absent)}\n")
        (tmp_path / name).chmod(0o755)
    done = subprocess.run(
        [SCRIPT, "make", "gcc-avr"], capture_output=True, text=True, check=False,
        env=os.environ | {"PATH": f"{tmp_path}:/usr/bin:/bin"},
    )  # fmt: skip
    assert done.returncode == code
    assert ("no network" in done.stderr) == (code != 0)
