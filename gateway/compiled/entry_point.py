"""Functions that Python calls as machine code: directly by ctypes, or through numba."""

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import update_wrapper
from inspect import signature
from typing import Any, Final, Generic, ParamSpec, TypeVar

from gateway.compiled import compiled, digest_of
from gateway.compiled.machine_code import (
    MachineCode,
    compiling,
    keep_code,
    kept_code,
    load_code,
    tell_of_compiling,
)

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

INTERPRETED: Final = os.environ.get("NUMBA_DISABLE_JIT", "0") != "0"
"""Run everything as Python, for a debugger."""
C_TYPES: Final[dict[Any, Any]] = {int: ctypes.c_int64, float: ctypes.c_double}


_may_compile = True


class NotCompiledError(ValueError):
    """Machine code is not cached, and this process may not compile."""


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """Raise NotCompiledError where this process would compile: it takes seconds.

    For a running gateway, whose event loop would stop meanwhile, whichever thread compiles.
    """
    global _may_compile
    before, _may_compile = _may_compile, False
    try:
        yield
    finally:
        _may_compile = before


class EntryPoint(Generic[Parameters]):
    """A function that is called as machine code, loaded from the cache or compiled at first call.

    Parameters
    ----------
    function : callable
        Takes `int` (addresses of arrays too) and `float`, and returns nothing; see
        `compiler.compile_entry`.
    """

    def __init__(self, function: Callable[Parameters, None]) -> None:
        self._function = compiled(function)
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._loaded: Callable[..., None] | None = function if INTERPRETED else None
        update_wrapper(self, function)

    def __call__(self, *args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        """Call it."""
        if self._loaded is None:
            self._loaded = self._load(self.code())
        self._loaded(*args, **kwargs)

    def prepare(self) -> None:
        """Load or compile it before it is called."""
        self._loaded = self._loaded or self._load(self.code())

    def interpret(self) -> None:
        """Run it as Python until `take`, unless it is loaded; that is much slower."""
        self._loaded = self._loaded or self._run_as_python

    def take(self, code: MachineCode) -> None:
        """Load machine code that another process has got by `code`."""
        self._loaded = self._load(code)

    @property
    def is_kept(self) -> bool:
        """Whether its machine code is cached, or not needed."""
        if INTERPRETED:
            return True
        return kept_code(self._name, digest_of(self._function)) is not None

    def code(self) -> MachineCode:
        """Read its machine code from the cache, or compile it and cache it.

        Raises
        ------
        NotCompiledError
            If it is not there and `nothing_compiled` holds.
        """
        name, digest = self._name, digest_of(self._function)
        code = kept_code(name, digest)
        if code is None:
            if not _may_compile:
                raise NotCompiledError(f"{name} is not compiled yet")
            with compiling(name):
                code = kept_code(name, digest) or self._compile(name, digest)
        return code

    def _compile(self, name: str, digest: str) -> MachineCode:
        # Imported late, here and below: numba takes 60 MB.
        from gateway.compiled.compiler import compile_entry

        tell_of_compiling()
        code = compile_entry(self._function)
        keep_code(name, digest, code)
        return code

    def _load(self, code: MachineCode) -> Callable[..., None]:
        parameters = signature(self._function).parameters.values()
        prototype = ctypes.PYFUNCTYPE(None, *(C_TYPES[p.annotation] for p in parameters))
        return prototype(load_code(code))

    def _run_as_python(self, *args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        # Python raises where machine code goes on with NaN. Then the rest of the call is left out:
        # no number of a sensor may stop the telemetry.
        with suppress(ArithmeticError, ValueError):
            self._function(*args, **kwargs)


class _Dispatched(Generic[Parameters, Result]):
    """A function that numba compiles at its first call."""

    def __init__(self, function: Callable[Parameters, Result]) -> None:
        self._function = compiled(function)
        self._dispatcher: Callable[..., Result] | None = function if INTERPRETED else None
        update_wrapper(self, function)

    def __call__(self, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if self._dispatcher is None:
            if not _may_compile:
                raise NotCompiledError(f"{self._function.__qualname__} is for recordings")
            from gateway.compiled.compiler import compile_dispatcher

            self._dispatcher = compile_dispatcher(self._function)
        return self._dispatcher(*args, **kwargs)


def dispatched(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function when Python calls it, for loops over whole recordings.

    Only Python can call the result; compiled code calls functions marked by `compiled`.

    Parameters
    ----------
    function : callable
        In numba's nopython subset; takes arrays and records as they are.
    """
    return _Dispatched(function)
