"""System ids of the vehicles of all sites, and the file that stores them.

Two sites may both have an aircraft 1, so each vehicle gets a unique system id in the fleet.
"""

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from gateway.hub.endpoint import SITE_NAME
from gateway.live.kept_files import begin_worker, done_by
from gateway.output import write_new
from gateway.printable import reason_of

log = logging.getLogger(__name__)

FIRST_ID: Final = 1
LAST_ID: Final = 249
"""Largest id of a vehicle; those from 250 on are of ground stations."""
MAX_WAITING: Final = 4096
"""Maximum listed vehicles without an id."""
LEFT_OUT: Final = 0
"""Value instead of an id for an excluded vehicle."""


class SiteVehicle(NamedTuple):
    """A vehicle by its site, and its system id there."""

    site: str
    system_id: int


class Handover(NamedTuple):
    """An id that was reassigned to another vehicle."""

    own_id: int
    former: SiteVehicle
    holder: SiteVehicle


class IdMap:
    """System ids, each assigned once and kept as long as there are enough.

    A vehicle keeps the id that it has at its site if that is free here, else it gets the lowest
    free one. No site gets more than `per_site`, nor do all sites of one client together; and none
    gets more than are left for the others. When none is left, `make_room` finds a vehicle that is
    no longer received.
    """

    def __init__(
        self, known: Mapping[SiteVehicle, int] | None = None, per_site: int = LAST_ID
    ) -> None:
        self._per_site = per_site
        self._ids: dict[SiteVehicle, int] = {}
        self._vehicles: dict[int, SiteVehicle] = {}
        self.version = 0
        """Number of changes, so that the file is written only after one."""
        self.unmapped: set[SiteVehicle] = set()
        """Vehicles for which no id is left."""
        self.left_out: set[SiteVehicle] = set()
        """Vehicles excluded by the operator."""
        self.clients: dict[str, str] = {}
        """Client of each site, if known; otherwise each site counts as a separate client."""
        for vehicle, own_id in (known or {}).items():
            if own_id == LEFT_OUT:
                self.left_out.add(vehicle)
            else:
                self._give(vehicle, own_id)

    def id_of(self, site: str, system_id: int) -> int | None:
        """Return the id of a vehicle here, assigning one to a new vehicle; None if it has none."""
        vehicle = SiteVehicle(site, system_id)
        own_id = self._ids.get(vehicle)
        if own_id is not None or not system_id:
            return own_id
        if vehicle in self.unmapped or vehicle in self.left_out:
            return None
        share = self._shares()[self._client_of(site)]
        if share >= self._per_site or share >= LAST_ID - len(self._ids):
            if len(self.unmapped) < MAX_WAITING:
                self.unmapped.add(vehicle)
            return None
        wanted = [system_id, *range(FIRST_ID, LAST_ID + 1)]
        free: int = next(filter(self._is_free, wanted))
        self._give(vehicle, free)
        return free

    def make_room(
        self, received_us: Mapping[SiteVehicle, int], idle_since_us: int
    ) -> "Handover | None":
        """Reassign an id of a vehicle that is no longer received to one that waits for an id.

        The former vehicle is of the same site, or of a site that has more ids. A vehicle that is
        received keeps its id: otherwise ground stations would command another vehicle by it.
        """
        shares = self._shares()
        idle = [each for each in self._ids if received_us.get(each, 0) < idle_since_us]
        idle.sort(key=lambda each: received_us.get(each, 0))
        one_of_site = {each.site: each for each in self.unmapped}
        for site in sorted(one_of_site, key=lambda each: shares[self._client_of(each)]):
            share = shares[self._client_of(site)]
            for former in idle:
                client = self._client_of(former.site)
                may_grow = share < self._per_site and shares[client] > share
                if client == self._client_of(site) or may_grow:
                    own_id = self._ids.pop(former)
                    self._give(one_of_site[site], own_id)
                    return Handover(own_id, former, one_of_site[site])
        return None

    def set_client(self, site: str, client: str) -> None:
        """Set the client whose quota a site shares; waiting vehicles get ids with later frames."""
        if self.clients.get(site) != client:
            self.clients[site] = client
            self.unmapped.clear()

    def known_id(self, site: str, system_id: int) -> int | None:
        """Return the id of a vehicle here, if it has one."""
        return self._ids.get(SiteVehicle(site, system_id))

    def vehicle_of(self, own_id: int) -> SiteVehicle | None:
        """Return the vehicle that has an id."""
        return self._vehicles.get(own_id)

    def set_by_hand(self, site: str, system_id: int, own_id: int) -> None:
        """Assign an id; its former holder gets another, if one is free. Raises ValueError."""
        if not FIRST_ID <= own_id <= LAST_ID:
            raise ValueError(f"id {own_id} is not {FIRST_ID} to {LAST_ID}")
        holder, vehicle = self._vehicles.get(own_id), SiteVehicle(site, system_id)
        if holder == vehicle:
            return
        former = self._ids.get(vehicle)
        if former is not None:
            del self._vehicles[former]
        if holder is not None:
            del self._ids[holder]
        self._give(vehicle, own_id)
        if holder is not None and former is not None:
            self._give(holder, former)
        elif holder is not None:
            self.id_of(*holder)

    def leave_out(self, site: str, system_id: int) -> None:
        """Exclude a vehicle permanently; the next waiting one gets its id."""
        vehicle = SiteVehicle(site, system_id)
        own_id = self._ids.pop(vehicle, None)
        if own_id is not None:
            del self._vehicles[own_id]
        self.left_out.add(vehicle)
        # A waiting vehicle gets its id with its next frame.
        self.unmapped.clear()
        self.version += 1

    def items(self) -> list[tuple[SiteVehicle, int]]:
        """Return all vehicles in the order of their ids, excluded ones first."""
        out = [(vehicle, LEFT_OUT) for vehicle in sorted(self.left_out)]
        return out + sorted(self._ids.items(), key=lambda item: item[1])

    def _shares(self) -> Counter[str]:
        return Counter(self._client_of(each.site) for each in self._ids)

    def _client_of(self, site: str) -> str:
        return self.clients.get(site, site)

    def _is_free(self, own_id: int) -> bool:
        return FIRST_ID <= own_id <= LAST_ID and own_id not in self._vehicles

    def _give(self, vehicle: SiteVehicle, own_id: int) -> None:
        self._ids[vehicle] = own_id
        self._vehicles[own_id] = vehicle
        self.unmapped.discard(vehicle)
        self.left_out.discard(vehicle)
        self.version += 1


class IdsFile:
    """The file of the ids, `{"SITE/SYSTEM": id, …}`; 0 for an excluded vehicle.

    Raises ValueError if it is malformed.
    """

    def __init__(self, file: Path, per_site: int = LAST_ID) -> None:
        self.file = file
        """Path of the file."""
        self.ids = IdMap(_read(file), per_site)
        self._kept = self.ids.version
        self._worker = begin_worker("ids")
        self._trouble = ""

    async def keep(self) -> str:
        """Write changed ids to the disk; return the reason of a failure, which is also logged."""
        version = self.ids.version
        if version != self._kept:
            reason = await done_by(self._worker, self._write, self._text())
            self._record(version, reason)
        return self._trouble

    def close(self) -> None:
        """Write changed ids, and end; waits for the disk."""
        self._worker.shutdown(wait=True)
        if self.ids.version != self._kept:
            self._record(self.ids.version, self._write(self._text()))

    def _text(self) -> bytes:
        table = {f"{site}/{system}": own_id for (site, system), own_id in self.ids.items()}
        return msgspec.json.format(msgspec.json.encode(table)) + b"\n"

    def _write(self, text: bytes) -> str:
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            write_new(self.file, [text], overwrite=True)
        except OSError as error:
            return reason_of(error)
        return ""

    def _record(self, version: int, reason: str) -> None:
        if not reason:
            self._kept = max(self._kept, version)
        elif reason != self._trouble:
            log.warning("%s: %s; new ids are lost when the fleet ends", self.file, reason)
        self._trouble = reason


def _read(file: Path) -> dict[SiteVehicle, int]:
    try:
        table = msgspec.json.decode(file.read_bytes(), type=dict[str, int])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{file}: {error}") from error
    ids: dict[SiteVehicle, int] = {}
    for vehicle, own_id in table.items():
        site, _, system = vehicle.rpartition("/")
        if not SITE_NAME.fullmatch(site) or not system.isdecimal():
            raise ValueError(f"{file}: {vehicle!r} is not SITE/SYSTEM")
        if own_id != LEFT_OUT and own_id in ids.values():
            raise ValueError(f"{file}: id {own_id} is there twice")
        ids[SiteVehicle(site, int(system))] = own_id
    return ids
