"""Settings of the hub."""

from typing import Annotated, Final

from gateway.hub.endpoint import EndpointKind, parse_endpoint
from gateway.settings import Settings, setting

SOURCES: Final = frozenset({EndpointKind.SERIAL, EndpointKind.TCP, EndpointKind.UDP_LISTEN})
"""Kinds of endpoint to which autopilots connect."""
ENDPOINTS: Final = ("udp:127.0.0.1:14550", "udp-listen:127.0.0.1:14551")
"""Default endpoints."""


class HubSettings(Settings, frozen=True):
    """Endpoints and limits of the hub."""

    endpoints: Annotated[
        tuple[str, ...],
        setting(
            "Endpoint URLs: udp:HOST:PORT, udp-listen:HOST:PORT, udp-broadcast:HOST:PORT, "
            "udp-multicast:GROUP:PORT, tcp:HOST:PORT, tcp-listen:HOST:PORT, ws:HOST:PORT, "
            "ws-listen:HOST:PORT (56781 is usual), wss:HOST:PORT, wss-listen:HOST:PORT, "
            "zenoh:tcp/HOST:7447?site=NAME, "
            "serial:DEVICE:BAUD, or outputs that are not MAVLink, such as nmea:udp:HOST:10110; "
            "with options such as ?name=tablet&deny=RAW_IMU&rate=ATTITUDE:5&pack=1100&trusted=no. "
            "?systems=1 passes only system 1, ?as=2 gives the vehicle of a link the id 2, "
            "?cache=yes answers further stations for the vehicles of a slow link."
        ),
    ] = ENDPOINTS
    max_clients: Annotated[
        int,
        setting("Maximum clients of a listening endpoint.", ge=1, le=2000),
    ] = 32
    idle_timeout_s: Annotated[
        float,
        setting(
            "A client of a listening UDP port is removed after this time without a frame. "
            "Ground stations send a heartbeat every second. A WebSocket client is removed after "
            "this time without an answer to pings, if it has answered some before.",
            "s",
            ge=2,
            le=3600,
        ),
    ] = 30.0
    queue_bytes: Annotated[
        int,
        setting(
            "Queue of a slow or stalled client by TCP or WebSocket; when it is full the oldest "
            "telemetry is dropped. Small: fresh data after a stall. Large: fewer gaps.",
            "byte",
            ge=1024,
            le=16_777_216,
        ),
    ] = 65_536
    late_after_s: Annotated[
        float,
        setting(
            "A frame that is older than the newest of its system by more than this is dropped, if "
            "the system is received on several links, one of which may be congested.",
            "s",
            ge=0.05,
            le=30,
        ),
    ] = 1.0
    ping_interval_s: Annotated[
        float,
        setting("Interval of measuring round trips; 0 measures none.", "s", ge=0, le=3600),
    ] = 5.0
    metrics_port: Annotated[
        int,
        setting("Loopback port that serves Prometheus text; 0 serves none.", ge=0, le=65535),
    ] = 0
    tls_certificate: Annotated[
        str,
        setting(
            "PEM file with the certificate of this machine, and its chain, that "
            "wss-listen: presents. A replaced one is used for new connections.",
            path=True,
        ),
    ] = ""
    tls_key: Annotated[
        str,
        setting(
            "PEM file with the key of the certificate; empty if it is in the same file.", path=True
        ),
    ] = ""
    tls_authority: Annotated[
        str,
        setting(
            "PEM file with the certificates of the authorities that wss: accepts, such as your "
            "own; empty for those of the system.",
            path=True,
        ),
    ] = ""
    event_loop: Annotated[
        str,
        setting(
            "Event loop of the gateway: asyncio, or uvloop (extra fast), which "
            "delivers up to a quarter more frames to many clients. Applies at the next start.",
            pattern=r"^(asyncio|uvloop)$",
        ),
    ] = "asyncio"
    realtime_priority: Annotated[
        int,
        setting(
            "SCHED_RR priority of the process, which keeps latency low on a busy machine; needs "
            "the right CAP_SYS_NICE. 0 leaves the scheduler alone.",
            ge=0,
            le=99,
        ),
    ] = 0

    @property
    def has_other_sources(self) -> bool:
        """Whether MAVLink may come from more than the default endpoints."""
        added = {*self.endpoints} - {*ENDPOINTS}
        return any(parse_endpoint(url).kind in SOURCES for url in added)

    def __post_init__(self) -> None:
        """Refuse wrong endpoints when the settings are read, not when they are used."""
        locations: set[str] = set()
        errors = []
        for url in self.endpoints:
            try:
                endpoint = parse_endpoint(url)
            except ValueError as error:
                errors.append(str(error))
                continue
            if endpoint.location in locations:
                errors.append(f"endpoint {endpoint.location!r} is given twice")
            if endpoint.kind is EndpointKind.WSS_LISTEN and not self.tls_certificate:
                errors.append(f"endpoint {endpoint.location!r} needs a tls_certificate")
            locations.add(endpoint.location)
        if errors:
            raise ValueError("\n".join(errors))
