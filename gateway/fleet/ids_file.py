"""The file that keeps which system id a vehicle of a site has here."""

import json
import logging
from pathlib import Path

import msgspec

from gateway.fleet.id_map import LEFT_OUT, IdMap, Vehicle
from gateway.routing.endpoint import SITE_NAME

log = logging.getLogger(__name__)


class IdsFile:
    """`{"SITE/SYSTEM": id, …}`, 0 for a vehicle that is left out.

    Parameters
    ----------
    file : Path
        Where it is; made when there is something to keep.

    Raises
    ------
    ValueError
        If what is there is none.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self.ids = IdMap(_read(file))
        self._kept = self.ids.version

    def keep(self) -> None:
        """Write what has changed; a disk that takes nothing is logged once."""
        if self._kept == self.ids.version:
            return
        table = {f"{site}/{system}": own_id for (site, system), own_id in self.ids.items()}
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            fresh = self._file.with_suffix(".new")
            fresh.write_text(json.dumps(table, indent=2) + "\n")
            fresh.replace(self._file)
        except OSError as error:
            log.warning("%s: %s; ids are kept only until the end", self._file, error.strerror)
        self._kept = self.ids.version


def _read(file: Path) -> dict[Vehicle, int]:
    try:
        table = msgspec.json.decode(file.read_bytes(), type=dict[str, int])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{file}: {error}") from error
    ids: dict[Vehicle, int] = {}
    for vehicle, own_id in table.items():
        site, _, system = vehicle.rpartition("/")
        if not SITE_NAME.fullmatch(site) or not system.isdecimal():
            raise ValueError(f"{file}: {vehicle!r} is not SITE/SYSTEM")
        if own_id != LEFT_OUT and own_id in ids.values():
            raise ValueError(f"{file}: id {own_id} is there twice")
        ids[site, int(system)] = own_id
    return ids
