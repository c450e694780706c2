"""Numeric functions that are compiled to machine code; called from Python they run as Python.

A function marked by `compiled` is in numba's nopython subset. `tools/build_kernels.py` compiles the
entry points (see `entry_point`) and all functions that they call into one library. Compiled code is
strict IEEE 754 and gives the same bits everywhere; Python gives the same except for some units in
the last place, because its powers and `hypot` are rounded differently.
"""

import ctypes
from collections.abc import Callable
from math import prod
from types import FunctionType
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

Function = TypeVar("Function", bound=Callable[..., object])
Record = TypeVar("Record")

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

    The caller must keep that memory alive. `kind` is the numpy.dtype of the items, in compiled code
    a constant of its module.
    """
    memory = (ctypes.c_char * (prod(shape) * kind.itemsize)).from_address(int(address))
    return np.frombuffer(memory, kind).reshape(shape)


def record_at(address: int, layout: Any) -> Any:
    """View the record at an address, without a copy; its fields are attributes.

    The caller must keep that record alive. `layout` is a numpy.dtype with fields `f8`, `i8` or
    arrays of `f8`, in compiled code a constant of its module.
    """
    memory = (ctypes.c_char * layout.itemsize).from_address(int(address))
    return np.frombuffer(memory, layout)[0]


def shared(declaration: type[Record]) -> type[Record]:
    """Make a class of annotated fields a record in memory that Python and compiled code use.

    The annotations are `int` or `Annotated[Any, length]`. Python reads and writes the fields of a
    `ctypes.Structure`, several times faster than those of a record of numpy.
    """
    hints = get_type_hints(declaration, include_extras=True).items()
    words = ctypes.c_int64
    fields = [(name, words if hint is int else words * get_args(hint)[1]) for name, hint in hints]
    return type(declaration.__name__, (declaration, ctypes.Structure), {"_fields_": fields})


def layout_of(record: Any) -> Any:
    """Return the numpy.dtype of a class made by `shared`, for `record_at` and `array_at`."""
    return np.dtype((np.record, np.dtype(record)))


def address_of(array: Any) -> int:
    """Return the memory address of an array or a record, valid as long as the object exists."""
    # Not by `__array_interface__`: describing each field of a record takes longer than a sample.
    address: int = np.frombuffer(array, np.uint8).ctypes.data
    return address
