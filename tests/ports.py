"""Ports of this machine that are free, and stay free until a test uses them."""

import itertools
import os
import random
import socket

FIRST, PER_WORKER, WORKERS = 20_000, 1_500, 8
"""Below what the kernel gives to whoever asks for any port: no other socket gets one by chance."""

_worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % WORKERS
_numbers = itertools.count(random.SystemRandom().randrange(PER_WORKER))


def free_ports(count: int) -> list[int]:
    """Return ports that nobody uses over UDP or TCP; each worker of the tests has its own."""
    found: list[int] = []
    while len(found) < count:
        port = FIRST + _worker * PER_WORKER + next(_numbers) % PER_WORKER
        if _is_free(port):
            found.append(port)
    return found


def free_port() -> int:
    """Return one port that nobody uses."""
    return free_ports(1)[0]


def _is_free(port: int) -> bool:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
        with socket.socket(socket.AF_INET, kind) as sock:
            try:
                sock.bind(("127.0.0.1", port))
            except OSError:
                return False
    return True
