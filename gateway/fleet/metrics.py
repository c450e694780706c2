"""The metrics of a fleet for Prometheus, in addition to those of any hub."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from prometheus_client.core import Metric

from gateway.live.metrics import counter, gauge

SITE_GAUGES: Final = (
    ("is_here", "here", "1 while a session of the site is present."),
    ("sessions", "sessions", "Sessions under the site's name; more than 1: rename all but one."),
    ("round_trip_s", "round_trip_seconds", "Time until the site's session answered a query."),
)
SITE_COUNTERS: Final = (
    ("sent", "sent", "Frames published for the site."),
    ("dropped", "dropped", "Frames for the site that were dropped: its link is too slow."),
    ("bytes_garbage", "garbage_bytes", "Bytes under the site's keys that are not MAVLink."),
    ("unknown", "unknown", "Frames of unknown messages, whose ids cannot be changed."),
    ("signed", "signed", "Signed frames dropped because the passphrase is not set here."),
    ("unsigned", "unsigned", "Unsigned frames dropped because the site has a passphrase."),
    ("forged", "forged", "Frames not signed with the site's passphrase."),
    ("replayed", "replayed", "Signed frames with a timestamp used before, or too old."),
    ("looped", "looped", "Frames of the fleet that returned through the site, and were dropped."),
)
VEHICLE_GAUGES: Final = (
    ("rate_hz", "rate_hertz", "Frames a second of the last seconds."),
    ("age_s", "age_seconds", "Time since the vehicle's newest frame."),
)
VEHICLE_COUNTERS: Final = (
    ("frames", "frames", "Frames of the vehicle."),
    ("lost", "lost", "Frames of the vehicle that were lost, by their sequence numbers."),
)
SITE: Final = ("site",)
VEHICLE: Final = ("site", "system", "id")


def fleet_families(status: Mapping[str, Any]) -> Iterator[Metric]:
    """Describe a fleet."""
    linked = float(status["is_linked"])
    yield gauge("fleet_linked", "1 while there is a router.", (), [((), linked)])
    for key, text in (
        ("unmapped", "Vehicles for which no system id is left."),
        ("left_out", "Vehicles excluded by the operator."),
    ):
        yield gauge(f"fleet_{key}", text, (), [((), float(len(status[key])))])
    for key, text in (
        ("overflowed", "Messages dropped because they arrived faster than they were handled."),
        ("looped", "Frames for sites that a client here returned, and that were dropped."),
        ("bad_names", "Messages under invalid site names, or of too many sites."),
    ):
        yield counter(f"fleet_{key}", text, (), [((), float(status[key]))])
    sites = [((site["name"],), site) for site in status["sites"]]
    yield from _families("fleet_site", SITE, SITE_GAUGES, SITE_COUNTERS, sites)
    vehicles = [
        ((site["name"], str(vehicle["system_id"]), str(vehicle["id"] or "")), vehicle)
        for site in status["sites"]
        for vehicle in site["vehicles"]
    ]
    yield from _families("fleet_vehicle", VEHICLE, VEHICLE_GAUGES, VEHICLE_COUNTERS, vehicles)


def _families(
    head: str,
    labels: tuple[str, ...],
    gauges: Sequence[tuple[str, str, str]],
    counters: Sequence[tuple[str, str, str]],
    things: Sequence[tuple[tuple[str, ...], Mapping[str, Any]]],
) -> Iterator[Metric]:
    for make, families in ((gauge, gauges), (counter, counters)):
        for key, name, text in families:
            samples = [
                (label, float(thing[key])) for label, thing in things if thing[key] is not None
            ]
            yield make(f"{head}_{name}", text, labels, samples)
