"""Files that URLs name: certificates, logins, maps of columns, Zenoh's configuration.

They are read only if they are regular and small: opening a pipe may block for ever, and a device
may have no end. A URL that is added while the gateway runs comes from a client of the control
socket or the panel, and names only files below the folder of the settings: with any other file, a
broker could be sent what only this user may read.
"""

from pathlib import Path
from stat import S_ISREG
from typing import Final

from gateway.hub.endpoint import Endpoint

MAX_BYTES: Final = 1_000_000
"""Maximum size; a bundle of all public certificate authorities has 0.2 MB."""
FILE_OPTIONS: Final = ("authority", "certificate", "key", "login")
"""Options that name files, besides `config`."""


def regular_file(name: str, most: int = MAX_BYTES) -> Path:
    """Return the path of a file; raises OSError if it is not regular, or larger than `most`."""
    path = Path(name).expanduser()
    found = path.stat()
    if not S_ISREG(found.st_mode) or found.st_size > most:
        raise OSError(f"{path} is not a regular file of at most {most} bytes")
    return path


def read_text(name: str, most: int = MAX_BYTES) -> str:
    """Return the text of a file; raises OSError as `regular_file`, or if it is not UTF-8."""
    path = regular_file(name, most)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise OSError(f"{path} is not UTF-8 text") from error


def check_files(endpoint: Endpoint, folder: Path | None) -> None:
    """Raise OSError if an endpoint names a file that is not regular and below the folder."""
    named = [endpoint.added.get(option, "") for option in FILE_OPTIONS]
    for name in filter(None, (*named, endpoint.config)):
        path = regular_file(name).resolve()
        if folder is None or not path.is_relative_to(folder.resolve()):
            raise OSError(f"{name} is not in {folder}, the folder of the settings")
