"""Numeric functions that machine code is compiled from; called from Python they run as Python.

A function marked by `compiled` is in numba's nopython subset. `tools/build_kernels.py` compiles the
entry points (see `entry_point`) and all functions that they call into one library. Compiled code is
strict IEEE 754 and gives the same bits everywhere; Python gives the same except for some units in
the last place, because its powers and `hypot` are rounded differently.
"""

import ctypes
from collections.abc import Callable
from functools import cache, lru_cache
from math import prod
from types import FunctionType
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
