"""Compile the kernels into one library, which the gateway loads without a compiler.

    python -m tools.build_kernels [--check | --force] [--output FILE [--architecture aarch64]]

Machine code of sources that were compiled before is taken from the user's cache folder.

The C compiler of the system links the library or, where there is none, the one of the package
`ziglang`, which can also link for another architecture and for older systems.
"""

import argparse
import gc
import hashlib
import importlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from gateway.compiled.entry_point import (
    ENTRY_POINTS,
    LIBRARY,
    EntryPoint,
    LibraryError,
    changed_source,
    open_library,
    stamp_in,
    stamp_of,
)

KERNEL_MODULES: Final = (
    "gateway.estimation.eskf.filter",
    "gateway.estimation.smoother",
    "gateway.estimation.paper",
    "gateway.hub.forwarding_step",
    "gateway.recordings.tlog_scan",
    "gateway.geometry.quaternion",
)
"""Modules with entry points. A wheel is built with only numpy, msgspec and pygeomag installed."""
ARCHITECTURES: Final = ("x86_64", "aarch64")
OLDEST_GLIBC: Final = "2.17"
"""Oldest version of the C library with which the library of a wheel runs."""
NO_KERNELS: Final = ("gateway.compiled", "gateway.compiled.entry_point", "gateway.settings")
"""Modules that all kernels import, but from which they use no constant."""
COMPILER: Final = Path(__file__).with_name("kernel_compiler.py")
OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH
MAX_CACHED: Final = 8
"""Maximum cached object files, of 0.2 MB each."""


def main() -> None:
    """Build the library of this source tree, unless it is current."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--check", action="store_true", help="compile nothing; exit code 1 if it is not current"
    )
    parser.add_argument("--force", action="store_true", help="compile it even if it is current")
    parser.add_argument("--output", type=Path, help="where to build it, for a package")
    parser.add_argument(
        "--architecture", choices=ARCHITECTURES, help="for a wheel, which runs on older systems too"
    )
    options = parser.parse_args()
    if options.check:
        sys.exit(0 if is_current() else 1)
    if options.output or options.force or not is_current():
        build_installed(options.output or LIBRARY, options.architecture, rebuild=options.force)


def is_current() -> bool:
    """Return whether the library of this source tree was compiled from the present sources."""
    try:
        return changed_source(stamp_in(open_library(LIBRARY))) is None
    except (LibraryError, ValueError):
        return False


def build_installed(path: Path, architecture: str | None = None, *, rebuild: bool = False) -> None:
    """Build the library that the gateway loads, in a process without other imports.

    Parameters
    ----------
    path : Path
    architecture : str, optional
        See `build_library`.
    rebuild : bool
        Do not use an object file of the cache.
    """
    for name in KERNEL_MODULES:
        importlib.import_module(name)
    # Any imported module may define a constant or a type of a kernel.
    names = [name for name in sys.modules if name.startswith("gateway.")]
    files = {sys.modules[name].__file__ for name in names if name not in NO_KERNELS}
    stamp = "\n".join(sorted(stamp_of(Path(file)) for file in files if file))
    cached = None if rebuild or architecture else cached_object(stamp)
    begin_s = time.monotonic()
    print(f"compiling {len(ENTRY_POINTS)} kernels, or taking them from the cache", flush=True)
    build_library(path, ENTRY_POINTS, stamp=stamp, architecture=architecture, cached=cached)
    elapsed_s, size_kb = time.monotonic() - begin_s, path.stat().st_size / 1e3
    print(f"{path.name}: {size_kb:.0f} kB after {elapsed_s:.0f} s")


def cached_object(stamp: str) -> Path | None:
    """Return the path in the cache of the object file of these sources and this compiler.

    None without a cache, for a user without a home folder.
    """
    versions = [f"{name} {version(name)}" for name in ("numba", "llvmlite", "numpy")]
    parts = (stamp, COMPILER.read_text(), platform.machine(), *versions)
    key = hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return folder / "mavgate" / "kernels" / f"{key}.o"


@contextmanager
def compiled_again(entry_points: Sequence[EntryPoint[...]]) -> Iterator[None]:
    """Run entry points with the patched constants and functions of their modules.

    For experiments: they are compiled when the context begins; after it, they call the installed
    library again.

    Parameters
    ----------
    entry_points : sequence of EntryPoint
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "variant.so")
        build_library(path, entry_points)
        try:
            for entry_point in entry_points:
                entry_point.load(path)
            yield
        finally:
            for entry_point in entry_points:
                entry_point.load()


def build_library(
    path: Path,
    entry_points: Sequence[EntryPoint[...]],
    *,
    stamp: str = "",
    architecture: str | None = None,
    cached: Path | None = None,
) -> None:
    """Compile entry points, and all functions that they call, into a library.

    Parameters
    ----------
    path : Path
        Path of the library; replaced atomically, so that a running process keeps the old one.
    entry_points : sequence of EntryPoint
    stamp : str
        The value of `SOURCES_SYMBOL`.
    architecture : str, optional
        For a wheel: `x86_64` or `aarch64`. By default the library is for this machine only.
    cached : Path, optional
        Path of the object file, which is compiled and stored there unless it exists.

    Raises
    ------
    TypeError
        If a function needs the run-time library of Python or numba, because it allocates.
    """
    machine_code = _kept(cached) if cached is not None else b""
    if not machine_code:
        machine_code = _compiled(entry_points, stamp, architecture)
        if cached is not None:
            _keep(cached, machine_code)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".kernels-") as folder:
        relocatable, library = Path(folder, "kernels.o"), Path(folder, "kernels.so")
        relocatable.write_bytes(machine_code)
        _link(relocatable, library, architecture)
        library.replace(path)


def _compiled(
    entry_points: Sequence[EntryPoint[...]], stamp: str, architecture: str | None
) -> bytes:
    # Imported late: without numba, the command can still find that the library is current.
    from tools.kernel_compiler import compile_object

    was_enabled = gc.isenabled()
    # The garbage collector would take a fifth of the time.
    gc.disable()
    try:
        return compile_object(entry_points, stamp, architecture)
    finally:
        if was_enabled:
            gc.enable()


def _kept(cached: Path) -> bytes:
    """Return an object file of the cache; empty if there is none, or it is damaged or foreign."""
    with suppress(OSError), cached.open("rb") as file:
        status, (digest, _, machine_code) = os.fstat(file.fileno()), file.read().partition(b"\n")
        # In a shared folder, another user could have written a file that would then be run.
        is_own = status.st_uid == os.geteuid() and not status.st_mode & OTHERS_WRITE
        if is_own and digest == _digest(cached, machine_code):
            return machine_code
    return b""


def _digest(cached: Path, machine_code: bytes) -> bytes:
    return hashlib.blake2b(cached.name.encode() + machine_code).hexdigest().encode()


def _keep(cached: Path, machine_code: bytes) -> None:
    """Store an object file, and remove the oldest others; errors of the cache are ignored."""
    with suppress(OSError):
        cached.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = cached.parent.lstat()
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
            return
        with tempfile.TemporaryDirectory(dir=cached.parent) as folder:
            file = Path(folder, cached.name)
            file.touch(mode=0o600)
            file.write_bytes(_digest(cached, machine_code) + b"\n" + machine_code)
            file.replace(cached)
        kept = sorted(cached.parent.glob("*.o"), key=lambda path: path.stat().st_mtime)
        for path in kept[:-MAX_CACHED]:
            path.unlink()


def _link(relocatable: Path, library: Path, architecture: str | None) -> None:
    """Make a library of an object file."""
    command = _linker(architecture)
    options = ["-shared", "-nostartfiles", "-s", "-o", str(library), str(relocatable), "-lm"]
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": cache}
        done = subprocess.run(
            [*command, *options], capture_output=True, text=True, check=False, env=environment
        )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} cannot link {library.name}:\n{done.stderr}")


def _linker(architecture: str | None) -> list[str]:
    """Return the command that links; for a wheel, the one that supports older systems."""
    if architecture is None and (compiler := shutil.which("cc")):
        return [compiler]
    if find_spec("ziglang") is None:
        raise SystemExit(
            "the kernels cannot be linked: install a C compiler or the Python package ziglang"
        )
    target = f"{architecture or platform.machine()}-linux-gnu.{OLDEST_GLIBC}"
    return [sys.executable, "-m", "ziglang", "cc", "-target", target]


if __name__ == "__main__":
    main()
