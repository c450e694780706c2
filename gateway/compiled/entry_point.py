"""Functions that Python calls as machine code, from one library that is built at installation.

`tools/build_kernels.py` makes the library of all entry points. It contains digests of the sources
that it was compiled from, which are compared when it is loaded.
"""

import ast
import ctypes
import hashlib
from collections.abc import Callable
from functools import cache, partial, update_wrapper
from inspect import signature
from pathlib import Path
from typing import Any, Final, Generic, ParamSpec

from gateway.compiled import compiled

Parameters = ParamSpec("Parameters")

ROOT: Final = Path(__file__).resolve().parents[2]
"""The folder that contains the package `gateway`."""
LIBRARY: Final = Path(__file__).with_name("kernels.so")
SOURCES_SYMBOL: Final = "mavgate_sources"
"""Name of a string in the library: the lines of `stamp_of` for each of its sources."""
BUILD_COMMAND: Final = "make kernels"
C_TYPES: Final[dict[Any, Any]] = {int: ctypes.c_int64, float: ctypes.c_double}

ENTRY_POINTS: Final[list["EntryPoint[...]"]] = []
"""All entry points of the modules imported so far."""


class LibraryError(OSError):
    """The library of compiled kernels is missing, or was compiled from other sources."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__()
        self.filename = str(path)
        self._text = (
            f"the library of compiled kernels {reason}; build it by `{BUILD_COMMAND}` in the "
            "source tree, or install mavgate again"
        )

    def __str__(self) -> str:
        """Return the reason and the remedy."""
        return self._text


class EntryPoint(Generic[Parameters]):
    """A function that is called as machine code; use it as a decorator.

    `__wrapped__` is the function itself, which runs as Python.

    Parameters
    ----------
    function : callable
        At module level, in numba's nopython subset; takes `int` (also addresses of arrays and
        records) and `float`, and returns None. It must not allocate. Its module must be listed in
        `KERNEL_MODULES` of `tools/build_kernels.py`.
    """

    def __init__(self, function: Callable[Parameters, None]) -> None:
        self._loaded: Callable[..., None] | None = None
        self._library: ctypes.PyDLL | None = None
        self.symbol = f"{function.__module__}.{function.__qualname__}"
        update_wrapper(self, compiled(function))
        ENTRY_POINTS.append(self)

    def __call__(self, *args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        """Call the function; raises LibraryError if the library cannot be used."""
        if self._loaded is None:
            self.load()
        self._loaded(*args, **kwargs)  # type: ignore[misc]

    def load(self, path: Path | None = None) -> None:
        """Load the function before it is called, from another library if a path is given.

        Raises LibraryError if the library is missing or lacks this function, or if the installed
        library was built from other sources.
        """
        library = open_checked_library() if path is None else open_library(path)
        try:
            loaded = library[self.symbol]
        except AttributeError:
            raise LibraryError(path or LIBRARY, f"lacks {self.symbol}") from None
        loaded.argtypes = [C_TYPES[p.annotation] for p in self.parameters]
        loaded.restype = None
        self._loaded, self._library = loaded, library

    def bound(self, *arguments: int) -> Callable[[], None]:
        """Return a call with fixed integers, which are converted once, for a hot loop.

        The caller must keep alive the memory that is passed by address. Raises LibraryError like
        `load`.
        """
        if self._loaded is None:
            self.load()
        assert self._library is not None
        # A separate function without argument types, which would be converted at every call.
        function = self._library[self.symbol]
        function.restype = None
        return partial(function, *map(ctypes.c_int64, arguments))

    @property
    def parameters(self) -> list[Any]:
        """The parameters of the function, each annotated as `int` or `float`."""
        return [*signature(self.__wrapped__).parameters.values()]  # type: ignore[attr-defined]


def load_entry_points() -> None:
    """Load the entry points of all imported modules; raises LibraryError if that is impossible."""
    for entry_point in ENTRY_POINTS:
        entry_point.load()


def open_library(path: Path) -> ctypes.PyDLL:
    """Open a library of kernels; raises LibraryError if there is none."""
    try:
        # PyDLL keeps the interpreter's lock: a live step is shorter than releasing it.
        return ctypes.PyDLL(str(path))
    except OSError as error:
        reason = f"cannot be loaded ({error})" if path.exists() else "is missing"
        raise LibraryError(path, reason) from error


@cache
def open_checked_library() -> ctypes.PyDLL:
    """Open the installed library, if it was compiled from the present sources."""
    library = open_library(LIBRARY)
    if changed := changed_source(stamp_in(library)):
        raise LibraryError(LIBRARY, f"is older than {changed}")
    return library


def stamp_in(library: ctypes.PyDLL) -> str:
    """Return the lines of `stamp_of` that a library contains."""
    text = ctypes.c_char.in_dll(library, SOURCES_SYMBOL)
    return ctypes.string_at(ctypes.addressof(text)).decode()


def changed_source(stamp: str) -> str | None:
    """Return the first source that differs from that in the stamp of a library."""
    for line in stamp.splitlines():
        name, content, code = line.split()
        path = ROOT / name
        source = path.read_bytes() if path.exists() else b""
        # Comments and docstrings do not matter, but removing them takes long.
        if _digest(source) != content and code_digest(source) != code:
            return name
    return None


def stamp_of(path: Path) -> str:
    """Return a source's path relative to `ROOT`, and digests of its content and of its code."""
    source = path.read_bytes()
    return f"{path.relative_to(ROOT).as_posix()} {_digest(source)} {code_digest(source)}"


def code_digest(source: bytes) -> str:
    """Return a digest of Python code that comments, docstrings and layout do not change."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ""
    for node in ast.walk(tree):
        for block in ("body", "orelse", "finalbody"):
            if isinstance(statements := getattr(node, block, None), list):
                setattr(node, block, [s for s in statements if not _is_text(s)])
    return _digest(ast.dump(tree).encode())


def _is_text(statement: ast.AST) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
