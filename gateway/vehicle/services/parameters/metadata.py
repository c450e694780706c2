"""Component metadata: what each parameter means, its unit and range, as JSON for ground stations.

References
----------
.. [1] https://mavlink.io/en/services/component_metadata.html
"""

import json
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
PARAMETER_PATH: Final = "/parameter.json"
TYPE_PARAMETER: Final = 1
"""COMP_METADATA_TYPE_PARAMETER."""


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
    parameters = _json({"version": 1, "parameters": described})
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
    described: dict[str, Any] = {
        "name": parameter.name,
        "type": "Float",
        "shortDesc": field.meaning.split(". ")[0].rstrip("."),
        "longDesc": f"{field.meaning} ({'.'.join((parameter.section, *parameter.path))})",
        "units": field.unit,
        "default": parameter.to_number(field.default),
        "group": group,
        "category": parameter.section,
    }
    low, high = field.bounds
    if field.choices:
        described["values"] = [
            {"value": number, "description": choice} for number, choice in enumerate(field.choices)
        ]
    elif isinstance(field.default, bool):
        described["values"] = [
            {"value": 0, "description": "off"},
            {"value": 1, "description": "on"},
        ]
    else:
        described |= {"min": low} if low is not None else {}
        described |= {"max": high} if high is not None else {}
        described["decimalPlaces"] = 0 if isinstance(field.default, int) else 4
    return described


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
