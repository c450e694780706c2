"""Endpoint URLs: destinations and sources of frames, and their filters.

    udp:HOST:PORT            send there; answers come back to the same socket
    udp-listen:HOST:PORT     serve every client that sends to this port
    udp-broadcast:HOST:PORT  send to a broadcast address, receive unicast answers
    udp-multicast:GROUP:PORT send to a group and receive from it
    tcp:HOST:PORT            connect, and reconnect when it breaks
    tcp-listen:HOST:PORT     serve every client that connects
    ws:HOST:PORT             connect by WebSocket, and reconnect when it breaks
    ws-listen:HOST:PORT      serve every program and page that connects by WebSocket
    wss:, wss-listen:        the same over TLS
    zenoh:tcp/HOST:7447      a fleet, through a Zenoh router; needs ?site=NAME
    serial:DEVICE:BAUD       a telemetry radio or an autopilot on a serial port

IPv6 addresses are written in brackets. Options follow as in any URL:
`?name=tablet&deny=RAW_IMU&pack=1100`. The spellings of MAVProxy, MAVSDK, pymavlink, mavlink-router
and mavp2p are accepted as well: the words of `ALIASES`, `//` after the kind, `HOST:PORT` for
`udp:`, and `DEVICE:BAUD` or `DEVICE,BAUD` for `serial:`.

`udp://` is refused, because it listens in MAVSDK, binds and sends in MAVROS, and looks like `udp:`,
which sends here. So is a destination that can only be an address to listen on.

A browser lets any page of any site connect to any port, this machine's own included, and sends the
server only the page's origin (RFC 6454, RFC 6455 section 10.2). Pages of this machine may connect,
and those of origins that the operator allows. Programs that are not browsers send no origin and are
treated like TCP clients.
"""

import ipaddress
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final
from urllib.parse import parse_qsl, urlsplit

from gateway.hub.systems import FILTER_OPTIONS, NO_FILTER, SystemFilter, ids_from, new_ids_from
from gateway.printable import unknown_choice
from gateway.units import BITS_PER_BYTE, US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS

_HOST: Final = re.compile(r"[\w.-]+")
NULL_ORIGIN: Final = "null"
"""The origin that a browser sends for a page opened as a file, and for any sandboxed page."""
MAX_NAME: Final = 64
MAX_MESSAGE_ID: Final = (1 << 24) - 1
MIN_RATE_HZ: Final = 0.001
NO_MESSAGES: Final = -1
"""An interval that stops a message."""
MAX_BUDGET: Final = 1_000_000_000
MS_PER_S: Final = 1000
MAX_WAIT_MS: Final = 1000
MAX_PACK_BYTES: Final = 1100
"""Largest datagram of packed frames, bytes: routers on the way cut or drop those beyond 1120."""
MAX_PORT: Final = 65535
DEFAULT_BAUD: Final = 57600
MIN_BAUD: Final = 300
MAX_BAUD: Final = 12_000_000
"""Rate of the fastest USB adapters, Bd."""
SITE_KEYS: Final = "site"
LOCATOR: Final = re.compile(r"(tcp|tls|quic|udp|ws|unixsock-stream)/\S+")
"""Pattern of an address as Zenoh writes it."""
RAW_KEYS: Final = "mavlink_raw"
JSON_KEYS: Final = "mavlink_json"
SITE_NAME: Final = re.compile(r"(?!\.+$)[A-Za-z0-9_.-]{1,64}")
"""A segment of a Zenoh key or of a path without special characters."""
ALIASES: Final = {
    "udpin": "udp-listen",
    "udps": "udp-listen",
    "udpout": "udp",
    "udpc": "udp",
    "udpbcast": "udp-broadcast",
    "udpb": "udp-broadcast",
    "mcast": "udp-multicast",
    "tcpin": "tcp-listen",
    "tcps": "tcp-listen",
    "tcpout": "tcp",
    "tcpc": "tcp",
    "wsserver": "ws-listen",
}
ANY_ADDRESS: Final = "0.0.0.0"
PARTS: Final = frozenset({"site", "vehicle"})
"""Options that distinguish endpoints of one address: sites of a router, vehicles of an output."""


def admits_page(origin: str, local_host: str, named: Collection[str]) -> bool:
    """Return whether a page of this origin may connect.

    A page from `local_host`, our address to which the browser connected, is also a local page; the
    host name that the browser used proves nothing. `named` are further allowed origins.
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


def host_of(host_header: str) -> str:
    """Return the host of a request's `Host`, without its port; empty if it is malformed."""
    try:
        return urlsplit(f"//{host_header.strip()}").hostname or ""
    except ValueError:
        return ""


def names_loopback(host_header: str) -> bool:
    """Return whether a request's `Host` is loopback; that of a page after DNS rebinding is not."""
    return is_loopback(host_of(host_header))


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def is_name(host: str) -> bool:
    """Return whether a host is a valid name: for any other, the resolver raises an error."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    # A mistyped IPv4 address is not a name.
    return _HOST.fullmatch(host) is not None and not host.replace(".", "").isdecimal()


def is_numeric(host: str) -> bool:
    """Return whether a host is an address and not a name."""
    return _address(host) is not None


def is_loopback(host: str) -> bool:
    """Return whether a host is a loopback address or the name `localhost`."""
    if host == "localhost":
        return True
    address = _address(host)
    return address is not None and address.is_loopback


def is_of_this_machine(host: str, local_host: str) -> bool:
    """Return whether a datagram from `host` to our address `local_host` was sent on this machine.

    The kernel accepts datagrams of its own addresses from no network.
    """
    return is_loopback(host) or _address(host) == _address(local_host)


class EndpointKind(StrEnum):
    """How an endpoint reaches its peers; the word before the URL's first colon."""

    UDP = "udp"
    UDP_LISTEN = "udp-listen"
    UDP_BROADCAST = "udp-broadcast"
    UDP_MULTICAST = "udp-multicast"
    TCP = "tcp"
    TCP_LISTEN = "tcp-listen"
    WS = "ws"
    WS_LISTEN = "ws-listen"
    WSS = "wss"
    WSS_LISTEN = "wss-listen"
    ZENOH = "zenoh"
    SERIAL = "serial"


LISTENING: Final = frozenset(kind for kind in EndpointKind if kind.endswith("-listen"))
"""Kinds that bind to their port; port 0 is any free one."""
OPEN_TO_ALL: Final = LISTENING | {EndpointKind.UDP_BROADCAST, EndpointKind.UDP_MULTICAST}
"""Kinds that serve unknown peers. They bind to an address; looking up a name would block."""
TLS_KINDS: Final = frozenset({EndpointKind.WSS, EndpointKind.WSS_LISTEN})
"""Kinds that use TLS."""
OWN_OPTIONS: Final[dict[str, frozenset[EndpointKind]]] = {
    "path": frozenset({EndpointKind.WS, EndpointKind.WSS}),
    "origins": frozenset({EndpointKind.WS_LISTEN, EndpointKind.WSS_LISTEN}),
    **dict.fromkeys(("site", "keys", "config"), frozenset({EndpointKind.ZENOH})),
}
"""Kinds of the options that only some have."""
HOSTED: Final = LISTENING | {EndpointKind.UDP, EndpointKind.TCP, EndpointKind.WS, EndpointKind.WSS}
"""Kinds whose frames are sent to the addresses of single hosts."""


@dataclass(frozen=True, slots=True)
class AddedKind:
    """A kind of endpoint added by another package, which parses the rest of the URL itself."""

    options: frozenset[str] = frozenset()
    """Its own options; one with the name of a common option replaces it."""
    check: "Callable[[Endpoint], None]" = lambda _endpoint: None
    """Raises ValueError if it does not understand an endpoint."""


ADDED_KINDS: Final[dict[str, AddedKind]] = {}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One parsed endpoint URL."""

    url: str
    kind: str
    """An `EndpointKind`, or one of `ADDED_KINDS`."""
    host: str
    """Address or name without brackets; device of a serial port; otherwise the whole location."""
    port: int
    """Port number; for a serial port the baud rate, for an added kind 0."""
    location: str
    """The URL in our own spelling and without options but `PARTS`; no two endpoints share one."""
    name: str
    """The name given by the operator; the location by default."""
    allow: frozenset[int] = frozenset()
    """Only these messages pass; empty lets all pass."""
    deny: frozenset[int] = frozenset()
    systems: SystemFilter = NO_FILTER
    """Systems and components that pass, in both directions."""
    new_ids: dict[int, int] = field(default_factory=dict)
    """System ids at the gateway by the ids on the link; see `SystemTranslation`."""
    interval_us: dict[int, int] = field(default_factory=dict)
    """Least time between two frames of a message, by message id."""
    pack_bytes: int = 0
    """Gather frames into datagrams or messages of up to this size; 0 sends each on its own."""
    pack_wait_s: float = 0.0
    """How long the first frame waits for others; 0 packs only frames that arrive together."""
    budget: int = 0
    """Bytes a second that the link carries; telemetry is thinned to fit. 0 for no limit."""
    trusted: bool | None = None
    """Whether its clients may change state; None: loopback and configured peers except fleets."""
    mavlink: int = 0
    """MAVLink version of all frames sent there; 0 for 2, or 1 if the client has sent only 1."""
    cache: bool | None = None
    """Whether answers of its vehicles are kept for other stations; False: its own stations are
    answered by the vehicles alone."""
    monitor: bool = False
    """Send all traffic, addressed frames included, and ignore everything received."""
    origins: frozenset[str] = frozenset()
    """Origins of pages of other machines that may connect by WebSocket."""
    path: str = "/"
    """The path requested from a WebSocket server."""
    site: str = ""
    """The site's name in a fleet."""
    keys: str = SITE_KEYS
    """Keys of a fleet: `site`, or those of mavlink-server, `mavlink_raw` or `mavlink_json`."""
    config: str = ""
    """Zenoh's own configuration file; empty for none."""
    added: dict[str, str] = field(default_factory=dict)
    """Options that only its added kind has, as they are written."""

    @property
    def address(self) -> str:
        """Its address: `HOST:PORT`, or the device of a serial port."""
        whole = self.kind in (EndpointKind.SERIAL, EndpointKind.ZENOH) or self.kind in ADDED_KINDS
        return self.host if whole else host_and_port(self.host, self.port)

    def name_of(self, peer: str) -> str:
        """Return the name of a client of this port, which begins with the port's name."""
        return peer if self.name == self.location else f"{self.name} {peer}"

    def passes(self, message_id: int) -> bool:
        """Return whether the `allow` and `deny` lists let a message out to this endpoint."""
        return message_id not in self.deny and (not self.allow or message_id in self.allow)


def parse_endpoint(url: str) -> Endpoint:
    """Read one endpoint URL, as in the table of this module.

    Raises ValueError if a part of it is invalid; the text gives the allowed values.
    """
    address, _, query = url.partition("?")
    try:
        kind, rest = _kind_and_rest(address)
        host, port = _split_address(kind, rest)
        options = _options(kind, query)
        added_kind = ADDED_KINDS.get(kind, AddedKind())
        added = {key: options.pop(key) for key in added_kind.options & options.keys()}
        parts = [f"{key}={value}" for key, value in (options | added).items() if key in PARTS]
        location = "?".join([f"{kind}:{rest}", *parts])
        given: dict[str, Any] = {"name": location, "budget": _bandwidth(kind, port)}
        for option, text in options.items():
            if option in READERS:
                name, read = READERS[option]
                given[name] = read(text)
        endpoint = Endpoint(
            url=url,
            kind=kind,
            host=host,
            port=port,
            location=location,
            systems=selection_from(options),
            added=added,
            **given,
        )
        _check_fleet(endpoint)
        added_kind.check(endpoint)
    except ValueError as error:
        raise ValueError(f"endpoint {url!r}: {error}") from None
    return endpoint


def selection_from(options: Mapping[str, str]) -> SystemFilter:
    """Read the options that select systems; raises ValueError."""
    only, without, components = (ids_from(key, options.get(key, "")) for key in FILTER_OPTIONS)
    found = SystemFilter(only, without, components, messages_from(options.get("also", "")))
    if both := found.only & found.without:
        raise ValueError(f"system {min(both)} is in both systems= and not-systems=")
    return found


def host_and_port(host: object, port: object) -> str:
    """Write host and port as in a URL, an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


def _kind_and_rest(address: str) -> tuple[str, str]:
    if not address.isprintable():
        raise ValueError("contains characters that cannot be printed")
    word, _, rest = address.partition(":")
    if word in ADDED_KINDS:
        return word, rest
    word, rest = respell(address)
    if not rest and (is_numeric(word) or "." in word):
        raise ValueError(f"write udp:{word}:14550 to send to this host")
    if word not in set(EndpointKind):
        raise ValueError(unknown_choice("kind", word, [*EndpointKind, *sorted(ADDED_KINDS)]))
    return EndpointKind(word), rest


def _split_address(kind: str, rest: str) -> tuple[str, int]:
    if kind in ADDED_KINDS:
        return rest, 0
    if kind is EndpointKind.SERIAL:
        device, colon, baud = rest.rpartition(":")
        if not colon:
            device, baud = rest, str(DEFAULT_BAUD)
        if not device:
            raise ValueError(f"write {kind}:DEVICE:BAUD, as in {kind}:/dev/ttyUSB0:57600")
        return device, number_from(baud, "baud rate", MIN_BAUD, MAX_BAUD)
    if kind is EndpointKind.ZENOH:
        if not LOCATOR.fullmatch(rest):
            raise ValueError(f"{rest!r} is not the address of a router; write {kind}:tcp/HOST:7447")
        return rest, 0
    host, _, port = rest.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    if not host or (":" in host and not bracketed):
        raise ValueError(f"write {kind}:HOST:PORT, an IPv6 host in [brackets]")
    number = number_from(port, "port", 0, MAX_PORT)
    host = host[1:-1] if bracketed else host
    if number == 0 and kind not in LISTENING:
        raise ValueError(f"port must be 1 to {MAX_PORT}: 0 cannot be sent to")
    _check_host(kind, host)
    return host, number


def _check_host(kind: str, host: str) -> None:
    if kind in OPEN_TO_ALL and not is_numeric(host):
        raise ValueError(f"{host!r} is not an address such as 127.0.0.1 or 0.0.0.0")
    address = _address(host)
    if kind is EndpointKind.UDP_MULTICAST and (address is None or not address.is_multicast):
        raise ValueError(f"{host!r} is not a multicast group such as 239.255.145.50")
    if address is None and not is_name(host):
        raise ValueError(f"{host!r} is neither an address nor a name")


def stays_here(endpoint: Endpoint) -> bool:
    """Return whether all traffic of an endpoint stays on this machine."""
    return endpoint.kind in HOSTED and is_loopback(endpoint.host)


def _options(kind: str, query: str) -> dict[str, str]:
    """Read the options; a repeated one is refused, since their order would decide its value."""
    names = (*READERS, *FILTER_OPTIONS, "also")
    known = {name for name in names if name not in OWN_OPTIONS or kind in OWN_OPTIONS[name]}
    known |= ADDED_KINDS[kind].options if kind in ADDED_KINDS else set()
    options: dict[str, str] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise ValueError(unknown_choice("option", key, sorted(known)))
        if key in options:
            raise ValueError(f"option {key!r} is given twice")
        if ";" in value:
            raise ValueError(f"{key}={value!r}: options are joined by &")
        options[key] = value
    return options


def _bandwidth(kind: str, baud: int) -> int:
    """Return the bandwidth of a link without `budget`: that of a serial line is its baud rate."""
    return baud // BITS_PER_BYTE if kind == EndpointKind.SERIAL else 0


def _origins(text: str) -> frozenset[str]:
    origins = frozenset(filter(None, text.lower().split(",")))
    for origin in origins:
        scheme, _, rest = origin.partition("://")
        if origin != NULL_ORIGIN and (not scheme or not rest or "/" in rest):
            raise ValueError(
                f"origin {origin!r} is not {NULL_ORIGIN} or like https://example.org:8080"
            )
    return origins


def _check_fleet(endpoint: Endpoint) -> None:
    site, keys = endpoint.site, endpoint.keys
    if endpoint.kind != EndpointKind.ZENOH:
        return
    if keys not in (SITE_KEYS, RAW_KEYS, JSON_KEYS):
        raise ValueError(unknown_choice("keys", keys, (SITE_KEYS, RAW_KEYS, JSON_KEYS)))
    if keys == SITE_KEYS and not SITE_NAME.fullmatch(site):
        raise ValueError(f"site {site!r}: it needs ?site=NAME of letters, digits, . _ and -")


def _path(text: str) -> str:
    if not text.startswith("/") or not text.isascii() or not text.isprintable() or " " in text:
        raise ValueError(f"path {text!r} does not begin with / or has spaces")
    return text


def respell(address: str) -> tuple[str, str]:
    """Read an endpoint without its options, in any accepted spelling.

    Raises ValueError if programs differ about its meaning; the error names the unambiguous
    spellings.
    """
    if address.startswith("/"):
        device, comma, baud = address.partition(",")
        return "serial", f"{device}:{baud}" if comma else address
    word, colon, rest = address.partition(":")
    slashes = rest.startswith("//")
    if colon and not slashes and (word[:1] == "[" or "." in word or word == "localhost"):
        # A host without a kind: it has a dot or a bracket.
        return "udp", address
    kind = ALIASES.get(word, word)
    rest = rest.removeprefix("//")
    if slashes and word == "udp":
        raise ValueError(_either(word, rest))
    host, _, port = rest.rpartition(":")
    if kind in LISTENING and not host:
        rest = f"{ANY_ADDRESS}:{port}"
    elif kind in HOSTED - LISTENING and port.isdecimal() and host in ("", ANY_ADDRESS, "[::]"):
        raise ValueError(_either(kind, rest))
    return kind, rest


def _either(kind: str, rest: str) -> str:
    """Return a text that shows how to write each of the possible meanings."""
    host, _, port = rest.rpartition(":")
    if not port.isdecimal():
        host, port = rest, "PORT"
    anywhere = host in ("", ANY_ADDRESS, "[::]")
    listening = f"{host or ANY_ADDRESS}:{port}"
    sending = f"{'HOST' if anywhere else host}:{port}"
    return (
        f"write {kind}-listen:{listening} to wait for clients there, {kind}:{sending} to send there"
    )


def message_id_from(text: str) -> int:
    """Return a message id from its name or number.

    Raises ValueError if no message has that name.
    """
    if text.isdecimal():
        return number_from(text, "message id", 0, MAX_MESSAGE_ID)
    try:
        return MESSAGE_IDS[text.upper()]
    except KeyError:
        raise ValueError(f"no MAVLink message is called {text!r}") from None


def number_from(text: str, what: str, low: int, high: int) -> int:
    """Read a whole number within bounds; the text of a ValueError begins with `what`."""
    # Python itself refuses thousands of digits, with an error that concerns Python's own limit.
    if not text.isascii() or not text.isdecimal() or len(text) > len(str(high)):
        raise ValueError(f"{what} {text!r} is not {low} to {high}")
    if not low <= int(text) <= high:
        raise ValueError(f"{what} {text} is not {low} to {high}")
    return int(text)


def name_from(text: str) -> str:
    """Read a printable name."""
    if not text.strip() or not text.isprintable():
        raise ValueError(f"name {text!r} cannot be printed")
    return text[:MAX_NAME]


def messages_from(text: str) -> frozenset[int]:
    """Read message names or numbers, separated by commas."""
    return frozenset(message_id_from(part) for part in text.split(",") if part)


def intervals_from(text: str) -> dict[int, int]:
    """Read `NAME:hertz`, separated by commas; return the least times between two frames in us."""
    intervals = {}
    for part in filter(None, text.split(",")):
        message, _, rate = part.partition(":")
        try:
            rate_hz = float(rate)
        except ValueError:
            raise ValueError(f"rate {part!r} is not NAME:hertz") from None
        if not (rate_hz == 0 or MIN_RATE_HZ <= rate_hz <= US_PER_S):
            raise ValueError(f"rate {part!r} is not 0, or {MIN_RATE_HZ} to {US_PER_S} Hz")
        interval = round(US_PER_S / rate_hz) if rate_hz else NO_MESSAGES
        intervals[message_id_from(message)] = interval
    return intervals


def yes_or_no(option: str) -> Callable[[str], bool]:
    """Return the reader of an option that is `yes` or `no`."""

    def read(text: str) -> bool:
        if text not in {"yes", "no"}:
            raise ValueError(f"{option} {text!r} is not yes or no")
        return text == "yes"

    return read


def _number(option: str, high: int) -> Callable[[str], int]:
    return lambda text: number_from(text, option, 0, high)


READERS: Final[dict[str, tuple[str, Callable[[str], Any]]]] = {
    "name": ("name", name_from),
    "allow": ("allow", messages_from),
    "deny": ("deny", messages_from),
    "rate": ("interval_us", intervals_from),
    "pack": ("pack_bytes", _number("pack", MAX_PACK_BYTES)),
    "wait": ("pack_wait_s", lambda text: number_from(text, "wait", 0, MAX_WAIT_MS) / MS_PER_S),
    "budget": ("budget", _number("budget", MAX_BUDGET)),
    "trusted": ("trusted", yes_or_no("trusted")),
    "cache": ("cache", yes_or_no("cache")),
    "monitor": ("monitor", yes_or_no("monitor")),
    "mavlink": ("mavlink", _number("mavlink", 2)),
    "as": ("new_ids", new_ids_from),
    "origins": ("origins", _origins),
    "path": ("path", _path),
    "site": ("site", str),
    "keys": ("keys", str),
    "config": ("config", str),
}
"""The field of each option, and the function that reads its text or raises ValueError."""
