"""Meaning of parameters: the component metadata of a vehicle, read leniently.

References
----------
.. [1] https://mavlink.io/en/services/component_metadata.html
"""

import json
import lzma
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from gateway.records import NAN

GENERAL_PATHS: Final = ("/general.json", "/etc/extras/component_general.json.xz")
"""Default paths of the general metadata file."""
TYPE_PARAMETER: Final = 1
MAX_PLAIN: Final = 16_000_000
"""Limit of an unpacked metadata file, against decompression bombs."""


class ParameterMeta(msgspec.Struct, frozen=True, kw_only=True):
    """Metadata of one parameter."""

    name: str
    group: str = ""
    category: str = ""
    short: str = ""
    long: str = ""
    unit: str = ""
    default: float = NAN
    low: float = NAN
    high: float = NAN
    choices: tuple[tuple[float, str], ...] = ()
    """The only values, and what they mean."""


def parameter_path(general: bytes) -> str | None:
    """Return the path of the parameters' file in a general metadata file.

    Parameters
    ----------
    general : bytes
        JSON, packed with xz or not.

    Returns
    -------
    str or None
        On the vehicle; None if there is none, or it is elsewhere.
    """
    for kind in _items(_parsed(general), "metadataTypes"):
        uri = str(kind.get("uri", ""))
        if kind.get("type") == TYPE_PARAMETER and uri.startswith("mftp://"):
            return "/" + uri.removeprefix("mftp://").lstrip("/")
    return None


def parse_parameters(content: bytes) -> dict[str, ParameterMeta]:
    """Read a parameters' file.

    Parameters
    ----------
    content : bytes
        JSON, packed with xz or not.

    Returns
    -------
    dict of str to ParameterMeta
        By name; unreadable entries are left out.
    """
    found = (_meta_of(item) for item in _items(_parsed(content), "parameters"))
    return {meta.name: meta for meta in found if meta is not None}


def _parsed(content: bytes) -> Any:
    try:
        if content[:6] == b"\xfd7zXZ\0":
            content = lzma.LZMADecompressor().decompress(content, MAX_PLAIN)
        return json.loads(content)
    except (ValueError, lzma.LZMAError):
        return {}


def _items(tree: Any, key: str) -> list[Mapping[str, Any]]:
    items = tree.get(key, []) if isinstance(tree, dict) else []
    return [item for item in items if isinstance(item, dict)] if isinstance(items, list) else []


def _meta_of(item: Mapping[str, Any]) -> ParameterMeta | None:
    name = item.get("name")
    if not isinstance(name, str):
        return None
    return ParameterMeta(
        name=name,
        group=_text(item, "group"),
        category=_text(item, "category"),
        short=_text(item, "shortDesc"),
        long=_text(item, "longDesc"),
        unit=_text(item, "units"),
        default=_number(item.get("default")),
        low=_number(item.get("min")),
        high=_number(item.get("max")),
        choices=tuple(
            (_number(value.get("value")), _text(value, "description"))
            for value in _items(item, "values")
        ),
    )


def _text(item: Mapping[str, Any], key: str) -> str:
    value = item.get(key)
    return value if isinstance(value, str) else ""


def _number(value: Any) -> float:
    return float(value) + 0.0 if isinstance(value, int | float) else NAN
