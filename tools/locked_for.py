"""Print the entries of a lock file that apply to a version of Python and a processor.

    python -m tools.locked_for LOCK_FILE PYTHON_VERSION MACHINE [--only NAME... | --without NAME...]

pip decides by the interpreter that runs it, also if it downloads for another one.
"""

import argparse
import re
from collections.abc import Iterator, Set
from pathlib import Path
from typing import Final

from packaging.markers import Marker

ENTRY: Final = re.compile(r"\n(?=[A-Za-z])")
FIRST_LINE: Final = re.compile(r"([\w.-]+)==(\S+?)(?: ; (.*?))? \\$")


def main() -> None:
    """Print the entries."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("lock", type=Path)
    parser.add_argument("python_version")
    parser.add_argument("machine")
    parser.add_argument("--only", nargs="+", default=(), help="these packages only")
    parser.add_argument("--without", nargs="+", default=(), help="all but these packages")
    options = parser.parse_args()
    environment = {
        "python_version": options.python_version,
        "python_full_version": f"{options.python_version}.0",
        "platform_machine": options.machine,
    }
    for entry in entries(options.lock.read_text(), environment, {*options.without}):
        if not options.only or entry.partition("==")[0] in options.only:
            print(entry)


def entries(text: str, environment: dict[str, str], without: Set[str]) -> Iterator[str]:
    """Yield the entries whose marker holds in an environment, without the marker."""
    for entry in ENTRY.split(text.strip()):
        first, _, hashes = entry.partition("\n")
        if (found := FIRST_LINE.match(first)) is None or found[1] in without:
            continue
        if found[3] is None or Marker(found[3]).evaluate(environment):
            yield f"{found[1]}=={found[2]} \\\n{hashes}"


if __name__ == "__main__":
    main()
