"""Hosts: how to classify them, and whose pages may open a WebSocket.

Pages of this machine may, and those of origins that the operator allows.

A browser lets any page of any site connect to any port, this machine's own included, and sends the
server only the page's origin (RFC 6454, RFC 6455 section 10.2). Programs that are not browsers
send none and are treated like TCP clients.
"""

import ipaddress
import re
from collections.abc import Collection
from typing import Final
from urllib.parse import urlsplit

_HOST: Final = re.compile(r"[\w.-]+")
NULL_ORIGIN: Final = "null"
"""The origin that a browser sends for a page opened as a file, and for any sandboxed page."""


def admits_page(origin: str, local_host: str, named: Collection[str]) -> bool:
    """Return whether a page may connect.

    Parameters
    ----------
    origin : str
        As the browser sends it, such as `http://localhost:8080`.
    local_host : str
        Address of ours that the browser connected to. A page from there is of this machine too;
        the host name that the browser used proves nothing.
    named : collection of str
        Origins that are allowed in addition to those of this machine, in lower case.

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


def names_loopback(host_header: str) -> bool:
    """Return whether a request's `Host` is loopback: a page of elsewhere, rebound to it, is not."""
    try:
        return is_loopback(urlsplit(f"//{host_header.strip()}").hostname or "")
    except ValueError:
        return False


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def is_name(host: str) -> bool:
    """Return whether the resolver would accept a host; it raises for every one that it does not."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    # A mistyped IPv4 address is no name either.
    return _HOST.fullmatch(host) is not None and not host.replace(".", "").isdecimal()


def is_numeric(host: str) -> bool:
    """Return whether a host is an address and not a name."""
    return _address(host) is not None


def is_group(host: str) -> bool:
    """Return whether a host is the address of a multicast group."""
    return is_numeric(host) and ipaddress.ip_address(host.partition("%")[0]).is_multicast


def is_loopback(host: str) -> bool:
    """Return whether an address is loopback; of the names only `localhost` is."""
    if host == "localhost":
        return True
    address = _address(host)
    return address is not None and address.is_loopback
