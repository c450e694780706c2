"""A cache of machine code on disk, loaded without numba in some milliseconds.

A file's name contains a digest of the sources, versions and platform that its code was compiled
from and for, and its first bytes are a digest of its content: damaged or foreign files are ignored.
"""

import contextlib
import ctypes
import errno
import fcntl
import hashlib
import logging
import mmap
import os
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

log = logging.getLogger(__name__)

DIGEST_SIZE: Final = hashlib.sha256().digest_size
READABLE: Final = 0o644
ENTRY: Final = "entry"
"""The function's symbol."""
OTHERS_KEPT: Final = 3
"""Other installations of this minor version of Python (another build, another numba) whose code
stays: each would else compile anew when another had run."""
ONCE: Final = "compiling machine code, once after an upgrade: it takes up to a minute"

_HAS_TOLD: Final = mmap.mmap(-1, 1)
"""Whether `tell_of_compiling` has logged; forked processes share this byte, so one of them does."""


class MachineCode(NamedTuple):
    """One function, for any processor of this platform."""

    relocatable: bytes
    """An object file, which LLVM loads."""
    shared: bytes | None
    """The same as a library, which the system loads: LLVM takes 40 MB. None without a linker."""


@cache
def _made_for() -> str:
    compiler = Path(__file__).with_name("compiler.py").read_text()
    here = (EXTENSION_SUFFIXES[0], sys.version, version("numba"), version("llvmlite"))
    return repr((here, compiler))


def _file(folder: Path, name: str, digest: str) -> Path:
    return folder / f"{_begin_of_own(name)}{digest[:32]}.code"


def _begin_of_own(name: str) -> str:
    made_for = hashlib.sha256(_made_for().encode()).hexdigest()
    return f"{name}.{sys.implementation.cache_tag}-{made_for[:16]}-"


def _folders() -> Iterator[Path]:
    """Yield the folders of the cache: `NUMBA_CACHE_DIR`, else beside the source, else at home."""
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(asked)
        return
    yield Path(__file__).with_name("__pycache__")
    with contextlib.suppress(RuntimeError):
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mavgate"


def kept_code(name: str, digest: str) -> MachineCode | None:
    """Read the cached machine code of a function; None if there is none, or it is damaged.

    Parameters
    ----------
    name : str
        The function's name, a part of the file's.
    digest : str
        From `digest_of`.
    """
    for folder in _folders():
        try:
            data = _file(folder, name, digest).read_bytes()
            if hashlib.sha256(data[DIGEST_SIZE:]).digest() == data[:DIGEST_SIZE]:
                return msgspec.msgpack.decode(data[DIGEST_SIZE:], type=MachineCode)
        except (OSError, msgspec.MsgspecError):
            continue
    return None


def keep_code(name: str, digest: str, code: MachineCode) -> None:
    """Cache the machine code of a function and remove older code; does nothing if not permitted.

    Parameters
    ----------
    name, digest : str
        As for `kept_code`.
    code : MachineCode
        From the compiler.
    """
    data = msgspec.msgpack.encode(code)
    for folder in _folders():
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            target = _file(folder, name, digest)
            with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
                file.write(hashlib.sha256(data).digest() + data)
            temporary = Path(file.name)
            temporary.chmod(READABLE)
            # Atomic, because another process may be writing the same file.
            temporary.replace(target)
            with contextlib.suppress(OSError):
                _remove_older(target, name)
            return


def _remove_older(target: Path, name: str) -> None:
    """Remove what earlier sources made, and of other installations' code all but the newest."""
    code = target.parent.glob(f"{name}.{sys.implementation.cache_tag}-*.code")
    others = []
    for file in code:
        if not file.name.startswith(_begin_of_own(name)):
            others.append((file.stat().st_mtime_ns, file))
        elif file != target:
            file.unlink()
    for _, file in sorted(others, reverse=True)[OTHERS_KEPT:]:
        file.unlink()


def tell_of_compiling(text: str = ONCE) -> None:
    """Log that machine code is being compiled, for which somebody waits; only the first time."""
    if not _HAS_TOLD[0]:
        _HAS_TOLD[0] = 1
        log.info(text)


@contextlib.contextmanager
def compiling(name: str) -> Iterator[None]:
    """Compile a function in one process at a time: the next finds what the one before has cached.

    Where nothing can be cached, nothing is waited for.

    Parameters
    ----------
    name : str
        As for `kept_code`.
    """
    with contextlib.ExitStack() as opened:
        for folder in _folders():
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                lock = opened.enter_context((folder / f"{name}.lock").open("a"))
                fcntl.flock(lock, fcntl.LOCK_EX)
                break
        yield


def load_code(code: MachineCode) -> int:
    """Load machine code into this process for good, and return the address of its function.

    Raises
    ------
    OSError
        If there are no file descriptors left.
    """
    if code.shared is not None:
        try:
            with tempfile.NamedTemporaryFile(suffix=".so") as file:
                file.write(code.shared)
                file.flush()
                function = ctypes.CDLL(file.name)[ENTRY]
                return ctypes.cast(function, ctypes.c_void_p).value or 0
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise
            # It may be forbidden to execute what lies there, or the disk is full.
    return _load_by_llvm(code.relocatable)


_ENGINES: Final[list[Any]] = []
"""Their code is valid as long as they live."""


def _load_by_llvm(relocatable: bytes) -> int:
    # Imported late, because most gateways need none.
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(relocatable))
    engine.finalize_object()
    _ENGINES.append(engine)
    address: int = engine.get_function_address(ENTRY)
    return address
