"""The lock files and the list of third-party licences."""

import re
import tomllib
from importlib.metadata import distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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
