"""Numeric functions that machine code is compiled from; called from Python they run as Python.

A function marked by `compiled` is in numba's nopython subset. The machine code of an entry point
(see `entry_point`) contains all the functions that it calls. Compiled code is strict IEEE 754 and
gives the same bits everywhere; Python gives the same to some units in the last place, because its
powers and `hypot` are rounded otherwise.
"""

import ctypes
import hashlib
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from math import prod
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numpy as np

Function = TypeVar("Function", bound=Callable[..., object])

MOST_DIMENSIONS: Final = 2
"""Of a memoryview, which gives no part of one with more."""

_MARKED: set[Callable[..., object]] = set()


def compiled(function: Function) -> Function:
    """Mark a function that compiled code may call.

    Parameters
    ----------
    function : callable
        In numba's nopython subset.

    Returns
    -------
    callable
        The same.
    """
    _MARKED.add(function)
    return function


def is_compiled(function: object) -> bool:
    """Return whether compiled code may call a function."""
    return isinstance(function, FunctionType) and function in _MARKED


def compiled_with(template: Function, names: dict[str, object], mark: str) -> Function:
    """Copy a function with other values for some of its global names.

    Parameters
    ----------
    template : callable
        In numba's nopython subset.
    names : dict
        Their values: constants and compiled functions.
    mark : str
        Suffix of the copy's name.

    Returns
    -------
    callable
        As from `compiled`.
    """
    source = cast(FunctionType, template)
    copy = FunctionType(source.__code__, {**source.__globals__, **names}, source.__name__)
    copy.__qualname__, copy.__doc__ = f"{source.__qualname__}_{mark}", source.__doc__
    copy.__annotations__ = source.__annotations__
    return cast(Function, compiled(copy))


def digest_of(function: Callable[..., object]) -> str:
    """Return a digest of everything that the machine code of a function is compiled from.

    It covers the bytecode of the function and of all compiled functions that it calls, directly or
    not, and the global constants that these use. Comments and line numbers do not change it.
    """
    digest, found = hashlib.sha256(), [cast(FunctionType, function)]
    for one in found:
        for code in _codes(one.__code__):
            constants = [c for c in code.co_consts if not isinstance(c, CodeType)]
            digest.update(repr((code.co_name, code.co_code, constants, code.co_names)).encode())
        for name, value in _globals_of(one):
            if is_compiled(value):
                value = cast(FunctionType, value)
                if value not in found:
                    found.append(value)
                value = found.index(value)
            digest.update(f"{name} {value}\n".encode())
    return digest.hexdigest()


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _globals_of(function: FunctionType) -> Iterator[tuple[str, object]]:
    """Yield the global constants and compiled functions that a function uses."""
    for code in _codes(function.__code__):
        for name in code.co_names:
            value = function.__globals__.get(name)
            if isinstance(value, ModuleType):
                yield from ((n, v) for n, v in _taken_from(value, code) if _is_fixed(v))
            elif _is_fixed(value):
                yield name, value


def _taken_from(module: ModuleType, code: CodeType) -> Iterator[tuple[str, object]]:
    yield from ((name, getattr(module, name, None)) for name in code.co_names)


def _is_fixed(value: object) -> bool:
    return isinstance(value, int | float | tuple | np.dtype) or is_compiled(value)


def array_at(address: int, shape: tuple[int, ...], kind: Any) -> Any:
    """View the memory at an address as an array, without a copy.

    Parameters
    ----------
    address : int
        From `address_of`; the caller keeps that memory alive.
    shape : tuple of int
        Of the array, which is contiguous.
    kind : numpy.dtype
        Of its items; in compiled code a constant of its module.

    Returns
    -------
    memoryview or ndarray
        In Python a memoryview if the array has one dimension or two: it gives plain numbers, which
        Python reckons with five times faster than with numpy's. But it has no row of a matrix, and
        no way to fill a slice.
    """
    memory = (ctypes.c_char * (prod(shape) * kind.itemsize)).from_address(address)
    array: Any = np.frombuffer(memory, kind).reshape(shape)
    return memoryview(array) if len(shape) <= MOST_DIMENSIONS else array


def record_at(address: int, layout: Any) -> Any:
    """Read the record at an address, without a copy.

    Parameters
    ----------
    address : int
        From `address_of`; the caller keeps that record alive.
    layout : numpy.dtype
        Of the record, whose fields are `f8`, `i8` or arrays of `f8`; in compiled code a constant of
        its module.

    Returns
    -------
    object
        With the fields as attributes: plain numbers and what `array_at` gives.
    """
    return _record_at(address, layout)


@lru_cache(maxsize=64)
def _record_at(address: int, layout: Any) -> Any:
    record = _numbers_of(layout).from_address(address)
    for name in layout.names:
        kind, offset = layout.fields[name][:2]
        if kind.shape:
            setattr(record, name, array_at(address + offset, kind.shape, kind.base))
    return record


@cache
def _numbers_of(layout: Any) -> type[ctypes.Structure]:
    """Make a class with the numbers of a layout as attributes; arrays are only skipped."""
    fields: list[tuple[str, Any]] = []
    for name in layout.names:
        kind = layout.fields[name][0]
        number = ctypes.c_double if kind.base.kind == "f" else ctypes.c_int64
        fields.append((f"_{name}", number * prod(kind.shape)) if kind.shape else (name, number))
    return type("Record", (ctypes.Structure,), {"_fields_": fields})


def address_of(array: Any) -> int:
    """Return where an array or a record lies in memory; valid as long as the object lives."""
    # Not by `__array_interface__`: to describe each field of a record takes longer than a sample.
    address: int = np.frombuffer(array, np.uint8).ctypes.data
    return address
