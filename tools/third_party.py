"""List the packages that mavgate requires, with their licences.

    python -m tools.third_party
    python -m tools.third_party --copyright FILE LIBRARY

The first writes THIRD_PARTY.md from the lock files, with the licences that the installed packages
state. The second writes the file `copyright` of a Debian package: the licence of mavgate, and those
of all packages in a folder, with their texts.
"""

import argparse
import re
import sys
from collections.abc import Iterable, Iterator
from email.message import Message
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from pathlib import Path
from typing import Final, cast

from packaging.requirements import Requirement

ROOT: Final = Path(__file__).resolve().parent.parent
PAGE: Final = ROOT / "THIRD_PARTY.md"
LOCKS: Final = {
    "requirements.lock": "Used by the program; part of the Debian package and the image",
    "requirements-build.lock": "Used to compile the kernels; not distributed",
    "requirements-linker.lock": "Used to link the kernels, without a C compiler and for wheels; "
    "not distributed",
}
LICENCE_FILE: Final = re.compile(r"(licen[sc]e|copying|notice|authors)", re.IGNORECASE)
STATED: Final = {
    "intelhex": "BSD-3-Clause",
    "pyserial": "BSD-3-Clause",
    "scipy": "BSD-3-Clause AND others of bundled libraries",
    "ziglang": "MIT",
}
"""Licences of packages whose metadata contain a text instead of a name, or none."""
NO_TEXT: Final = {
    "pmtiles": "Copyright 2021 and later Protomaps LLC",
    "pyserial": "Copyright (c) 2001-2020 Chris Liechti <cliechti@gmx.net>",
}
"""Copyright of packages under BSD-3-Clause that do not contain the text of the licence."""
LICENCES: Final = Path(__file__).with_name("licences")
BSD_3_CLAUSE: Final = (LICENCES / "BSD-3-Clause.txt").read_text()
BUNDLED: Final = (
    (
        "Natural Earth, coasts and borders at 1:50 million and populated places",
        "Public domain",
        "the panel's coarse map, `gateway/panel/web/base_map.json`",
        "",
    ),
    (
        "world-atlas, which makes TopoJSON of the coasts and borders",
        "ISC",
        "the same file",
        (LICENCES / "world-atlas.txt").read_text(),
    ),
)
"""Data in this repository: origin, licence, use, and text of the licence."""


def main() -> None:
    """Write one of the two files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--copyright", type=Path, nargs=2, metavar=("FILE", "LIBRARY"))
    options = parser.parse_args()
    if options.copyright is None:
        PAGE.write_text(page())
    else:
        file, library = options.copyright
        found = distributions(path=[str(library)])
        file.write_text(copyright_of(one for one in found if one.name != "mavgate"))


def page() -> str:
    """Return the text of THIRD_PARTY.md; exits if a package is missing or states no licence."""
    lines = ["# Third-party packages", ""]
    lines += [
        "Written by `python -m tools.third_party` from the lock files, which have the versions."
    ]
    for lock, use in LOCKS.items():
        rows = [(name, licence_of(name)) for name in locked_in(ROOT / lock)]
        width = max(len(name) for name, _ in rows)
        lines += ["", f"## `{lock}`", "", f"{use}.", ""]
        lines += [f"| {'package':{width}} | licence |", f"| {'-' * width} | --- |"]
        lines += [f"| {name:{width}} | {licence} |" for name, licence in rows]
    lines += ["", "## Data in this repository", ""]
    lines += ["| data | licence | use |", "| --- | --- | --- |"]
    lines += [f"| {data} | {licence} | {use} |" for data, licence, use, _ in BUNDLED]
    lines += ["", *(text.rstrip() for *_, text in BUNDLED if text)]
    return "\n".join(lines) + "\n"


def locked_in(lock: Path) -> list[str]:
    """List the packages of a lock file that are installed on a machine like this."""
    lines = re.findall(r"^[A-Za-z][^\\\n]*", lock.read_text(), re.MULTILINE)
    required = [Requirement(line) for line in lines]
    return sorted({one.name for one in required if one.marker is None or one.marker.evaluate()})


def licence_of(name: str) -> str:
    """Return the licence of a package; exits if it is neither installed nor listed here."""
    try:
        return _licence(distribution(name))
    except PackageNotFoundError:
        # The linker is installed only if it is needed.
        if name in STATED:
            return STATED[name]
        sys.exit(f"{name} is not installed: run this in the environment of `make test`")


def copyright_of(packages: Iterable[Distribution]) -> str:
    """Return the licences of mavgate and of packages, with their texts."""
    parts = [
        "mavgate is licensed under the Apache License 2.0, which is on Debian systems in",
        "/usr/share/common-licenses/Apache-2.0. The package contains other projects' packages, in",
        "/usr/lib/mavgate, under the licences below.",
        "",
        (ROOT / "LICENSE").read_text(),
    ]
    for data, licence, _, text in BUNDLED:
        parts += ["=" * 78, f"{data}: {licence}", "", text]
    for package in sorted(packages, key=lambda one: one.name.lower()):
        parts += ["=" * 78, f"{package.name} {package.version}: {_licence(package)}", ""]
        parts += texts_of(package)
    return "\n".join(parts)


def texts_of(package: Distribution) -> Iterator[str]:
    """Yield the texts of a package's licences; exits if it contains none."""
    found = False
    for path in package.files or []:
        if ".dist-info" in path.parts[0] and LICENCE_FILE.search("/".join(path.parts[1:])):
            file = Path(str(package.locate_file(path)))
            if file.is_file():
                found = True
                yield file.read_text(errors="replace")
    if not found:
        if package.name not in NO_TEXT:
            sys.exit(f"{package.name} contains no licence: add its copyright to NO_TEXT")
        yield f"{NO_TEXT[package.name]}\n\n{BSD_3_CLAUSE}"


def _licence(package: Distribution) -> str:
    metadata = cast(Message, package.metadata)
    if stated := STATED.get(package.name) or metadata.get("License-Expression"):
        return stated
    name = (metadata.get("License") or "").strip()
    if name and "\n" not in name:
        return name
    classifiers = metadata.get_all("Classifier") or []
    stated_by = [one.rpartition(" :: ")[2] for one in classifiers if one.startswith("License")]
    if not stated_by:
        sys.exit(f"{package.name} states no licence: look it up, and add it to STATED")
    return ", ".join(stated_by)


if __name__ == "__main__":
    main()
