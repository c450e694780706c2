"""Endpoint URLs: where frames go to and come from, and what may pass.

    udp:HOST:PORT            send there; answers come back to the same socket
    udp-listen:HOST:PORT     serve every client that speaks to this port
    udp-broadcast:HOST:PORT  send to a broadcast address, hear unicast answers
    udp-multicast:GROUP:PORT send to a group and hear it
    tcp:HOST:PORT            connect, and connect again when it breaks
    tcp-listen:HOST:PORT     serve every client that connects
    serial:DEVICE:BAUD       a telemetry radio or an autopilot on a serial port

IPv6 addresses stand in brackets. Options follow as in any URL:
`?name=tablet&deny=RAW_IMU&pack=1100`.
"""

import ipaddress
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final
from urllib.parse import parse_qsl

from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS

MAX_PACK_BYTES: Final = 1100
"""Routers on the way cut or drop datagrams beyond 1120 bytes."""
MAX_PORT: Final = 65535
DEFAULT_BAUD: Final = 57600
MAX_NAME: Final = 64

NO_MESSAGES: Final = -1
"""An interval that stops a message."""


class EndpointKind(StrEnum):
    """How an endpoint reaches its peers; the word before the URL's first colon."""

    UDP = "udp"
    UDP_LISTEN = "udp-listen"
    UDP_BROADCAST = "udp-broadcast"
    UDP_MULTICAST = "udp-multicast"
    TCP = "tcp"
    TCP_LISTEN = "tcp-listen"
    SERIAL = "serial"


OPEN_TO_ALL: Final = frozenset(
    {
        EndpointKind.UDP_LISTEN,
        EndpointKind.UDP_BROADCAST,
        EndpointKind.UDP_MULTICAST,
        EndpointKind.TCP_LISTEN,
    }
)
"""Kinds whose peers nobody has named. They bind to an address; to look up a name would block."""


HOSTED: Final = frozenset(
    {EndpointKind.UDP, EndpointKind.UDP_LISTEN, EndpointKind.TCP, EndpointKind.TCP_LISTEN}
)
"""Kinds whose frames go to hosts by their addresses, one by one."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One parsed endpoint URL."""

    url: str
    kind: EndpointKind
    host: str
    """Address or name without brackets; the device of a serial port."""
    port: int
    """Port number; the baud rate of a serial port."""
    place: str
    """The URL without options; no two endpoints share one."""
    name: str
    """What the operator calls it; the place unless given."""
    allow: frozenset[int] = frozenset()
    """Only these messages pass; empty lets all pass."""
    deny: frozenset[int] = frozenset()
    interval_us: dict[int, int] = field(default_factory=dict)
    """Least time between two frames of a message, by message id."""
    pack_bytes: int = 0
    """Gather frames into datagrams of up to this size; 0 sends each on its own."""
    trusted: bool | None = None
    """Whether its clients may change state; None: loopback and configured peers may."""

    @property
    def address(self) -> str:
        """Where it is: `HOST:PORT`, or the device of a serial port."""
        serial = self.kind is EndpointKind.SERIAL
        return self.host if serial else host_and_port(self.host, self.port)

    def passes(self, message_id: int) -> bool:
        """Tell whether the lists let a message out to this endpoint."""
        return message_id not in self.deny and (not self.allow or message_id in self.allow)


def parse_endpoint(url: str) -> Endpoint:
    """Read one endpoint URL.

    Parameters
    ----------
    url : str
        As in the table above; options are `name`, `allow`, `deny` (message names or numbers,
        separated by commas), `rate` (`NAME:hertz`, separated by commas), `pack` (bytes) and
        `trusted` (yes or no).

    Returns
    -------
    Endpoint
        The parsed form.

    Raises
    ------
    ValueError
        If anything in it is not understood; the text says what is allowed.
    """
    address, _, query = url.partition("?")
    word, _, place = address.partition(":")
    if word not in set(EndpointKind):
        raise ValueError(f"endpoint {url!r}: {word!r} is none of {', '.join(EndpointKind)}")
    kind = EndpointKind(word)
    host, port = _split_place(url, kind, place)
    options = _options(url, query)
    try:
        return Endpoint(
            url=url,
            kind=kind,
            host=host,
            port=port,
            place=address,
            name=options.get("name", address)[:MAX_NAME],
            allow=_messages(options.get("allow", "")),
            deny=_messages(options.get("deny", "")),
            interval_us=_intervals(options.get("rate", "")),
            pack_bytes=_pack_bytes(options.get("pack", "0")),
            trusted=_yes_or_no(options.get("trusted")),
        )
    except ValueError as error:
        raise ValueError(f"endpoint {url!r}: {error}") from None


def host_and_port(host: object, port: object) -> str:
    """Write a place as in a URL, an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


def message_id_from(text: str) -> int:
    """Return a message id from its name or number.

    Raises
    ------
    ValueError
        If no message has that name.
    """
    if text.isdecimal():
        return int(text)
    try:
        return MESSAGE_IDS[text.upper()]
    except KeyError:
        raise ValueError(f"no MAVLink message is called {text!r}") from None


def _split_place(url: str, kind: EndpointKind, place: str) -> tuple[str, int]:
    if kind is EndpointKind.SERIAL:
        device, colon, baud = place.rpartition(":")
        if not colon:
            return place, DEFAULT_BAUD
        if not baud.isdecimal() or not int(baud):
            raise ValueError(f"endpoint {url!r}: {baud!r} is no baud rate")
        return device, int(baud)
    host, _, port = place.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    if not host or (":" in host and not bracketed):
        raise ValueError(f"endpoint {url!r}: write {kind}:HOST:PORT, an IPv6 host in [brackets]")
    if not port.isdecimal() or int(port) > MAX_PORT:
        raise ValueError(f"endpoint {url!r}: port {port!r} is not 0 to {MAX_PORT}")
    host = host.strip("[]")
    if kind in OPEN_TO_ALL and not is_numeric(host):
        raise ValueError(f"endpoint {url!r}: {host!r} is no address, such as 127.0.0.1 or 0.0.0.0")
    return host, int(port)


def is_numeric(host: str) -> bool:
    """Tell whether a host is an address and not a name."""
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Tell whether an address is one of this machine alone; a name is none but `localhost`."""
    if host == "localhost":
        return True
    if not is_numeric(host):
        return False
    address = ipaddress.ip_address(host.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


def stays_here(endpoint: Endpoint) -> bool:
    """Tell whether nothing that goes to an endpoint can leave this machine."""
    return endpoint.kind in HOSTED and is_loopback(endpoint.host)


def _options(url: str, query: str) -> dict[str, str]:
    known = {"name", "allow", "deny", "rate", "pack", "trusted"}
    options = dict(parse_qsl(query, keep_blank_values=True))
    if unknown := options.keys() - known:
        raise ValueError(
            f"endpoint {url!r}: option {min(unknown)!r} is none of {', '.join(sorted(known))}"
        )
    return options


def _messages(text: str) -> frozenset[int]:
    return frozenset(message_id_from(part) for part in text.split(",") if part)


def _intervals(text: str) -> dict[int, int]:
    intervals = {}
    for part in filter(None, text.split(",")):
        message, _, rate = part.partition(":")
        try:
            rate_hz = float(rate)
        except ValueError:
            raise ValueError(f"rate {part!r} is not NAME:hertz") from None
        if not 0 <= rate_hz <= US_PER_S:
            raise ValueError(f"rate {part!r} is not 0 to {US_PER_S} Hz")
        interval = round(US_PER_S / rate_hz) if rate_hz else NO_MESSAGES
        intervals[message_id_from(message)] = interval
    return intervals


def _pack_bytes(text: str) -> int:
    if not text.isdecimal() or int(text) > MAX_PACK_BYTES:
        raise ValueError(f"pack {text!r} is not 0 to {MAX_PACK_BYTES}")
    return int(text)


def _yes_or_no(text: str | None) -> bool | None:
    if text is None:
        return None
    if text not in {"yes", "no"}:
        raise ValueError(f"trusted {text!r} is not yes or no")
    return text == "yes"
