"""The one place where numba enters: a typed, cached, strict-IEEE `njit`."""

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import IndexDataCacheFile

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
    if hasattr(dispatcher, "_cache"):
        dispatcher._cache._cache_file.__class__ = _FileBySignature  # noqa: SLF001
    return cast(Function, dispatcher)
