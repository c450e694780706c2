"""The only place that uses numba: strict-IEEE machine code of functions marked by `compiled`.

Imported only when there is something to compile: numba takes 60 MB and a quarter of a second.
"""

import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from inspect import signature
from pathlib import Path
from types import FunctionType
from typing import Any, Final

import llvmlite.binding as llvm
import numba
from numba import carray, types  # type: ignore[attr-defined]
from numba.core.caching import IndexDataCacheFile
from numba.extending import intrinsic, overload, typeof_impl

from gateway.compiled import array_at, digest_of, is_compiled, record_at
from gateway.compiled.machine_code import ENTRY, MachineCode, compiling, tell_of_compiling

STRICT: Final[dict[str, Any]] = {"fastmath": False, "error_model": "numpy"}
"""Offline fusion of a log must give exactly what it gave live."""
TYPES: Final[dict[Any, Any]] = {int: types.int64, float: types.float64}


def compile_entry(function: Callable[..., None]) -> MachineCode:
    """Compile an entry point.

    Parameters
    ----------
    function : callable
        Marked by `compiled`; takes `int` and `float`, and returns nothing. It must not allocate
        or raise, because that needs numba's runtime, which is not there when the code is loaded.

    Returns
    -------
    MachineCode
        With a C function of the same parameters: `int64_t` and `double`.

    Raises
    ------
    TypeError
        If it allocates.
    """
    arguments = [TYPES[p.annotation] for p in signature(function).parameters.values()]
    entry = numba.cfunc(types.void(*arguments), **STRICT)(function)
    module = llvm.parse_assembly(entry.inspect_llvm())
    if any("alloc" in name.lower() for name in _helpers(module.functions)):
        raise TypeError(f"{function.__qualname__} allocates, which an entry point may not")
    _isolate(module, entry.native_name)
    relocatable = _target_machine().emit_object(module)
    return MachineCode(relocatable, _link(relocatable))


def _helpers(values: Iterable[Any]) -> list[str]:
    """List the symbols of numba and Python that code needs; they are only used to raise."""
    missing = (value.name for value in values if value.is_declaration)
    return [name for name in missing if name.startswith(("NRT_", "Py", "numba_"))]


def _isolate(module: Any, entry: str) -> None:
    """Make the code need no more than the C library: what would raise, stops the process."""
    stubs = [f'target triple = "{module.triple}"', "declare void @llvm.trap()"]
    stubs += [
        f"define void @{name}() {{ call void @llvm.trap() unreachable }}"
        for name in _helpers(module.functions)
    ]
    stubs += [f"@{name} = global i64 0" for name in _helpers(module.global_variables)]
    module.link_in(llvm.parse_assembly("\n".join(stubs)))
    for value in (*module.functions, *module.global_variables):
        if value.name == entry:
            value.name = ENTRY
        elif not value.is_declaration:
            value.linkage = "internal"


@cache
def _target_machine() -> Any:
    """Return LLVM's description of any processor of this kind."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(opt=3, reloc="pic", codemodel="small")


def _link(relocatable: bytes) -> bytes | None:
    """Make a library of an object file, if there is a linker."""
    linker = shutil.which("cc")
    if linker is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "entry.o"), Path(folder, "entry.so")
        source.write_bytes(relocatable)
        command = [linker, "-shared", "-nostartfiles", "-s", "-o", str(target), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, check=False)
        return target.read_bytes() if done.returncode == 0 else None


def compile_dispatcher(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for any argument types; numba caches the code for each set of types.

    Parameters
    ----------
    function : callable
        Marked by `compiled`.

    Returns
    -------
    callable
        Compiles the function, or loads its cached code, when it is called.
    """
    dispatcher: Any = numba.njit(cache=True, **STRICT)(function)
    files = dispatcher._cache._cache_file  # noqa: SLF001
    files.__class__ = _FileBySignature
    # Numba itself compares only the function's own file, not those of the functions it calls.
    files._source_stamp = digest_of(function)  # noqa: SLF001
    compile_or_load = dispatcher.compile

    def compile_alone(signature: object) -> object:
        with compiling(f"{function.__module__}.{function.__qualname__}"):
            return compile_or_load(signature)

    dispatcher.compile = compile_alone
    return dispatcher  # type: ignore[no-any-return]


class _FileBySignature(IndexDataCacheFile):
    """Names a file of machine code by the types that it was compiled for.

    Numba numbers the files of a function. Two processes that compile it for different types at the
    same time may take the same number, and ever after one would run the other's code.
    """

    def load(self: Any, key: object) -> object:
        """Return the kept machine code of one signature; None where it has to be compiled."""
        found: object = super().load(key)  # type: ignore[no-untyped-call]
        if found is None:
            tell_of_compiling()
        return found

    def save(self: Any, key: object, data: object) -> None:
        """Keep the machine code of one signature."""
        digest = hashlib.sha256(repr(key).encode()).digest()
        name = self._data_name(int.from_bytes(digest[:8]))
        self._save_index({**self._load_index(), key: name})
        self._save_data(name, data)


@cache
def _called(function: FunctionType) -> Any:
    """Return the form of a function that compiled code can call."""
    njit: Any = numba.njit
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **STRICT)(function)


@typeof_impl.register(FunctionType)
def _type_of_function(function: FunctionType, _: object) -> Any:
    return types.Dispatcher(_called(function)) if is_compiled(function) else None


def _make_pointer(_: Any, _address: Any) -> Any:
    """Convert an integer to the pointer of that value."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


_pointer_to: Any = intrinsic(_make_pointer)


@overload(array_at)
def _array_at(address: Any, shape: Any, kind: Any) -> Any:  # noqa: ARG001
    def see(address: Any, shape: Any, kind: Any) -> Any:
        return carray(_pointer_to(address), shape, kind)

    return see


@overload(record_at)
def _record_at(address: Any, layout: Any) -> Any:  # noqa: ARG001
    def see(address: Any, layout: Any) -> Any:
        return carray(_pointer_to(address), 1, layout)[0]

    return see
