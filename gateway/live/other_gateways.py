"""The gateways, players and fleets of this machine, with the vehicles and clients of each.

Two programs that send the same system id to one ground station show one vehicle that jumps.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from gateway.live.control_socket import ControlError, Verbs, all_sockets, request
from gateway.printable import UNKNOWN

log = logging.getLogger(__name__)

ANSWER_S: Final = 1.0
"""Timeout of an answer: a suspended gateway must not delay the start of another."""


class Gateway(msgspec.Struct, frozen=True):
    """A running gateway, player or fleet; without a process id if it does not answer us."""

    socket: str
    pid: int | None = None
    since_s: float = 0.0
    """Civil time of its start, s since 1970."""
    systems: tuple[int, ...] = ()
    """System ids of the vehicles that it sends."""
    endpoints: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """`run` (or `demo`), `play` or `fleet`."""
        return Path(self.socket).stem.partition("-")[0]

    @property
    def since(self) -> str:
        """Civil time of its start."""
        if not self.since_s:
            return UNKNOWN
        return f"{datetime.fromtimestamp(self.since_s, UTC):%Y-%m-%d %H:%M:%S} UTC"

    def __str__(self) -> str:
        """Return process, start and socket."""
        if self.pid is None:
            return f"socket {self.socket}, which does not answer this user"
        return f"pid {self.pid}, since {self.since}, socket {self.socket}"


def identity_verb(
    systems: Callable[[], Iterable[int]], endpoints: Callable[[], Iterable[str]]
) -> Verbs:
    """Return the handler of `identity`, of a process that starts now."""
    since_s = time.time()

    def identity() -> dict[str, Any]:
        sent = {"systems": sorted(systems()), "endpoints": list(endpoints())}
        return {"pid": os.getpid(), "since_s": since_s} | sent

    return {"identity": identity}


def other_gateways() -> list[Gateway]:
    """Ask all gateways, players and fleets of this user, and the service, but not this process."""
    found = []
    for path in all_sockets():
        try:
            known = request(path, "identity", timeout_s=ANSWER_S)
        except ControlError:
            known = {}
        found.append(msgspec.convert({**known, "socket": str(path)}, Gateway))
    return [one for one in found if one.pid != os.getpid()]


def log_other_gateways() -> None:
    """Log the other gateways at the start; `conflicts` with them are warned of."""
    for other in other_gateways():
        # No fault: a fleet on one machine is two gateways. `conflicts` are warned of.
        log.info("another gateway runs here: %s", other)


def conflicts(systems: Collection[int], endpoints: Iterable[str]) -> list[str]:
    """Describe each vehicle id that another gateway sends to one of these endpoints."""
    own = {_target(url) for url in endpoints}
    found = []
    for other in other_gateways():
        for url in other.endpoints:
            if _target(url) in own and (both := sorted({*systems} & {*other.systems})):
                ids = ", ".join(map(str, both))
                text = f"vehicle {ids} is sent to {url} by another gateway already ({other})"
                found.append(text)
    return found


def _target(url: str) -> tuple[str, str, int]:
    # Imported here: `mavgate status` needs no endpoints.
    from gateway.hub.endpoint import is_loopback, parse_endpoint

    endpoint = parse_endpoint(url)
    host = "localhost" if is_loopback(endpoint.host) else endpoint.host
    return endpoint.kind, host, endpoint.port
