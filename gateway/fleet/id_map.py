"""Which system id a vehicle of a site has here: two fields both have an aircraft 1."""

from collections import Counter
from collections.abc import Mapping
from typing import Final, NamedTuple

FIRST_ID: Final = 1
LAST_ID: Final = 249
"""From 250 on there are ground stations."""
MAX_WAITING: Final = 20_000
"""Vehicles without an id that are kept in mind: all of many sites."""
LEFT_OUT: Final = 0
"""In the place of an id: a vehicle that shall have none."""

Vehicle = tuple[str, int]
"""Site and system id there."""


class Handover(NamedTuple):
    """An id that another vehicle has from now on."""

    own_id: int
    former: Vehicle
    holder: Vehicle


class IdMap:
    """System ids given once and kept as long as there are enough.

    A vehicle keeps the id that it has at its site if nobody else has it here, else it gets the
    lowest that is free. No site gets more than are left for the others, so that one alone cannot
    use up all. Where none is left, `make_room` finds who has gone.

    Parameters
    ----------
    known : mapping
        Ids given before, by vehicle; `LEFT_OUT` for those that shall have none.
    """

    def __init__(self, known: Mapping[Vehicle, int] | None = None) -> None:
        self._ids: dict[Vehicle, int] = {}
        self._vehicles: dict[int, Vehicle] = {}
        self.version = 0
        """Counts the changes, so that the keeper knows when to write."""
        self.unmapped: set[Vehicle] = set()
        """Vehicles for which there is no id left."""
        self.left_out: set[Vehicle] = set()
        """Vehicles that shall have none."""
        for vehicle, own_id in (known or {}).items():
            if own_id == LEFT_OUT:
                self.left_out.add(vehicle)
            else:
                self._give(vehicle, own_id)

    def id_of(self, site: str, system_id: int) -> int | None:
        """Return the id of a vehicle here, giving it one if it is new; None if it has none."""
        vehicle = (site, system_id)
        own_id = self._ids.get(vehicle)
        if own_id is not None or not system_id:
            return own_id
        if vehicle in self.unmapped or vehicle in self.left_out:
            return None
        if self._shares()[site] >= LAST_ID - len(self._ids):
            if len(self.unmapped) < MAX_WAITING:
                self.unmapped.add(vehicle)
            return None
        wanted = [system_id, *range(FIRST_ID, LAST_ID + 1)]
        free: int = next(filter(self._is_free, wanted))
        self._give(vehicle, free)
        return free

    def make_room(self, heard_us: Mapping[Vehicle, int], silent_since_us: int) -> "Handover | None":
        """Give a vehicle that waits the id of one that was not heard for long.

        That is one of the same site, or of a site that has more ids. Who is heard keeps its id:
        ground stations would command another vehicle by it.

        Parameters
        ----------
        heard_us : mapping
            When vehicles were last heard; one that is not in it never was.
        silent_since_us : int
            Who was heard before is forgotten.

        Returns
        -------
        Handover, optional
            What was changed, if anything.
        """
        shares = self._shares()
        silent = [each for each in self._ids if heard_us.get(each, 0) < silent_since_us]
        silent.sort(key=lambda each: heard_us.get(each, 0))
        one_of_site = {each[0]: each for each in self.unmapped}
        for site in sorted(one_of_site, key=lambda each: shares[each]):
            for former in silent:
                if former[0] == site or shares[former[0]] > shares[site]:
                    own_id = self._ids.pop(former)
                    self._give(one_of_site[site], own_id)
                    return Handover(own_id, former, one_of_site[site])
        return None

    def known_id(self, site: str, system_id: int) -> int | None:
        """Return the id of a vehicle here, if it has one."""
        return self._ids.get((site, system_id))

    def vehicle_of(self, own_id: int) -> Vehicle | None:
        """Return whose id it is."""
        return self._vehicles.get(own_id)

    def set_by_hand(self, site: str, system_id: int, own_id: int) -> None:
        """Give a vehicle an id; whoever had it gets another, as far as there is one.

        Raises
        ------
        ValueError
            If it is none for a vehicle.
        """
        if not FIRST_ID <= own_id <= LAST_ID:
            raise ValueError(f"id {own_id} is not {FIRST_ID} to {LAST_ID}")
        holder = self._vehicles.get(own_id)
        if holder == (site, system_id):
            return
        former = self._ids.get((site, system_id))
        if former is not None:
            del self._vehicles[former]
        if holder is not None:
            del self._ids[holder]
        self._give((site, system_id), own_id)
        if holder is not None and former is not None:
            self._give(holder, former)
        elif holder is not None:
            self.id_of(*holder)

    def leave_out(self, site: str, system_id: int) -> None:
        """Take a vehicle's id away and give it none again; the next one that waits gets it."""
        vehicle = (site, system_id)
        own_id = self._ids.pop(vehicle, None)
        if own_id is not None:
            del self._vehicles[own_id]
        self.left_out.add(vehicle)
        # Whoever waits asks anew with its next frame.
        self.unmapped.clear()
        self.version += 1

    def items(self) -> list[tuple[Vehicle, int]]:
        """Return all vehicles with their ids in the order of these, first those left out."""
        out = [(vehicle, LEFT_OUT) for vehicle in sorted(self.left_out)]
        return out + sorted(self._ids.items(), key=lambda item: item[1])

    def _shares(self) -> Counter[str]:
        return Counter(site for site, _ in self._ids)

    def _is_free(self, own_id: int) -> bool:
        return FIRST_ID <= own_id <= LAST_ID and own_id not in self._vehicles

    def _give(self, vehicle: Vehicle, own_id: int) -> None:
        self._ids[vehicle] = own_id
        self._vehicles[own_id] = vehicle
        self.unmapped.discard(vehicle)
        self.left_out.discard(vehicle)
        self.version += 1
