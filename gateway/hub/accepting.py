"""Connections of a listening socket, also while there are no file descriptors for them."""

import asyncio
import socket
from collections.abc import Callable
from typing import Any, Final

ACCEPT_AGAIN_S: Final = 1.0
"""After which a connection is accepted that could not be."""


def accept_each(
    sock: socket.socket,
    admit: Callable[[socket.socket, Any], None],
    report: Callable[[OSError | None], None],
) -> None:
    """Accept the connections of a socket until it is closed; needs a running event loop.

    While there are no file descriptors left, a waiting connection would wake the loop for ever, so
    the socket is left alone meanwhile.

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
