"""State and gains of a kernel as one flat numpy record, declared once as a typed class.

A kernel's state is read as `s.q_ib[0]`, copied as bytes and passed between live and offline runs
without conversion. The declaration is a class that is never instantiated: mypy checks each access
with it, while the memory is a plain structured scalar whose fields numba compiles.
"""

import zlib
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import compiled
from gateway.records import Quat, Vec3

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

Declared = TypeVar("Declared")
Packed = tuple[int, bytes]
"""A checksum of the layout, and the bytes of a record."""


def layout(declaration: type) -> np.dtype[np.void]:
    """Derive the memory layout: one 8-byte aligned field per annotation of a class, in order.

    The annotations are `float`, `int` or `Annotated[FloatArray, shape]`.
    """
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for name, hint in get_type_hints(declaration, include_extras=True).items():
        if hint is float:
            fields.append((name, "f8", ()))
        elif hint is int:
            fields.append((name, "i8", ()))
        else:
            fields.append((name, "f8", get_args(hint)[1]))
    # With `np.record` Python can read the fields as attributes, too.
    return np.dtype((np.record, fields))


def new_record(declaration: type[Declared]) -> Declared:
    """Make a record of zeros."""
    return cast(Declared, np.zeros(1, layout(declaration))[0])


def filled_record(declaration: type[Declared], values: dict[str, Any]) -> Declared:
    """Make a record of values by field name; KeyError for a missing one, others are ignored."""
    record = new_record(declaration)
    for name in layout(declaration).names or ():
        setattr(record, name, values[name])
    return record


def copy_record(record: Declared) -> Declared:
    """Copy a record, to return or restore a state."""
    return cast(Declared, cast(np.void, record).copy())


def pack_record(record: object) -> Packed:
    """Write a record of any declaration as bytes."""
    void = cast(np.void, record)
    return (_mark(void.dtype), void.tobytes())


def unpack_record(declaration: type[Declared], packed: Packed) -> Declared:
    """Read a packed record; raises ValueError if it is of another declaration or damaged."""
    wanted, (mark, data) = layout(declaration), packed
    if mark != _mark(wanted) or len(data) != wanted.itemsize:
        raise ValueError("a state of another layout")
    return cast(Declared, np.frombuffer(data, wanted, 1)[0].copy())


@cache
def _mark(wanted: np.dtype[Any]) -> int:
    return zlib.crc32(repr(wanted.descr).encode())


@compiled
def as_quat(q: FloatArray) -> Quat:
    """Read four numbers of a record."""
    return (q[0], q[1], q[2], q[3])


@compiled
def as_vec(v: FloatArray) -> Vec3:
    """Read three numbers of a record."""
    return (v[0], v[1], v[2])


@compiled
def write_vec(target: FloatArray, values: Vec3) -> None:
    """Write three numbers of a record."""
    target[0], target[1], target[2] = values


@compiled
def write_quat(target: FloatArray, values: Quat) -> None:
    """Write four numbers of a record."""
    target[0], target[1], target[2], target[3] = values
