"""Admission of the panel's clients: slots for their sessions, connections, pages and exports.

All resources of clients are bounded by the same rule. Each role has separate slots, so no viewer,
and no client without a login, takes a slot from an operator. Within a role, a session and an
address may hold a part of the slots; beyond that, a new item replaces the oldest one of its own
session or address, or else of the address with the most slots.
"""

import ipaddress
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Generic, NamedTuple, TypeVar

IPV6_PREFIX: Final = 64
"""Prefix length of the network that one IPv6 subscriber usually gets."""

Item = TypeVar("Item")


class Role(StrEnum):
    """Role of a page's user."""

    OPERATOR = "operator"
    VIEWER = "viewer"


class Holder(NamedTuple):
    """A client that holds slots."""

    role: Role | None
    """None before the login."""
    session: str
    """Token of the session; empty for none, as without passwords."""
    address: str
    """Key of its address, from `address_group`."""


LOCAL: Final = Holder(Role.OPERATOR, "", "")
"""The user of this machine."""


@dataclass(slots=True)
class Slots(Generic[Item]):
    """Slots for one kind of items, with their holders; see the rule in the module's docstring."""

    of_session: int
    of_address: int
    of_role: int
    evict: Callable[[Item], object] | None = None
    """Ends an item that is replaced; None if new items wait for a free slot instead."""
    _held: dict[Item, Holder] = field(default_factory=dict)
    """Holders by item, oldest item first."""

    def admit(self, item: Item, holder: Holder) -> bool:
        """Add an item; return False, without adding it, if there is no slot for it."""
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
        """Free the slot of an item; return its holder, None if it had no slot."""
        return self._held.pop(item, None)

    def holder(self, item: Item) -> Holder | None:
        """Return the holder of an item."""
        return self._held.get(item)


def address_group(host: str) -> str:
    """Return the key of the limit of an address: the address, or the network of an IPv6 one."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, IPV6_PREFIX), strict=False))
