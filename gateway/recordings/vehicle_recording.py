"""One vehicle of a recording of any format and number of parts, for extracts and comparisons."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.answers import LogAnswers
from gateway.recordings.convert import FlightToWrite
from gateway.recordings.extracts import RecordedPlan
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.senders import Senders
from gateway.recordings.tlog import Batch
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader


class VehicleRecording:
    """The vehicle of a recording that `options` choose, or the only one with an autopilot.

    Raises FlightError if it holds no vehicle, or several to choose from; OSError if it cannot be
    read.
    """

    def __init__(self, files: Sequence[Path], options: ReadOptions) -> None:
        self.flight = FlightToWrite(files, options)
        if not self.flight.has_messages:
            raise FlightError(f"{files[0]}: is neither MAVLink nor the log of an autopilot")
        self.first_us = 0
        """Time of the first record, once it was read."""
        self._answers = LogAnswers()
        # Those of the flight must be complete or empty.
        self._senders = self.flight.senders if self.flight.is_mavlink else Senders()
        self._batches: Iterator[Batch] | None = self.flight.chosen()
        self.system_id = options.system_id
        if self.flight.is_mavlink and self.system_id is None:
            self.system_id = _only_vehicle(files, self.flight.senders)

    def batches(self) -> Iterator[Batch]:
        """Yield the records, of all senders; parameters and plans are known after that."""
        batches, self._batches = self._batches or self.flight.chosen(), None
        self._answers = LogAnswers()
        self.first_us = 0
        for batch in batches:
            self.first_us = self.first_us or (int(batch.time_us[0]) if len(batch) else 0)
            if not self.flight.is_mavlink:
                self._senders.add(batch)
            self._answers.add(batch, self._senders)
            yield batch

    def messages(self, wanted: Iterable[int]) -> Iterator[VehicleMessage]:
        """Yield the positions and texts of the vehicle, and other messages by id."""
        reader = self.reader(wanted)
        for batch in self.batches():
            yield from reader.feed_batch(batch)
        yield from reader.flush()

    def read(self) -> None:
        """Read all, for its parameters and plans."""
        for _ in self.batches():
            pass

    def reader(self, wanted: Iterable[int]) -> VehicleReader:
        """Return a reader of the vehicle for `batches`."""
        return VehicleReader(self.flight.senders, wanted, self.system_id, with_attitude=False)

    def plan(self) -> RecordedPlan:
        """Return its parameters and plans at the end of what was read."""
        system_id = self.system_id or next(iter(self._senders.systems()), 1)
        return RecordedPlan(self._answers, self._senders.vehicle(system_id))


def _only_vehicle(files: Sequence[Path], senders: Senders) -> int:
    systems = senders.systems()
    piloted = [one for one in systems if _has_autopilot(senders.vehicle(one).heartbeat)]
    found = piloted or systems
    if not found:
        raise FlightError(f"{files[0]}: no vehicle in it")
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise FlightError(f"{files[0]}: several vehicles; choose one with --system: {listed}")
    return found[0]


def _has_autopilot(heartbeat: tuple[int, int] | None) -> bool:
    return heartbeat is not None and heartbeat[1] != mavlink.MAV_AUTOPILOT_INVALID
