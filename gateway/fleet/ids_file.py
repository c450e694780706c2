"""The file that keeps which system id a vehicle of a site has here."""

import logging
from pathlib import Path

import msgspec

from gateway.edges.disk.worker import begin_worker, done_by
from gateway.fleet.id_map import LEFT_OUT, IdMap, Vehicle
from gateway.hub.endpoint import SITE_NAME
from gateway.output import write_new
from gateway.reasons import reason_of

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
        self.file = file
        """Where it is."""
        self.ids = IdMap(_read(file))
        self._kept = self.ids.version
        self._worker = begin_worker("ids")
        self._trouble = ""

    async def keep(self) -> str:
        """Write what has changed, and wait until the disk has it.

        Returns
        -------
        str
            Why the disk did not take it, also logged; empty if it did. The next call tries again.
        """
        version = self.ids.version
        if version != self._kept:
            reason = await done_by(self._worker, self._write, self._text())
            self._note(version, reason)
        return self._trouble

    def close(self) -> None:
        """Write what has changed, and end; waits for the disk."""
        self._worker.shutdown(wait=True)
        if self.ids.version != self._kept:
            self._note(self.ids.version, self._write(self._text()))

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

    def _note(self, version: int, reason: str) -> None:
        if not reason:
            self._kept = max(self._kept, version)
        elif reason != self._trouble:
            log.warning("%s: %s; new ids count only until the end", self.file, reason)
        self._trouble = reason


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
