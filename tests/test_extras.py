"""Optional parts: the line that names a missing one fits the environment, everywhere the same."""

import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway import extras
from gateway.extras import EXTRAS, MissingExtraError, how_to_add, require
from tests.conftest import ROOT


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Pretend that Python runs in an environment without some modules."""

    def pretend(*absent: str) -> Path:
        monkeypatch.setattr(sys, "prefix", str(tmp_path))
        monkeypatch.setattr(sys, "executable", "/env/bin/python")
        for name in absent:
            monkeypatch.setitem(sys.modules, name, None)
        return tmp_path

    return pretend


def test_extras_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ours = set(project["optional-dependencies"]) - {"docs", "bench", "dev"}
    assert set(EXTRAS) == ours


PACKAGES = "'jinja2>=3.1' 'matplotlib>=3.9'"


@pytest.mark.parametrize(
    ("absent", "file", "command"),
    [
        ((), "x", f"/env/bin/python -m pip install {PACKAGES}"),
        (("pip",), "x", f"uv pip install --python /env/bin/python {PACKAGES}"),
        ((), "pipx_metadata.json", f"pipx inject mavgate {PACKAGES}"),
        (("pip",), "pipx_metadata.json", f"pipx inject mavgate {PACKAGES}"),
    ],
    ids=["venv", "uv", "pipx", "pipx with shared pip"],
)
def test_command_fits_the_environment(
    environment: Callable[..., Path], absent: tuple[str, ...], file: str, command: str
) -> None:
    (environment(*absent) / file).touch()
    assert how_to_add("a report", "plot") == (
        f"a report needs the extra plot; to install it: {command}"
    )


def test_only_missing_modules_are_an_error_and_a_debian_package_refers_to_its_docs(
    environment: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "DEBIAN_PACKAGE", Path(extras.__file__).parent)
    assert "/usr/share/doc/mavgate/service.md" in how_to_add("a report", "plot")
    environment("mcap")
    require("a report", "plot")
    with pytest.raises(MissingExtraError, match="needs the extra formats"):
        require("MCAP", "formats")
