"""The only writer of output files, which are written completely or not at all.

No file is replaced without permission, if it is not a regular file, or while it is read. A file is
written next to the target and renamed when it is complete, so nobody finds an incomplete file under
that name, not even after a power loss or a kill.
"""

import contextlib
import errno
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

READABLE: Final = 0o666
"""Mode of files in general, before the user's umask."""
PRIVATE: Final = 0o600
"""Mode of files with a passphrase."""
LETTERS: Final = 40
"""Characters of a file's name in the name of its temporary file: up to 4 bytes each, of 255."""


def check_output(
    path: Path, inputs: Iterable[Path | None] = (), *, overwrite: bool = False
) -> None:
    """Check that a file can be written here, before the work for it is done.

    Raises FileExistsError if it exists and must not be replaced, OSError for any other reason.
    """
    try:
        there = path.lstat()
    except FileNotFoundError:
        _check_writable(path, path.parent)
        return
    for read in inputs:
        if read is not None and read.exists() and os.path.samestat(read.stat(), path.stat()):
            raise OSError(errno.EINVAL, "is an input; give another output", str(path))
    if not stat.S_ISREG(there.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file, and is not replaced", str(path))
    if not overwrite:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    _check_writable(path, path.parent)


def check_ending(path: Path, endings: Iterable[str]) -> None:
    """Raise OSError if the suffix of a file's name is not one of its format."""
    if path.suffix not in endings:
        raise OSError(errno.EINVAL, f"the output must end in {', '.join(endings)}", str(path))


def check_folder(path: Path, *, overwrite: bool = False) -> None:
    """Check that files can be written into a folder; raises OSError as `check_output`."""
    there = next(each for each in (path, *path.parents) if each.exists() or each.is_symlink())
    if not there.is_dir():
        raise OSError(errno.ENOTDIR, "is not a folder", str(there))
    if there == path and not overwrite and any(path.iterdir()):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    _check_writable(path, there)


def _check_writable(path: Path, folder: Path) -> None:
    if not folder.is_dir():
        raise FileNotFoundError(errno.ENOENT, "is in a folder that does not exist", str(path))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, "is in a folder that cannot be written", str(path))


def write_new(
    path: Path,
    pieces: Iterable[bytes],
    *,
    overwrite: bool = False,
    inputs: Iterable[Path | None] = (),
    rights: int | None = None,
) -> int:
    """Write a file completely or not at all, and return its size in bytes.

    A regular file is replaced only with `overwrite`, and never if it is one of `inputs`. Its mode
    is `rights`, by default that of the replaced file, or `READABLE`. Raises OSError as
    `check_output`, or if the disk fails.
    """
    check_output(path, inputs, overwrite=overwrite)
    if rights is None:
        rights = stat.S_IMODE(path.stat().st_mode) if path.exists() else READABLE & ~_mask()
    prefix, size = f".{path.name[:LETTERS]}.", 0
    with _named(path, prefix):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=prefix)
        fresh = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                for piece in pieces:
                    size += file.write(piece)
                file.flush()
                os.fchmod(file.fileno(), rights)
                os.fsync(file.fileno())
            if overwrite:
                fresh.replace(path)
            else:
                _put_where_none_is(fresh, path)
        finally:
            fresh.unlink(missing_ok=True)
    sync_folder(path.parent)
    return size


@contextlib.contextmanager
def written_together(folder: Path) -> Iterator[Path]:
    """Write files that belong together: all of them are moved into a folder, or none.

    Raises OSError as `check_output`, or if the disk fails.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as undo:
        if is_new:
            undo.callback(_remove_if_empty, folder)
        with _named(folder, "."):
            made = tempfile.TemporaryDirectory(dir=folder, prefix=".")
        fresh = Path(undo.enter_context(made))
        try:
            yield fresh
            files = [*fresh.iterdir()]
            for file in files:
                check_output(folder / file.name, overwrite=True)
            for file in files:
                file.replace(folder / file.name)
            sync_folder(folder)
        except OSError as error:
            if error.filename is not None and Path(error.filename).parent == fresh:
                error.filename = str(folder / Path(error.filename).name)
            raise


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


@contextlib.contextmanager
def _named(path: Path, prefix: str) -> Iterator[None]:
    """Put the target's name into errors of the temporary file; other errors are unchanged."""
    try:
        yield
    except OSError as error:
        if error.filename is None or Path(error.filename).name.startswith(prefix):
            error.filename = str(path)
        raise


def _put_where_none_is(fresh: Path, path: Path) -> None:
    """Rename a complete file; raises FileExistsError if the name has been taken since."""
    try:
        os.link(fresh, path)
    except FileExistsError as error:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
    except OSError:
        # FAT does not support hard links.
        path.touch(exist_ok=False)
        fresh.replace(path)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that new names in it survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some file systems, such as FAT, do not support this, and do not need it.
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _mask() -> int:
    """Return the user's umask, which can only be read by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
