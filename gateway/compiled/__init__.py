"""Numeric functions that machine code is compiled from; called from Python they run as Python.

A function marked by `compiled` is in numba's nopython subset. `tools/build_kernels.py` compiles the
entry points (see `entry_point`) and all functions that they call into one library. Compiled code is
strict IEEE 754 and gives the same bits everywhere; Python gives the same except for some units in
the last digit, because its powers and `hypot` are rounded differently.
"""

import ctypes
from collections.abc import Callable
from functools import cache, lru_cache
from math import prod
from types import FunctionType
from typing import Any, Final, TypeVar

import numpy as np

Function = TypeVar("Function", bound=Callable[..., object])

MOST_DIMENSIONS: Final = 2
"""Of a memoryview, which gives no part of one with more."""

_MARKED: set[Callable[..., object]] = set()


def compiled(function: Function) -> Function:
    """Mark a function, in numba's nopython subset, that compiled code may call."""
    _MARKED.add(function)
    return function


def is_compiled(function: object) -> bool:
    """Return whether compiled code may call a function."""
    return isinstance(function, FunctionType) and function in _MARKED


def array_at(address: int, shape: tuple[int, ...], kind: Any) -> Any:
    """View the memory at an address as a contiguous array, without a copy.

    The caller keeps that memory alive. `kind` is the numpy.dtype of the items, in compiled code a
    constant of its module. Python gets a memoryview of an array of one dimension or two: it gives
    plain numbers, with which Python calculates five times faster than with numpy's. But it has no
    row of a matrix, and no way to fill a slice.
    """
    memory = (ctypes.c_char * (prod(shape) * kind.itemsize)).from_address(address)
    array: Any = np.frombuffer(memory, kind).reshape(shape)
    return memoryview(array) if len(shape) <= MOST_DIMENSIONS else array


def record_at(address: int, layout: Any) -> Any:
    """View the record at an address, without a copy; its fields are attributes.

    The caller keeps that record alive. The fields of `layout`, a numpy.dtype, are `f8`, `i8` or
    arrays of `f8`; in compiled code it is a constant of its module.
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
