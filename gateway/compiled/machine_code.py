"""A cache of machine code on disk, loaded by LLVM without numba in some milliseconds.

A file's name contains a digest of the sources, versions and processor that its code was compiled
from and for, and its first bytes are a digest of its content: damaged or foreign files are ignored.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import llvmlite.binding as llvm
import msgspec

DIGEST_SIZE: Final = hashlib.sha256().digest_size
READABLE: Final = 0o644


class MachineCode(NamedTuple):
    """A relocatable object that holds one function."""

    symbol: str
    """The function's."""
    helpers: list[str]
    """Symbols of numba and Python that are called only to raise: no entry point raises."""
    content: bytes


@cache
def target_machine() -> Any:
    """Return LLVM's description of this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="static" if platform.machine() in {"x86_64", "i686"} else "default",
        codemodel="jitdefault",
        jit=True,
    )


@cache
def _made_for() -> str:
    features = llvm.get_host_cpu_features().flatten()
    here = (llvm.get_process_triple(), llvm.get_host_cpu_name(), features, sys.version)
    compiler = Path(__file__).with_name("compiler.py").read_text()
    return repr((here, version("numba"), version("llvmlite"), compiler))


def _file(folder: Path, name: str, digest: str) -> Path:
    key = hashlib.sha256((digest + _made_for()).encode()).hexdigest()
    return folder / f"{name}.{sys.implementation.cache_tag}-{key[:32]}.code"


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
            for old in folder.glob(f"{name}.{sys.implementation.cache_tag}-*.code"):
                if old != target:
                    old.unlink()
            return


_ENGINES: Final[list[Any]] = []
"""Their code is valid as long as they live."""


def load_code(code: MachineCode) -> int:
    """Load machine code into this process, and return the address of its function."""
    helpers = llvm.parse_assembly("\n".join(f"declare void @{name}()" for name in code.helpers))
    engine = llvm.create_mcjit_compiler(helpers, target_machine())
    abort = ctypes.cast(ctypes.CDLL(None).abort, ctypes.c_void_p).value
    for helper in helpers.functions:
        engine.add_global_mapping(helper, abort)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.content))
    engine.finalize_object()
    _ENGINES.append(engine)
    address: int = engine.get_function_address(code.symbol)
    return address
