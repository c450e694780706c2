"""What a vehicle keeps over a restart: its missions, its mark, and an operator's home.

One JSON text per aircraft. An unknown number is written as NaN, as Python and most readers do.
"""

import json
import math
from collections.abc import Iterator
from typing import Final, Literal

import msgspec

from gateway.vehicle.client_place import is_on_earth
from gateway.vehicle.home import Place
from gateway.vehicle.services.missions.mission_items import (
    ACCEPTED,
    FENCE,
    MAX_ITEMS,
    MISSION,
    RALLY,
    Item,
    check_item,
)

KINDS: Final = {MISSION: "mission", FENCE: "fence", RALLY: "rally"}


class StoredPlaces(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All places of one vehicle that are kept over a restart."""

    version: Literal[1] = 1
    home: Place | None = None
    """Where an operator set it; a home that the GPS measured is not kept."""
    mark: Place | None = None
    mark_of: int | None = None
    """MAV_MISSION_TYPE of the items that the mark follows; None if it was set by itself."""
    current: int = 0
    """Item of the mission."""
    mission: tuple[Item, ...] = ()
    fence: tuple[Item, ...] = ()
    rally: tuple[Item, ...] = ()


def encode_places(places: StoredPlaces) -> str:
    """Encode places as a text that `decode_places` reads back equal."""
    return json.dumps(msgspec.to_builtins(places), indent=1) + "\n"


def decode_places(text: str) -> StoredPlaces:
    """Read places.

    Parameters
    ----------
    text : str
        JSON of `encode_places`.

    Returns
    -------
    StoredPlaces

    Raises
    ------
    ValueError
        If it is not such a text, or holds what no ground station could have stored; the error says
        what.
    """
    try:
        places = msgspec.convert(json.loads(text), StoredPlaces)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ValueError(str(error)) from error
    fault = next(_faults(places), None)
    if fault is not None:
        raise ValueError(fault)
    return places


def _faults(places: StoredPlaces) -> Iterator[str]:
    for name, place in (("home", places.home), ("mark", places.mark)):
        if place is not None and not is_on_earth(place.lat_deg, place.lon_deg):
            yield f"{name}: no place on earth"
    if places.home is not None and not math.isfinite(places.home.alt_amsl_m):
        yield "home: its height is no number"
    for kind, name in KINDS.items():
        items = getattr(places, name)
        if len(items) > MAX_ITEMS[kind]:
            yield f"{name}: more than {MAX_ITEMS[kind]} items"
        for number, item in enumerate(items):
            if check_item(item, kind) != ACCEPTED:
                yield f"{name}: item {number} cannot be stored"
    if places.current not in range(max(1, len(places.mission))):
        yield f"current: there is no item {places.current}"
