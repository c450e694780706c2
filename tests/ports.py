"""Ports of this machine that are free, and stay free until a test uses them."""

import itertools
import random
import socket
from contextlib import suppress
from functools import cache

FIRST, PER_PROCESS, PROCESSES = 20_000, 200, 60
"""Below what the kernel gives to whoever asks for any port: no other socket gets one by chance."""

_numbers = itertools.count(random.SystemRandom().randrange(PER_PROCESS))


@cache
def _first_port() -> int:
    """Reserve ports for this process: no other run of the tests uses one, not even a closed one."""
    lock = socket.socket(socket.AF_UNIX)
    for number in range(PROCESSES):
        with suppress(OSError):
            # It ends with the process.
            lock.bind(f"\0mavgate-test-ports-{number}")
            lock.detach()
            return FIRST + number * PER_PROCESS
    raise AssertionError(f"{PROCESSES} processes run tests on this machine")


def free_ports(count: int) -> list[int]:
    """Return ports that nobody uses over UDP or TCP."""
    found: list[int] = []
    while len(found) < count:
        port = _first_port() + next(_numbers) % PER_PROCESS
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
