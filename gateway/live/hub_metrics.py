"""Prometheus metrics of the hub, and how families are built and written."""

import math
from collections.abc import Iterable, Iterator
from typing import Any, Final

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gateway.hub.stats import ClientStats, HubCounters, ListenerStats
from gateway.units import US_PER_S

Labels = tuple[str, ...]
Sample = tuple[Labels, float]
CLIENT: Final = ("client", "name", "remote")
LISTENER: Final = ("name", "endpoint")
HUB_HELP: Final = {
    "published": "MAVLink frames of the gateway itself.",
    "forwarded": "Frames of other systems, such as an autopilot, that were forwarded.",
    "duplicates": "Copies by a second path, dropped: two endpoints reach one peer.",
    "late": "Frames dropped because newer ones of their system had arrived on another link.",
    "shed": "Telemetry of the gateway dropped because the processor was short of time.",
    "looped": "Frames of ours that came back: an endpoint leads to a router that sends to us.",
    "unroutable": "Frames for an unknown system, or from a client that may not send to it.",
    "unserved": "Requests dropped because their client exceeded its quota.",
}
CLIENT_COUNTERS: Final = (
    ("sent", "Frames sent to a client."),
    ("dropped", "Frames dropped: the client is too slow for them, or out of reach."),
    ("unheard", "Frames sent to a port on which nobody listened, as before a station is started."),
    (
        "bytes_sent",
        "Bytes sent to a client; the rate divided by the width of its link is its load.",
    ),
    ("received", "Frames received from a client."),
    (
        "bytes_garbage",
        "Bytes from a client that were not MAVLink: a wrong baud rate or another program.",
    ),
)


def text_of(found: Iterable[Metric]) -> Iterator[str]:
    """Write families in the Prometheus text format, and yield them one by one."""
    return (generate_latest(_Moment([family])).decode() for family in found)


def gauge(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    """Build a gauge; its name begins with `mavgate_`."""
    family = GaugeMetricFamily(f"mavgate_{name}", text, labels=labels)
    return _filled(family, samples)


def counter(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    """Build a counter; its samples are named by its name and `_total`."""
    family = CounterMetricFamily(f"mavgate_{name}", text, labels=labels)
    return _filled(family, samples)


def hub_families(
    hub: HubCounters,
    listeners: tuple[ListenerStats, ...],
    clients: tuple[ClientStats, ...],
    now_us: int,
) -> Iterator[Metric]:
    """Yield the metrics of the hub, its listening ports and its clients."""
    yield from _hub(hub)
    yield from _listeners(listeners)
    yield from _clients(clients, now_us)


def _hub(hub: HubCounters) -> Iterator[Metric]:
    for field, text in HUB_HELP.items():
        yield counter(f"hub_{field}", text, (), [((), float(getattr(hub, field)))])


def _listeners(listeners: tuple[ListenerStats, ...]) -> Iterator[Metric]:
    ports = [((port.name, port.endpoint), port) for port in listeners]
    yield gauge(
        "listener_open",
        "1 while a listening port accepts clients; 0: another program has it.",
        LISTENER,
        [(labels, float(port.state == "open")) for labels, port in ports],
    )
    yield gauge(
        "listener_clients",
        "Clients of a listening port.",
        LISTENER,
        [(labels, float(port.clients)) for labels, port in ports],
    )
    yield counter(
        "listener_turned_away",
        "Clients turned away for lack of room: see max_clients.",
        LISTENER,
        [(labels, float(port.turned_away)) for labels, port in ports],
    )


def _clients(clients: tuple[ClientStats, ...], now_us: int) -> Iterator[Metric]:
    named = [((str(c.client_id), c.name, c.remote), c) for c in clients]
    for field, text in CLIENT_COUNTERS:
        samples = [(labels, float(getattr(client, field))) for labels, client in named]
        yield counter(f"client_{field}", text, CLIENT, samples)
    yield gauge(
        "client_queued",
        "Frames that wait for a client: it is slower than what it is sent.",
        CLIENT,
        [(labels, float(client.queued)) for labels, client in named],
    )
    yield gauge(
        "client_open",
        "1 while frames reach the client as far as is known.",
        CLIENT,
        [(labels, float(client.state == "open")) for labels, client in named],
    )
    yield gauge(
        "client_round_trip_seconds",
        "Time of the newest answer to PING or TIMESYNC.",
        CLIENT,
        [
            (labels, client.round_trip_us / US_PER_S)
            for labels, client in named
            if client.round_trip_us is not None
        ],
    )
    yield gauge(
        "client_silent_seconds",
        "Time since the client's newest frame: ground stations send one a second.",
        CLIENT,
        [
            (labels, (now_us - client.heard_us) / US_PER_S)
            for labels, client in named
            if client.heard_us is not None
        ],
    )


def _filled(family: Any, samples: Iterable[Sample]) -> Metric:
    for labels, value in samples:
        if not math.isnan(value):
            family.add_metric(labels, value)
    filled: Metric = family
    return filled


class _Moment(Collector):
    """The metrics of one moment, in place of a registry that counts by itself."""

    def __init__(self, found: Iterable[Metric]) -> None:
        self._found = found

    def collect(self) -> Iterable[Metric]:
        return self._found
