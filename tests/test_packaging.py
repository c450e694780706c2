"""Lock files, third-party licences, and the optional extras."""

import re
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gateway import extras
from gateway.extras import EXTRAS, MissingExtraError, how_to_add, require
from tests.conftest import ROOT
from tools import third_party

LOCKS = sorted(ROOT.glob("requirements*.lock"))


def test_each_locked_package_has_hashes_which_the_installation_checks() -> None:
    for lock in LOCKS:
        for entry in re.split(r"\n(?=[A-Za-z])", lock.read_text()):
            assert re.match(r"[\w.-]+==[\w.]+", entry), entry
            assert "--hash=sha256:" in entry, entry
    for script in ("set_up.sh", "make_deb.sh"):
        text = (ROOT / "tools" / script).read_text()
        assert text.count("--requirement") == text.count("--require-hashes --requirement") > 0


def test_each_dependency_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    groups = project["dependency-groups"]
    for lock, wanted in {
        "requirements.lock": [
            *project["project"]["dependencies"], *extras["panel"], *extras["fleet"]
        ],
        "requirements-build.lock": groups["build"],
        "requirements-linker.lock": groups["linker"],
        "requirements-dev.lock": [one for some in extras.values() for one in some],
    }.items():  # fmt: skip
        names = re.findall(r"^([\w.-]+)==", (ROOT / lock).read_text(), re.MULTILINE)
        locked = {canonicalize_name(name) for name in names}
        assert {canonicalize_name(Requirement(one).name) for one in wanted} <= locked, lock


def test_list_of_licences_is_current_and_all_their_texts_are_found() -> None:
    """`python -m tools.third_party` writes the list again."""
    assert third_party.PAGE.read_text() == third_party.page()
    names = third_party.locked_in(ROOT / "requirements.lock")
    packages = [distribution(name) for name in names]
    text = third_party.copyright_of(packages)
    assert text.count("=" * 78) >= len(names)
    assert "Chris Liechti" in text
    assert "GNU LESSER GENERAL PUBLIC LICENSE" in text, "that of pymavlink"


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
