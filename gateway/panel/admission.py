"""Admission of the panel's clients: places for their sessions, connections, pages and exports.

Everything that a client may hold is bounded by the same rule. Each role has places of its own, so
no viewer, and nobody without a login, takes a place from an operator. Within a role, a session and
an address may hold a part of them; beyond that, a newcomer takes the oldest place of its own
session or address, or else of the address that holds most.
"""

import ipaddress
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Generic, NamedTuple, TypeVar

IPV6_PREFIX: Final = 64
"""Bits of the network that one IPv6 subscriber usually gets."""

Item = TypeVar("Item")


class Role(StrEnum):
    """Role of a page's user."""

    OPERATOR = "operator"
    VIEWER = "viewer"


class Holder(NamedTuple):
    """A client that holds something."""

    role: Role | None
    """None before the login."""
    session: str
    """Token of the session; empty for none, as without passwords."""
    address: str
    """As by `address_group`."""


LOCAL: Final = Holder(Role.OPERATOR, "", "")
"""The user of this machine."""


@dataclass(slots=True)
class Places(Generic[Item]):
    """Items of one kind by their holders; see the theory of operation above."""

    of_session: int
    of_address: int
    of_role: int
    evict: Callable[[Item], object] | None = None
    """Ends an item that must make room; None if newcomers wait for room instead."""
    _held: dict[Item, Holder] = field(default_factory=dict)
    """Oldest first."""

    def admit(self, item: Item, holder: Holder) -> bool:
        """Add an item; return False, and do not add it, if there is no room for it."""
        self._held.pop(item, None)
        rules: list[tuple[int, Callable[[Holder], bool]]] = [
            (self.of_address, lambda held: held.address == holder.address),
            (self.of_role, lambda _: True),
        ]
        if holder.session:
            rules.insert(0, (self.of_session, lambda held: held.session == holder.session))
        for limit, is_counted in rules:
            found = [
                (each, held.address)
                for each, held in self._held.items()
                if held.role is holder.role and is_counted(held)
            ]
            if len(found) < limit:
                continue
            if self.evict is None:
                return False
            crowded = Counter(address for _, address in found).most_common(1)[0][0]
            oldest = next(each for each, address in found if address == crowded)
            self.release(oldest)
            self.evict(oldest)
        self._held[item] = holder
        return True

    def release(self, item: Item) -> Holder | None:
        """Give a place back; return its holder, None if it had no place."""
        return self._held.pop(item, None)

    def holder(self, item: Item) -> Holder | None:
        """Return the holder of a place."""
        return self._held.get(item)

    def items(self) -> list[Item]:
        """Return all items, oldest first."""
        return [*self._held]


def address_group(host: str) -> str:
    """Return the key by which an address is limited: itself, or the network of an IPv6 one."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, IPV6_PREFIX), strict=False))
