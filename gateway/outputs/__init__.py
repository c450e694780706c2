"""Endpoints that are not MAVLink: NMEA 0183, Cursor on Target, MQTT, GDL90, antenna rotators.

They are added in the way other packages add kinds of endpoints; see docs/extend.md. Each kind has a
module of its name, with a class of its name, which is imported when an endpoint of it is used.
"""

from functools import partial
from importlib import import_module
from typing import Any, Final

from gateway.hub.endpoint import ADDED_KINDS, Endpoint
from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.registry import add_endpoint_kind

KINDS: Final = {
    "nmea": ("rate", "vehicle", "station"),
    "cot": ("rate", "vehicle", "callsign", "certificate", "key", "authority"),
    "gdl90": ("rate", "vehicle", "callsign"),
    "mqtt": ("rate", "vehicle", "topic", "login", "certificate", "key", "authority"),
    "rotator": ("rate", "vehicle", "station", "protocol"),
}
"""Options by kind."""


def _output_class(kind: str) -> Any:
    return getattr(import_module(f"gateway.outputs.{kind}"), f"{kind.capitalize()}Output")


def _make(context: HubContext, client_id: int, endpoint: Endpoint) -> Client:
    client: Client = _output_class(endpoint.kind)(context, client_id, endpoint)
    return client


def _check(kind: str, endpoint: Endpoint) -> None:
    _output_class(kind).check(endpoint)


def extend() -> None:
    """Add the kinds that do not exist yet."""
    for kind, options in KINDS.items():
        if kind not in ADDED_KINDS:
            add_endpoint_kind(kind, _make, options, partial(_check, kind))
