"""Component metadata: the meaning, unit and range of each parameter, as JSON for ground stations.

The parameters' file is compressed by xz, as the specification allows: 6 kB in place of 40 kB, which
takes a 57600 baud radio 2 s in place of 10 s.

References
----------
.. [1] https://mavlink.io/en/services/component_metadata.html
"""

import json
import lzma
from functools import cache
from typing import Any, Final

from gateway import __version__
from gateway.settings import Settings
from gateway.vehicle.dialect import ComponentMetadata
from gateway.vehicle.services.ftp import crc32
from gateway.vehicle.services.parameters.parameters import (
    Parameter,
    ParameterTable,
    parameters_of,
)
from gateway.vehicle.telemetry.messages import boot_ms

GENERAL_PATH: Final = "/general.json"
PARAMETER_PATH: Final = "/parameter.json.xz"
TYPE_PARAMETER: Final = 1
"""COMP_METADATA_TYPE_PARAMETER."""
MAX_SHORT: Final = 100
"""Length of a short description in the specification's schema."""
POSITION_PLACES: Final = 7
PLACES: Final = 4
"""Decimal places shown of a latitude or longitude, and of other numbers."""


class Metadata:
    """The metadata files of one vehicle."""

    def __init__(self, table: ParameterTable) -> None:
        self._general, self._parameters = _files(table.kinds)

    def general(self) -> bytes:
        """Return the file that lists the others."""
        return self._general

    def parameters(self) -> bytes:
        """Return the parameters' file."""
        return self._parameters

    def announcement(self, now_us: int) -> Any:
        """Encode COMPONENT_METADATA."""
        uri = f"mftp://{GENERAL_PATH}".encode()
        return ComponentMetadata(boot_ms(now_us), crc32(self._general), uri)


@cache
def _files(kinds: tuple[tuple[str, type[Settings]], ...]) -> tuple[bytes, bytes]:
    """Write the two files, once for all vehicles."""
    described = [_describe(parameter) for parameter in parameters_of(kinds)]
    # CRC32 is the check that every decoder of xz supports; embedded ones lack the default, CRC64.
    parameters = lzma.compress(
        _json({"version": 1, "parameters": described}), check=lzma.CHECK_CRC32
    )
    general = {
        "version": 1,
        "vendorName": "mavgate",
        "modelName": "mavgate tracker",
        "firmwareVersion": ".".join((*__version__.split("."), "0", "0", "0")[:3]),
        "metadataTypes": [
            {
                "type": TYPE_PARAMETER,
                "uri": f"mftp://{PARAMETER_PATH}",
                "fileCrc": crc32(parameters),
            }
        ],
    }
    return _json(general), parameters


def _describe(parameter: Parameter) -> dict[str, Any]:
    field = parameter.field
    group = parameter.path[-2] if len(parameter.path) > 1 else parameter.section
    is_whole = bool(field.choices) or isinstance(field.default, int)
    default = parameter.to_number(field.default)
    described: dict[str, Any] = {
        "name": parameter.name,
        "type": "Int32" if is_whole else "Float",
        "shortDesc": _shorten(field.meaning),
        "longDesc": f"{field.meaning} ({'.'.join((parameter.section, *parameter.path))})",
        "units": field.unit,
        "default": int(default) if is_whole else default,
        "group": group,
        "category": parameter.section,
    }
    low, high = field.bounds
    names = ("off", "on") if isinstance(field.default, bool) else field.choices
    if names:
        described["values"] = [
            {"value": number, "description": name} for number, name in enumerate(names)
        ]
        return described
    described |= {"min": low} if low is not None else {}
    described |= {"max": high} if high is not None else {}
    if not is_whole:
        is_position = parameter.path[-1] in ("lat_deg", "lon_deg")
        described["decimalPlaces"] = POSITION_PLACES if is_position else PLACES
    return described


def _shorten(text: str) -> str:
    """Return the first sentence, cut at a word where it is longer than the schema allows."""
    sentence = text.split(". ")[0].rstrip(".")
    if len(sentence) <= MAX_SHORT:
        return sentence
    return sentence[: MAX_SHORT - 3].rpartition(" ")[0].rstrip(",;:") + "..."


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
