"""The only code that uses numba: strict-IEEE machine code of functions marked by `compiled`.

Numba translates each function to LLVM's language once. Its own code generator would then optimise
and load every function with copies of all that it calls, which takes four times as long; here all
functions are linked into one module, which is optimised as a whole. The code uses only instructions
that every processor of its architecture has, and no fused multiply-add.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from types import FunctionType
from typing import Any, Final

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.core import codegen
from numba.core.registry import cpu_target
from numba.extending import intrinsic, overload, typeof_impl

from gateway.compiled import array_at, is_compiled, record_at, system_calls
from gateway.compiled.entry_point import SOURCES_SYMBOL, EntryPoint

STRICT: Final[dict[str, Any]] = {"fastmath": False, "error_model": "numpy"}
"""Options of numba, because offline fusion of a log must give exactly the result of live fusion."""
TYPES: Final[dict[Any, Any]] = {int: types.int64, float: types.float64}
RUN_TIME_PREFIXES: Final = ("NRT_", "Py", "numba_", "_Py")
"""Prefixes of the symbols of Python and numba that allocate and raise."""
NO_REFERENCES: Final = "\n".join(
    f"define void @NRT_{name}(ptr %meminfo) alwaysinline {{ ret void }}"
    for name in ("incref", "decref")
)
"""Calls that count references, which are removed: nothing is allocated, and they would prevent most
optimisations."""


def compile_object(
    entry_points: Sequence[EntryPoint[...]],
    stamp: str,
    architecture: str | None = None,
) -> bytes:
    """Compile entry points, and all functions that they call, into an object file.

    Parameters
    ----------
    entry_points : sequence of EntryPoint
    stamp : str
        The value of `SOURCES_SYMBOL`.
    architecture : str, optional
        By default that of this machine.

    Returns
    -------
    bytes
        It has a C function with the name and the parameters (`int64_t`, `double`) of each entry
        point.

    Raises
    ------
    TypeError
        If a function allocates or uses Python objects.
    """
    cpu_target.target_context._internal_codegen = _Codegen("kernels")  # type: ignore[no-untyped-call]  # noqa: SLF001
    # Numba binds global constants when it compiles; they may have been patched since an earlier
    # call.
    _called.cache_clear()
    symbols, libraries = {}, []
    for entry_point in entry_points:
        signature = types.void(*(TYPES[p.annotation] for p in entry_point.parameters))
        function: Any = numba.cfunc(signature, **STRICT)(entry_point.__wrapped__)  # type: ignore[attr-defined]
        symbols[function.native_name] = entry_point.symbol
        libraries.append(function._library)  # noqa: SLF001
    module = _linked(libraries)
    machine = _target_machine(architecture)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    _isolate(module, symbols, stamp)
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(3))
    passes.getModulePassManager().run(module, passes)
    return bytes(machine.emit_object(module))


class _Library(codegen.AOTCodeLibrary):
    """The code of one function, neither optimised nor loaded."""

    def _optimize_functions(self, ll_module: Any) -> None:
        pass

    def finalize(self) -> None:
        """Leave the code as it was translated."""
        self._finalized = True

    def get_pointer_to_function(self, _: str) -> int:
        """Return no address: the code is not called in this process."""
        return 0


class _Codegen(codegen.AOTCPUCodegen):
    """Creates the libraries above."""

    _library_class = _Library

    def set_env(self, env_name: str, env: object) -> None:
        """Ignore the environment, which only code with Python objects needs."""


def _linked(libraries: Iterable[Any]) -> Any:
    """Link the modules of libraries, and of all libraries whose functions they call."""
    found = dict.fromkeys(libraries)
    for library in (queue := [*found]):
        for other in library._linking_libraries:  # noqa: SLF001
            if other not in found:
                found[other] = None
                queue.append(other)
    module = llvm.parse_assembly(NO_REFERENCES)
    for library in found:
        one = library._final_module  # noqa: SLF001
        if any("alloc" in name.lower() for name in _run_time_symbols(one.functions)):
            raise TypeError(f"{library.name} allocates memory, which a kernel may not")
        for function in one.functions:
            if not function.is_declaration:
                # Several libraries may contain the same helper function.
                function.linkage = "weak_odr"
        module.triple, module.data_layout = one.triple, one.data_layout
        module.link_in(one, preserve=True)
    return module


def _run_time_symbols(values: Iterable[Any]) -> list[str]:
    missing = (value.name for value in values if value.is_declaration)
    return [name for name in missing if name.startswith(RUN_TIME_PREFIXES)]


def _isolate(module: Any, symbols: dict[str, str], stamp: str) -> None:
    """Remove all dependencies except the C library; an exception stops the process."""
    text = stamp.encode()
    escaped = "".join(f"\\{byte:02x}" for byte in (*text, 0))
    stubs = [
        f'target triple = "{module.triple}"',
        f'target datalayout = "{module.data_layout}"',
        "declare void @llvm.trap()",
        f'@{SOURCES_SYMBOL} = constant [{len(text) + 1} x i8] c"{escaped}"',
    ]
    stubs += [
        f"define void @{name}() {{ call void @llvm.trap() unreachable }}"
        for name in _run_time_symbols(module.functions)
    ]
    stubs += [f"@{name} = global i64 0" for name in _run_time_symbols(module.global_variables)]
    module.link_in(llvm.parse_assembly("\n".join(stubs)))
    for value in (*module.functions, *module.global_variables):
        if value.name in symbols:
            value.name = symbols[value.name]
            value.linkage = "external"
        elif not value.is_declaration and value.name != SOURCES_SYMBOL:
            value.linkage = "internal"


def _target_machine(architecture: str | None) -> Any:
    """Return LLVM's description of a generic processor of an architecture."""
    if architecture is None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        target = llvm.Target.from_default_triple()
    else:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        target = llvm.Target.from_triple(f"{architecture}-unknown-linux-gnu")
    return target.create_target_machine(opt=3, reloc="pic", codemodel="small")


@cache
def _called(function: FunctionType) -> Any:
    """Return the compiled form of a function."""
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
    def view(address: Any, shape: Any, kind: Any) -> Any:
        return carray(_pointer_to(address), shape, kind)

    return view


@overload(record_at)
def _record_at(address: Any, layout: Any) -> Any:  # noqa: ARG001
    def view(address: Any, layout: Any) -> Any:
        return carray(_pointer_to(address), 1, layout)[0]

    return view


_ADDRESS, _INT, _LONG = types.voidptr, types.int32, types.int64
_error_number: Any = types.ExternalFunction("__errno_location", _ADDRESS())
_recvmmsg: Any = types.ExternalFunction("recvmmsg", _INT(_INT, _ADDRESS, _INT, _INT, _ADDRESS))
_sendmmsg: Any = types.ExternalFunction("sendmmsg", _INT(_INT, _ADDRESS, _INT, _INT))
_send: Any = types.ExternalFunction("send", _LONG(_INT, _ADDRESS, _LONG, _INT))
_RECEIVE_FLAGS: Final = system_calls.MSG_DONTWAIT
_SEND_FLAGS: Final = system_calls.MSG_DONTWAIT | system_calls.MSG_NOSIGNAL
_ERROR_TYPE: Final = np.dtype(np.int32)


@overload(system_calls.receive_many)
def _receive_many(file: Any, headers: Any, count: Any) -> Any:  # noqa: ARG001
    def call(file: Any, headers: Any, count: Any) -> Any:
        found = _recvmmsg(file, _pointer_to(headers), count, _RECEIVE_FLAGS, _pointer_to(0))
        return types.int64(found) if found >= 0 else -carray(_error_number(), 1, _ERROR_TYPE)[0]

    return call


@overload(system_calls.send_many)
def _send_many(file: Any, headers: Any, count: Any) -> Any:  # noqa: ARG001
    def call(file: Any, headers: Any, count: Any) -> Any:
        found = _sendmmsg(file, _pointer_to(headers), count, _SEND_FLAGS)
        return types.int64(found) if found >= 0 else -carray(_error_number(), 1, _ERROR_TYPE)[0]

    return call


@overload(system_calls.send_one)
def _send_one(file: Any, data: Any, size: Any) -> Any:  # noqa: ARG001
    def call(file: Any, data: Any, size: Any) -> Any:
        found = _send(file, _pointer_to(data), size, _SEND_FLAGS)
        return found if found >= 0 else -carray(_error_number(), 1, _ERROR_TYPE)[0]

    return call
