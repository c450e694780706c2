"""Extensions of the gateway by other installed packages.

A package declares a function in its `pyproject.toml`:

    [project.entry-points."mavgate.extensions"]
    my-extension = "my_package:extend"

It is called once, without arguments, when a `mavgate` command starts that does more than send a
request to a running gateway, and adds to the registries; docs/extend.md shows how.
"""

import logging
from importlib import metadata
from typing import Final

from gateway.printable import UserError

log = logging.getLogger(__name__)

GROUP: Final = "mavgate.extensions"
SHIPPED: Final = metadata.EntryPoint("outputs", "gateway.outputs:extend", GROUP)
"""The endpoint kinds other than MAVLink, which are added like those of other packages."""


class ExtensionError(UserError):
    """An extension that cannot be used; the text states which one and the reason."""


def load_extensions() -> tuple[str, ...]:
    """Call the function of every installed extension, and return their names.

    Raises ExtensionError if one cannot be imported, or what it adds is rejected.
    """
    found = []
    for entry in (SHIPPED, *metadata.entry_points(group=GROUP)):
        try:
            entry.load()()
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ExtensionError(f"extension {entry.name} ({entry.value}): {error}") from error
        log.debug("extension %s", entry.name)
        found.append(entry.name)
    return tuple(found)
