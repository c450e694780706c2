"""Sockets that do not block: opening them, and accepting connections."""

import asyncio
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Receive buffer of a socket: the default holds only some 256 small datagrams; a parameter upload
sends more at once."""
ACCEPT_AGAIN_S: Final = 1.0
"""Delay after which a failed accept is repeated, s."""


@contextmanager
def new_socket(family: int, kind: int) -> Iterator[socket.socket]:
    """Yield a non-blocking socket; it is closed if the `with` block raises."""
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        yield sock
    except BaseException:
        sock.close()
        raise


def bound_socket(address: tuple[str, int], *, shared: bool) -> socket.socket:
    """Open a datagram socket on an address; `shared` if one is bound there already."""
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    with new_socket(family, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if shared:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        sock.bind(address)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        return sock


def accept_each(
    sock: socket.socket,
    admit: Callable[[socket.socket, Any], None],
    report: Callable[[OSError | None], None],
) -> None:
    """Accept the connections of a socket until it is closed; needs a running event loop.

    Without free file descriptors a waiting connection would wake the loop for ever, so the socket
    is then not watched for `ACCEPT_AGAIN_S`.

    Parameters
    ----------
    sock : socket
        Listens, and does not block. Remove it from the loop's readers before it is closed.
    admit : callable
        Takes each connection and its peer's address. One at a wake-up, since to admit one takes as
        long as to serve the others several times.
    report : callable
        Called with the error when connections begin to wait, and with None when they no longer do.
    """
    loop = asyncio.get_running_loop()
    waiting = False

    def watch() -> None:
        if sock.fileno() >= 0:
            loop.add_reader(sock, accept)

    def accept() -> None:
        nonlocal waiting
        try:
            connection, address = sock.accept()
        except BlockingIOError:
            return
        except OSError as error:
            loop.remove_reader(sock)
            loop.call_later(ACCEPT_AGAIN_S, watch)
            if not waiting:
                waiting = True
                report(error)
            return
        if waiting:
            waiting = False
            report(None)
        admit(connection, address)

    watch()
