"""Hosts: what they are, and whose pages may open a WebSocket.

Those of this machine may, and those that the operator names.

A browser lets any page of any site connect to any port, this machine's own included, and tells
the server only whose page it is (RFC 6454, RFC 6455 section 10.2). Programs that are no browsers
tell nothing and are judged like those that come by TCP.
"""

import ipaddress
import re
from collections.abc import Collection
from typing import Final
from urllib.parse import urlsplit

_HOST: Final = re.compile(r"[\w.-]+")
NULL_ORIGIN: Final = "null"
"""What a browser tells of a page that was opened as a file, and of any page in a sandbox."""


def admits_page(origin: str, local_host: str, named: Collection[str]) -> bool:
    """Return whether a page may connect.

    Parameters
    ----------
    origin : str
        As the browser tells it, such as `http://localhost:8080`.
    local_host : str
        Address of ours that the browser connected to. A page from there is of this machine too;
        what the browser believes to be our name proves nothing.
    named : collection of str
        Origins that are allowed beside those of this machine, in lower case.

    Returns
    -------
    bool
        Whether it may.
    """
    if origin.lower() in named:
        return True
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
    except ValueError:
        return False
    if parts.scheme not in {"http", "https"}:
        return False
    if host == "localhost" or host.endswith(".localhost"):
        return True
    address = _address(host)
    return address is not None and (address.is_loopback or address == _address(local_host))


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def is_name(host: str) -> bool:
    """Return whether the resolver would take it; one that does not raises each time it is asked."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    # Four numbers with a slip of the hand are no name either.
    return _HOST.fullmatch(host) is not None and not host.replace(".", "").isdecimal()


def is_numeric(host: str) -> bool:
    """Return whether a host is an address and not a name."""
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def is_group(host: str) -> bool:
    """Return whether a host is the address of a multicast group."""
    return is_numeric(host) and ipaddress.ip_address(host.partition("%")[0]).is_multicast


def is_loopback(host: str) -> bool:
    """Return whether an address is one of this machine alone; a name is none but `localhost`."""
    if host == "localhost":
        return True
    if not is_numeric(host):
        return False
    address = ipaddress.ip_address(host.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
