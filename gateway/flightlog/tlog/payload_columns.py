"""The fields of many frames at once, straight from the bytes of a recording."""

from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.flightlog.tlog.tlog import Batch
from gateway.flightlog.tlog.tlog_scan import TIME_SIZE, IntArray
from gateway.wire.mavlink_splitter import START_V2

HEAD_V1: Final = 6
HEAD_V2: Final = 10
LENGTH_AT: Final = 1


@cache
def layout_of(kind: Any) -> np.dtype[np.void]:
    """Return a message's fields as they lie in its payload.

    Parameters
    ----------
    kind : type
        pymavlink's class of the message.

    Returns
    -------
    dtype
        A field of it by each name; texts are bytes up to their first NUL at the latest.
    """
    fields = []
    for name, code, length in zip(
        kind.ordered_fieldnames, kind.native_format[1:], kind.array_lengths, strict=True
    ):
        if chr(code) == "c":
            fields.append((name, f"S{max(1, length)}"))
        else:
            fields.append((name, f"({length},)<{chr(code)}" if length else f"<{chr(code)}"))
    return np.dtype(fields)


def columns_of(batch: Batch, wanted: IntArray, kind: Any) -> NDArray[np.void]:
    """Read the fields of some frames of one message.

    Parameters
    ----------
    batch : Batch
        Records of a tlog.
    wanted : ndarray of int, shape (n,)
        Numbers of those that are this message.
    kind : type
        pymavlink's class of the message.

    Returns
    -------
    ndarray, shape (n,)
        See `layout_of`; what a sender cut off or did not know is zero.
    """
    layout = layout_of(kind)
    data = np.frombuffer(batch.data, np.uint8)
    starts = batch.starts[wanted] + TIME_SIZE
    begins = starts + np.where(data[starts] == START_V2, HEAD_V2, HEAD_V1)
    places = np.arange(layout.itemsize)
    is_there = places < data[starts + LENGTH_AT][:, None]
    payloads = np.zeros((len(wanted), layout.itemsize), np.uint8)
    payloads[is_there] = data[(begins[:, None] + places)[is_there]]
    found: NDArray[np.void] = payloads.view(layout)[:, 0]
    return found
