"""The one writer of files that a person or the gateway asks for: whole or not at all.

Nothing that exists is replaced unasked, nothing but a regular file ever, and nothing that is being
read. What is written beside the target and put in its place in one step survives a loss of power.
"""

import contextlib
import errno
import os
import stat
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

READABLE: Final = 0o666
"""Less what the user's mask takes away."""
PRIVATE: Final = 0o600
"""For what holds a passphrase."""


def check_output(
    path: Path, inputs: Iterable[Path | None] = (), *, overwrite: bool = False
) -> None:
    """Check that a file may be written here, before the work that makes it.

    Parameters
    ----------
    path : Path
        The file to be.
    inputs : iterable of Path or None
        What it is made of; None for what was not given.
    overwrite : bool
        Whether a regular file that is there may be replaced.

    Raises
    ------
    OSError
        FileExistsError if it is there and may not be replaced; otherwise what speaks against it.
    """
    try:
        there = path.lstat()
    except FileNotFoundError:
        return
    for read in inputs:
        if read is not None and read.exists() and os.path.samestat(read.stat(), path.stat()):
            raise OSError(errno.EINVAL, "is what the output is made of; name another", str(path))
    if not stat.S_ISREG(there.st_mode):
        raise OSError(errno.EINVAL, "is no regular file, and is not replaced", str(path))
    if not overwrite:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def check_folder(path: Path, *, overwrite: bool = False) -> None:
    """Check that files may be written into a folder; raises OSError as `check_output`."""
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_dir():
        raise OSError(errno.ENOTDIR, "is no folder", str(path))
    if not overwrite and any(path.iterdir()):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def write_new(
    path: Path,
    pieces: Iterable[bytes],
    *,
    overwrite: bool = False,
    inputs: Iterable[Path | None] = (),
    rights: int | None = None,
) -> int:
    """Write a file in full or not at all.

    Parameters
    ----------
    path : Path
        Must not be there yet unless it may be overwritten.
    pieces : iterable of bytes
        What to write.
    overwrite : bool
        Put it in the place of a regular file that is there.
    inputs : iterable of Path or None
        What it is made of; none of it is replaced.
    rights : int, optional
        Who may read and write it; by default those of the file that it replaces, or `READABLE`.

    Returns
    -------
    int
        Bytes written.

    Raises
    ------
    OSError
        As `check_output`, or what the disk does not like.
    """
    check_output(path, inputs, overwrite=overwrite)
    claimed = _claim(path)
    if rights is None:
        rights = READABLE & ~_mask() if claimed else stat.S_IMODE(path.stat().st_mode)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:100]}.")
    fresh, size = Path(name), 0
    try:
        with os.fdopen(handle, "wb") as file:
            for piece in pieces:
                size += file.write(piece)
            file.flush()
            os.fchmod(file.fileno(), rights)
            os.fsync(file.fileno())
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        if claimed:
            path.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)
    return size


def sync_folder(folder: Path) -> None:
    """Make new names in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some file systems (FAT among them) cannot; then there is nothing to be done.
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _claim(path: Path) -> bool:
    """Take the name, so that nobody else does while the work goes on; False if it is taken."""
    try:
        path.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _mask() -> int:
    """Return the user's mask of rights, which can be read but by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
