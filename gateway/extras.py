"""Optional extras: the packages that each requires, and the command to install them here."""

import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from gateway.printable import UserError

EXTRAS: Final = {
    "plot": ("jinja2", "matplotlib"),
    "panel": ("nicegui", "pmtiles", "pyjson5"),
    "fleet": ("zenoh",),
    "formats": ("mcap", "pyarrow", "pyulog"),
    "batch": ("distributed", "fsspec"),
    "fast": ("uvloop",),
    "mqtt": ("aiomqtt",),
}
"""Modules by extra, as in `pyproject.toml`."""
DEBIAN_PACKAGE: Final = Path("/usr/lib/mavgate")
"""Folder in which `make deb` installs everything; packages installed by pip are not found there."""


class MissingExtraError(UserError):
    """A missing extra; the text contains the command that installs it."""


def missing(extra: str) -> list[str]:
    """Return the modules of an extra that are not installed."""
    return [name for name in EXTRAS[extra] if find_spec(name) is None]


def require(what: str, extra: str) -> None:
    """Raise MissingExtraError if an extra that is needed for something is not installed."""
    if missing(extra):
        raise MissingExtraError(how_to_add(what, extra))


def how_to_add(what: str, extra: str) -> str:
    """Return a line that names the extra and the command to install it here."""
    return f"{what} needs the extra {extra}; to install it: {_command(extra)}"


def _command(extra: str) -> str:
    """Return the command to install an extra in this Python's kind of environment."""
    if Path(__file__).is_relative_to(DEBIAN_PACKAGE):
        return "see Elsewhere in /usr/share/doc/mavgate/service.md, as Debian has no such package"
    # Imported here, as it takes 20 ms.
    from importlib import metadata

    try:
        requirements = metadata.requires("mavgate") or []
    except metadata.PackageNotFoundError:
        return f"python3 -m pip install '.[{extra}]' in the folder of the source"
    of_extra = re.compile(rf"([^;]*?)\s*;.*extra == ['\"]{extra}['\"]")
    packages = shlex.join(found[1] for each in requirements if (found := of_extra.match(each)))
    if (Path(sys.prefix) / "pipx_metadata.json").exists():
        return f"pipx inject mavgate {packages}"
    python = sys.executable
    if find_spec("pip") is None:
        return f"uv pip install --python {python} {packages}"
    return f"{python} -m pip install {packages}"
