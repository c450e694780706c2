"""One vehicle of a recording of any format and number of parts, for extracts and comparisons."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.answers.log_answers import LogAnswers
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import RecordedFile
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.recordings.workshop.convert import FlightToWrite
from gateway.recordings.workshop.extracts import RecordedPlan
from gateway.vehicle_state.senders import Senders
from gateway.wire.recorded_frames import Batch

NO_AUTOPILOT: Final = mavlink.MAV_AUTOPILOT_INVALID


class VehicleRecording:
    """The vehicle that `options` select in a recording, or the only one with an autopilot.

    Raises FlightError if there is no vehicle, or several to choose from; OSError if it cannot be
    read.
    """

    def __init__(self, recordings: Sequence[RecordedFile], options: ReadOptions) -> None:
        self.flight, path = FlightToWrite(recordings, options), recordings[0].path
        if not self.flight.has_messages:
            raise FlightError(f"{path}: is neither MAVLink nor the log of an autopilot")
        self.first_us = 0
        """Time of the first record; 0 before it is read."""
        self._answers = LogAnswers()
        senders = self.flight.senders
        chosen = options.system_id if self.flight.is_mavlink else None
        self.system_id = chosen or _only_vehicle(path, senders)

    def batches(self) -> Iterator[Batch]:
        """Yield the records of all senders; afterwards parameters and plans are known."""
        self._answers = LogAnswers()
        has_begun = False
        for batch in self.flight.chosen():
            if len(batch) and not has_begun:
                self.first_us, has_begun = int(batch.time_us[0]), True
            self._answers.add(batch, self.flight.senders)
            yield batch

    def messages(self, wanted: Iterable[int]) -> Iterator[VehicleMessage]:
        """Yield the positions and texts of the vehicle, and other messages given by id."""
        reader = self.reader(wanted)
        for batch in self.batches():
            yield from reader.feed_batch(batch)
        yield from reader.flush()

    def read(self) -> None:
        """Read all records, to find parameters and plans."""
        for _ in self.batches():
            pass

    def reader(self, wanted: Iterable[int]) -> VehicleReader:
        """Return a reader of the vehicle for `batches`."""
        return VehicleReader(self.flight.senders, wanted, self.system_id, with_attitude=False)

    def plan(self) -> RecordedPlan:
        """Return its parameters and plans at the end of the records read so far."""
        return RecordedPlan(self._answers, self.flight.senders.vehicle(self.system_id))


def _only_vehicle(path: Path, senders: Senders) -> int:
    systems = senders.systems()
    beats = {one: senders.vehicle(one).heartbeat for one in systems}
    piloted = [one for one, beat in beats.items() if beat and beat[1] != NO_AUTOPILOT]
    found = piloted or systems
    if not found:
        raise FlightError(f"{path}: contains no vehicle")
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise FlightError(f"{path}: several vehicles; choose one with --system: {listed}")
    return found[0]
