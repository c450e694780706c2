"""System calls for compiled code; called from Python they use ctypes.

Each returns its result, or the negative error number. The structures are those of Linux on 64-bit
machines; addresses are integers.
"""

import ctypes
from functools import cache
from typing import Any, Final

MSG_TRUNC: Final = 0x20
"""Flag of a received datagram that was longer than its buffer."""
MSG_DONTWAIT: Final = 0x40
MSG_NOSIGNAL: Final = 0x4000
MSG_EOR: Final = 0x80
"""Flag of a stream: the next data begins another segment."""


def receive_many(file: int, headers: int, count: int) -> int:
    """Receive up to `count` datagrams into the `struct mmsghdr` at an address."""
    return _call("recvmmsg", file, headers, count, MSG_DONTWAIT, 0)


def send_many(file: int, headers: int, count: int) -> int:
    """Send up to `count` datagrams of the `struct mmsghdr` at an address."""
    return _call("sendmmsg", file, headers, count, MSG_DONTWAIT | MSG_NOSIGNAL | MSG_EOR)


def send_one(file: int, data: int, size: int) -> int:
    """Send one datagram."""
    return _call("send", file, data, size, MSG_DONTWAIT | MSG_NOSIGNAL)


def _call(name: str, file: int, address: int, *numbers: int) -> int:
    rest = map(ctypes.c_size_t, map(int, numbers))
    found: int = _library()[name](ctypes.c_int(int(file)), ctypes.c_void_p(int(address)), *rest)
    return -ctypes.get_errno() if found < 0 else found


@cache
def _library() -> Any:
    return ctypes.CDLL(None, use_errno=True)
