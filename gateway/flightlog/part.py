"""What is gathered for the part of a recording that is being written."""

from typing import Final

from gateway.flightlog.stamps import Stamper

PENDING_LIMIT: Final = 16 << 20
"""Bytes that wait for a slow disk: minutes of telemetry. More is given up, not piled up."""
TLOG: Final = ".tlog"


class Part:
    """Bytes by the end of their file's name, gathered until they are taken to the disk.

    Parameters
    ----------
    session : str
        Name of the recording.
    number : int
        Which part of it, from 1.
    offset_us : int
        Civil time of gateway time zero, for as long as the part is written.
    """

    def __init__(self, session: str, number: int, offset_us: int) -> None:
        self.session = session
        self.number = number
        self.stamper = Stamper(offset_us)
        self.tables: set[int] = set()
        """Aircraft whose table has its head."""
        self.pending: dict[str, bytearray] = {}
        self.size = 0
        """Bytes that were given, those beyond the limit included."""

    def add(self, ending: str, data: bytes) -> None:
        """Gather bytes for one file, unless too many wait already."""
        if self.size < PENDING_LIMIT:
            self.pending.setdefault(ending, bytearray()).extend(data)
        self.size += len(data)

    def take(self) -> dict[str, bytes]:
        """Hand over what was gathered."""
        pending, self.pending, self.size = self.pending, {}, 0
        return {ending: bytes(data) for ending, data in pending.items()}


def table_ending(vehicle_id: int) -> str:
    """Name the end of an aircraft's table."""
    return f"_v{vehicle_id}.csv"
