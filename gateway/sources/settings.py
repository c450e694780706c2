"""The URL of a source: its kind, the transport for its bytes, and options.

    KIND:/dev/ttyACM0            serial port; ?baud=420000
    KIND:usb:1a86:7523           serial port by its USB id, as [serial] port
    KIND:udp:HOST:PORT           datagrams to this address
    KIND:tcp:HOST:PORT           connect, and reconnect after a failure
    KIND:tcp-listen:HOST:PORT    serve one client at a time
    KIND:poll:HOST:PORT          query a server by HTTP repeatedly
    KIND:push                    HTTP posts to the panel, with a token
    KIND:receiver                packets of other programs, passed on by the receiver
    KIND:stdin                   standard input
    KIND:file:PATH               a file that grows

An address outside of loopback is listened on only if it is given explicitly, as for every endpoint.
The option `id` is the vehicle; by default it is the position of the source in the list.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Final
from urllib.parse import parse_qsl

from gateway.hub.endpoint import Endpoint, EndpointKind, parse_endpoint
from gateway.records import SOURCE_NODE, NodeId
from gateway.settings import Settings, setting

TRANSPORTS: Final = (
    "serial", "udp", "tcp", "tcp-listen", "poll", "push", "receiver", "stdin", "file"
)  # fmt: skip
PLAIN: Final = frozenset({"push", "receiver", "stdin"})
"""Transports without an address."""
ENDPOINTS: Final = {
    "serial": EndpointKind.SERIAL,
    "udp": EndpointKind.UDP_LISTEN,
    "tcp": EndpointKind.TCP,
    "tcp-listen": EndpointKind.TCP_LISTEN,
    "poll": EndpointKind.TCP,
}
"""Kinds of endpoints with the same address."""
DEFAULT_BAUD: Final = {"crsf": 420_000, "ltm": 9600}
USUAL_BAUD: Final = 115_200
MAX_SOURCES: Final = 16
MAX_VEHICLE: Final = 31
OPTIONS: Final = ("baud", "id", "token")
"""Options of every kind."""
TOKEN: Final = re.compile(r"[\w.~-]{16,64}", re.ASCII)
"""A token that cannot be guessed, as a segment of the path of a URL."""


@dataclass(frozen=True, slots=True)
class SourceUrl:
    """One parsed URL."""

    url: str
    kind: str
    transport: str
    address: str
    """Path of a file, or the address of an endpoint."""
    endpoint: Endpoint | None
    """The endpoint that brings the bytes, for a serial port or an address of the network."""
    options: dict[str, str]

    @property
    def name(self) -> str:
        """The URL without its options, which may contain secrets."""
        return self.url.partition("?")[0]


def parse_source(url: str) -> SourceUrl:
    """Parse a URL; raises ValueError that states the reason."""
    location, _, query = url.partition("?")
    kind, colon, address = location.partition(":")
    transport, address = _transport_of(address)
    if not kind or not colon:
        raise ValueError(f"source {location!r}: write KIND:WHERE, such as lines:/dev/ttyUSB0")
    options = dict(parse_qsl(query, keep_blank_values=True))
    if "token" in options and not TOKEN.fullmatch(options["token"]):
        raise ValueError(f"source {location!r}: token= needs 16 to 64 letters, digits, - . _ or ~")
    if transport not in PLAIN and not address:
        raise ValueError(f"source {location!r}: has no device or file")
    endpoint = None
    if (same := ENDPOINTS.get(transport)) is not None:
        baud = options.get("baud", DEFAULT_BAUD.get(kind, USUAL_BAUD))
        whole = f"{address}:{baud}" if transport == "serial" else address
        if not whole.rpartition(":")[0]:
            # An endpoint without a host would be open to the network.
            raise ValueError(f"source {location!r}: write {transport}:HOST:PORT")
        try:
            endpoint = parse_endpoint(f"{same}:{whole}?trusted=yes")
        except ValueError as error:
            why = str(error).partition("': ")[2].replace(f"{same}:", f"{transport}:")
            raise ValueError(f"source {location!r}: {why}") from None
    return SourceUrl(url, kind, transport, address, endpoint, options)


def _transport_of(address: str) -> tuple[str, str]:
    """Split the rest of a URL into transport and address; a device needs no transport."""
    word, _, rest = address.partition(":")
    if word in TRANSPORTS:
        return word, rest
    return ("stdin", "") if address == "-" else ("serial", address)


class SourceSettings(Settings, frozen=True):
    """A tracker, radio or phone that is a vehicle, in addition to those of the receiver."""

    url: Annotated[
        str,
        setting(
            "Kind, location and options, such as crsf:/dev/ttyACM0?id=2 or "
            "lines:udp:0.0.0.0:5600; docs/sources.md lists them."
        ),
    ]

    def __post_init__(self) -> None:
        """Reject an invalid URL when the settings are read."""
        parse_source(self.url)


def nodes_of(sources: tuple[SourceSettings, ...]) -> list[NodeId]:
    """Return the node of each source; node ids of sources begin at 8 for each vehicle."""
    found: list[NodeId] = []
    for position, source in enumerate(sources, 1):
        wanted = parse_source(source.url).options.get("id", "")
        vehicle_id = int(wanted) if wanted.isdecimal() else position
        before = sum(node.vehicle_id == vehicle_id for node in found)
        found.append(NodeId(vehicle_id, SOURCE_NODE + before))
    return found
