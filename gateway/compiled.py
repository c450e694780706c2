"""The one place where numba enters: a typed, cached, strict-IEEE `njit`, and records by address."""

import ctypes
import hashlib
from collections.abc import Callable, Iterator
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.core.caching import IndexDataCacheFile
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., object])


class _FileBySignature(IndexDataCacheFile):
    """Names a file of machine code by the types that it was compiled for.

    Numba numbers the files of a function. Two processes that compile it for different types at the
    same time may take the same number, and ever after one would run the other's code.
    """

    def save(self: Any, key: object, data: object) -> None:
        """Keep the machine code of one signature."""
        digest = hashlib.sha256(repr(key).encode()).digest()
        name = self._data_name(int.from_bytes(digest[:8]))
        self._save_index({**self._load_index(), key: name})
        self._save_data(name, data)


def _files(dispatcher: object) -> Any:
    """Find where numba keeps a function's machine code; None without a compiler."""
    return getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)


def is_kept(function: Callable[..., object]) -> bool:
    """Return whether machine code of the present source is kept; also where none is ever made."""
    files = _files(function)
    return files is None or bool(files._load_index())  # noqa: SLF001


def _borrowed(names: dict[str, Any]) -> Iterator[tuple[str, object]]:
    """Return what machine code may hold of other files: their constants, and what they compile."""
    for name, value in names.items():
        if isinstance(value, ModuleType):
            # What is private may be an address, which is another one in every process.
            public = ((n, v) for n, v in vars(value).items() if not n.startswith("_"))
            yield from ((n, v) for n, v in public if isinstance(v, int | float))
        elif isinstance(value, int | float | tuple | np.dtype):
            yield (name, value)
        elif isinstance(files := _files(value), _FileBySignature):
            yield (name, files._source_stamp)  # noqa: SLF001


def compiled(function: Function) -> Function:
    """Compile a numeric function to machine code on its first call.

    The code is cached beside the source (or in the user's cache directory where that is not
    writable), so only the first start after an upgrade pays for the compiler. `fastmath` stays
    off: a log that is fused offline must give bit for bit what it gave live.

    Parameters
    ----------
    function : callable
        A function in numba's nopython subset.

    Returns
    -------
    callable
        The dispatcher, typed as the function it stands for.
    """
    dispatcher: Any = numba.njit(cache=True, fastmath=False, error_model="numpy")(function)
    if (files := _files(dispatcher)) is not None:
        files.__class__ = _FileBySignature
        # Numba looks at the function's own file only, whatever else the machine code is made of;
        # what comes from other files is imported before.
        made_of = (files._source_stamp, *_borrowed(function.__globals__))  # noqa: SLF001
        files._source_stamp = hashlib.sha256(repr(made_of).encode()).hexdigest()  # noqa: SLF001
    return cast(Function, dispatcher)


def compiled_with(template: Function, names: dict[str, object], mark: str) -> Function:
    """Compile a copy of a function in which names stand for something else.

    Parameters
    ----------
    template : callable
        A function in numba's nopython subset, not yet compiled.
    names : dict
        What they stand for: constants and compiled functions.
    mark : str
        Tells this copy's machine code from that of others; no two copies share one.

    Returns
    -------
    callable
        As from `compiled`.
    """
    source = cast(FunctionType, template)
    copy = FunctionType(source.__code__, {**source.__globals__, **names}, source.__name__)
    copy.__qualname__, copy.__doc__ = f"{source.__qualname__}_{mark}", source.__doc__
    return cast(Function, compiled(copy))


def _make_pointer(_: Any, _address: Any) -> Any:
    """Take an integer for the address that it is."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), generate


_pointer_to: Any = intrinsic(_make_pointer)


def _record_at(address: int, layout: Any) -> Any:
    """Read the record at an address, without a copy; for compiled functions alone.

    Numba's dispatcher describes every field of a record anew on each call, which takes several
    times as long as the work; an integer costs it nothing.

    Parameters
    ----------
    address : int
        From `address_of`; the caller keeps that record alive.
    layout : numpy.dtype
        Of the record; a constant of the caller's module.
    """
    return carray(_pointer_to(address), 1, layout)[0]


def _record_without_compiler(address: int, layout: Any) -> Any:
    memory = (ctypes.c_char * layout.itemsize).from_address(address)
    return np.frombuffer(memory, layout)[0]


record_at = compiled(_record_at)
if record_at is _record_at:
    # Numba was told not to compile.
    record_at = _record_without_compiler


def address_of(record: object) -> int:
    """Return where a record lies in memory; it stays there as long as the record lives."""
    address: int = cast(Any, record).__array_interface__["data"][0]
    return address
