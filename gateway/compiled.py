"""The one place where numba enters: a typed, cached, strict-IEEE `njit`."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


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
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
